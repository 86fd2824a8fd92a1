"""The tracker alone, on a user's own detections or frames."""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.core.records import Rows
from glintrack.io.detections import DetectionTable
from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.frame import Frame, Grid
from glintrack.track.reporting import History, report, report_history
from glintrack.track.tracker import start, step, step_detections

CLUTTER_CELL_M = 15.0
MOST_CELLS = 400  # along a side of the area: memory stays small whatever the coordinates
MARGIN_M = 50.0  # beyond the outermost detections

# Somebody's detections are vehicles, not change: nothing need be proved against parallax, and what stands may
# well be seen.
DETECTIONS_DESIGN = TrackDesign().replace(
    {
        "reporting.method": "confirmation",
        "association.gate_probability": 0.999,
        "motion.model": "imm",
        "motion.acceleration_psd_m2_s3": 3.0,
        "motion.straight_s": 20.0,
        "motion.stopped_detection_probability": 0.1,
        "initiation.stopped_coast_s": 30.0,
        "initiation.quality_s": 3.0,
        "association.method": "mht",
        "initiation.confirm_s": 0.5,
        "initiation.confirm_travel_m": 0.0,
        "initiation.confirm_speed_m_s": 0.0,
        "query.policy": "none",
        "identity.outlier_share": 0.0,
    }
)

LEAST_FRAMES = 3  # of the detector below

# Change detection in rectified frames gives no likelihood ratios that the existence model knows.
RECTIFIED_DESIGN = TrackDesign().replace(
    {
        "reporting.method": "confirmation",
        "motion.acceleration_psd_m2_s3": 1.5,
        "association.gate_probability": 0.999,
        "initiation.quality_s": 1.5,
        "query.policy": "none",
    }
)

# Frames alone, rectified, from near nadir: settings of docs/howto/my_frames.md.
FRAMES_DESIGN = RECTIFIED_DESIGN.replace(
    {
        "detect.detector": "median-motion",
        "detect.max_speed_m_s": 36.0,
        "association.detection_probability": 0.7,
        "initiation.confirm_hits": 2,
        "initiation.confirm_window": 4,
        "initiation.confirm_s": 0.0,
        "initiation.confirm_score": 7.0,
        "initiation.confirm_ratio": 4.0,
        "initiation.confirm_travel_m": 3.0,
        "initiation.duplicate_m": 3.0,
        "initiation.confirm_speed_m_s": 1.5,
        "initiation.tentative_s": 0.9,
        "initiation.coast_s": 1.7,
        "initiation.stopped_coast_s": 1.7,
        "reporting.coasted": False,
        "reporting.history": True,
    }
)


def frames_design(changes: Mapping[str, object]) -> TrackDesign:
    """`FRAMES_DESIGN` with changes, or `RECTIFIED_DESIGN` with them if they name another detector."""
    own = FRAMES_DESIGN.detect.detector
    base = FRAMES_DESIGN if changes.get("detect.detector", own) == own else RECTIFIED_DESIGN
    return base.replace(dict(changes))


def strict_design(design: TrackDesign) -> TrackDesign:
    """The design that reports only what is measured and gives up early: purer tracks of fewer vehicles."""
    return design.replace(
        {"initiation.coast_s": min(design.initiation.coast_s, 1.0), "reporting.coasted": False}
    )


@dataclass(frozen=True)
class TrackedRows:
    """Tracks of a whole recording.

    Parameters
    ----------
    rows
        One row per confirmed track and epoch, coasted ones included.
    epochs
        How many there were.
    outside
        Detections that lay outside the area and were not used.
    area_m
        West, south, east, north in which targets live.
    """

    rows: xr.Dataset
    epochs: int
    outside: int
    area_m: tuple[float, float, float, float]


def track_detections(
    table: DetectionTable,
    design: TrackDesign | None = None,
    area_m: tuple[float, float, float, float] | None = None,
    seed: int = 0,
) -> TrackedRows:
    """Track detections, epoch by epoch.

    Parameters
    ----------
    table
        From `io_detections.read_detections`.
    design
        `DETECTIONS_DESIGN` if none is given; the number of features is the table's.
    area_m
        West, south, east, north; targets that leave it are dropped. By default all detections but stray ones,
        farther from the middle half than its own size, lie inside.
    seed
        Of the tracker's only use of chance.
    """
    design = DETECTIONS_DESIGN if design is None else design
    width = table.features.shape[1]
    design = design.replace({"identity.bins": max(width, 2)})
    area_m = surroundings(table.position) if area_m is None else area_m
    west, south, east, north = area_m
    if not (west < east and south < north and np.isfinite(area_m).all()):
        raise ValueError(
            f"`area` must be west, south, east, north in metres, got {' '.join(map(str, area_m))}"
        )
    grid = _grid(area_m)
    features = _standardized(table.features, design.identity.bins)
    inside = _within(table.position, area_m)
    epochs = table.epochs()

    def reports() -> Iterator[tuple[float, xr.Dataset]]:
        state = start(design, seed)
        for time_s, rows in epochs:
            mine = rows[inside[rows]]
            found = Detections(
                table.position[mine], table.covariance[mine], np.full(len(mine), 4.0), np.ones(len(mine))
            )
            state = step_detections(state, found, time_s, grid, features[mine])
            yield time_s, report(state)

    return TrackedRows(as_rows(reports()), len(epochs), int((~inside).sum()), area_m)


def track_frames(
    frames: Iterable[tuple[float, xr.Dataset]], design: TrackDesign | None = None, seed: int = 0
) -> Iterator[tuple[float, xr.Dataset]]:
    """Track rectified frames one after the other; nothing of a frame is kept.

    Parameters
    ----------
    frames
        Time [s] and Dataset of the schema ``image``.
    design, seed
        As in `start`; `FRAMES_DESIGN` if no design is given.

    Yields
    ------
    Time [s] and the tracks of that frame, as a Dataset of the schema ``tracks``. With
    ``reporting.history`` places at earlier times come before it, once they are known to be a
    track's: Datasets of their own times, ``tentative`` 1.
    """
    design = (FRAMES_DESIGN if design is None else design).replace({"query.policy": "none"})
    state, history = start(design, seed), History()
    for time_s, image in frames:
        state, _ = step(state, Frame(time_s, image))
        tracks = report(state)
        if design.reporting.history:
            history, earlier = report_history(history, state, tracks)
            yield from earlier
            tracks = tracks.assign(tentative=("track", np.zeros(tracks.sizes["track"]), {"units": "1"}))
        yield time_s, tracks


def as_rows(reports: Iterable[tuple[float, xr.Dataset]]) -> xr.Dataset:
    """Reports of many epochs as one Dataset with dim ``row``, time and id among its columns."""
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
    # places told late come where they belong
    return table.isel(row=np.argsort(table["time_s"].values, kind="stable"))


def surroundings(position: Float[Array, "row 2"]) -> tuple[float, float, float, float]:
    """West, south, east, north about the bulk of some points. [m]"""
    if len(position) == 0:
        return (-MARGIN_M, -MARGIN_M, MARGIN_M, MARGIN_M)
    quarter, half, three_quarters = np.quantile(position, [0.25, 0.5, 0.75], axis=0)
    reach = 4 * (three_quarters - quarter) + MARGIN_M
    low = np.maximum(position.min(axis=0), half - reach) - MARGIN_M
    high = np.minimum(position.max(axis=0), half + reach) + MARGIN_M
    return (float(low[0]), float(low[1]), float(high[0]), float(high[1]))


def _within(position: Float[Array, "row 2"], area_m) -> Bool[Array, "row"]:
    west, south, east, north = area_m
    x, y = position.T
    return (x >= west) & (x <= east) & (y >= south) & (y <= north)


def _grid(area_m: tuple[float, float, float, float]) -> Grid:
    west, south, east, north = area_m
    cell = max(CLUTTER_CELL_M, max(east - west, north - south) / MOST_CELLS)
    shape = (max(int(np.ceil((north - south) / cell)), 1), max(int(np.ceil((east - west) / cell)), 1))
    return Grid(shape, (west + cell / 2, north - cell / 2), cell)


def _standardized(features: Float[Array, "row feature"], width: int) -> Float[Array, "row width"]:
    """Features in units of their own spread, so that their units do not matter; padded with 0."""
    out = np.zeros((len(features), width))
    if features.shape[1] == 0:
        out[:] = np.nan
        return out
    known = np.isfinite(features).all(axis=1)
    if known.any():
        spread = features[known].std(axis=0)
        out[:, : features.shape[1]] = (features - features[known].mean(axis=0)) / np.where(
            spread > 0, spread, 1
        )
    out[~known] = np.nan
    return out
