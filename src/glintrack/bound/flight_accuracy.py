"""Bounds of positions over a flight: each vehicle by its own visibility, and tracks' errors beside them."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack import metrics
from glintrack.arrays import Array
from glintrack.bound.accuracy import TRAFFIC, Kinematics, information_reduction, posterior_bound
from glintrack.bound.found import owners
from glintrack.bound.ladder import FrameLadder
from glintrack.camera import Pose

_SEED = 18  # of the draws of clutter: the same for all designs
_FEWEST = 8  # detections of vehicles from which their covariance is told


class Sighting(NamedTuple):
    """The truth of one frame, as far as bounds need it; ``counted`` are the visible movers of the window."""

    time_s: float
    lens_m: Float[Array, "2"]
    area_m2: float
    vehicle: Int[Array, "vehicle"]
    place: Float[Array, "vehicle 2"]
    heading: Float[Array, "vehicle"]
    visible: Float[Array, "vehicle"]
    counted: Bool[Array, "vehicle"]
    length: Float[Array, "vehicle"]


class Turn(NamedTuple):
    """What a loop made of one frame.

    Parameters
    ----------
    found
        Ids of the vehicles that a detection lies in reach of. [m]
    offset
        Of the nearest detection of each from its middle: away from the camera, and to its right. [m]
    false
        Where detections are false. [m]
    track, position
        Of the reported tracks. [m]
    """

    found: Int[Array, "found"]
    offset: Float[Array, "found 2"]
    false: Float[Array, "false 2"]
    track: Int[Array, "track"]
    position: Float[Array, "track 2"]


def sighting(
    time_s: float, pose: Pose, truth: xr.Dataset, area_m: tuple[float, float, float, float]
) -> Sighting:
    """What is kept of a frame's truth."""
    counted = metrics.is_moving(truth) & metrics.is_in_window(truth, area_m) & metrics.is_visible(truth)
    return Sighting(
        time_s,
        pose.position[:2],
        1e6 * metrics.window_km2(area_m),
        truth["vehicle"].values,
        np.stack([truth["east"].values, truth["north"].values], axis=1),
        truth["heading"].values,
        truth["visible_fraction"].values,
        np.asarray(counted),
        truth["length"].values,
    )


def turn(seen: Sighting, detected: Float[Array, "detection 2"], tracks: xr.Dataset) -> Turn:
    """What is kept of a loop's detections and tracks."""
    owner, false = owners(detected, seen.place, seen.length)
    order = np.argsort(np.hypot(*(detected - seen.place[owner]).T), kind="stable")
    order = order[owner[order] >= 0]
    whose, first = np.unique(owner[order], return_index=True)
    offset = detected[order[first]] - seen.place[whose]
    axes = _view_axes(seen.place[whose], seen.lens_m)
    position = np.stack([tracks["east"].values, tracks["north"].values], axis=1)
    return Turn(
        seen.vehicle[whose], np.einsum("nac,nc->na", axes, offset), detected[false],
        tracks["track"].values, position,
    )  # fmt: skip


class Detector(NamedTuple):
    """P_D, covariance away from the camera and across it, and clutter of a detector. [1, m², m⁻²]"""

    probability: float
    covariance: Float[Array, "2 2"]
    clutter: float

    def reduction(self) -> float:
        """Part of a detection's information that misses and clutter leave. [1]"""
        share = self.clutter * float(np.sqrt(np.linalg.det(self.covariance)))
        return information_reduction(self.probability, share, np.random.default_rng(_SEED))

    def sigmas(self) -> dict[str, float]:
        """Standard deviations away from the camera and across it, by the names of attributes. [m]"""
        away, right = np.sqrt(np.diag(self.covariance)).tolist()
        return {"detection_sigma_away_m": away, "detection_sigma_right_m": right}


def measured_detector(sightings: list[Sighting], turns: list[Turn]) -> Detector | None:
    """P_D over visible movers, covariance of their detections about their mean, false ones per area.

    None where there are too few detections of vehicles to tell.
    """
    held = [np.isin(t.found, s.vehicle[s.counted]) for s, t in zip(sightings, turns, strict=True)]
    offset = np.concatenate([t.offset[k] for t, k in zip(turns, held, strict=True)])
    if len(offset) < _FEWEST:
        return None
    counted = sum(int(s.counted.sum()) for s in sightings)
    clutter = np.mean([len(t.false) / s.area_m2 for s, t in zip(sightings, turns, strict=True)])
    return Detector(len(offset) / counted, np.cov(offset.T), float(clutter))


def flight_accuracy(
    sightings: list[Sighting],
    frames: list[FrameLadder],
    turns: list[Turn] | None = None,
    motion: Kinematics = TRAFFIC,
) -> xr.Dataset:
    """Bounds of filtered positions of every vehicle whose information was measured.

    What a frame says of a vehicle's place is what it said, along and across the vehicle, where it was
    measured (``frames``), in proportion to the visible fraction.

    Returns
    -------
    Dim ``vehicle``: ``position_bound_sensor`` and, where a loop flew, ``position_bound_detector`` and
    ``position_error_tracker``, the root of the mean square over the frames in which it is a visible mover.
    The tracker's error is that of each track from the vehicle that it was matched to most, however far.
    Attributes: medians of the same over vehicles and frames, the tracker's root of the mean square too, and
    the detector's figures. [m]
    """
    ids = np.unique(np.concatenate([s.vehicle for s in sightings]))
    table = _Table.of(sightings, ids)
    body = _body_information(frames, sightings, ids)
    kept = (np.trace(body, axis1=1, axis2=2) > 0) & table.counted.any(axis=1)
    table, body, ids = table.take(kept), body[kept], ids[kept]
    times_s = np.array([s.time_s for s in sightings])
    first = table.counted.argmax(axis=1)
    axes = _body_axes(table.heading)
    told = {"sensor": np.einsum("vtac,vab,vtbd->vtcd", axes, body, axes) * table.visible[..., None, None]}
    detector = measured_detector(sightings, turns) if turns else None
    figures: dict[str, float] = {}
    if detector is not None:
        reduction = detector.reduction()
        view = np.stack(
            [_view_axes(p, s.lens_m) for p, s in zip(table.place.swapaxes(0, 1), sightings, strict=True)], 1
        )
        inverse = np.einsum("vtac,ab,vtbd->vtcd", view, np.linalg.inv(detector.covariance), view)
        told["detector"] = np.where(table.counted[..., None, None], reduction * inverse, 0.0)
        figures = {
            "detection_probability": detector.probability,
            **detector.sigmas(),
            "clutter_per_km2": 1e6 * detector.clutter,
            "information_reduction": reduction,
        }
    columns, counted = {}, table.counted
    for name, information in told.items():
        bound = posterior_bound(times_s, np.nan_to_num(information), motion, first)
        variance = np.where(counted, bound[..., 0, 0] + bound[..., 1, 1], np.nan)
        columns[f"position_bound_{name}"] = variance
    if turns:
        columns["position_error_tracker"] = np.where(
            counted, _track_errors(sightings, turns, ids, table.place), np.nan
        )
    out = xr.Dataset(coords={"vehicle": ids}, attrs=figures)
    for name, square in columns.items():
        known = square[np.isfinite(square)]
        out[name] = ("vehicle", _root_mean(square), {"units": "m"})
        out.attrs[f"{name}_median_m"] = float(np.sqrt(np.median(known))) if known.size else np.nan
        out.attrs[f"{name}_rms_m"] = float(np.sqrt(known.mean())) if known.size else np.nan
    return out


class _Table(NamedTuple):
    """Sightings by vehicle and frame; places and headings NaN where a vehicle is away."""

    place: Float[Array, "vehicle time 2"]
    heading: Float[Array, "vehicle time"]
    visible: Float[Array, "vehicle time"]
    counted: Bool[Array, "vehicle time"]

    @classmethod
    def of(cls, sightings: list[Sighting], ids: Array) -> "_Table":
        shape = len(ids), len(sightings)
        out = cls(
            np.full((*shape, 2), np.nan), np.full(shape, np.nan), np.zeros(shape), np.zeros(shape, bool)
        )
        for k, seen in enumerate(sightings):
            rows = np.searchsorted(ids, seen.vehicle)
            out.place[rows, k], out.heading[rows, k] = seen.place, seen.heading
            out.visible[rows, k], out.counted[rows, k] = seen.visible, seen.counted
        return out

    def take(self, kept: Array) -> "_Table":
        return _Table(*(values[kept] for values in self))


def _body_information(frames: list[FrameLadder], sightings: list[Sighting], ids: Array) -> Array:
    """What a vehicle says of its place along and across itself, were it wholly visible. [m⁻²]"""
    total, visible = np.zeros((len(ids), 2, 2)), np.zeros(len(ids))
    for frame in frames:
        seen = next(s for s in sightings if s.time_s == frame.time_s)
        order = np.argsort(seen.vehicle)
        mine = order[np.searchsorted(seen.vehicle[order], frame.vehicles["vehicle_id"])]
        axes, rows = _body_axes(seen.heading[mine]), np.searchsorted(ids, seen.vehicle[mine])
        total[rows] += np.einsum("nac,ncd,nbd->nab", axes, frame.information, axes)
        visible[rows] += seen.visible[mine]
    return total / np.maximum(visible, 1e-9)[:, None, None]


def _body_axes(heading: Float[Array, "..."]) -> Float[Array, "... 2 2"]:
    """Rows: unit vectors along vehicles and to their right."""
    s, c = np.sin(heading), np.cos(heading)
    return np.stack([np.stack([s, c], -1), np.stack([c, -s], -1)], -2)


def _view_axes(place: Float[Array, "n 2"], lens_m: Float[Array, "2"]) -> Float[Array, "n 2 2"]:
    """Rows: unit vectors on the ground away from the camera and to its right; north from straight above."""
    away = place - lens_m
    length = np.hypot(*away.T)[:, None]
    away = np.where(length > 1e-6, away / np.maximum(length, 1e-6), [0.0, 1.0])
    return np.stack([away, np.stack([away[:, 1], -away[:, 0]], -1)], -2)


def _track_errors(sightings: list[Sighting], turns: list[Turn], ids: Array, place: Array) -> Array:
    """Squared distance of the track that is a vehicle's from it; NaN without one. [m²]"""
    counts: dict[int, dict[int, int]] = {}
    for seen, one in zip(sightings, turns, strict=True):
        near, distance_m = metrics.near_pairs(one.position, seen.place, metrics.MATCH_DISTANCE_M)
        rows, columns = near[metrics.match(near, distance_m, metrics.MATCH_DISTANCE_M)].T
        for track, vehicle in zip(one.track[rows].tolist(), seen.vehicle[columns].tolist(), strict=True):
            mine = counts.setdefault(track, {})
            mine[vehicle] = mine.get(vehicle, 0) + 1
    of = {track: min(n, key=lambda v: (-n[v], v)) for track, n in counts.items()}
    out = np.full(place.shape[:2], np.nan)
    for k, one in enumerate(turns):
        for track, position in zip(one.track.tolist(), one.position, strict=True):
            row = int(np.searchsorted(ids, of.get(track, -1)))
            if row < len(ids) and ids[row] == of.get(track, -1):
                error = float(((position - place[row, k]) ** 2).sum())
                out[row, k] = np.fmin(out[row, k], error)
    return out


def _root_mean(square: Float[Array, "vehicle time"]) -> Float[Array, "vehicle"]:
    known = np.isfinite(square)
    total, count = np.where(known, square, 0.0).sum(axis=1), known.sum(axis=1)
    return np.where(count > 0, np.sqrt(total / np.maximum(count, 1)), np.nan)
