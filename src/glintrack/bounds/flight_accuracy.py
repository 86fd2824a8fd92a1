"""Bounds of positions over a flight: each vehicle by its own visibility, and tracks' errors beside them."""

from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack import metrics
from glintrack.bounds.accuracy import TRAFFIC, Kinematics, information_reduction, posterior_bound
from glintrack.bounds.found import owners
from glintrack.bounds.ladder import FrameLadder
from glintrack.camera import Pose
from glintrack.core.arrays import Array

_SEED = 18  # of the draws of clutter: the same for all designs
_FEWEST = 8  # detections of vehicles from which their covariance is told
_TOGETHER = 64  # vehicles bounded at once, over the frames from the first to the last of them


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
    owned = np.flatnonzero(owner >= 0)
    away_m = np.hypot(*(detected[owned] - seen.place[owner[owned]]).T)
    order = owned[np.argsort(away_m, kind="stable")]
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
    body, stays = _body_information(frames, sightings, ids), _stays(sightings, ids)
    kept = (np.trace(body, axis1=1, axis2=2) > 0) & (stays[:, 1] > 0)
    ids, body, stays = ids[kept], body[kept], stays[kept]
    detector = measured_detector(sightings, turns) if turns else None
    reduction = None if detector is None else detector.reduction()
    squares = _squared_bounds(sightings, ids, body, stays, (detector, reduction), motion)
    if turns:
        squares["position_error_tracker"] = _squared_errors(sightings, turns, ids, stays)
    figures: dict[str, float] = {}
    if detector is not None and reduction is not None:
        figures = {
            "detection_probability": detector.probability,
            **detector.sigmas(),
            "clutter_per_km2": 1e6 * detector.clutter,
            "information_reduction": reduction,
        }
    out = xr.Dataset(coords={"vehicle": ids}, attrs=figures)
    for name, square in squares.items():
        known = np.concatenate([one[np.isfinite(one)] for one in (np.empty(0), *square)])
        means = [_root_mean(one, stay[0], len(sightings)) for one, stay in zip(square, stays, strict=True)]
        out[name] = ("vehicle", np.array(means, float), {"units": "m"})
        out.attrs[f"{name}_median_m"] = float(np.sqrt(np.median(known))) if known.size else np.nan
        out.attrs[f"{name}_rms_m"] = float(np.sqrt(known.mean())) if known.size else np.nan
    return out


def _stays(sightings: list[Sighting], ids: Array) -> Int[Array, "vehicle 2"]:
    """First frame in which each vehicle is a visible mover, and the one after the last; zeros if in none."""
    out = np.zeros((len(ids), 2), int)
    for k, seen in enumerate(sightings):
        rows = np.searchsorted(ids, seen.vehicle[seen.counted])
        out[rows, 0] = np.where(out[rows, 1], out[rows, 0], k)
        out[rows, 1] = k + 1
    return out


def _squared_bounds(
    sightings: list[Sighting],
    ids: Int[Array, "vehicle"],
    body: Float[Array, "vehicle 2 2"],
    stays: Int[Array, "vehicle 2"],
    detector: tuple[Detector | None, float | None],
    motion: Kinematics,
) -> dict[str, list[Array]]:
    """Bounds of the place of each vehicle over its stay; NaN where it is no visible mover. [m²]"""
    names = ("sensor",) if detector[0] is None else ("sensor", "detector")
    out = {f"position_bound_{name}": [np.empty(0)] * len(ids) for name in names}
    by_begin = np.argsort(stays[:, 0], kind="stable")
    for k in range(0, len(ids), _TOGETHER):
        some = np.sort(by_begin[k : k + _TOGETHER])
        begin, end = int(stays[some, 0].min()), int(stays[some, 1].max())
        seen, within = sightings[begin:end], stays[some] - begin
        table, times_s = _Table.of(seen, ids[some]), np.array([s.time_s for s in seen])
        for name, information in _information(seen, table, body[some], *detector).items():
            bound = posterior_bound(times_s, np.nan_to_num(information), motion, within[:, 0])
            square = np.where(table.counted, bound[..., 0, 0] + bound[..., 1, 1], np.nan)
            for row, mine, stay in zip(some, square, within, strict=True):
                out[f"position_bound_{name}"][row] = mine[slice(*stay)]
    return out


def _information(
    seen: list[Sighting], table: "_Table", body: Array, detector: Detector | None, reduction: float | None
) -> dict[str, Float[Array, "vehicle time 2 2"]]:
    """What the light, and the detector if there is one, say of the places of vehicles in each frame. [m⁻²]"""
    axes = _body_axes(table.heading)
    told = {"sensor": np.einsum("vtac,vab,vtbd->vtcd", axes, body, axes) * table.visible[..., None, None]}
    if detector is not None:
        view = np.stack(
            [_view_axes(p, s.lens_m) for p, s in zip(table.place.swapaxes(0, 1), seen, strict=True)], 1
        )
        inverse = np.einsum("vtac,ab,vtbd->vtcd", view, np.linalg.inv(detector.covariance), view)
        told["detector"] = np.where(table.counted[..., None, None], reduction * inverse, 0.0)
    return told


class _Table(NamedTuple):
    """Sightings by vehicle and frame; places and headings NaN where a vehicle is away."""

    place: Float[Array, "vehicle time 2"]
    heading: Float[Array, "vehicle time"]
    visible: Float[Array, "vehicle time"]
    counted: Bool[Array, "vehicle time"]

    @classmethod
    def of(cls, sightings: list[Sighting], ids: Array) -> "_Table":
        """Of these vehicles, whose ids rise."""
        shape = len(ids), len(sightings)
        out = cls(
            np.full((*shape, 2), np.nan), np.full(shape, np.nan), np.zeros(shape), np.zeros(shape, bool)
        )
        for k, seen in enumerate(sightings):
            mine = np.isin(seen.vehicle, ids)
            rows = np.searchsorted(ids, seen.vehicle[mine])
            out.place[rows, k], out.heading[rows, k] = seen.place[mine], seen.heading[mine]
            out.visible[rows, k], out.counted[rows, k] = seen.visible[mine], seen.counted[mine]
        return out


def _body_information(frames: list[FrameLadder], sightings: list[Sighting], ids: Array) -> Array:
    """What a vehicle says of its place along and across itself, were it wholly visible. [m⁻²]"""
    total, visible = np.zeros((len(ids), 2, 2)), np.zeros(len(ids))
    at = {s.time_s: s for s in sightings}
    for frame in frames:
        seen = at[frame.time_s]
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


def _squared_errors(
    sightings: list[Sighting], turns: list[Turn], ids: Array, stays: Int[Array, "vehicle 2"]
) -> list[Array]:
    """Squared distance from each vehicle of the track that is its, over its stay; NaN without one. [m²]"""
    counts: dict[int, dict[int, int]] = {}
    for seen, one in zip(sightings, turns, strict=True):
        near, distance_m = metrics.near_pairs(one.position, seen.place, metrics.MATCH_DISTANCE_M)
        rows, columns = near[metrics.match(near, distance_m, metrics.MATCH_DISTANCE_M)].T
        for track, vehicle in zip(one.track[rows].tolist(), seen.vehicle[columns].tolist(), strict=True):
            mine = counts.setdefault(track, {})
            mine[vehicle] = mine.get(vehicle, 0) + 1
    of = {track: min(n, key=lambda v: (-n[v], v)) for track, n in counts.items()}
    row_of = {vehicle: row for row, vehicle in enumerate(ids.tolist())}
    out = [np.full(end - begin, np.nan) for begin, end in stays]
    for k, (seen, one) in enumerate(zip(sightings, turns, strict=True)):
        place = dict(zip(seen.vehicle[seen.counted].tolist(), seen.place[seen.counted], strict=True))
        for track, position in zip(one.track.tolist(), one.position, strict=True):
            vehicle = of.get(track)
            if vehicle in row_of and vehicle in place:
                error, row = float(((position - place[vehicle]) ** 2).sum()), row_of[vehicle]
                at = k - stays[row, 0]
                out[row][at] = np.fmin(out[row][at], error)
    return out


def _root_mean(square: Float[Array, "time"], begin: int, frames: int) -> float:
    """Root of the mean over those known, summed as over a whole flight: the last bit depends on where."""
    known, total = np.isfinite(square), np.zeros(frames)
    total[begin : begin + len(square)] = np.where(known, square, 0.0)
    return float(np.sqrt(total.sum() / known.sum())) if known.any() else np.nan
