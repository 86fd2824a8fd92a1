"""Vehicles in a user's own rectified frames from near nadir: F1 of frames and of tracks, by detector.

``python benchmarks/near_nadir.py [--tune] [--cache DIR] [--json FILE]``. Scenes are near_nadir_scenes.py's:
painted ones, and flights of the simulator (rendered once into the cache, a minute or three each), 12 frames
at 1.25 Hz and 8 bits. ``--tune`` takes the scenes on which settings were chosen; the table in
docs/tracking.md is of the others. A place is right within max(4 m, L/2 + 1 m) of a vehicle that moves at 1
m/s or more and is at least a quarter visible, one to one; beside a vehicle that stands or is hidden it
counts neither way, and nothing within 4 m of the frame's edge counts. ``detections`` are those of each frame
alone, ``tracks`` what ``glintrack track`` writes, all frames from the first; ``six`` is the tracks' F1 when
there are but six frames. The plain methods (differencing, median, GoDec) have our registration and windows
and the threshold that is best on the tuning scenes; ``tracked alike`` has our tracker's settings for frames.
"""

import argparse
import json
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr
from near_nadir_scenes import EDGE_M, MOVING_M_S, Sequence, Wear, flown, painted
from scipy.optimize import linear_sum_assignment

from glintrack import metrics, track
from glintrack.io.orthoimages import Geotransform, image_of
from glintrack.track.detect import local_registration as registration
from glintrack.track.detect.detections import of_boxes
from glintrack.track.detect.footprint import footprints, peak_places, peaks, window_means
from glintrack.track.detect.frame import grid_of, plane
from glintrack.track.detect.sliding_median import median_and_spread
from glintrack.track.files import FRAMES_DESIGN, as_rows, track_frames

FRAMES, SIX = 12, 6
WORSE = Wear(shift_px=0.5, warp_px=0.3, gain=0.03, offset=0.02, noise=0.04)
FINE = Wear(shift_px=0.5, warp_px=0.3, blur_px=0.7, noise=0.03)
FLIGHT = {
    "channels": '["pan"]', "bound.every": 0, "output.film_frames": 0, "output.keep_frames": 16,
    "flight.frames": 16, "flight.rate_hz": 1.25, "flight.altitude_m": 3000, "flight.kind": "straight",
    "flight.speed_m_s": 40, "flight.viewpoint_s": 6, "sensor.layout": "pan", "sensor.pitch_um": 11.333333,
    "sensor.columns": 1320, "sensor.rows": 840, "ortho.gsd_m": 0.5, "track.query.policy": "none",
    "sensor.demosaic": "bilinear",
}  # fmt: skip


def scenes(tune: bool, cache: Path) -> Iterator[Sequence]:
    """Those for choosing settings, or those for reporting."""
    seed = 0 if tune else 100
    small = {"count": FRAMES, "size_m": 360.0}
    yield painted("painted, 1 m", seed + 1, **small)
    yield painted("painted, 1 m, tall and noisy", seed + 2, **small, tall_m=45.0, wear=WORSE)
    yield painted("painted, 0.5 m", seed + 3, gsd_m=0.5, count=FRAMES, size_m=240.0, wear=FINE)
    if tune:
        yield _flight(cache, "embedded11", "quickstart", 11, 3.0, 5.0, "flown, embedded city, 1 m")
        return
    yield _flight(cache, "braunschweig21", "braunschweig", 21, 3.0, 0.0, "flown, Braunschweig, 1 m")
    yield _flight(cache, "embedded31", "quickstart", 31, 2.0, 70.0, "flown, embedded city, 1 m")


def _flight(
    cache: Path, name: str, case: str, seed: int, off_nadir: float, start_s: float, label: str
) -> Sequence:
    folder = cache / name
    if not folder.is_dir():
        keys = FLIGHT | {
            "scene.seed": seed, "seed": seed, "flight.off_nadir_deg": off_nadir, "flight.start_s": start_s,
        }  # fmt: skip
        sets = [part for key, value in keys.items() for part in ("--set", f"{key}={value}")]
        command = [sys.executable, "-m", "glintrack", "run", case, "-o", str(folder), *sets]
        subprocess.run(command, check=True, stdout=subprocess.DEVNULL)
    return replace(flown(folder, 2, Wear(), seed, FRAMES), name=label)


def frames_of(scene: Sequence, count: int | None = None) -> Iterator[tuple[float, xr.Dataset]]:
    """Time and image of each frame, as the command reads them."""
    for time_s, counts in zip(scene.times_s[:count], scene.frames[:count], strict=True):
        image = image_of({"pan": counts.astype(np.float32)}, Geotransform(0.0, 0.0, scene.gsd_m))
        yield float(time_s), image


@dataclass(frozen=True)
class Plain:
    """Peaks of the mean change under a vehicle's window, over a threshold in the frame's own deviations."""

    change: Callable[[np.ndarray], np.ndarray]
    threshold: float

    def start(self, frame):
        """No frames yet."""
        return ()

    def detect(self, state, frame):
        """Peaks; none in the first two frames."""
        values = plane(frame, "pan")
        values = np.where(values == 0, np.float32(np.nan), values)
        gsd = frame.grid.gsd_m
        if state:
            back = median_and_spread(np.stack(state[-6:]))[0]
            gain, offset = registration.gain_between(values, back)
            values = gain * values + np.float32(offset)
            values = registration.shift_locally(values, *registration.displacement(values, back, gsd))
        past = (*state, values)
        if len(past) < 3:
            return replace(of_boxes(np.empty((0, 4)), 0.7), detail=past)
        rest = np.abs(np.nan_to_num(self.change(np.stack(past)).astype(np.float32)))
        rest = np.minimum(rest / max(1.4826 * np.median(rest[rest > 0]), 1e-6), 8.0)
        means = window_means(rest, footprints(4.6, 2.6, gsd))
        cell = peaks(means, self.threshold, 3.0, gsd)
        at = peak_places(means, cell, max(1, round(2 / gsd)))
        (west, north), half = frame.grid.corner_m, 2.0
        east, north = west + gsd * at[:, 1], north - gsd * at[:, 0]
        box = np.stack([east - half, north - half, east + half, north + half], axis=-1)
        return replace(of_boxes(box, 0.7, means[tuple(cell.T)] / self.threshold), detail=past)

    def update(self, state, frame, detections, association):
        """The latest frames."""
        return detections.detail[-9:]


def difference(stack: np.ndarray) -> np.ndarray:
    """Change against the frame before."""
    return stack[-1] - stack[-2]


def from_median(stack: np.ndarray) -> np.ndarray:
    """Change against the median of the window."""
    return stack[-1] - median_and_spread(stack)[0]


def godec(stack: np.ndarray, rank: int = 1, rounds: int = 4) -> np.ndarray:
    """The last frame's sparse part by GoDec (Zhou and Tao, ICML 2011): low rank and sparse in turn."""
    missing = ~np.isfinite(stack).all(axis=0)
    x = np.nan_to_num(stack.reshape(len(stack), -1).astype(np.float64))
    sparse = np.zeros_like(x)
    for _ in range(rounds):
        vectors = np.linalg.eigh((x - sparse) @ (x - sparse).T)[1][:, -rank:]
        rest = x - vectors @ (vectors.T @ (x - sparse))
        sparse = np.where(np.abs(rest) > np.quantile(np.abs(rest[:, ::7]), 0.95), rest, 0.0)
    return np.where(missing, np.nan, rest[-1].reshape(stack.shape[1:]))


# a detector of our own by name with the design that flies it, or a plain one with its threshold
METHODS: dict[str, Plain | str] = {
    "differencing": Plain(difference, 5.0),
    "median": Plain(from_median, 5.5),
    "GoDec": Plain(godec, 5.25),
    "`mog2`": "mog2",
    "`three-frame`": "three-frame",
    "`background`": "background",
    "`background`, tracked alike": "background",
    "`median-motion`": "median-motion",
}


def detections_of(scene: Sequence, method: Plain | str) -> tuple[list[np.ndarray], list[np.ndarray], float]:
    """Places and contrasts in each frame with nothing tracked, and processor time a frame. [s]"""
    detector = track.DETECTORS[method](FRAMES_DESIGN.detect) if isinstance(method, str) else method
    state, places, strengths, last = None, [], [], None
    start = time.process_time()
    for time_s, image in frames_of(scene):
        frame = track.Frame(time_s, image, interval_s=0.0 if last is None else time_s - last)
        frame, last = replace(frame, grid=grid_of(frame, None)), time_s
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        nobody = track.Association(np.zeros(len(found), bool), np.empty((0, 2)))
        state = detector.update(state, frame, found, nobody)
        places.append(found.position)
        strengths.append(found.contrast)
    return places, strengths, (time.process_time() - start) / len(places)


def tracks_of(scene: Sequence, method: Plain | str, alike: bool, count: int | None = None) -> xr.Dataset:
    """Rows of tracks, by the settings of `FRAMES_DESIGN` or by the default ones."""
    if alike:
        return as_rows(
            track_frames(frames_of(scene, count), FRAMES_DESIGN.replace({"detect.detector": method}))
        )
    if isinstance(method, str):
        design = track.TrackDesign().replace({"detect.detector": method})
        return as_rows(track_frames(frames_of(scene, count), design))
    state, reports = track.start(detector=method), []
    for time_s, image in frames_of(scene, count):
        state, _ = track.step(state, track.Frame(time_s, image))
        reports.append((time_s, track.report(state)))
    return as_rows(reports)


def right_and_wrong(scene: Sequence, k: int, places: np.ndarray) -> tuple[int, int, int]:
    """Right and false places in a frame, and vehicles asked for."""
    height, width = (n * scene.gsd_m for n in scene.frames.shape[1:])

    def inside(east, north):
        return (east > EDGE_M) & (east < width - EDGE_M) & (north < -EDGE_M) & (north > EDGE_M - height)

    truth = scene.truth[np.isclose(scene.truth["time_s"], scene.times_s[k])]
    east, north = truth["east_m"].to_numpy(), truth["north_m"].to_numpy()
    speed = np.hypot(truth["east_speed_m_s"], truth["north_speed_m_s"]).to_numpy()
    asked = inside(east, north) & (speed >= MOVING_M_S) & (truth["visible_fraction"].to_numpy() >= 0.25)
    places = places[inside(*places.T)]
    limit = np.maximum(4.0, truth["length_m"].to_numpy() / 2 + 1)
    distance = np.hypot(places[:, :1] - east, places[:, 1:] - north)
    near = distance <= limit
    cost = np.where(near[:, asked], distance[:, asked], 1e3)
    rows, columns = linear_sum_assignment(cost)
    hit = cost[rows, columns] < 1e3
    lone = np.ones(len(places), bool)
    lone[rows[hit]] = False
    return int(hit.sum()), int((lone & ~near[:, ~asked].any(axis=1)).sum()), int(asked.sum())


def f1(scene: Sequence, places: list[np.ndarray]) -> float:
    """Of all frames together."""
    right, wrong, asked = np.sum([right_and_wrong(scene, k, p) for k, p in enumerate(places)], axis=0)
    return float(2 * right / max(right + wrong + asked, 1))


def places_of(scene: Sequence, rows: xr.Dataset, count: int) -> list[np.ndarray]:
    """Tracks' places in each frame."""
    if "time_s" not in rows:
        return [np.empty((0, 2))] * count
    here = np.stack([rows["east"].values, rows["north"].values], axis=-1)
    return [here[np.isclose(rows["time_s"].values, t)] for t in scene.times_s[:count]]


def row(scene: Sequence, name: str, method: Plain | str) -> dict:
    """All scores of a method on a scene."""
    places, contrasts, seconds = detections_of(scene, method)
    alike = method == "median-motion" or "alike" in name
    rows = tracks_of(scene, method, alike)
    six = tracks_of(scene, method, alike, SIX)
    height, width = (n * scene.gsd_m for n in scene.frames.shape[1:])
    area = (EDGE_M, EDGE_M - height, width - EDGE_M, -EDGE_M)
    truth = {
        "east": "east_m",
        "north": "north_m",
        "east_speed": "east_speed_m_s",
        "north_speed": "north_speed_m_s",
    }
    columns = {k: ("row", scene.truth[v].to_numpy()) for k, v in truth.items()}
    columns |= {n: ("row", scene.truth[n].to_numpy()) for n in ("time_s", "vehicle_id", "visible_fraction")}
    scores = metrics.score_rows(rows, xr.Dataset(columns), area)
    return {
        "scene": scene.name, "name": name,
        "detections": f1(scene, [p[c >= 1] for p, c in zip(places, contrasts, strict=True)]),
        "tracks": f1(scene, places_of(scene, rows, len(scene.times_s))),
        "six": f1(scene, places_of(scene, six, SIX)),
        **{k: scores[k] for k in ("completeness_visible", "purity", "custody")},
        "value": seconds, "unit": "s",
    }  # fmt: skip


def main() -> None:
    """Run, print and perhaps write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--tune", action="store_true", help="the scenes for choosing settings")
    parser.add_argument("--cache", type=Path, default=Path("/tmp/near-nadir"), help="folder of the flights")
    parser.add_argument("--only", nargs="*", help="methods")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    rows = []
    for scene in scenes(arguments.tune, arguments.cache):
        for name, method in METHODS.items():
            if arguments.only is None or name.strip("`") in arguments.only:
                rows.append(row(scene, name, method))
                keys = ("detections", "tracks", "six", "completeness_visible", "purity", "custody", "value")
                print(f"{scene.name:32}{name:18}", *(f"{rows[-1][key]:7.3f}" for key in keys), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
