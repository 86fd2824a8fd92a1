"""Loss budget: share of the same vehicles that each stage still has (docs/theory/bounds.md)."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array

RUNG_WORDS: Mapping[str, str] = {
    "moving": "moving in the window",
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
RUNGS = tuple(RUNG_WORDS)
FOUND = ("known_background", "predicted_background", "reported_pose", "detector")
TRACKED = ("oracle_association", "tracker")
REACH_M = 4.0  # of a detection from its vehicle's middle, or half its length and a metre
FALSE_M = 5.0  # farther from every vehicle a detection is false


class Scored(NamedTuple):
    """Best score among the detections of each vehicle (−∞ for none), and the scores of false detections."""

    vehicle: Float[Array, "vehicle"]
    false: Float[Array, "detection"]


@dataclass
class FrameLadder:
    """What one frame says of one group of elements.

    Parameters
    ----------
    index, time_s
        Which frame, and when. [1, s]
    movers, in_view
        How many vehicles move in the window, and of how many the frame holds the middle or sees enough.
    vehicles
        Of the visible movers: ``vehicle_id`` and what they are (``length``, ``speed``, …), a row each.
    probability, detectability
        The ideal observer's P_D and d′ of each. [1]
    information
        Fisher information of the (east, north) of each (`bound.position`). [m⁻²]
    scored
        By rung of `FOUND`: best score of each, and those of the false detections.
    held
        By rung of `TRACKED`: whether each is held.
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
    held: dict[str, Array] = field(default_factory=dict)


def order_observers(of_group: Mapping[str, FrameLadder]) -> None:
    """Hold all elements to no less than pan and DoLP to no more: they know all that either does.

    Each observer's P_D is an approximation, which in much noise puts them in another order.
    """
    every, dolp = of_group["all"], of_group["dolp"]
    pan = of_group.get("pan", every)  # which light without polarization does not change
    for name in ("probability", "detectability"):
        most = np.maximum(getattr(every, name), getattr(pan, name))
        setattr(every, name, most)
        setattr(dolp, name, np.minimum(getattr(dolp, name), most))


def ladder(frames: list[FrameLadder], false_per_frame: float) -> xr.Dataset:
    """Every rung over all frames, at the same number of false detections.

    Returns
    -------
    ``ladder(rung)`` over the moving vehicles of the window, counting the visible ones alone from ``visible``
    on; ``of_visible(rung)`` over these; ``false_detections(rung)`` a frame, where the rung detects; NaN where
    a rung was not measured. Attributes ``d_prime_5`` and ``d_prime_50``, which 95 % and half of the visible
    vehicles exceed. One ``row`` a vehicle and frame with what it is and ``found_…`` by rung.

    Raises
    ------
    ValueError
        If no frame has a moving vehicle.
    """
    movers = sum(f.movers for f in frames)
    if movers == 0:
        raise ValueError("`case` must have moving vehicles in the window for a ladder, got none")
    visible = sum(len(f.probability) for f in frames)
    counts = dict.fromkeys(RUNGS, np.nan)
    counts |= {"moving": movers, "in_view": sum(f.in_view for f in frames), "visible": visible}
    counts["ideal_observer"] = sum(float(f.probability.sum()) for f in frames)
    false = dict.fromkeys(RUNGS, np.nan)
    found: dict[str, Array] = {"ideal_observer": np.concatenate([f.probability for f in frames])}
    for rung in FOUND:
        if all(rung in f.scored for f in frames):
            least = threshold([f.scored[rung].false for f in frames], false_per_frame)
            found[rung] = np.concatenate([least.detected(f.scored[rung].vehicle) for f in frames])
            false[rung] = float(np.mean([least.detected(f.scored[rung].false).sum() for f in frames]))
    for rung in TRACKED:
        if all(rung in f.held for f in frames):
            found[rung] = np.concatenate([f.held[rung] for f in frames])
    counts |= {rung: float(values.sum()) for rung, values in found.items()}
    told = np.concatenate([f.detectability for f in frames])
    share = np.array([counts[rung] for rung in RUNGS], float)
    of_visible = np.where(np.arange(len(RUNGS)) >= RUNGS.index("visible"), share / max(visible, 1), np.nan)
    quantiles = np.quantile(told, [0.05, 0.5]) if len(told) else np.full(2, np.nan)
    return xr.Dataset(
        {
            "ladder": ("rung", share / movers, {"units": "1"}),
            "of_visible": ("rung", of_visible, {"units": "1"}),
            "false_detections": ("rung", np.array([false[rung] for rung in RUNGS]), {"units": "1"}),
            **_rows(frames, found, told),
        },
        coords={"rung": list(RUNGS)},
        attrs={
            "frames": [f.index for f in frames],
            "false_per_frame": float(false_per_frame),
            "d_prime_5": float(quantiles[0]),
            "d_prime_50": float(quantiles[1]),
        },
    )


def by(rows: xr.Dataset, rung: str, name: str, edges: Array) -> xr.Dataset:
    """Share of the visible movers that a rung finds, in classes of what they are.

    Parameters
    ----------
    rows
        From `ladder`.
    rung
        One of those measured.
    name
        ``length``, ``speed``, ``sunlit`` or ``visible_fraction``.
    edges
        Of the classes, the upper ones not included.
    """
    which = np.digitize(rows[name].values, edges) - 1
    inside = (which >= 0) & (which < len(edges) - 1)
    count = np.bincount(which[inside], minlength=len(edges) - 1)
    total = np.bincount(which[inside], rows[f"found_{rung}"].values[inside], minlength=len(edges) - 1)
    with np.errstate(invalid="ignore"):
        share = total / count
    units = {"units": str(rows[name].attrs.get("units", "1"))}
    return xr.Dataset(
        {"share": (name, share, {"units": "1"}), "vehicles": (name, count, {"units": "1"})},
        coords={name: (name, np.asarray(edges[:-1], float), units)},
    )


def _rows(frames: list[FrameLadder], found: Mapping[str, Array], told: Array) -> dict:
    units = {"length": "m", "speed": "m s-1", "time_s": "s"}
    names = [name for name in frames[0].vehicles] if frames else []
    rows = {name: np.concatenate([f.vehicles[name] for f in frames]) for name in names}
    rows["time_s"] = np.concatenate([np.full(len(f.probability), f.time_s) for f in frames])
    rows["d_prime"] = told
    rows |= {f"found_{rung}": values.astype(float) for rung, values in found.items()}
    return {name: ("row", values, {"units": units.get(name, "1")}) for name, values in rows.items()}


def score_detections(
    position: Float[Array, "detection 2"],
    score: Float[Array, "detection"],
    vehicle_m: Float[Array, "vehicle 2"],
    length_m: Float[Array, "vehicle"],
) -> Scored:
    """Give each detection to the nearest vehicle in reach; it is false if no vehicle, moving or not, is near.

    Parameters
    ----------
    position, score
        Of the detections. [m, 1]
    vehicle_m, length_m
        Middles and lengths of all vehicles of the truth. [m]
    """
    best = np.full(len(vehicle_m), -np.inf)
    owner, false = owners(position, vehicle_m, length_m)
    owned = owner >= 0
    np.maximum.at(best, owner[owned], np.asarray(score, float)[owned])
    return Scored(best, np.asarray(score, float)[false])


def owners(
    position: Float[Array, "detection 2"],
    vehicle_m: Float[Array, "vehicle 2"],
    length_m: Float[Array, "vehicle"],
) -> tuple[Int[Array, "detection"], Bool[Array, "detection"]]:
    """Nearest vehicle in reach of each detection, −1 for none; and whether none is near: it is false."""
    if not len(position) or not len(vehicle_m):
        return np.full(len(position), -1), np.ones(len(position), np.bool_)
    distance = np.hypot(*(position[:, None] - vehicle_m[None]).transpose(2, 0, 1))
    within = distance <= np.maximum(REACH_M, length_m / 2 + 1.0)
    owner = np.where(within, distance, np.inf).argmin(axis=1)
    near = distance <= np.maximum(FALSE_M, length_m / 2 + 1.0)
    return np.where(within.any(axis=1), owner, -1), ~near.any(axis=1)


class Threshold(NamedTuple):
    """A score to detect above, and which part of those that score just that counts as detected too."""

    least: float
    tied: float

    def detected(self, scores: Float[Array, "_"]) -> Float[Array, "_"]:
        """1 for what is detected, 0 for what is not, a part for a tie. [1]"""
        scores = np.asarray(scores, float)
        return np.where(scores > self.least, 1.0, np.where(scores == self.least, self.tied, 0.0))


def threshold(false: list[Float[Array, "detection"]], false_per_frame: float) -> Threshold:
    """Score above which so many detections a frame are false; −∞ if there are fewer.

    Of detections that all score the same, a detector's capped contrast, a part is taken: that of the line
    between the two points of its receiver operating characteristic.

    Raises
    ------
    ValueError
        If no false detection is allowed.
    """
    if not false_per_frame > 0:
        raise ValueError(f"`false_per_frame` must be greater than 0, got {false_per_frame:g}")
    scores = np.sort(np.concatenate(false))[::-1]
    allowed = int(false_per_frame * len(false))
    if allowed >= len(scores):
        return Threshold(-np.inf, 0.0)
    least = float(scores[allowed])
    above, same = int((scores > least).sum()), int((scores == least).sum())
    return Threshold(least, (allowed - above) / same)


@dataclass(frozen=True)
class OracleRules:
    """Rules of the tracker in use, by which an oracle holds vehicles.

    Parameters
    ----------
    hits, window
        Of a confirmation: M of N frames.
    age_s
        Least age at confirmation. [s]
    single_score
        Score of one detection that confirms at once.
    coast_s
        How long a track coasts. [s]
    lag_s
        Fixed lag of the reported tracks. [s]
    """

    hits: int
    window: int
    age_s: float
    single_score: float
    coast_s: float
    lag_s: float


def held_by_oracle(
    score: Float[Array, "time"], times_s: Float[Array, "time"], rules: OracleRules
) -> Bool[Array, "time"]:
    """When a vehicle is held if its detections are associated by truth under a tracker's own rules.

    A track is confirmed when M of its last N frames detected it over at least the least age, or by a single
    detection with a high score. It then lasts until it was not detected for longer than it may coast. With a
    fixed lag a vehicle is held at a time if it is held at any time within the lag after it.

    Parameters
    ----------
    score, times_s
        Best score of the vehicle's detections in each frame, −∞ where none detected it. [1, s]
    rules
        Of the tracker.
    """
    out, detected = np.zeros(len(score), np.bool_), np.asarray(score) > -np.inf
    since = last = None
    held = False
    for k, found in enumerate(detected):
        if last is not None and times_s[k] - last > rules.coast_s + 1e-9 and not found:
            since, held = None, False
        if found:
            last = times_s[k]
            since = last if since is None else since
        recent = detected[max(k - rules.window + 1, 0) : k + 1]
        if found and not held and since is not None:
            confirmed = recent.sum() >= rules.hits and times_s[k] - since >= rules.age_s - 1e-9
            held = bool(confirmed or score[k] >= rules.single_score)
        out[k] = held
    if rules.lag_s > 0:
        latest = np.searchsorted(times_s, times_s + rules.lag_s + 1e-6)
        out = np.array([out[k:end].any() for k, end in enumerate(latest)], np.bool_)
    return out
