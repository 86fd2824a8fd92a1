"""Accuracy of positions: posterior Cramér–Rao bounds, and the errors of tracks.

The state is (east, north, their speeds), driven by white acceleration. With the information J of the state,
F and Q of the motion over an interval, and the information I_k of one frame on the position,

    J_{k+1} = (Q + F J_k⁻¹ Fᵀ)⁻¹ + Hᵀ I_{k+1} H,      J_0 from the prior,

no filter's mean squared error is below the diagonal of J⁻¹. Of a detector that misses (P_D) and that reports
clutter, I = q R⁻¹: the information reduction factor q is what is left of a measurement that may be another.

References
----------
Tichavský, Muravchik and Nehorai, IEEE Trans. Signal Process. 46, 1386 (1998), Eq. (21). Niu, Willett and
Bar-Shalom, IEEE Trans. Aerosp. Electron. Syst. 37, 1317 (2001): information reduction by uncertain origin.
Hernandez, Marrs, Gordon, Maskell and Reed, Proc. 5th Int. Conf. Information Fusion (2002): the recursion with
it.
"""

import math
from collections import Counter, defaultdict
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack import metrics
from glintrack.bounds.loss_budget import FrameBudget, assign_vehicles
from glintrack.camera import Pose
from glintrack.core.arrays import Array

GATE = 5.0  # standard deviations about the truth within which clutter can be confused with the vehicle
START_SIGMA_M = 100.0  # of a vehicle's position before it is first seen, along each axis
_DRAWS = 40_000  # of scans
_SEED = 18  # of the draws of clutter, the same for all designs
_MIN_DETECTIONS = 8  # of vehicles for an estimate of their covariance


class Kinematics(NamedTuple):
    """Power density of vehicles' acceleration [m² s⁻³], and rms speed of one component [m s⁻¹]."""

    acceleration_psd: float
    speed_sigma: float


TRAFFIC = Kinematics(0.86, 6.7)  # of the shipped recording, outside the packaged flight's time


def posterior_bound(
    times_s: Float[Array, "time"],
    information: Float[Array, "*vehicle time 2 2"],
    motion: Kinematics,
    first: Int[Array, "*vehicle"] | int = 0,
) -> Float[Array, "*vehicle time 4 4"]:
    """Bound of the filtered state's covariance after each frame. [m², m² s⁻¹, m² s⁻²]

    Parameters
    ----------
    times_s
        Times of the frames. [s]
    information
        Information of each frame on the position; zeros where a vehicle is not seen. [m⁻²]
    motion
        Motion model; its speed is that of the prior too.
    first
        Frame up to which each vehicle's prior holds.
    """
    shape = information.shape[:-3]
    prior = np.diag([START_SIGMA_M**2] * 2 + [motion.speed_sigma**2] * 2)
    covariance, out = np.broadcast_to(prior, (*shape, 4, 4)), np.empty((*shape, len(times_s), 4, 4))
    for k in range(len(times_s)):
        if k:  # F P Fᵀ + Q of constant velocity and white acceleration
            step_s = float(times_s[k] - times_s[k - 1])
            forward = np.kron([[1.0, step_s], [0.0, 1.0]], np.eye(2))
            spread = [[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]]
            noise = motion.acceleration_psd * np.kron(spread, np.eye(2))
            covariance = forward @ covariance @ forward.T + noise
        covariance = np.where((k <= np.broadcast_to(first, shape))[..., None, None], prior, covariance)
        covariance = out[..., k, :, :] = _add_information(covariance, information[..., k, :, :])
    return out


def _add_information(covariance: Array, information: Array) -> Float[Array, "... 4 4"]:
    """(P⁻¹ + Hᵀ I H)⁻¹, without inverting P or I, either of which may be singular."""
    place = covariance[..., :2, :2]
    gain = covariance[..., :, :2] @ information @ np.linalg.inv(np.eye(2) + place @ information)
    updated = covariance - gain @ covariance[..., :2, :]
    return 0.5 * (updated + np.swapaxes(updated, -1, -2))


def information_reduction(detection_probability: float, clutter: float, rng: np.random.Generator) -> float:
    """Part of a measurement's information that is left with missed detections and clutter. [1]

    A scan contains, within the gate, the vehicle's detection with probability P_D and a Poisson number of
    false ones, spread evenly. The score of its density in the vehicle's position is Σ β_i u_i, with β_i the
    probability that detection i is the vehicle's, and u_i its offset in standard deviations; the factor is
    half of its mean square.

    Parameters
    ----------
    detection_probability
        Probability of detection of the vehicle. [1]
    clutter
        False detections in an area of |R|^½: the density times the square root of the covariance's
        determinant. [1]
    rng
        Random generator of the scans.

    Raises
    ------
    ValueError
        If the probability is not within 0 and 1, or the clutter is negative.
    """
    if not 0 <= detection_probability <= 1:
        raise ValueError(f"`detection_probability` must lie within 0 and 1; got {detection_probability:g}.")
    if not (math.isfinite(clutter) and clutter >= 0):
        raise ValueError(f"`clutter` must be at least 0; got {clutter:g}.")
    if clutter == 0 or detection_probability == 0:
        return float(detection_probability)
    p = float(detection_probability)
    false = rng.poisson(clutter * math.pi * GATE**2, _DRAWS)
    there = rng.random(_DRAWS) < p
    own = np.where(there[:, None], rng.standard_normal((_DRAWS, 2)), 0.0)
    scan = np.repeat(np.arange(_DRAWS), false)
    radius, angle = GATE * np.sqrt(rng.random(len(scan))), 2 * np.pi * rng.random(len(scan))
    u = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    scan, u = np.concatenate([scan, np.flatnonzero(there)]), np.concatenate([u, own[there]])
    likelihood = np.exp(-0.5 * (u**2).sum(axis=1)) / (2 * np.pi)
    total = np.bincount(scan, likelihood, minlength=_DRAWS) + (1 - p) / p * clutter
    score = np.stack([np.bincount(scan, likelihood * u[:, c], minlength=_DRAWS) for c in (0, 1)], axis=1)
    return float(0.5 * np.mean(((score / total[:, None]) ** 2).sum(axis=1)))


@dataclass(frozen=True)
class FrameTruth:
    """Truth of one frame as the bounds need it; ``counted`` are the visible movers of the area."""

    time_s: float
    lens_m: Float[Array, "2"]
    area: metrics.Area
    vehicle: Int[Array, "vehicle"]
    place: Float[Array, "vehicle 2"]
    heading: Float[Array, "vehicle"]
    visible: Float[Array, "vehicle"]
    counted: Bool[Array, "vehicle"]
    length: Float[Array, "vehicle"]

    @classmethod
    def of(cls, time_s: float, pose: Pose, truth: xr.Dataset, area: metrics.Area) -> "FrameTruth":
        """Select from the truth of a frame with its scored area. [s, m]"""
        counted = metrics.is_moving(truth) & metrics.is_in_area(truth, area) & metrics.is_visible(truth)
        return cls(
            time_s=time_s,
            lens_m=pose.position[:2],
            area=area,
            vehicle=truth["vehicle"].values,
            place=np.stack([truth["east_m"].values, truth["north_m"].values], axis=1),
            heading=truth["heading_rad"].values,
            visible=truth["visible_fraction"].values,
            counted=np.asarray(counted),
            length=truth["length_m"].values,
        )


class FrameTracking(NamedTuple):
    """Detections and tracks of one channel in one frame.

    Parameters
    ----------
    found
        Ids of the vehicles in reach of a detection.
    offset
        Offset of the nearest detection of each from its middle: away from the camera, and to its right. [m]
    false
        Positions of false detections. [m]
    track, position
        Ids and positions of the reported tracks. [m]
    """

    found: Int[Array, "found"]
    offset: Float[Array, "found 2"]
    false: Float[Array, "false 2"]
    track: Int[Array, "track"]
    position: Float[Array, "track 2"]

    @classmethod
    def of(cls, truth: FrameTruth, detection: Float[Array, "detection 2"], tracks: xr.Dataset):
        """Compare a channel's detections with the truth of the frame."""
        owner, false = assign_vehicles(detection, truth.place, truth.length)
        owned = np.flatnonzero(owner >= 0)
        away_m = np.hypot(*(detection[owned] - truth.place[owner[owned]]).T)
        order = owned[np.argsort(away_m, kind="stable")]
        row, first = np.unique(owner[order], return_index=True)
        offset = detection[order[first]] - truth.place[row]
        return cls(
            found=truth.vehicle[row],
            offset=np.einsum("nac,nc->na", _view_axes(truth.place[row], truth.lens_m), offset),
            false=detection[false & metrics.contains(truth.area, detection)],
            track=tracks["track"].values,
            position=np.stack([tracks["east_m"].values, tracks["north_m"].values], axis=1),
        )


@dataclass(frozen=True)
class DetectorStatistics:
    """P_D, covariance away from the camera and across it, and clutter of a detector. [1, m², m⁻²]"""

    probability: float
    covariance: Float[Array, "2 2"]
    clutter: float

    @classmethod
    def of(cls, truths: list[FrameTruth], frames: list[FrameTracking]) -> "DetectorStatistics | None":
        """Statistics over visible movers, with offsets about their mean; None with too few detections."""
        pairs = list(zip(truths, frames, strict=True))
        while pairs and not (len(pairs[0][1].found) or len(pairs[0][1].false)):
            pairs.pop(0)  # frames in which the background is learnt
        offset = [f.offset[np.isin(f.found, s.vehicle[s.counted])] for s, f in pairs]
        offset = np.concatenate([np.zeros((0, 2)), *offset])
        if len(offset) < _MIN_DETECTIONS:
            return None
        counted = sum(int(s.counted.sum()) for s, _ in pairs)
        clutter = 1e-6 * np.nanmean([len(f.false) / metrics.area_km2(s.area) for s, f in pairs])
        return cls(len(offset) / counted, np.cov(offset.T), float(clutter))

    @cached_property
    def reduction(self) -> float:
        """Part of a detection's information that is left with misses and clutter. [1]"""
        share = self.clutter * float(np.sqrt(np.linalg.det(self.covariance)))
        return information_reduction(self.probability, share, np.random.default_rng(_SEED))

    def attributes(self) -> dict[str, float]:
        """Values by the names of a loss budget's attributes, standard deviations in m, clutter per km²."""
        away, right = np.sqrt(np.diag(self.covariance)).tolist()
        return {
            "detection_probability": self.probability,
            "detection_sigma_away_m": away,
            "detection_sigma_right_m": right,
            "clutter_per_km2": 1e6 * self.clutter,
            "information_reduction": self.reduction,
        }


def flight_accuracy(
    truths: list[FrameTruth],
    frames: list[FrameBudget],
    tracking: list[FrameTracking] | None = None,
    motion: Kinematics = TRAFFIC,
) -> xr.Dataset:
    """Bounds of filtered positions of every vehicle with measured information.

    The information of a frame on a vehicle's position is what was measured along and across the vehicle
    (``frames``), in proportion to the visible fraction.

    Returns
    -------
    Dim ``vehicle``: ``position_bound_sensor`` and, with a tracking channel, ``position_bound_detector`` and
    ``position_error_tracker``, the root of the mean square over the frames in which it is a visible mover.
    The tracker's error is that of each track from the vehicle that it was matched to most, however far.
    Attributes: medians of the same over vehicles and frames, the root of the mean square, and the detector's
    statistics. [m]
    """
    ids = np.unique(np.concatenate([s.vehicle for s in truths]))
    body, first = _body_information(frames, truths, ids), np.full(len(ids), -1)
    for k, seen in enumerate(truths):
        rows = np.searchsorted(ids, seen.vehicle[seen.counted])
        first[rows] = np.where(first[rows] < 0, k, first[rows])
    known = (np.trace(body, axis1=1, axis2=2) > 0) & (first >= 0)
    ids, body, first = ids[known], body[known], first[known]
    detector = DetectorStatistics.of(truths, tracking) if tracking else None
    times_s, table, squares = np.array([s.time_s for s in truths]), _Table.of(truths, ids), {}
    for name, information in _information(truths, table, body, detector).items():
        bound = posterior_bound(times_s, np.nan_to_num(information), motion, first)
        square = np.where(table.counted, bound[..., 0, 0] + bound[..., 1, 1], np.nan)
        squares[f"position_bound_{name}"] = square
    if tracking:
        squares["position_error_tracker"] = _track_errors(truths, tracking, ids)
    out = xr.Dataset(coords={"vehicle": ids}, attrs={} if detector is None else detector.attributes())
    for name, square in squares.items():
        finite = square[np.isfinite(square)]
        with np.errstate(invalid="ignore"):
            means = np.sqrt(np.nansum(square, axis=1) / np.isfinite(square).sum(axis=1))
        out[name] = ("vehicle", means, {"units": "m"})
        out.attrs[f"{name}_median_m"] = float(np.sqrt(np.median(finite))) if finite.size else np.nan
        out.attrs[f"{name}_rms_m"] = float(np.sqrt(finite.mean())) if finite.size else np.nan
    return out


def _information(
    truths: list[FrameTruth], table: "_Table", body: Array, detector: DetectorStatistics | None
) -> dict[str, Float[Array, "vehicle time 2 2"]]:
    """Information of the light and of the detector on positions of vehicles in each frame. [m⁻²]"""
    axes = _body_axes(table.heading)
    out = {"sensor": np.einsum("vtac,vab,vtbd->vtcd", axes, body, axes) * table.visible[..., None, None]}
    if detector is not None:
        places = table.place.swapaxes(0, 1)
        view = np.stack([_view_axes(p, s.lens_m) for p, s in zip(places, truths, strict=True)], 1)
        inverse = np.einsum("vtac,ab,vtbd->vtcd", view, np.linalg.inv(detector.covariance), view)
        out["detector"] = np.where(table.counted[..., None, None], detector.reduction * inverse, 0.0)
    return out


class _Table(NamedTuple):
    """Truth by vehicle and frame; positions and headings NaN where a vehicle is away."""

    place: Float[Array, "vehicle time 2"]
    heading: Float[Array, "vehicle time"]
    visible: Float[Array, "vehicle time"]
    counted: Bool[Array, "vehicle time"]

    @classmethod
    def of(cls, truths: list[FrameTruth], ids: Array) -> "_Table":
        """Table of vehicles with rising ids."""
        shape = len(ids), len(truths)
        out = cls(
            np.full((*shape, 2), np.nan), np.full(shape, np.nan), np.zeros(shape), np.zeros(shape, bool)
        )
        for k, seen in enumerate(truths):
            mine = np.isin(seen.vehicle, ids)
            rows = np.searchsorted(ids, seen.vehicle[mine])
            for name in cls._fields:
                getattr(out, name)[rows, k] = getattr(seen, name)[mine]
        return out


def _body_information(frames: list[FrameBudget], truths: list[FrameTruth], ids: Array) -> Array:
    """Information on positions along and across each vehicle, if it were wholly visible. [m⁻²]"""
    total, visible = np.zeros((len(ids), 2, 2)), np.zeros(len(ids))
    at = {s.time_s: s for s in truths}
    for frame in frames:
        if np.isnan(frame.information).any():  # not measured
            continue
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


def _track_errors(
    truths: list[FrameTruth], frames: list[FrameTracking], ids: Array
) -> Float[Array, "vehicle time"]:
    """Squared distance of each vehicle's track in each frame; NaN without one. [m²]"""
    counts: dict[int, Counter[int]] = defaultdict(Counter)
    for seen, one in zip(truths, frames, strict=True):
        near, distance_m = metrics.near_pairs(one.position, seen.place, metrics.MATCH_DISTANCE_M)
        rows, columns = near[metrics.match(near, distance_m, metrics.MATCH_DISTANCE_M)].T
        for track, vehicle in zip(one.track[rows].tolist(), seen.vehicle[columns].tolist(), strict=True):
            counts[track][vehicle] += 1
    vehicle_of = {track: min(n, key=lambda v: (-n[v], v)) for track, n in counts.items()}
    row_of = {vehicle: row for row, vehicle in enumerate(ids.tolist())}
    out = np.full((len(ids), len(truths)), np.nan)
    for k, (seen, one) in enumerate(zip(truths, frames, strict=True)):
        place = dict(zip(seen.vehicle[seen.counted].tolist(), seen.place[seen.counted], strict=True))
        for track, position in zip(one.track.tolist(), one.position, strict=True):
            vehicle = vehicle_of.get(track)
            if vehicle in row_of and vehicle in place:
                error, row = float(((position - place[vehicle]) ** 2).sum()), row_of[vehicle]
                out[row, k] = np.fmin(out[row, k], error)
    return out
