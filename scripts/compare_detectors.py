"""Detectors beside each other on the same light: `background` and `mosaic`, with and without polarization.

``python scripts/compare_detectors.py [--flights quickstart:31 quickstart:32 braunschweig:31]`` flies
(`scripts/record_flight.py`) and prints the table of docs/tracking.md: each
detector in each channel of the sensor as flown, the same with S1 = S2 = 0 in all light, and a sensor of the
same lens whose elements are all panchromatic. Nobody asks for spectra. `mosaic` is followed by the tracker of
the packaged case, `background` by the default one, which was tuned for it.
"""

import argparse
import csv
import sys
import time
from collections.abc import Iterator
from pathlib import Path

from record_flight import Recording, recorded

from glintrack import metrics, track
from glintrack.config import Case, find_case

CHANNELS = {"flown": ("pan", "dolp", "all"), "unpolarized": ("pan", "dolp", "all"), "pan": ("pan",)}
DETECTORS = ("background", "mosaic")
SCORES = ("completeness", "completeness_visible", "custody", "purity", "false_per_km2", "identity_switches")
COLUMNS = ("flight", "sensor", "channel", "detector", *SCORES, "ms_per_frame")
TITLES = {"flown": "as flown", "unpolarized": "S1 = S2 = 0", "pan": "all elements pan"}


def score(recording: Recording, sensor: str, channel: str, detector: str) -> dict[str, float]:
    """One tracker over one flight."""
    packaged = Case.from_toml(find_case(recording.case.name)).track
    design = (packaged if detector == "mosaic" else track.TrackDesign()).replace(
        {"query.policy": "none", "detect.detector": detector, "detect.channel": channel}
    )
    state, scores, began = track.start(design, recording.case.seed), [], time.process_time()
    for frame, truth in zip(recording.seen(sensor), recording.truths, strict=True):
        state, _ = track.step(state, frame)
        area_m = recording.extent_m
        scores.append(metrics.score_epoch(track.report(state), truth, area_m, time_s=frame.time_s))
    spent_ms = 1e3 * (time.process_time() - began) / len(scores)
    found = metrics.summarize(scores)
    return {**{name: found[name] for name in SCORES}, "ms_per_frame": spent_ms}


def rows_of(recording: Recording, flight: str) -> Iterator[dict[str, str | float]]:
    """Every tracker over one flight."""
    for sensor, channels in CHANNELS.items():
        for channel in channels:
            for detector in DETECTORS:
                named = {"flight": flight, "sensor": sensor, "channel": channel, "detector": detector}
                yield {**named, **score(recording, sensor, channel, detector)}


def print_table(rows: list[dict]) -> None:
    """Means over the flights of each city, one line a sensor, channel and detector."""
    print("| city | light and sensor | channel | detector | completeness | of visible | custody | purity "
          "| false per km² | switches |")  # fmt: skip
    print("|" + " --- |" * 10)
    cities = sorted({str(row["flight"]).split(":")[0] for row in rows}, reverse=True)
    keys = [(s, c, d) for s, channels in CHANNELS.items() for c in channels for d in DETECTORS]
    for city in cities:
        for sensor, channel, detector in keys:
            mine = [
                row for row in rows
                if str(row["flight"]).startswith(city + ":")
                and (row["sensor"], row["channel"], row["detector"]) == (sensor, channel, detector)
            ]  # fmt: skip
            if not mine:
                continue
            mean = {name: sum(float(row[name]) for row in mine) / len(mine) for name in SCORES}
            cells = [f"{mean[name]:.3f}" for name in SCORES[:4]]
            cells += [f"{mean['false_per_km2']:.1f}", f"{mean['identity_switches']:.0f}"]
            print(f"| {city} | {TITLES[sensor]} | {channel} | `{detector}` | " + " | ".join(cells) + " |")


def main() -> None:
    """Fly, track, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    flights = ["quickstart:31", "quickstart:32", "braunschweig:31"]
    parser.add_argument("--flights", nargs="+", default=flights, help="CASE:SEED")
    parser.add_argument("--csv", type=Path, help="write all rows here too")
    args = parser.parse_args()
    rows = []
    for flight in args.flights:
        for row in rows_of(recorded(flight), flight):
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
