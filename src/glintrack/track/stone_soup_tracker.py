"""A Stone Soup tracker in the place of ours (extra ``stonesoup``), behind the same detectors.

Constant velocity, a Kalman filter and the assignment of least distance between a scan's detections and the
tracks, as Stone Soup's own tutorials build them. Nothing of our tracker takes part: neither its motion nor
its associations nor its evidence for what is born. What is tracked goes back to the detector, as from ours.
"""

import itertools
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace
from datetime import datetime, timedelta
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.extras import require_extra
from glintrack.track.design import TrackDesign
from glintrack.track.detect.detector import Association, Detector
from glintrack.track.detect.detectors import DETECTORS
from glintrack.track.detect.frame import Frame, grid_of
from glintrack.track.frame_detections import found_in
from glintrack.track.stone_soup import from_tracks, to_detections

_EPOCH = datetime(2000, 1, 1)  # nothing of it is told


@dataclass(frozen=True)
class GnnSettings:
    """Of Stone Soup's global nearest neighbour; the defaults are those of ``benchmarks/tracking.py``.

    Parameters
    ----------
    acceleration_psd_m2_s3
        Of the motion of nearly constant velocity. [m² s⁻³]
    gate
        Mahalanobis distance from which a detection is not a track's. [1]
    speed_sigma_m_s
        Of a track that has been seen once, east and north. [m s⁻¹]
    confirm_hits
        Detections that make a track.
    tentative_frames, coast_frames
        Frames without a detection after which what is tentative is given up, and a track.
    report_coasted
        Whether `StoneSoupTracker` reports tracks that a frame does not show; SORT does not.
    """

    acceleration_psd_m2_s3: float = 1.5
    gate: float = 3.0
    speed_sigma_m_s: float = 8.0
    confirm_hits: int = 3
    tentative_frames: int = 2
    coast_frames: int = 4
    report_coasted: bool = False


def require_stone_soup() -> SimpleNamespace:
    """What is needed of Stone Soup.

    Raises
    ------
    ValueError
        If it is not installed.
    """
    module = partial(require_extra, extra="stonesoup", purpose="track with Stone Soup")
    linear = module("stonesoup.models.transition.linear")
    return SimpleNamespace(
        Associator=module("stonesoup.dataassociator.neighbour").GNNWith2DAssignment,
        Deleter=module("stonesoup.deleter.time").UpdateTimeStepsDeleter,
        Hypothesiser=module("stonesoup.hypothesiser.distance").DistanceHypothesiser,
        Initiator=module("stonesoup.initiator.simple").MultiMeasurementInitiator,
        Mahalanobis=module("stonesoup.measures").Mahalanobis,
        Combined=linear.CombinedLinearGaussianTransitionModel,
        ConstantVelocity=linear.ConstantVelocity,
        Predictor=module("stonesoup.predictor.kalman").KalmanPredictor,
        Tracker=module("stonesoup.tracker.simple").MultiTargetTracker,
        GaussianState=module("stonesoup.types.state").GaussianState,
        Updater=module("stonesoup.updater.kalman").KalmanUpdater,
    )


def gnn_tracker(
    scans: Iterator[tuple[datetime, set[Any]]], settings: GnnSettings
) -> Iterator[tuple[datetime, set[Any]]]:
    """Stone Soup's `MultiTargetTracker` of global nearest neighbours over scans of detections.

    Parameters
    ----------
    scans
        Times and Stone Soup detections with linear measurement models, as `to_detections` gives them.
    settings
        Of the tracker.

    Raises
    ------
    ValueError
        If Stone Soup is not installed.
    """
    theirs = require_stone_soup()
    moves = theirs.Combined([theirs.ConstantVelocity(settings.acceleration_psd_m2_s3)] * 2)
    predictor, updater = theirs.Predictor(moves), theirs.Updater(None)
    hypothesiser = theirs.Hypothesiser(
        predictor, updater, measure=theirs.Mahalanobis(), missed_distance=settings.gate
    )
    associator = theirs.Associator(_Near(hypothesiser))
    unknown = theirs.GaussianState(np.zeros((4, 1)), np.diag([0.0, settings.speed_sigma_m_s**2] * 2))
    initiator = theirs.Initiator(
        unknown, theirs.Deleter(settings.tentative_frames), associator, updater,
        min_points=settings.confirm_hits,
    )  # fmt: skip
    return iter(theirs.Tracker(initiator, theirs.Deleter(settings.coast_frames), scans, associator, updater))


class _Near:
    """Stone Soup's hypothesiser, asked only of detections that its gate may hold: the same, much sooner.

    A Mahalanobis distance is no less than the distance over the root of the covariance's trace.
    """

    def __init__(self, within: Any):
        self._within = within
        self._scan: set[Any] | None = None
        self._listed: list[Any] = []
        self._place_m, self._variance_m2 = np.empty((0, 2)), np.empty(0)

    def hypothesise(self, track: Any, detections: set[Any], timestamp: datetime, **more: Any) -> Any:
        """As of Stone Soup's hypothesisers."""
        if self._scan is not detections:
            self._scan, self._listed = detections, list(detections)
            self._place_m = np.array([np.ravel(one.state_vector) for one in self._listed]).reshape(-1, 2)
            covariances = [one.measurement_model.covar() for one in self._listed]
            self._variance_m2 = np.array([np.trace(one) for one in covariances])
        predicted = self._within.predictor.predict(track, timestamp=timestamp)
        east, _, north, _ = np.ravel(predicted.state_vector)
        away_m2 = ((self._place_m - [east, north]) ** 2).sum(axis=1)
        spread_m2 = predicted.covar[0, 0] + predicted.covar[2, 2] + self._variance_m2
        near = np.flatnonzero(away_m2 <= self._within.missed_distance**2 * spread_m2)
        return self._within.hypothesise(track, {self._listed[k] for k in near}, timestamp, **more)


class StoneSoupTracker:
    """Stone Soup's tracker behind one of our detectors, frame by frame.

    Parameters
    ----------
    design
        Of which the detector and its keys are used, ``detect``, and nothing else.
    settings
        Of Stone Soup's tracker.

    Raises
    ------
    ValueError
        If Stone Soup is not installed.
    """

    def __init__(self, design: TrackDesign, settings: GnnSettings | None = None):
        settings = settings or GnnSettings()
        self._channel, self._shows_coasted = design.detect.channel, settings.report_coasted
        self._detector: Detector = DETECTORS[design.detect.detector](design.detect)
        self._memory, self._grid, self._time_s = None, None, None
        self._scans: deque[tuple[datetime, set[Any]]] = deque()
        scans = (self._scans.popleft() for _ in itertools.count())
        self._tracker = gnn_tracker(scans, settings)
        self._number: dict[int, int] = {}  # of a Stone Soup id, by order of appearance and from west to east
        self._report = from_tracks((), 0.0, _EPOCH)

    def step(self, frame: Frame) -> xr.Dataset:
        """Tracks at a frame, of the schema ``tracks``.

        Raises
        ------
        ValueError
            If the image breaks its schema, its grid has changed, or time does not advance.
        """
        if self._time_s is not None and frame.time_s <= self._time_s:
            raise ValueError(
                f"`time_s` must be later than the last frame's {self._time_s:g} s, got {frame.time_s:g}"
            )
        self._grid = grid_of(frame, self._grid)
        interval_s = 0.0 if self._time_s is None else frame.time_s - self._time_s
        frame = replace(
            frame,
            grid=self._grid,
            channel=self._channel,
            interval_s=interval_s,
            expected_m=_columns(self._report, "east", "north")
            + interval_s * _columns(self._report, "east_speed", "north_speed"),
        )
        memory, found = found_in(self._detector, self._memory, frame)
        scan = to_detections(found, frame.time_s, _EPOCH)
        self._scans.append((_EPOCH + timedelta(seconds=float(frame.time_s)), set(scan)))
        _, tracks = next(self._tracker)
        last = [one.states[-1] for one in tracks]
        taken = {id(one.hypothesis.measurement) for one in last if hasattr(one, "hypothesis")}
        explained = np.array([id(one) in taken for one in scan], bool)
        self._report = self._numbered(from_tracks(tracks, frame.time_s, _EPOCH))
        seen = self._report.isel(track=self._report["coasted"].values == 0)
        association = Association(explained, _columns(seen, "east", "north"))
        self._memory = self._detector.update(memory, frame, found, association)
        self._time_s = frame.time_s
        return self._report if self._shows_coasted else seen

    def _numbered(self, report: xr.Dataset) -> xr.Dataset:
        """The report with small numbers for Stone Soup's chance ids: of the same frames the same."""
        report = report.isel(track=np.lexsort((report["north"].values, report["east"].values)))
        ids = [self._number.setdefault(int(one), len(self._number)) for one in report["track"].values]
        report = report.assign_coords(track=np.array(ids, np.int64))
        return report.isel(track=np.argsort(ids, kind="stable"))


def _columns(report: xr.Dataset, *names: str) -> Float[Array, "track column"]:
    return np.stack([report[name].values for name in names], axis=-1)
