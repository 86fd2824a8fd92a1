"""Detectors beside each other on the same light: `background` and `mosaic`, with and without polarization.

``python scripts/compare_detectors.py [--flights embedded:51 … braunschweig:31]`` flies
(`scripts/record_flight.py`) and prints the table of docs/tracking.md: each
detector in each channel of the sensor as flown, the same with S1 = S2 = 0 in all light, and a sensor of the
same lens whose elements are all panchromatic. Nobody asks for spectra. `mosaic` is followed by the tracker of
the packaged case, `background` by the default one, which was tuned for it. As flown, both are followed by the
same tracker with a road map too, an erring one: each lane is 2 m off (RMS), and a tenth of them are missing.
A flight's seed draws its traffic, paints, trees and noise.
Scores are of frame 10 and later ones, before which the ground is still being learnt and tracks begin.
"""

import argparse
import csv
import sys
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import xarray as xr
from record_flight import Recording, recorded
from scipy import stats

from glintrack import metrics, track
from glintrack.case.design import Case
from glintrack.case.packaged import find_case

FLIGHTS = [
    *(f"embedded:{seed}" for seed in range(51, 56)),
    *(f"{city}:{seed}" for city in ("braunschweig", "berlin", "wildau") for seed in (31, 32, 33)),
]
CHANNELS = {"flown": ("pan", "dolp", "all"), "unpolarized": ("pan", "dolp", "all"), "pan": ("pan",)}
DETECTORS = ("background", "mosaic")
ROAD_RMS_M, ROADS_MISSING = 2.0, 0.1
SETTLED_FRAMES = 10
SCORES = ("completeness", "completeness_visible", "custody", "purity", "false_per_km2", "identity_switches")
COLUMNS = ("flight", "sensor", "channel", "detector", *SCORES, "ms_per_frame")
WHAT = (("flown", "pan", "pan"), ("flown", "dolp", "DoLP"), ("flown", "all", "all elements"),
        ("pan", "pan", "pan, all elements pan"))  # fmt: skip


def erring(lanes: tuple[np.ndarray, ...], seed: int) -> list[np.ndarray]:
    """Lanes as an old map has them."""
    rng = np.random.default_rng(seed)
    return [
        lane + rng.normal(0, ROAD_RMS_M / np.sqrt(2), 2) for lane in lanes if rng.random() > ROADS_MISSING
    ]


def settled(
    states: Iterable[track.TrackerState],
    truths: Sequence[xr.Dataset],
    area_m: tuple[float, float, float, float],
) -> dict[str, float]:
    """Scores of what is told, from frame `SETTLED_FRAMES` on."""
    scores = [
        metrics.score_epoch(tracks, truth, area_m, time_s=tracks.attrs["time_s"])
        for tracks, truth in zip(track.told_of(states), truths, strict=True)
    ]
    return metrics.summarize(scores[SETTLED_FRAMES:])


def score(recording: Recording, sensor: str, channel: str, detector: str) -> dict[str, dict[str, float]]:
    """One tracker over one flight; and, as flown, with an erring road map: by detector and map."""
    packaged = Case.from_toml(find_case(recording.case.name)).track
    design = (packaged if detector == "mosaic" else track.TrackDesign()).replace(
        {"query.policy": "none", "detect.detector": detector, "detect.channel": channel}
    )
    seed, area_m = recording.case.seed, recording.extent_m
    guided = track.start(design.replace({"roads.prior": True}), seed, erring(recording.lanes, seed))
    states, with_roads, spent_s = [], [], 0.0
    state = track.start(design, seed)
    for frame in recording.seen(sensor):
        began = time.process_time()
        state, _ = track.step(state, frame)
        spent_s += time.process_time() - began
        states.append(replace(state, memory=None))
        if sensor == "flown" and state.grid is not None:
            guided = track.step_detections(guided, track.detections(state), frame.time_s, state.grid)
            with_roads.append(guided)
    spent_ms = 1e3 * spent_s / len(states)
    out = {}
    for name, flown in ((detector, states), (f"{detector}, roads", with_roads)):
        if flown:
            found = settled(flown, recording.truths[-len(flown) :], area_m)
            out[name] = {**{key: found[key] for key in SCORES}, "ms_per_frame": spent_ms}
    return out


def rows_of(recording: Recording, flight: str, detectors: Sequence[str]) -> Iterator[dict[str, str | float]]:
    """Every tracker over one flight."""
    for sensor, channels in CHANNELS.items():
        for channel in channels:
            for detector in detectors:
                for name, found in score(recording, sensor, channel, detector).items():
                    named = {"flight": flight, "sensor": sensor, "channel": channel, "detector": name}
                    yield {**named, **found}


def print_table(rows: list[dict]) -> None:
    """Means over the flights of each city: `background` and `mosaic` beside each other, a row a channel.

    From three flights of a city on, half the 95 % interval stands beside completeness of the visible.
    """
    print(
        "| city | channel | `background`: of visible | false | `mosaic`: of visible | custody | purity "
        "| false | switches | with roads | false | S1 = S2 = 0 | false |"
    )
    print("|" + " --- |" * 13)
    for city in dict.fromkeys(str(row["flight"]).split(":")[0] for row in rows):
        mine = [row for row in rows if str(row["flight"]).startswith(city + ":")]
        for sensor, channel, title in WHAT:
            old, new, guided, blind = (
                [row for row in mine if (row["sensor"], row["channel"], row["detector"]) == (of, channel, by)]
                for of, by in (
                    (sensor, "background"), (sensor, "mosaic"), (sensor, "mosaic, roads"),
                    ("unpolarized" if sensor == "flown" else "", "mosaic"),
                )
            )  # fmt: skip
            held, false = _held(new)
            more = _mean(new, "custody"), _mean(new, "purity"), false, _mean(new, "identity_switches", 0)
            cells = *_held(old), held, *more, *_held(guided), *_held(blind)
            print(f"| {city} | {title} | " + " | ".join(cells) + " |")


def _mean(rows: Sequence[dict], name: str, digits: int = 3) -> str:
    return f"{np.mean([float(row[name]) for row in rows]):.{digits}f}" if rows else ""


def _held(rows: Sequence[dict]) -> tuple[str, str]:
    """Completeness of the visible, and false tracks per km²."""
    held = _mean(rows, "completeness_visible")
    if len(rows) > 2:
        half = stats.t.ppf(0.975, len(rows) - 1) * stats.sem([float(r["completeness_visible"]) for r in rows])
        held += f" ± {half:.3f}"
    return held, _mean(rows, "false_per_km2", 1)


def main() -> None:
    """Fly, track, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", nargs="+", default=FLIGHTS, help="NAME:SEED")
    parser.add_argument("--detectors", nargs="+", default=DETECTORS)
    parser.add_argument("--set", nargs="+", default=(), help="keys of the cases changed: KEY=VALUE in TOML")
    parser.add_argument("--csv", type=Path, help="write all rows here too")
    args = parser.parse_args()
    rows = []
    for flight in args.flights:
        drawn = f"scene.seed={flight.split(':')[1]}"
        for row in rows_of(recorded(flight, (drawn, *args.set)), flight, args.detectors):
            rows.append(row)
            print(row, file=sys.stderr, flush=True)
    if args.csv:
        with args.csv.open("w", newline="", encoding="utf-8") as file:
            writer = csv.DictWriter(file, COLUMNS)
            writer.writeheader()
            writer.writerows(rows)
    print_table(rows)


if __name__ == "__main__":
    main()
