"""Compare classical change detectors with ours on the same flights, each with SORT, GNN and `mht`.

``python benchmarks/detectors.py [--flights embedded:51 braunschweig:31] [--json FILE]``. Each flight
is simulated once (`tools/record_flight.py`). All detectors see the same panchromatic frames and reported
poses: `mosaic` sees the raw mosaics, all others see the rectified frames. Differencing, three-frame
differencing, the median, GoDec and OpenCV's MOG2 use our registration and windows. Their thresholds, and the
least likelihood ratio with which a detection of `mosaic` counts in F1, give the best F1 of frames on
quickstart:11. Detections do not depend on the tracks. F1 is of single frames: a
moving vehicle of which a quarter is visible is found, and a detection with no vehicle near is false.
``value`` is the detector's processor time a frame.
"""

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.tracking import baseline
from glintrack import metrics, track
from glintrack.bounds.loss_budget import score_detections
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.track.detect import registration
from glintrack.track.detect.detections import of_boxes
from glintrack.track.detect.footprint import footprints, peak_places, peaks, window_means
from glintrack.track.detect.frame import grid_of, plane
from glintrack.track.detect.sliding_median import median_and_spread
from glintrack.track.files import as_rows
from tools.record_flight import Recording, record_flight

Found = list[track.Detections]


@dataclass(frozen=True)
class Classical:
    """Detector of peaks of the mean change under a vehicle's window.

    Parameters
    ----------
    change
        Change of the last frame of a stack (frame, y, x), in any unit.
    threshold
        Least mean change of a detection, in standard deviations of the frame.
    """

    change: Callable[[np.ndarray], np.ndarray]
    threshold: float

    def start(self, frame):
        """Return the empty window of frames."""
        return ()

    def detect(self, state, frame):
        """Find peaks; none in the first two frames."""
        values = plane(frame, "pan")
        values = np.where(values == 0, np.float32(np.nan), values)
        gsd = frame.grid.gsd_m
        if state:
            back = median_and_spread(np.stack(state[-6:]))[0]
            gain, offset = registration.gain_between(values, back)
            values = gain * values + np.float32(offset)
            values = registration.shift_image(values, registration.estimate_shifts(values, back, gsd))
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
        """Keep the latest frames."""
        return detections.detail[-9:]


def difference(stack: np.ndarray) -> np.ndarray:
    """Change against the previous frame."""
    return stack[-1] - stack[-2]


def three_frame(stack: np.ndarray) -> np.ndarray:
    """Smaller of the changes against the two previous frames."""
    return np.minimum(np.abs(stack[-1] - stack[-2]), np.abs(stack[-1] - stack[-3]))


def from_median(stack: np.ndarray) -> np.ndarray:
    """Change against the median of the window."""
    return stack[-1] - median_and_spread(stack)[0]


def godec(stack: np.ndarray, rank: int = 1, rounds: int = 4) -> np.ndarray:
    """Sparse part of the last frame by GoDec (Zhou and Tao, ICML 2011): low rank and sparse in turn."""
    missing = ~np.isfinite(stack).all(axis=0)
    x = np.nan_to_num(stack.reshape(len(stack), -1).astype(np.float64))
    sparse = np.zeros_like(x)
    for _ in range(rounds):
        vectors = np.linalg.eigh((x - sparse) @ (x - sparse).T)[1][:, -rank:]
        rest = x - vectors @ (vectors.T @ (x - sparse))
        sparse = np.where(np.abs(rest) > np.quantile(np.abs(rest[:, ::7]), 0.95), rest, 0.0)
    return np.where(missing, np.nan, rest[-1].reshape(stack.shape[1:]))


def mog2(stack: np.ndarray) -> np.ndarray:
    """Change against the background of OpenCV's mixture of Gaussians (Zivkovic, ICPR 2004)."""
    import cv2

    filled = np.nan_to_num(stack, nan=float(np.nanmedian(stack)))
    low, high = np.quantile(filled, (0.001, 0.999))
    grey = np.clip(255 * (filled - low) / (high - low), 0, 255).astype(np.uint8)
    model = cv2.createBackgroundSubtractorMOG2(detectShadows=False)
    for image in grey:
        model.apply(image)
    return np.where(np.isnan(stack[-1]), np.nan, grey[-1].astype(np.float32) - model.getBackgroundImage())


CLASSICAL = {
    "differencing": Classical(difference, 6.0), "three-frame": Classical(three_frame, 6.0),
    "median": Classical(from_median, 5.0), "GoDec": Classical(godec, 5.0), "MOG2": Classical(mog2, 5.0),
}  # fmt: skip
LIKELY_NAT = -1.0  # of `mosaic`, which reports weak detections too
SCORES = ("completeness_visible", "purity", "custody", "false_per_km2", "mota", "hota")


def detections_of(recording: Recording, detector: track.Detector) -> tuple[Found, float]:
    """Detect in each frame without a tracker; return detections and processor time per frame. [s]"""
    state, last_s, out, began = None, None, [], time.process_time()
    for frame in recording.frames:
        interval_s = 0.0 if last_s is None else frame.time_s - last_s
        frame = replace(frame, grid=grid_of(frame, None), interval_s=interval_s, channel="pan")
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        nobody = track.Association(np.zeros(len(found), bool))
        state, last_s = detector.update(state, frame, found, nobody), frame.time_s
        out.append(replace(found, detail=None))
    return out, (time.process_time() - began) / len(out)


def f1(recording: Recording, found: Found) -> float:
    """Score all frames together, with detections that reach the smallest likelihood ratio."""
    right = wrong = asked = 0
    for one, truth in zip(found, recording.truths, strict=True):
        ratio = one.log_likelihood_ratio
        kept = np.ones(len(one), bool) if ratio is None else ratio >= LIKELY_NAT
        should_be_found = metrics.is_moving(truth) & metrics.is_in_area(truth, recording.extent_m)
        should_be_found &= metrics.is_visible(truth)
        place = np.stack([truth["east_m"].values, truth["north_m"].values], axis=1)
        scored = score_detections(one.position[kept], one.contrast[kept], place, truth["length_m"].values)
        right += int((np.isfinite(scored.vehicle) & should_be_found).sum())
        wrong, asked = wrong + len(scored.false), asked + int(should_be_found.sum())
    return 2 * right / max(right + wrong + asked, 1)


def reports_of(recording: Recording, found: Found, tracker: str, design: track.TrackDesign) -> xr.Dataset:
    """Rows of the tracks that a tracker makes of detections."""
    times = [frame.time_s for frame in recording.frames]
    if tracker == "SORT":
        reports, _ = baseline()(list(zip(times, recording.truths, strict=True)), found)
        return as_rows(zip(times, reports, strict=True))
    state = track.start(design.replace({"association.method": tracker, "query.policy": "none"}))
    grid, flown = grid_of(recording.frames[0], None), []
    for time_s, one in zip(times, found, strict=True):
        state = track.step_detections(state, one, time_s, grid)
        flown.append(state)
    return as_rows(zip(times, track.report_epochs(flown), strict=True))


def truth_rows(recording: Recording) -> xr.Dataset:
    """Return the truth with one row per vehicle and frame."""
    parts = []
    for frame, truth in zip(recording.frames, recording.truths, strict=True):
        table = truth.to_dataframe().reset_index().rename(columns={"vehicle": "vehicle_id"})
        parts.append(table.assign(time_s=frame.time_s))
    columns = {name: np.concatenate([part[name].to_numpy() for part in parts]) for name in parts[0]}
    return xr.Dataset({name: ("row", values) for name, values in columns.items()})


def rows_of(recording: Recording, flight: str) -> Iterator[dict]:
    """Every detector with every tracker over one flight."""
    truth, packaged = truth_rows(recording), Case.from_toml(find_case(recording.case.name)).track
    ours = {name: make(track.TrackDesign().detect) for name, make in track.DETECTORS.items()}
    for name, detector in {**CLASSICAL, **ours}.items():
        found, seconds = detections_of(recording, detector)
        design = packaged if name == "mosaic" else track.TrackDesign()
        for tracker in ("SORT", "gnn", "mht"):
            tracks = reports_of(recording, found, tracker, design)
            scores = metrics.score_rows(tracks, truth, recording.extent_m)
            yield {
                "flight": flight, "name": f"{name}, {tracker}", "f1": f1(recording, found),
                **{key: scores[key] for key in SCORES}, "value": seconds, "unit": "s",
            }  # fmt: skip


def main() -> None:
    """Fly, detect, track, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flights", nargs="+", default=["embedded:51", "braunschweig:31"], help="NAME:SEED")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    rows = []
    for flight in arguments.flights:
        for row in rows_of(record_flight(flight), flight):
            rows.append(row)
            keys = ("f1", *SCORES, "value")
            print(f"{flight:16}{row['name']:20}", *(f"{row[key]:7.3f}" for key in keys), flush=True)
    if arguments.json:
        arguments.json.write_text(json.dumps(rows, indent=1))


if __name__ == "__main__":
    main()
