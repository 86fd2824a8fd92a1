"""How well a vehicle's place can be known: posterior Cramér–Rao bounds of filtered positions.

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
it. Farina, Ristic and Timmoneri, IEEE Trans. Signal Process. 50, 2916 (2002): enumerated misses.
"""

import math
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array

GATE = 5.0  # standard deviations about the truth within which clutter may be taken for it
DRAWS = 40_000  # of scans
_MOST_MISSES = 16  # frames whose misses are enumerated: 65 536 sequences
TRAFFIC_ACCELERATION_PSD, TRAFFIC_SPEED_SIGMA = 0.86, 6.7  # `glintrack bound quickstart --calibrate`
START_SIGMA_M = 100.0  # of a vehicle's place before it is first seen: anywhere about here


class Kinematics(NamedTuple):
    """How vehicles move: power density of their acceleration [m² s⁻³], rms speed of one component [m s⁻¹]."""

    acceleration_psd: float
    speed_sigma: float


TRAFFIC = Kinematics(TRAFFIC_ACCELERATION_PSD, TRAFFIC_SPEED_SIGMA)


def fit_kinematics(
    interval_s: Float[Array, "step"], before: Float[Array, "step 2"], after: Float[Array, "step 2"]
) -> Kinematics:
    """The white acceleration that changes velocities as much as those of moving vehicles change.

    Parameters
    ----------
    interval_s, before, after
        Of every step of every vehicle: how long, and its velocity at either end. [s, m s⁻¹]

    Raises
    ------
    ValueError
        If there are no steps.
    """
    if not len(interval_s):
        raise ValueError("`interval_s` must hold one step of a moving vehicle at least, got none")
    change2 = ((np.asarray(after) - before) ** 2).sum(axis=1)
    return Kinematics(
        float(np.mean(change2 / (2 * np.asarray(interval_s)))),
        float(np.sqrt(np.mean(np.asarray(before) ** 2))),
    )


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


def bound_over_misses(
    times_s: Float[Array, "time"],
    information: Float[Array, "time 2 2"],
    motion: Kinematics,
    detection_probability: float,
    start_sigma_m: float = START_SIGMA_M,
) -> Float[Array, "time 4 4"]:
    """The same where each frame says so much with a probability, and else nothing: mean over all sequences.

    Each sequence of misses has its own bound; their mean bounds a filter that knows which frames missed. It
    is never below `posterior_bound` with the information times the probability.

    Raises
    ------
    ValueError
        If there are more than 16 frames, or the probability is none.
    """
    count = len(times_s)
    if count > _MOST_MISSES:
        raise ValueError(f"`times_s` must hold at most {_MOST_MISSES} frames to enumerate, got {count}")
    _check_probability(detection_probability)
    covariance, weight = _prior(motion, start_sigma_m)[None], np.ones(1)
    out = np.empty((count, 4, 4))
    for k, seen in enumerate(information):
        if k:
            step_s = float(times_s[k] - times_s[k - 1])
            covariance = _moved(covariance, step_s, motion.acceleration_psd)
        covariance = np.concatenate([_informed(covariance, seen), covariance])
        weight = np.concatenate([detection_probability * weight, (1 - detection_probability) * weight])
        out[k] = np.einsum("s,sij->ij", weight, covariance)
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


def position_rms(covariance: Float[Array, "*time 4 4"]) -> Float[Array, "*time"]:
    """Root of the summed variances of east and north. [m]"""
    return np.sqrt(covariance[..., 0, 0] + covariance[..., 1, 1])


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
