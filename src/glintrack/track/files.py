"""Track a user's own detections or rectified frames, without a simulation."""

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.core.installation import read_data
from glintrack.core.records import Extent, Rows
from glintrack.io.detections import DetectionTable
from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.frame import Frame, Grid
from glintrack.track.reporting import History, report, report_history
from glintrack.track.tracker import start, step, step_detections

CLUTTER_CELL_M = 15.0
MAX_CELLS = 400  # along a side of the area: memory stays small for any coordinates
MARGIN_M = 50.0  # beyond the outermost detections
_ROUNDING_S = 1e-6

MIN_FRAMES = 3  # of the detector of `FRAMES_DESIGN`
MIN_DURATION_S = 1.5  # of a track in frames: the lag after which its first position is final

_KEYS = read_data("tracking.toml")
DETECTIONS_DESIGN = TrackDesign().replace(_KEYS["detections"])
RECTIFIED_DESIGN = TrackDesign().replace(_KEYS["rectified"])
FRAMES_DESIGN = RECTIFIED_DESIGN.replace(_KEYS["frames"])


def frames_design(changes: Mapping[str, object]) -> TrackDesign:
    """`FRAMES_DESIGN` with changes, or `RECTIFIED_DESIGN` with them if they name another detector."""
    own = FRAMES_DESIGN.detect.detector
    base = FRAMES_DESIGN if changes.get("detect.detector", own) == own else RECTIFIED_DESIGN
    return base.replace(dict(changes))


def strict_design(design: TrackDesign) -> TrackDesign:
    """Return a design that reports only measured tracks and deletes early: purer tracks of fewer vehicles."""
    return design.replace(
        {"initiation.coast_s": min(design.initiation.coast_s, 1.0), "reporting.coasted": False}
    )


@dataclass(frozen=True)
class TrackedRows:
    """Tracks of a whole recording.

    Parameters
    ----------
    rows
        One row per confirmed track and epoch; coasted ones too, unless the design leaves them out.
    epochs
        Number of epochs.
    outside
        Number of detections outside the area, which were not used.
    area_m
        Area in which targets live. [m]
    """

    rows: xr.Dataset
    epochs: int
    outside: int
    area_m: Extent


def track_detections(
    table: DetectionTable,
    design: TrackDesign | None = None,
    area_m: tuple[float, float, float, float] | None = None,
) -> TrackedRows:
    """Track detections, epoch by epoch.

    Parameters
    ----------
    table
        See `io.detections.read_detections`.
    design
        `DETECTIONS_DESIGN` if none is given.
    area_m
        West, south, east, north; targets that leave it are deleted. By default around all detections but
        outliers, which are farther from the middle half than its own size.
    """
    design = DETECTIONS_DESIGN if design is None else design
    width = max(table.features.shape[1], 2)
    area = surroundings(table.position) if area_m is None else Extent(*area_m)
    west, south, east, north = area
    if not (west < east and south < north and np.isfinite(area).all()):
        raise ValueError(
            f"`area` must be west, south, east, north in metres; got {' '.join(map(str, area))}."
        )
    cell = max(CLUTTER_CELL_M, max(east - west, north - south) / MAX_CELLS)
    shape = (max(int(np.ceil((north - south) / cell)), 1), max(int(np.ceil((east - west) / cell)), 1))
    grid = Grid(shape, (west + cell / 2, north - cell / 2), cell)
    features = _standardize(table.features, width)
    x, y = table.position.T
    inside = (x >= west) & (x <= east) & (y >= south) & (y <= north)
    epochs, rules = table.epochs(), design.initiation
    longest_s = max(rules.coast_s, rules.in_use.stopped_coast_s, rules.in_use.tentative_coast_s)

    def reports() -> Iterator[tuple[float, xr.Dataset]]:
        state = start(design, features=width)
        for time_s, rows in _with_empty_epochs(epochs, longest_s):
            mine = rows[inside[rows]]
            found = Detections(
                table.position[mine], table.covariance[mine], np.full(len(mine), 4.0), np.ones(len(mine))
            )
            state = step_detections(state, found, time_s, grid, features[mine])
            yield time_s, report(state)

    return TrackedRows(as_rows(reports()), len(epochs), int((~inside).sum()), area)


def _with_empty_epochs(epochs: list[tuple[float, Array]], longest_s: float) -> Iterator[tuple[float, Array]]:
    """Epochs of a table, and epochs without detections where times are missing.

    In a pause they end when no track coasts any longer, after ``longest_s``. [s]
    """
    step_s = float(np.median(np.diff([time_s for time_s, _ in epochs]))) if len(epochs) > 1 else 0.0
    for k, (time_s, rows) in enumerate(epochs):
        yield time_s, rows
        if k + 1 < len(epochs):
            missing = round((epochs[k + 1][0] - time_s) / step_s) - 1
            missing = min(missing, math.ceil(longest_s / step_s) + 1)
            yield from ((time_s + j * step_s, rows[:0]) for j in range(1, missing + 1))


def track_frames(
    frames: Iterable[tuple[float, xr.Dataset]], design: TrackDesign | None = None
) -> Iterator[tuple[float, xr.Dataset]]:
    """Track rectified frames one after the other, without storing them.

    Parameters
    ----------
    frames
        Time [s] and Dataset of the schema ``image``.
    design
        `FRAMES_DESIGN` if none is given. Tracks are reported by confirmation.

    Yields
    ------
    Time [s] and the tracks of that frame, as a Dataset of the schema ``tracks``. With
    ``reporting.history`` earlier positions of its newly confirmed tracks come before it: Datasets of their
    own times, with ``tentative`` 1.

    Raises
    ------
    ValueError
        If the design reports by existence, whose model holds for simulated frames with raw mosaics.
    """
    design = (FRAMES_DESIGN if design is None else design).replace({"query.policy": "none"})
    if design.reporting.uses_existence:
        raise ValueError(
            "`track.reporting.method` must be 'confirmation' for frames of your own; got 'existence', which "
            "was fitted to simulated raw mosaics."
        )
    state, history = start(design), History()
    for time_s, image in frames:
        state, _ = step(state, Frame(time_s, image))
        tracks = report(state)
        if design.reporting.history:
            history, earlier = report_history(history, state, tracks)
            for earlier_s, rows in earlier:
                yield earlier_s, _with_tentative(rows, 1.0)
            tracks = _with_tentative(tracks, 0.0)
        yield time_s, tracks


def _with_tentative(tracks: xr.Dataset, value: float) -> xr.Dataset:
    return tracks.assign(tentative=("track", np.full(tracks.sizes["track"], value), {"units": "1"}))


def as_rows(reports: Iterable[tuple[float, xr.Dataset]]) -> xr.Dataset:
    """Join the reports of many epochs to one Dataset with dim ``row``, with time and id as columns."""
    rows = Rows()
    for time_s, tracks in reports:
        if tracks.sizes["track"]:
            columns = {str(name): ("row", v.values) for name, v in tracks.data_vars.items()}
            columns["time_s"] = ("row", np.full(tracks.sizes["track"], time_s))
            columns["track_id"] = ("row", tracks["track"].values)
            rows = rows.append(xr.Dataset(columns))
    table = rows.to_dataset()
    if not table.sizes:
        return table
    # earlier positions are reported later
    return table.isel(row=np.argsort(table["time_s"].values, kind="stable"))


def is_lasting(rows: xr.Dataset, last_s: float) -> Bool[Array, "row"]:
    """Return True for rows of tracks that last `MIN_DURATION_S`, or that the last frame still shows.

    A shorter track is most often a second one on a vehicle, or clutter.

    Parameters
    ----------
    rows
        From `as_rows`.
    last_s
        Time of the last frame. [s]
    """
    if not rows.sizes.get("row"):
        return np.zeros(0, bool)
    ids, index = np.unique(rows["track_id"].values, return_inverse=True)
    first_s, end_s = np.full(len(ids), np.inf), np.full(len(ids), -np.inf)
    np.minimum.at(first_s, index, rows["time_s"].values)
    np.maximum.at(end_s, index, rows["time_s"].values)
    lasts = (end_s - first_s >= MIN_DURATION_S - _ROUNDING_S) | (end_s >= last_s - _ROUNDING_S)
    return lasts[index]


def surroundings(position: Float[Array, "row 2"]) -> Extent:
    """Area around the bulk of some points. [m]"""
    if len(position) == 0:
        return Extent(-MARGIN_M, -MARGIN_M, MARGIN_M, MARGIN_M)
    quarter, half, three_quarters = np.quantile(position, [0.25, 0.5, 0.75], axis=0)
    reach = 4 * (three_quarters - quarter) + MARGIN_M
    low = np.maximum(position.min(axis=0), half - reach) - MARGIN_M
    high = np.minimum(position.max(axis=0), half + reach) + MARGIN_M
    return Extent(*low.tolist(), *high.tolist())


def _standardize(features: Float[Array, "row feature"], width: int) -> Float[Array, "row width"]:
    """Scale features by their standard deviation, so that their units do not matter, and pad them with 0."""
    out = np.zeros((len(features), width))
    known = np.isfinite(features).all(axis=1) & (features.shape[1] > 0)
    out[~known] = np.nan
    if known.any():
        spread = features[known].std(axis=0)
        scaled = (features[known] - features[known].mean(axis=0)) / np.where(spread > 0, spread, 1)
        out[known, : features.shape[1]] = scaled
    return out
