"""How well a vehicle's place can be known: posterior Cramér–Rao bounds, and tracks' errors beside them.

The state is (east, north, their speeds), driven by white acceleration. With the information J of the state,
F and Q of the motion over an interval, and I_k of what one frame says of the place,

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

GATE = 5.0  # standard deviations about the truth within which clutter may be taken for it
DRAWS = 40_000  # of scans
START_SIGMA_M = 100.0  # of a vehicle's place before it is first seen: anywhere about here
_SEED = 18  # of the draws of clutter: the same for all designs
_FEWEST = 8  # detections of vehicles from which their covariance is told
_TOGETHER = 64  # vehicles bounded at once


class Kinematics(NamedTuple):
    """How vehicles move: power density of their acceleration [m² s⁻³], rms speed of one component [m s⁻¹]."""

    acceleration_psd: float
    speed_sigma: float


TRAFFIC = Kinematics(0.86, 6.7)  # of the shipped recording, outside the packaged flight's time


def posterior_bound(
    times_s: Float[Array, "time"],
    information: Float[Array, "*vehicle time 2 2"],
    motion: Kinematics,
    first: Int[Array, "*vehicle"] | None = None,
    start_sigma_m: float = START_SIGMA_M,
) -> Float[Array, "*vehicle time 4 4"]:
    """Bound of the filtered state's covariance after each frame. [m², m² s⁻¹, m² s⁻²]

    Parameters
    ----------
    times_s
        Of the frames. [s]
    information
        What each says of the place; zeros where a vehicle is not seen. [m⁻²]
    motion
        Its speed is the prior's too.
    first
        Frame at which each vehicle's prior holds, and before; the first one by default.
    start_sigma_m
        Of the prior's place, each way. [m]
    """
    shape = information.shape[:-3]
    begun = np.zeros(shape, int) if first is None else np.asarray(first)
    prior = np.broadcast_to(_prior(motion, start_sigma_m), (*shape, 4, 4))
    covariance, out = prior, np.empty((*shape, len(times_s), 4, 4))
    for k in range(len(times_s)):
        if k:
            covariance = _moved(covariance, float(times_s[k] - times_s[k - 1]), motion.acceleration_psd)
        covariance = np.where((k <= begun)[..., None, None], prior, covariance)
        covariance = out[..., k, :, :] = _informed(covariance, information[..., k, :, :])
    return out


def information_reduction(
    detection_probability: float, clutter: float, rng: np.random.Generator, draws: int = DRAWS
) -> float:
    """Part of a measurement's information that is left where it may be missed, or be one of clutter's. [1]

    A scan holds, within the gate, the vehicle's detection with probability P_D and a Poisson number of false
    ones, spread evenly. The score of its density in the vehicle's place is Σ β_i u_i, with β_i the
    probability that detection i is the vehicle's, and u_i its offset in standard deviations; the factor is
    half of its mean square.

    Parameters
    ----------
    detection_probability
        Of the vehicle. [1]
    clutter
        False detections in an area of |R|^½: the density times the square root of the covariance's
        determinant. [1]
    rng, draws
        Of the scans.

    Raises
    ------
    ValueError
        If the probability is none, or the clutter negative.
    """
    _check_probability(detection_probability)
    if not (math.isfinite(clutter) and clutter >= 0):
        raise ValueError(f"`clutter` must be at least 0, got {clutter:g}")
    if clutter == 0 or detection_probability == 0:
        return float(detection_probability)
    p = float(detection_probability)
    false = rng.poisson(clutter * math.pi * GATE**2, draws)
    there = rng.random(draws) < p
    own = np.where(there[:, None], rng.standard_normal((draws, 2)), 0.0)
    scan = np.repeat(np.arange(draws), false)
    radius, angle = GATE * np.sqrt(rng.random(len(scan))), 2 * np.pi * rng.random(len(scan))
    u = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    scan, u = np.concatenate([scan, np.flatnonzero(there)]), np.concatenate([u, own[there]])
    likelihood = np.exp(-0.5 * (u**2).sum(axis=1)) / (2 * np.pi)
    total = np.bincount(scan, likelihood, minlength=draws) + (1 - p) / p * clutter
    score = np.stack([np.bincount(scan, likelihood * u[:, c], minlength=draws) for c in (0, 1)], axis=1)
    return float(0.5 * np.mean(((score / total[:, None]) ** 2).sum(axis=1)))


def _check_probability(value: float) -> None:
    if not 0 <= value <= 1:
        raise ValueError(f"`detection_probability` must lie within 0 and 1, got {value:g}")


def _prior(motion: Kinematics, start_sigma_m: float) -> Float[Array, "4 4"]:
    return np.diag([start_sigma_m**2] * 2 + [motion.speed_sigma**2] * 2)


def _moved(covariance: Array, step_s: float, psd: float) -> Float[Array, "... 4 4"]:
    """F P Fᵀ + Q of constant velocity and white acceleration."""
    forward = np.kron([[1.0, step_s], [0.0, 1.0]], np.eye(2))
    noise = psd * np.kron([[step_s**3 / 3, step_s**2 / 2], [step_s**2 / 2, step_s]], np.eye(2))
    return forward @ covariance @ forward.T + noise


def _informed(covariance: Array, information: Array) -> Float[Array, "... 4 4"]:
    """(P⁻¹ + Hᵀ I H)⁻¹, without inverting P or I, either of which may be singular."""
    place = covariance[..., :2, :2]
    gain = covariance[..., :, :2] @ information @ np.linalg.inv(np.eye(2) + place @ information)
    found = covariance - gain @ covariance[..., :2, :]
    return 0.5 * (found + np.swapaxes(found, -1, -2))


@dataclass(frozen=True)
class Sighting:
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
        time_s=time_s,
        lens_m=pose.position[:2],
        area_m2=1e6 * metrics.window_km2(area_m),
        vehicle=truth["vehicle"].values,
        place=np.stack([truth["east"].values, truth["north"].values], axis=1),
        heading=truth["heading"].values,
        visible=truth["visible_fraction"].values,
        counted=np.asarray(counted),
        length=truth["length"].values,
    )


def turn(seen: Sighting, detected: Float[Array, "detection 2"], tracks: xr.Dataset) -> Turn:
    """What is kept of a loop's detections and tracks."""
    owner, false = assign_vehicles(detected, seen.place, seen.length)
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


@dataclass(frozen=True)
class DetectorStatistics:
    """P_D, covariance away from the camera and across it, and clutter of a detector. [1, m², m⁻²]"""

    probability: float
    covariance: Float[Array, "2 2"]
    clutter: float

    @cached_property
    def reduction(self) -> float:
        """Part of a detection's information that misses and clutter leave. [1]"""
        share = self.clutter * float(np.sqrt(np.linalg.det(self.covariance)))
        return information_reduction(self.probability, share, np.random.default_rng(_SEED))

    def figures(self) -> dict[str, float]:
        """The same by the names of a loss budget's attributes, standard deviations in m, clutter a km²."""
        away, right = np.sqrt(np.diag(self.covariance)).tolist()
        return {
            "detection_probability": self.probability,
            "detection_sigma_away_m": away,
            "detection_sigma_right_m": right,
            "clutter_per_km2": 1e6 * self.clutter,
            "information_reduction": self.reduction,
        }


def measured_detector(sightings: list[Sighting], turns: list[Turn]) -> DetectorStatistics | None:
    """P_D over visible movers, covariance of their detections about their mean, false ones per area.

    None where there are too few detections of vehicles to tell.
    """
    held = [np.isin(t.found, s.vehicle[s.counted]) for s, t in zip(sightings, turns, strict=True)]
    offset = np.concatenate([t.offset[k] for t, k in zip(turns, held, strict=True)])
    if len(offset) < _FEWEST:
        return None
    counted = sum(int(s.counted.sum()) for s in sightings)
    clutter = np.mean([len(t.false) / s.area_m2 for s, t in zip(sightings, turns, strict=True)])
    return DetectorStatistics(len(offset) / counted, np.cov(offset.T), float(clutter))


def flight_accuracy(
    sightings: list[Sighting],
    frames: list[FrameBudget],
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
    squares = _squared_bounds(sightings, ids, body, stays, detector, motion)
    if turns:
        squares["position_error_tracker"] = _squared_errors(sightings, turns, ids)
    out = xr.Dataset(coords={"vehicle": ids}, attrs={} if detector is None else detector.figures())
    for name, square in squares.items():
        known = square[np.isfinite(square)]
        counts = np.isfinite(square).sum(axis=1)
        with np.errstate(invalid="ignore"):
            means = np.sqrt(np.nansum(square, axis=1) / counts)
        out[name] = ("vehicle", means, {"units": "m"})
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
    detector: DetectorStatistics | None,
    motion: Kinematics,
) -> dict[str, Float[Array, "vehicle time"]]:
    """Bounds of the place of each vehicle in each frame; NaN where it is no visible mover. [m²]"""
    out: dict[str, list[Array]] = {}
    times_s = np.array([s.time_s for s in sightings])
    for some in np.array_split(np.arange(len(ids)), max(len(ids) // _TOGETHER, 1)):
        table = _Table.of(sightings, ids[some])
        for name, information in _information(sightings, table, body[some], detector).items():
            bound = posterior_bound(times_s, np.nan_to_num(information), motion, stays[some, 0])
            square = np.where(table.counted, bound[..., 0, 0] + bound[..., 1, 1], np.nan)
            out.setdefault(f"position_bound_{name}", []).append(square)
    return {name: np.concatenate(parts) for name, parts in out.items()}


def _information(
    seen: list[Sighting], table: "_Table", body: Array, detector: DetectorStatistics | None
) -> dict[str, Float[Array, "vehicle time 2 2"]]:
    """Information on the places of vehicles in each frame, of the light and of the detector. [m⁻²]"""
    axes = _body_axes(table.heading)
    told = {"sensor": np.einsum("vtac,vab,vtbd->vtcd", axes, body, axes) * table.visible[..., None, None]}
    if detector is not None:
        view = np.stack(
            [_view_axes(p, s.lens_m) for p, s in zip(table.place.swapaxes(0, 1), seen, strict=True)], 1
        )
        inverse = np.einsum("vtac,ab,vtbd->vtcd", view, np.linalg.inv(detector.covariance), view)
        told["detector"] = np.where(table.counted[..., None, None], detector.reduction * inverse, 0.0)
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


def _body_information(frames: list[FrameBudget], sightings: list[Sighting], ids: Array) -> Array:
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


def _squared_errors(sightings: list[Sighting], turns: list[Turn], ids: Array) -> Float[Array, "vehicle time"]:
    """Squared distance from each vehicle of the track that is its, in each frame; NaN without one. [m²]"""
    counts: dict[int, dict[int, int]] = {}
    for seen, one in zip(sightings, turns, strict=True):
        near, distance_m = metrics.near_pairs(one.position, seen.place, metrics.MATCH_DISTANCE_M)
        rows, columns = near[metrics.match(near, distance_m, metrics.MATCH_DISTANCE_M)].T
        for track, vehicle in zip(one.track[rows].tolist(), seen.vehicle[columns].tolist(), strict=True):
            mine = counts.setdefault(track, {})
            mine[vehicle] = mine.get(vehicle, 0) + 1
    of = {track: min(n, key=lambda v: (-n[v], v)) for track, n in counts.items()}
    row_of = {vehicle: row for row, vehicle in enumerate(ids.tolist())}
    out = np.full((len(ids), len(sightings)), np.nan)
    for k, (seen, one) in enumerate(zip(sightings, turns, strict=True)):
        place = dict(zip(seen.vehicle[seen.counted].tolist(), seen.place[seen.counted], strict=True))
        for track, position in zip(one.track.tolist(), one.position, strict=True):
            vehicle = of.get(track)
            if vehicle in row_of and vehicle in place:
                error, row = float(((position - place[vehicle]) ** 2).sum()), row_of[vehicle]
                out[row, k] = np.fmin(out[row, k], error)
    return out
