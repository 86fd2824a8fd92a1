"""Loss budget: share of the same vehicles that each stage still has (docs/theory/bounds.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array

STAGE_LABELS: Mapping[str, str] = {
    "moving": "moving in the scored area",
    "in_view": "in the frame",
    "visible": "visible",
    "ideal_observer": "noise alone",
    "known_background": "background known",
    "predicted_background": "predicted from past frames",
    "reported_pose": "with reported poses",
    "detector": "detector in use",
    "oracle_association": "oracle association",
    "tracker": "tracker",
}
STAGES = tuple(STAGE_LABELS)
STAGES_NOTE = (
    'Down to "with reported poses" each stage detects in one frame, with less information than the stage '
    "above. The detector in use, oracle association (the truth assigns detections to vehicles) and the "
    "tracker use several frames, so they can be higher. A lasting loss is one that no later stage recovers."
)
DETECTION_STAGES = ("known_background", "predicted_background", "reported_pose", "detector")
TRACKING_STAGES = ("oracle_association", "tracker")
REACH_M = 4.0  # of a detection from its vehicle's middle, or half its length and a metre
FALSE_M = 5.0  # farther from every vehicle a detection is false


class Scored(NamedTuple):
    """Best score among the detections of each vehicle (−∞ for none), and the scores of false detections."""

    vehicle: Float[Array, "vehicle"]
    false: Float[Array, "detection"]


@dataclass
class FrameBudget:
    """Stages of one frame for one group of elements.

    Parameters
    ----------
    index, time_s
        Index and time of the frame. [1, s]
    movers, in_view
        Number of vehicles that move in the area, and of those with their middle in the frame or visible.
    vehicles
        Properties of the visible movers: ``vehicle_id``, ``length``, ``speed``, …, one row each.
    probability, detectability
        P_D and d′ of the ideal observer for each. [1]
    information
        Fisher information of the (east, north) of each (`bounds.position`); NaN if not measured. [m⁻²]
    scored
        Scores by stage that detects: best of each vehicle, and of the false detections.
    tracked
        Whether each vehicle is tracked, by stage that tracks.
    """

    index: int
    time_s: float
    movers: int
    in_view: int
    vehicles: dict[str, Array]
    probability: Array
    detectability: Array
    information: Array
    scored: dict[str, Scored] = field(default_factory=dict)
    tracked: dict[str, Array] = field(default_factory=dict)


def order_observers(of_group: Mapping[str, FrameBudget]) -> None:
    """Raise the observer of all elements to that of pan, and limit that of DoLP to it.

    All elements contain what either group has; the observers' approximations of P_D can differ in order.
    """
    every, dolp = of_group["all"], of_group["dolp"]
    pan = of_group.get("pan", every)  # which light without polarization does not change
    for name in ("probability", "detectability"):
        most = np.maximum(getattr(every, name), getattr(pan, name))
        setattr(every, name, most)
        setattr(dolp, name, np.minimum(getattr(dolp, name), most))


def loss_budget(frames: list[FrameBudget], false_per_frame: float) -> xr.Dataset:
    """Share of the vehicles at each stage over all frames, at an equal number of false detections.

    Returns
    -------
    ``of_moving(stage)``: share of the vehicles that move in the scored area, counting only visible ones from
    ``visible`` on. ``of_visible(stage)``: share of the visible ones. ``false_detections(stage)``: number per
    frame, where the stage detects. NaN where a stage was not measured. Attributes ``d_prime_5`` and
    ``d_prime_50``: 5th percentile and median of the visible vehicles. One ``row`` per vehicle and frame with
    its properties and ``found_…`` by stage.

    Raises
    ------
    ValueError
        If no frame has a moving vehicle.
    """
    movers = sum(f.movers for f in frames)
    if movers == 0:
        raise ValueError("`case` must have moving vehicles in the scored area for a loss budget; got none.")
    visible = sum(len(f.probability) for f in frames)
    counts = dict.fromkeys(STAGES, np.nan)
    counts |= {"moving": movers, "in_view": sum(f.in_view for f in frames), "visible": visible}
    counts["ideal_observer"] = sum(float(f.probability.sum()) for f in frames)
    false = dict.fromkeys(STAGES, np.nan)
    found: dict[str, Array] = {"ideal_observer": np.concatenate([f.probability for f in frames])}
    for stage in DETECTION_STAGES:
        if all(stage in f.scored for f in frames):
            limit = threshold([f.scored[stage].false for f in frames], false_per_frame)
            found[stage] = np.concatenate([limit.count(f.scored[stage].vehicle) for f in frames])
            false[stage] = float(np.mean([limit.count(f.scored[stage].false).sum() for f in frames]))
    for stage in TRACKING_STAGES:
        if all(stage in f.tracked for f in frames):
            found[stage] = np.concatenate([f.tracked[stage] for f in frames])
    counts |= {stage: float(values.sum()) for stage, values in found.items()}
    d_prime = np.concatenate([f.detectability for f in frames])
    share = np.array([counts[stage] for stage in STAGES], float)
    of_visible = np.where(np.arange(len(STAGES)) >= STAGES.index("visible"), share / max(visible, 1), np.nan)
    quantiles = np.quantile(d_prime, [0.05, 0.5]) if len(d_prime) else np.full(2, np.nan)
    return xr.Dataset(
        {
            "of_moving": ("stage", share / movers, {"units": "1"}),
            "of_visible": ("stage", of_visible, {"units": "1"}),
            "false_detections": ("stage", np.array([false[stage] for stage in STAGES]), {"units": "1"}),
            **_rows(frames, found, d_prime),
        },
        coords={"stage": list(STAGES)},
        attrs={
            "frames": [f.index for f in frames],
            "false_per_frame": float(false_per_frame),
            "d_prime_5": float(quantiles[0]),
            "d_prime_50": float(quantiles[1]),
        },
    )


def _rows(frames: list[FrameBudget], found: Mapping[str, Array], d_prime: Array) -> dict:
    units = {"length_m": "m", "speed_m_s": "m s-1", "time_s": "s"}
    rows = {name: np.concatenate([f.vehicles[name] for f in frames]) for name in frames[0].vehicles}
    rows["time_s"] = np.concatenate([np.full(len(f.probability), f.time_s) for f in frames])
    rows["d_prime"] = d_prime
    rows |= {f"found_{stage}": values.astype(float) for stage, values in found.items()}
    return {name: ("row", values, {"units": units.get(name, "1")}) for name, values in rows.items()}


def score_detections(
    position: Float[Array, "detection 2"],
    score: Float[Array, "detection"],
    vehicle_m: Float[Array, "vehicle 2"],
    length_m: Float[Array, "vehicle"],
) -> Scored:
    """Assign each detection to the nearest vehicle in reach; it is false if no vehicle is near.

    Parameters
    ----------
    position, score
        Positions and scores of the detections. [m, 1]
    vehicle_m, length_m
        Middles and lengths of all vehicles of the truth. [m]
    """
    best = np.full(len(vehicle_m), -np.inf)
    owner, false = assign_vehicles(position, vehicle_m, length_m)
    owned = owner >= 0
    np.maximum.at(best, owner[owned], np.asarray(score, float)[owned])
    return Scored(best, np.asarray(score, float)[false])


def assign_vehicles(
    position: Float[Array, "detection 2"],
    vehicle_m: Float[Array, "vehicle 2"],
    length_m: Float[Array, "vehicle"],
) -> tuple[Int[Array, "detection"], Bool[Array, "detection"]]:
    """Index of the nearest vehicle in reach of each detection, −1 for none; and whether it is false."""
    if not len(position) or not len(vehicle_m):
        return np.full(len(position), -1), np.ones(len(position), np.bool_)
    distance = np.hypot(*(position[:, None] - vehicle_m[None]).transpose(2, 0, 1))
    within = distance <= np.maximum(REACH_M, length_m / 2 + 1.0)
    owner = np.where(within, distance, np.inf).argmin(axis=1)
    near = distance <= np.maximum(FALSE_M, length_m / 2 + 1.0)
    return np.where(within.any(axis=1), owner, -1), ~near.any(axis=1)


class Threshold(NamedTuple):
    """Score above which a detection counts, and the part of a detection with just that score that counts."""

    score: float
    tied: float

    def count(self, scores: Float[Array, "_"]) -> Float[Array, "_"]:
        """1 for a score above the threshold, 0 below, a part for a tie. [1]"""
        scores = np.asarray(scores, float)
        return np.where(scores > self.score, 1.0, np.where(scores == self.score, self.tied, 0.0))


def threshold(false: list[Float[Array, "detection"]], false_per_frame: float) -> Threshold:
    """Score above which the mean frame has a number of false detections; −∞ if there are fewer.

    Of detections with equal scores, such as a detector's capped contrast, a part counts: that of the line
    between the two points of its receiver operating characteristic.

    Raises
    ------
    ValueError
        If no false detection is allowed.
    """
    if not false_per_frame > 0:
        raise ValueError(f"`false_per_frame` must be greater than 0; got {false_per_frame:g}.")
    scores = np.sort(np.concatenate(false))[::-1]
    allowed = int(false_per_frame * len(false))
    if allowed >= len(scores):
        return Threshold(-np.inf, 0.0)
    limit = float(scores[allowed])
    above, same = int((scores > limit).sum()), int((scores == limit).sum())
    return Threshold(limit, (allowed - above) / same)


@dataclass(frozen=True)
class OracleRules:
    """Rules of the tracker in use, applied with oracle association.

    Parameters
    ----------
    hits, window
        Confirmation by M of N frames.
    age_s
        Minimum age at confirmation. [s]
    single_score
        Score of one detection that confirms at once.
    coast_s
        Maximum time without a detection. [s]
    lag_s
        Fixed lag of the reported tracks. [s]
    """

    hits: int
    window: int
    age_s: float
    single_score: float
    coast_s: float
    lag_s: float


def track_by_oracle(
    score: Float[Array, "time"], times_s: Float[Array, "time"], rules: OracleRules
) -> Bool[Array, "time"]:
    """Return True for each frame in which a vehicle is tracked, if its detections are associated by truth.

    A track is confirmed when M of its last N frames detected it over at least the minimum age, or by a single
    detection with a high score. It ends when it was not detected for longer than it may coast. With a fixed
    lag a vehicle is tracked at a time if it is tracked at any time within the lag after it.

    Parameters
    ----------
    score, times_s
        Best score of the vehicle's detections in each frame, −∞ where none detected it. [1, s]
    rules
        Rules of the tracker.
    """
    out, detected = np.zeros(len(score), np.bool_), np.asarray(score) > -np.inf
    since = last = None
    confirmed = False
    for k, found in enumerate(detected):
        if last is not None and times_s[k] - last > rules.coast_s + 1e-9 and not found:
            since, confirmed = None, False
        if found:
            last = times_s[k]
            since = last if since is None else since
        recent = detected[max(k - rules.window + 1, 0) : k + 1]
        if found and not confirmed and since is not None:
            often = recent.sum() >= rules.hits and times_s[k] - since >= rules.age_s - 1e-9
            confirmed = bool(often or score[k] >= rules.single_score)
        out[k] = confirmed
    if rules.lag_s > 0:
        latest = np.searchsorted(times_s, times_s + rules.lag_s + 1e-6)
        out = np.array([out[k:end].any() for k, end in enumerate(latest)], np.bool_)
    return out
