"""Motion of vehicles: Kalman filters on arrays of targets, one mode or several that interact (IMM).

State ``[east, north, east speed, north speed]``, position measured. Every mode is linear: the position gains
``reach · velocity`` and the velocity becomes ``turn · velocity``, with white noise. A vehicle that turns does
so at a fixed rate to the left or right; one that stands keeps its place and forgets its velocity.

References
----------
Bar-Shalom, Li and Kirubarajan, *Estimation with Applications to Tracking and Navigation* (2001): white-noise
acceleration §6.2.2, coordinated turn §11.7.1, interacting multiple models §11.6.6.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.track.design import TrackDesign

TURN_S, STOP_S = 3.0, 10.0  # mean time of a turn, and of a stop
TURN_RATE_RAD_S = math.radians(20.0)
# standard deviation of the speed components from which a vehicle may stand at the next frame: this plus its
# braking until then
STOPPING_SPEED_M_S = 1.0
START_SPEED_M_S = 1.5  # standard deviation of each speed component of a vehicle that drives off
COAST_DAMPING_S = 3.0  # time in which the speed of a coasting track decays, with one mode
STOPPED_DAMPING_S = 0.3  # the same of a track that stands
MAX_COAST_SIGMA_M = 20.0  # standard deviation of a position beyond which coasting lets it grow no more
MAX_STOPPED_SIGMA_M = 2.0  # the same of a track that stands, so that it takes no passing vehicle
STOPPED_DRIFT_M2_S = 0.02  # the centroid of a standing vehicle wanders by its shadow


@dataclass(frozen=True)
class Motion:
    """The modes of motion over one interval.

    Parameters
    ----------
    reach
        Way per velocity. [s]
    turn
        Velocity after the interval per velocity before. [1]
    noise
        Covariance added. [m², m² s⁻¹, m² s⁻²]
    transition
        Probability of mode j after mode i. [1]
    detection
        Probability that change detection sees a vehicle in view. [1]
    stopped
        Index of the mode that stands, −1 for none.
    stopping2
        Variance of each speed component from which a vehicle may come to stand within the interval. [m² s⁻²]
    """

    reach: Float[Array, "mode 2 2"]
    turn: Float[Array, "mode 2 2"]
    noise: Float[Array, "mode 4 4"]
    transition: Float[Array, "mode mode"]
    detection: Float[Array, "mode"]
    stopped: int
    stopping2: float = math.inf


@dataclass(frozen=True)
class Modes:
    """State of each target in each mode.

    Parameters
    ----------
    mean, covariance
        Kalman state. [m, m s⁻¹]
    probability
        Of each mode, summing to 1. [1]
    """

    mean: Float[Array, "track mode 4"]
    covariance: Float[Array, "track mode 4 4"]
    probability: Float[Array, "track mode"]


def motion_model(design: TrackDesign, interval_s: float) -> Motion:
    """Modes of a design's motion model over an interval. [s]"""
    dt = float(interval_s)
    white = np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))
    noise = design.motion.acceleration_psd_m2_s3 * white
    if design.motion.model == "constant-velocity":
        return Motion(
            reach=dt * np.eye(2)[None], turn=np.eye(2)[None], noise=noise[None], transition=np.ones((1, 1)),
            detection=np.array([design.association.detection_probability]), stopped=-1,
        )  # fmt: skip
    arcs = [_arc(TURN_RATE_RAD_S * side, dt) for side in (0.0, 1.0, -1.0)]
    start = START_SPEED_M_S**2
    still = np.diag([STOPPED_DRIFT_M2_S * dt, STOPPED_DRIFT_M2_S * dt, start, start])
    times_s = [design.motion.straight_s, TURN_S, TURN_S, STOP_S]
    leave = 1 - np.exp(-dt / np.array(times_s))
    # where a vehicle goes that leaves its mode: straight, left, right, stopped
    share = np.array([[0, 0.3, 0.3, 0.4], [0.8, 0, 0, 0.2], [0.8, 0, 0, 0.2], [0.8, 0.1, 0.1, 0]])
    found = [design.association.detection_probability] * 3 + [design.motion.stopped_detection_probability]
    stopping_m_s = STOPPING_SPEED_M_S + design.motion.braking_m_s2 * dt
    return Motion(
        reach=np.stack([reach for reach, _ in arcs] + [np.zeros((2, 2))]),
        turn=np.stack([turn for _, turn in arcs] + [np.zeros((2, 2))]),
        noise=np.stack([noise] * 3 + [still]), transition=np.diag(1 - leave) + leave[:, None] * share,
        detection=np.array(found), stopped=3, stopping2=stopping_m_s**2,
    )  # fmt: skip


def _arc(rate_rad_s: float, dt: float) -> tuple[Float[Array, "2 2"], Float[Array, "2 2"]]:
    """Reach and turn of a counter-clockwise arc; a straight line at rate 0."""
    angle = rate_rad_s * dt
    along, aside = (
        (dt, 0.0) if angle == 0 else (math.sin(angle) / rate_rad_s, (1 - math.cos(angle)) / rate_rad_s)
    )
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[along, -aside], [aside, along]]), np.array([[c, -s], [s, c]])


def initial_modes(
    position: Float[Array, "track 2"],
    covariance: Float[Array, "track 2 2"],
    speed_covariance: Float[Array, "track 2 2"],
    modes: int,
    velocity: Float[Array, "track 2"] | None = None,
) -> Modes:
    """Modes of targets after their first detection: any velocity, and rarely stopped.

    Parameters
    ----------
    position, covariance
        First detection. [m, m²]
    speed_covariance
        Covariance of the velocity. [m² s⁻²]
    modes
        Number of modes.
    velocity
        Mean of the velocity, 0 by default. [m s⁻¹]
    """
    n = len(position)
    mean = np.zeros((n, modes, 4))
    mean[:, :, :2] = position[:, None]
    if velocity is not None:
        mean[:, :, 2:] = velocity[:, None]
    spread = np.zeros((n, modes, 4, 4))
    spread[:, :, :2, :2] = covariance[:, None]
    spread[:, :, 2:, 2:] = speed_covariance[:, None]
    first = np.array([1.0]) if modes == 1 else np.array([0.8, 0.08, 0.08, 0.04])
    return Modes(mean, spread, np.repeat(first[None], n, axis=0))


def predict_modes(
    modes: Modes,
    motion: Motion,
    damping_s: Float[Array, "track"],
    widest_m: Float[Array, "track"] | float = math.inf,
) -> Modes:
    """Predict the state after one interval.

    Parameters
    ----------
    modes
        State before.
    motion
        Motion model of the interval.
    damping_s
        Time in which each target's speed decays; infinite for no decay. [s]
    widest_m
        Standard deviation of each position beyond which it grows no more: a car is on a street nearby. [m]
    """
    mixed, dt = _mix_modes(modes, motion), float(motion.reach[0, 0, 0])
    damping_s = np.asarray(damping_s, float)
    damps = np.isfinite(damping_s) & (dt > 0)
    slowed = np.where(damps, np.exp(-dt / damping_s), 1.0)  # speed after dt over that before
    with np.errstate(invalid="ignore", divide="ignore"):  # way over that at full speed
        shortened = np.where(damps, damping_s * (1 - slowed) / dt, 1.0)
    f = np.zeros((*mixed.probability.shape, 4, 4))
    f[..., [0, 1], [0, 1]] = 1.0
    f[..., :2, 2:] = shortened[:, None, None, None] * motion.reach
    f[..., 2:, 2:] = slowed[:, None, None, None] * motion.turn
    mean = (f @ mixed.mean[..., None])[..., 0]
    covariance = f @ mixed.covariance @ f.swapaxes(-1, -2) + motion.noise
    wide = 0.5 * (covariance[..., 0, 0] + covariance[..., 1, 1])
    # all of it is scaled alike: the gain of the next measurement stays what it was
    widest_m2 = np.square(np.broadcast_to(widest_m, len(wide)))[:, None]
    shrink = np.where(wide > widest_m2, widest_m2 / wide, 1.0)[..., None, None]
    return Modes(mean, _symmetric(covariance * shrink), mixed.probability)


def _mix_modes(modes: Modes, motion: Motion) -> Modes:
    """Mix the modes: mean and covariance on entering each mode, and its probability.

    A vehicle that drives fast does not stand at the next frame, and stays in its mode. The factor is the
    likelihood that a velocity of that mode, braked within the interval, is 0, relative to a mean of 0.
    """
    if modes.mean.shape[1] == 1:
        return modes
    change = np.repeat(motion.transition[None], len(modes.mean), axis=0)
    driving = np.arange(len(motion.transition)) != motion.stopped
    if motion.stopped >= 0:
        spread = motion.stopping2 + 0.5 * (modes.covariance[..., 2, 2] + modes.covariance[..., 3, 3])
        slow = np.exp(-0.5 * (modes.mean[..., 2:] ** 2).sum(axis=-1) / spread)[:, driving]
        stops = motion.transition[driving, motion.stopped]
        change[:, driving, motion.stopped] = slow * stops
        change[:, driving, driving] = np.diag(motion.transition)[driving] + (1 - slow) * stops
    joint = change * modes.probability[:, :, None]
    total = joint.sum(axis=1)
    with np.errstate(invalid="ignore"):
        share = np.where(total[:, None] > 0, joint / total[:, None], 1 / modes.mean.shape[1])
    mean = np.einsum("tij,tic->tjc", share, modes.mean)
    apart = modes.mean[:, :, None] - mean[:, None]
    covariance = np.einsum("tij,ticd->tjcd", share, modes.covariance)
    covariance += np.einsum("tij,tijc,tijd->tjcd", share, apart, apart)
    return Modes(mean, covariance, total)


def _symmetric(covariance: Float[Array, "*n 4 4"]) -> Float[Array, "*n 4 4"]:
    return 0.5 * (covariance + covariance.swapaxes(-1, -2))


def mahalanobis_squared(
    apart: Float[Array, "*n 2"], spread: Float[Array, "*n 2 2"]
) -> tuple[Float[Array, "*n"], Float[Array, "*n"]]:
    """Squared Mahalanobis distance, and the determinant of the covariance."""
    dx, dy = apart[..., 0], apart[..., 1]
    s00, s01, s11 = spread[..., 0, 0], spread[..., 0, 1], spread[..., 1, 1]
    determinant = s00 * s11 - s01 * s01
    return (dx * dx * s11 - 2 * dx * dy * s01 + dy * dy * s00) / determinant, determinant


def position_density(
    modes: Modes,
    tracks: Int[Array, "pair"],
    partners: Int[Array, "pair"],
    measured: Float[Array, "detection 2"],
    measured_covariance: Float[Array, "detection 2 2"],
) -> Float[Array, "pair mode"]:
    """Density of each pair's measured position under each mode of its predicted target. [m⁻²]"""
    apart = measured[partners, None] - modes.mean[tracks, :, :2]
    spread = modes.covariance[tracks, :, :2, :2] + measured_covariance[partners, None]
    distance2, determinant = mahalanobis_squared(apart, spread)
    return np.exp(-0.5 * distance2) / (2 * np.pi * np.sqrt(determinant))


def update_modes(
    modes: Modes,
    motion: Motion,
    seen: Float[Array, "track"],
    first: Int[Array, "track_plus_1"],
    partners: Int[Array, "pair"],
    weights: Float[Array, "pair"],
    measured: Float[Array, "detection 2"],
    measured_covariance: Float[Array, "detection 2 2"],
) -> Modes:
    """Update the state with detections, weighted by the probability that each is the target's.

    Parameters
    ----------
    modes
        Predicted state.
    motion
        Motion model, for its probabilities of detection.
    seen
        Share of each target's surroundings that had data; a miss without data is no evidence. [1]
    first
        Pairs ``first[k]`` to ``first[k + 1]`` are those of target k.
    partners, weights
        Detection of each pair and its association probability; what a target's weights leave of 1 is the
        probability of a miss. With a weight of 1 this is the plain Kalman update. [1]
    measured, measured_covariance
        Detections. [m, m²]
    """
    n, count = len(modes.mean), np.diff(first)
    target, weights = np.repeat(np.arange(n), count), np.asarray(weights, float)
    prior = modes.probability * (1 - motion.detection * np.asarray(seen, float)[:, None])
    share = _shares(prior, modes.probability)
    missed = np.maximum(1 - np.bincount(target, weights, n), 0)[:, None] * share
    hit = weights[:, None] * np.ones(modes.mean.shape[1])
    if modes.mean.shape[1] > 1:
        density = position_density(modes, target, partners, measured, measured_covariance)
        likelihood = modes.probability[target] * motion.detection * density
        hit = weights[:, None] * _shares(likelihood, modes.probability[target])
    own = missed.copy()
    np.add.at(own, target, hit)
    means, covariances = _update_states(modes, target, partners, measured, measured_covariance)
    unchanged = (count == 0)[:, None] | (own <= 0)
    own_or_1 = np.where(unchanged, 1.0, own)
    miss_share, hit_share = missed / own_or_1, hit / own_or_1[target]
    mean = miss_share[..., None] * modes.mean
    np.add.at(mean, target, hit_share[..., None] * means)
    apart, hit_apart = modes.mean - mean, means - mean[target]
    covariance = miss_share[..., None, None] * (modes.covariance + apart[..., None] * apart[..., None, :])
    spread = covariances + hit_apart[..., None] * hit_apart[..., None, :]
    np.add.at(covariance, target, hit_share[..., None, None] * spread)
    return Modes(
        np.where(unchanged[..., None], modes.mean, mean),
        np.where(unchanged[..., None, None], modes.covariance, covariance),
        _shares(own, modes.probability),
    )


def _shares(values: Float[Array, "n mode"], otherwise: Float[Array, "n mode"]) -> Float[Array, "n mode"]:
    """Values over their sum by row, or others where that is 0."""
    total = values.sum(axis=1, keepdims=True)
    return np.where(total > 0, values / np.where(total > 0, total, 1.0), otherwise)


def _update_states(
    modes: Modes,
    target: Int[Array, "pair"],
    partners: Int[Array, "pair"],
    measured: Float[Array, "detection 2"],
    measured_covariance: Float[Array, "detection 2 2"],
) -> tuple[Float[Array, "pair mode 4"], Float[Array, "pair mode 4 4"]]:
    """Update each mode with each pair's detection, by Joseph's form.

    P' = (1 − K H) P (1 − K H)ᵀ + K R Kᵀ, where H takes the position; it stays positive where rounding bites.
    """
    mean, covariance = modes.mean[target], modes.covariance[target]
    noise = measured_covariance[partners, None]
    s = covariance[..., :2, :2] + noise
    s00, s01, s11 = (s[..., i, j, None] for i, j in ((0, 0), (0, 1), (1, 1)))
    east, north = covariance[..., 0], covariance[..., 1]
    gain = np.stack([east * s11 - north * s01, north * s00 - east * s01], axis=-1)
    gain /= (s00 * s11 - s01 * s01)[..., None]
    innovation = measured[partners, None] - mean[..., :2]
    left = covariance - gain @ covariance[..., :2, :]
    after = left + (gain @ noise - left[..., :2]) @ gain.swapaxes(-1, -2)
    return mean + (gain @ innovation[..., None])[..., 0], _symmetric(after)


def combine_modes(modes: Modes) -> tuple[Float[Array, "track 4"], Float[Array, "track 4 4"]]:
    """Mean and covariance over the modes. [m, m s⁻¹]"""
    n = len(modes.mean)
    if modes.mean.shape[1] == 1:
        return modes.mean.reshape(n, 4), modes.covariance.reshape(n, 4, 4)
    mean = np.einsum("tj,tjc->tc", modes.probability, modes.mean)
    apart = modes.mean - mean[:, None]
    covariance = np.einsum("tj,tjcd->tcd", modes.probability, modes.covariance)
    covariance += np.einsum("tj,tjc,tjd->tcd", modes.probability, apart, apart)
    return mean, _symmetric(covariance)
