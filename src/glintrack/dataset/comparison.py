"""Measure labelled frames, real or simulated, by the same numbers: image, detector and tracker.

Each number has Student's interval of 95 % from leaving parts out (jackknife). The parts are tiles of the grid
for images and false detections, vehicles for labels and tracks, and frames for registration.
"""

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.dataset.sequences import LabelledSequence, Matches, count_switches, match_positions
from glintrack.metrics.requirement import jackknife
from glintrack.metrics.sharpness import edge_rises, robust_sigma, temporal_noise
from glintrack.track.detect.footprint import footprints, window_means
from glintrack.track.detect.frame import Frame
from glintrack.track.detect.median_motion import CAP, FOOTPRINT_M, MedianMotionDetector, standardize_frames
from glintrack.track.files import FRAMES_DESIGN, as_rows, is_lasting, track_frames

TILES = 4  # along each side of the grid
NEAR_LABEL_PX = 2  # a label is good to 1.5 pixels
BODY_PX = 3  # reach of a vehicle's pixels from its label
BRIGHT_RATIO = 2.0  # of a change to the ground, from which a vehicle is bright
SAMPLE_STEP = 11  # of residuals: every so many pixels
SPEEDS_M_S = (1.0, 5.0, 12.0, np.inf)
CONTRASTS = (0.0, 1.5, 3.0, np.inf)
CUSTODY_S = 15.0
TRACK_COLUMNS = ["time_s", "track_id", "east_m", "north_m", "tentative"]


@dataclass(frozen=True)
class Measured:
    """A number and its interval."""

    name: str
    unit: str
    value: float
    low: float
    high: float

    @property
    def text(self) -> str:
        """Value and interval with 3 significant digits."""
        value, low, high = (f"{float(f'{v:.3g}'):,g}" for v in (self.value, self.low, self.high))
        return f"{value} ({low} to {high})"


@dataclass(frozen=True)
class DetectedFrames:
    """Results of the detector in a sequence, frame by frame.

    Parameters
    ----------
    rows
        Detections that are rather right than false: ``frame``, ``east_m``, ``north_m``.
    contrast
        Strength of the change at each label, bright or dark; NaN where the detector had no data. [σ]
    residual
        Sample of the changes against the background off all labels: ``part`` and ``size``. [σ]
    displacement_px
        Displacement of each frame against the background before the detector registers it. [pixel]
    """

    rows: pd.DataFrame
    contrast: Float[Array, "label"]
    residual: pd.DataFrame
    displacement_px: Float[Array, "frame"]


def measure(sequence: LabelledSequence, area: str) -> list[Measured]:
    """Measure sharpness, noise, contrast, residuals, detections and tracks of a sequence.

    Parameters
    ----------
    sequence
        Frames and labels; frames as from `ortho.stabilization`.
    area
        Name of the area whose labels and false positions count.
    """
    found = detect_frames(sequence)
    is_dark, is_bright = _is_on_dark_ground(sequence), _is_bright(sequence)
    labels = sequence.labels.assign(contrast=found.contrast, is_dark=is_dark, is_bright=is_bright)
    ready = replace(sequence, labels=labels[np.isfinite(found.contrast)])
    rows = tracks_of(sequence).query("lasting")
    detected, tracked = match_positions(ready, found.rows, area), match_positions(sequence, rows, area)
    displacement = pd.DataFrame({"part": np.arange(len(found.displacement_px)), "px": found.displacement_px})
    return [
        *_measure_images(sequence),
        *_quantiles("vehicle contrast", "σ", detected.labels, "contrast", (0.1, 0.5, 0.9), "vehicle_id"),
        *_quantiles("residual", "σ", found.residual, "size", (0.5, 0.9, 0.99, 0.999)),
        *_quantiles("registration residual", "px", displacement, "px", (0.5, 0.9)),
        *_measure_detections(sequence, detected, area),
        *_measure_tracks(sequence, tracked, area),
    ]


def comparison_table(measured: Mapping[str, Sequence[Measured]]) -> str:
    """Markdown table of the measurements of sequences by their names, with intervals."""
    lines = [["quantity", *measured], ["---"] * (len(measured) + 1)]
    for numbers in zip(*measured.values(), strict=True):
        first = numbers[0]
        unit = "" if first.unit == "1" else f" [{first.unit}]"
        lines.append([first.name + unit, *(one.text for one in numbers)])
    return "\n".join(f"| {' | '.join(line)} |" for line in lines)


def tracks_of(sequence: LabelledSequence) -> pd.DataFrame:
    """Tracks of ``glintrack track`` without settings, as from `frame_rows`, and those that it leaves out.

    ``lasting`` marks the rows of the former. With a lag of 0 all rows that are not ``tentative`` count.
    """
    rows = as_rows(track_frames(sequence.images(), FRAMES_DESIGN))
    table = frame_rows(rows, sequence.times_s)
    return table.assign(lasting=is_lasting(rows, float(sequence.times_s[-1])))


def frame_rows(rows: xr.Dataset, times_s: Float[Array, "frame"]) -> pd.DataFrame:
    """Table of the rows of `track.files.as_rows`, with the index of each row's frame."""
    table = pd.DataFrame({name: rows.get(name, np.empty(0)) for name in TRACK_COLUMNS})
    return table.assign(frame=np.searchsorted(times_s, table["time_s"] - 1e-6))


def detect_frames(sequence: LabelledSequence) -> DetectedFrames:
    """Run the detector of `FRAMES_DESIGN` over a sequence."""
    labels, gsd_m = sequence.labels, sequence.gsd_m
    cells = np.clip(sequence.cells(labels[["east_m", "north_m"]].to_numpy(float)), 0, None)
    windows, contrast = footprints(*FOOTPRINT_M, gsd_m), np.full(len(labels), np.nan)
    rows, residuals, displacement_px = list[pd.DataFrame](), list[pd.DataFrame](), list[float]()
    detector, state = MedianMotionDetector(FRAMES_DESIGN.detect), None
    for k, (time_s, image) in enumerate(sequence.images()):
        frame = Frame(time_s, image)
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        state = found.detail
        if k:
            displacement_px.append(float(np.hypot(*found.displacement_m)) / gsd_m)
        if len(state.past) < 3:
            continue
        east_m, north_m = found.position[found.contrast >= 1].T
        rows.append(pd.DataFrame({"frame": k, "track_id": 0, "east_m": east_m, "north_m": north_m}))
        (change,) = standardize_frames(state.past, "pan", gsd_m)
        here = np.flatnonzero(labels["frame"] == k)
        contrast[here] = _strengths(change, windows, cells[here])
        residuals.append(_sample_residual(change, cells[here]))
    residual = pd.concat(residuals, ignore_index=True)
    return DetectedFrames(pd.concat(rows, ignore_index=True), contrast, residual, np.array(displacement_px))


def _strengths(change: Float[Array, "y x"], windows, cells: Int[Array, "label 2"]) -> Float[Array, "label"]:
    """Greatest mean change under a vehicle's footprint next to each label; NaN off data. [σ]"""
    bounded = np.clip(np.nan_to_num(change), -CAP, CAP)
    layers = np.maximum(window_means(bounded, windows), window_means(-bounded, windows))
    reach = range(-NEAR_LABEL_PX, NEAR_LABEL_PX + 1)
    last = np.array(change.shape) - 1
    near = [np.clip(cells + (i, j), 0, last) for i in reach for j in reach]
    known = np.all([np.isfinite(change[tuple(at.T)]) for at in near], axis=0)
    return np.where(known, np.max([layers[tuple(at.T)] for at in near], axis=0), np.nan)


def _is_on_dark_ground(sequence: LabelledSequence) -> Bool[Array, "label"]:
    """Return True for labels whose pixel is, in the median of all frames, below the median of all pixels."""
    cells = sequence.cells(sequence.labels[["east_m", "north_m"]].to_numpy(float))
    row, column = np.clip(cells, 0, np.array(sequence.frames.shape[1:]) - 1).T
    known = sequence.frames[np.isfinite(sequence.frames)][::SAMPLE_STEP]
    return np.nanmedian(sequence.frames[:, row, column], axis=0) < np.median(known)


def _is_bright(sequence: LabelledSequence) -> Bool[Array, "label"]:
    """Return True for labels next to a change to brighter by more than `BRIGHT_RATIO` times their ground.

    The ground is the median of all frames.
    """
    cells = sequence.cells(sequence.labels[["east_m", "north_m"]].to_numpy(float))
    reach = np.arange(-BODY_PX, BODY_PX + 1)
    near = cells[:, None, None] + np.stack(np.meshgrid(reach, reach, indexing="ij"), axis=-1)
    row, column = np.moveaxis(np.clip(near, 0, np.array(sequence.frames.shape[1:]) - 1), -1, 0)
    median = np.nanmedian(sequence.frames[:, row, column], axis=0)
    now = sequence.frames[sequence.labels["frame"].to_numpy(int)[:, None, None], row, column]
    change = np.nan_to_num(now - median, nan=-np.inf).max(axis=(1, 2))
    return change > BRIGHT_RATIO * median[:, BODY_PX, BODY_PX]


def _sample_residual(change: Float[Array, "y x"], cells: Int[Array, "label 2"]) -> pd.DataFrame:
    """Sizes of some changes far from all labels, with their tiles."""
    place = np.argwhere(np.isfinite(change[::SAMPLE_STEP, ::SAMPLE_STEP])) * SAMPLE_STEP
    far = np.ones(len(place), bool)
    for cell in cells:
        far &= np.abs(place - cell).max(axis=1) > 4 * NEAR_LABEL_PX
    place = place[far]
    return pd.DataFrame({"part": _tile(place, change.shape), "size": np.abs(change[tuple(place.T)])})


def _tile(place: Float[Array, "n 2"] | Int[Array, "n 2"], shape: Sequence[int]) -> Int[Array, "n"]:
    """Index of the tile of each row and column."""
    row, column = np.clip((place * TILES / np.array(shape)).astype(int), 0, TILES - 1).T
    return row * TILES + column


def _measure_images(sequence: LabelledSequence) -> Iterator[Measured]:
    """Measure edge response and noise in a few frames."""
    shape, edges, noises = sequence.frames.shape[1:], list[pd.DataFrame](), list[pd.DataFrame]()
    known = sequence.frames[np.isfinite(sequence.frames)][::SAMPLE_STEP]
    span = float(np.subtract(*np.quantile(known, (0.99, 0.01))))
    for k in range(0, len(sequence.frames) - 1, 5):
        first, second = sequence.frames[k : k + 2]
        place, rise = edge_rises(np.nan_to_num(first, nan=float(np.median(known))))
        edges.append(pd.DataFrame({"part": _tile(place, shape), "px": rise}))
        noise = temporal_noise(first, second)
        place = np.argwhere(np.isfinite(noise))[::SAMPLE_STEP]
        size = 100 * noise[tuple(place.T)] / span
        noises.append(pd.DataFrame({"part": _tile(place, shape), "noise": size}))
    yield from _quantiles("edge rise, 10 % to 90 %", "px", pd.concat(edges), "px", (0.25, 0.5))
    name = "noise / range of 98 % of the pixels"
    yield _number(name, "%", pd.concat(noises), lambda of: robust_sigma(of["noise"].to_numpy()))


def _measure_detections(sequence: LabelledSequence, detected: Matches, area: str) -> Iterator[Measured]:
    """Probability of detection by speed and contrast, and density of false detections."""
    labels = detected.labels
    name = "probability of detection"
    yield _share(name, labels, "found")
    for text, column, edges in (("m/s", "speed_m_s", SPEEDS_M_S), ("σ contrast", "contrast", CONTRASTS)):
        for low, high in pairwise(edges):
            to = f"{low:g} to {high:g}" if np.isfinite(high) else f"from {low:g}"
            part = labels.take(np.flatnonzero((labels[column] >= low) & (labels[column] < high)))
            yield _share(f"{name}, {to} {text}", part, "found")
    yield _share("labels on ground darker than the median", labels, "is_dark")
    for text, is_dark in (("dark", True), ("bright", False)):
        part = labels.take(np.flatnonzero(labels["is_dark"] == is_dark))
        yield _share(f"{name}, {text} ground", part, "found")
    on_bright = labels.take(np.flatnonzero(~labels["is_dark"]))
    yield _share("bright vehicles among labels on bright ground", on_bright, "is_bright")
    seen = (sequence.areas[area] & np.isfinite(sequence.frames[2:])).sum(axis=0)
    yield _density("false detections in a frame", sequence, detected.false, seen)


def _measure_tracks(sequence: LabelledSequence, tracked: Matches, area: str) -> Iterator[Measured]:
    """F1, completeness, purity, custody, identity switches and false tracks."""
    labels = tracked.labels

    def f1(of: pd.DataFrame) -> float:  # false positions belong to no vehicle: in proportion
        return Matches(of, tracked.false.iloc[: round(len(tracked.false) * len(of) / len(labels))]).f1

    yield _number("F1", "1", labels, f1, "vehicle_id")
    yield _share("completeness", labels, "found")

    def purity(of: pd.DataFrame) -> float:
        return _count_most(of, "track_id", "vehicle_id") / max(np.count_nonzero(of["found"]), 1)

    def custody(of: pd.DataFrame) -> float:
        return _count_most(of, "vehicle_id", "track_id") / len(of)

    yield _number("purity", "1", labels, purity, "vehicle_id")
    yield _number("custody", "1", labels, custody, "vehicle_id")
    frames_of_custody = CUSTODY_S * (len(sequence.times_s) - 1) / float(np.ptp(sequence.times_s))

    def switches(of: pd.DataFrame) -> float:
        return count_switches(of) * frames_of_custody / max(np.count_nonzero(of["found"]), 1)

    name = f"identity switches of a vehicle in {CUSTODY_S:g} s"
    yield _number(name, "1", labels, switches, "vehicle_id")
    seen = sequence.areas[area] & np.isfinite(sequence.frames).any(axis=0)
    yield _density("false tracks", sequence, tracked.false_tracks, seen)


def _count_most(labels: pd.DataFrame, of: str, among: str) -> int:
    """Count the matches of each track or vehicle with its most frequent partner."""
    pairs = labels[[of, among]].to_numpy(int)[labels["found"].to_numpy(bool)]
    pairs, count = np.unique(pairs, axis=0, return_counts=True)
    return sum(int(count[pairs[:, 0] == one].max()) for one in np.unique(pairs[:, 0]))


def _density(name: str, sequence: LabelledSequence, rows: pd.DataFrame, seen: Array) -> Measured:
    """Positions per area of ground, which is counted in pixels. [km⁻²]"""
    shape = sequence.frames.shape[1:]
    place = np.argwhere(seen)
    km2 = np.bincount(_tile(place, shape), seen[tuple(place.T)], TILES**2) * sequence.gsd_m**2 * 1e-6
    tile = _tile(sequence.cells(rows[["east_m", "north_m"]].to_numpy(float)), shape)
    count, parts = np.bincount(tile, minlength=TILES**2), np.flatnonzero(km2)

    def density(chosen: Sequence[int]) -> float:
        index = parts[list(chosen)]
        return float(count[index].sum() / max(km2[index].sum(), 1e-12))

    return Measured(name, "km⁻²", *jackknife(density, len(parts)))


def _share(name: str, labels: pd.DataFrame, column: str) -> Measured:
    return _number(name, "1", labels, lambda of: float(of[column].to_numpy().mean()), "vehicle_id")


def _quantiles(
    name: str, unit: str, table: pd.DataFrame, column: str, shares: Sequence[float], by: str = "part"
) -> Iterator[Measured]:
    for share in shares:

        def quantile(of: pd.DataFrame, share: float = share) -> float:
            return float(np.quantile(of[column].to_numpy(), share))

        yield _number(f"{name}, {100 * share:g} % quantile", unit, table, quantile, by)


def _number(
    name: str, unit: str, table: pd.DataFrame, score: Callable[[pd.DataFrame], float], by: str = "part"
) -> Measured:
    """Score of a table, and its interval from leaving out each of its parts."""
    parts = list(table.groupby(by).indices.values())

    def of_parts(chosen: Sequence[int]) -> float:
        rows = np.concatenate([parts[k] for k in chosen]) if len(chosen) else np.empty(0, int)
        return float(score(table.iloc[rows])) if len(rows) else float("nan")

    return Measured(name, unit, *jackknife(of_parts, len(parts)))
