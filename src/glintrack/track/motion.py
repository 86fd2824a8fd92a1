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
from glintrack.core.parallel import over_rows
from glintrack.track.design import TrackDesign
from glintrack.track.motion_kernels import Belief, Scan, Step, combine_rows, predict_rows, update_rows

TURN_S, STOP_S = 3.0, 10.0  # mean time of a turn, and of a stop
START_SPEED_M_S = 1.5  # standard deviation of each speed component of a vehicle that drives off
COAST_DAMPING_S = 3.0  # time in which the speed of a coasting track decays, with one mode
MAX_COAST_SIGMA_M = 20.0  # standard deviation of a position beyond which coasting lets it grow no more
STOPPED_DRIFT_M2_S = 0.02  # the centroid of a standing vehicle wanders by its shadow
_LEAST_ROWS = 8192  # fewer targets are not worth a thread


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
    """What is believed of each target in each mode.

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


def motion_over(design: TrackDesign, interval_s: float) -> Motion:
    """Modes of a design's motion model over an interval. [s]"""
    dt, straight = float(interval_s), design.motion.acceleration_psd_m2_s3
    if design.motion.model == "constant-velocity":
        one = np.ones((1, 1))
        detection = np.array([design.association.detection_probability])
        return Motion(
            dt * np.eye(2)[None], np.eye(2)[None], _acceleration_noise(straight, dt)[None], one, detection, -1
        )
    rate = math.radians(design.motion.turn_rate_deg_s)
    arcs = [_arc(rate * side, dt) for side in (0.0, 1.0, -1.0)]
    start = START_SPEED_M_S**2
    still = np.diag([STOPPED_DRIFT_M2_S * dt, STOPPED_DRIFT_M2_S * dt, start, start])
    times_s = [design.motion.straight_s, TURN_S, TURN_S, STOP_S]
    leave = 1 - np.exp(-dt / np.array(times_s))
    # where a vehicle goes that leaves its mode: straight, left, right, stopped
    share = np.array([[0, 0.3, 0.3, 0.4], [0.8, 0, 0, 0.2], [0.8, 0, 0, 0.2], [0.8, 0.1, 0.1, 0]])
    return Motion(
        np.stack([reach for reach, _ in arcs] + [np.zeros((2, 2))]),
        np.stack([turn for _, turn in arcs] + [np.zeros((2, 2))]),
        np.stack([_acceleration_noise(straight, dt)] * 3 + [still]),
        np.diag(1 - leave) + leave[:, None] * share,
        np.array(
            [design.association.detection_probability] * 3 + [design.motion.stopped_detection_probability]
        ),
        3,
        (design.motion.stopping_speed_m_s + design.motion.braking_m_s2 * dt) ** 2,
    )


def _acceleration_noise(psd: float, dt: float) -> Float[Array, "4 4"]:
    return psd * np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(2))


def _arc(rate_rad_s: float, dt: float) -> tuple[Float[Array, "2 2"], Float[Array, "2 2"]]:
    """Reach and turn of a counter-clockwise arc; a straight line at rate 0."""
    angle = rate_rad_s * dt
    along, aside = (
        (dt, 0.0) if angle == 0 else (math.sin(angle) / rate_rad_s, (1 - math.cos(angle)) / rate_rad_s)
    )
    c, s = math.cos(angle), math.sin(angle)
    return np.array([[along, -aside], [aside, along]]), np.array([[c, -s], [s, c]])


def newborn_modes(
    position: Float[Array, "track 2"],
    covariance: Float[Array, "track 2 2"],
    speed_covariance: Float[Array, "track 2 2"],
    modes: int,
    velocity: Float[Array, "track 2"] | None = None,
) -> Modes:
    """Targets seen once: any velocity; a vehicle that stands is not expected to be seen first.

    Parameters
    ----------
    position, covariance
        Of the first detection. [m, m²]
    speed_covariance
        Of the velocity. [m² s⁻²]
    modes
        How many there are.
    velocity
        Its mean, 0 by default. [m s⁻¹]
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
    modes: Modes, motion: Motion, damping_s: Float[Array, "track"], widest_m: float = math.inf
) -> Modes:
    """What is believed after one interval without a look.

    Parameters
    ----------
    modes
        Before.
    motion
        From `motion_over` of the interval.
    damping_s
        Time in which each target's speed decays; infinite keeps it. [s]
    widest_m
        Standard deviation of a position beyond which it grows no more: a car is on the street somewhere near.
        [m]
    """
    before, after = _belief(modes), _unknown(modes)
    step = Step(
        motion.reach, motion.turn, motion.noise, motion.transition, motion.stopped, float(motion.stopping2),
        np.asarray(damping_s, float), float(motion.reach[0, 0, 0]), float(widest_m) ** 2,
    )  # fmt: skip
    over_rows(predict_rows, len(modes.mean), before, step, after, least=_LEAST_ROWS)
    return Modes(*after)


def _belief(modes: Modes) -> Belief:
    return Belief(modes.mean, modes.covariance, modes.probability)


def _unknown(modes: Modes) -> Belief:
    """Room for as many targets and modes."""
    return Belief(*(np.empty_like(values) for values in _belief(modes)))


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
    """What is believed after a look, each detection counting by the probability that it is the target's.

    Parameters
    ----------
    modes
        Predicted.
    motion
        Whose detection probabilities count.
    seen
        Share of each target's surroundings that had data; where nothing was seen a miss tells nothing. [1]
    first
        Pairs ``first[k]`` to ``first[k + 1]`` are those of target k.
    partners, weights
        Detection of each pair and its association probability; what a target's weights leave of 1 is the
        probability of a miss. With a weight of 1 this is the plain Kalman update. [1]
    measured, measured_covariance
        Detections. [m, m²]
    """
    before, after = _belief(modes), _unknown(modes)
    scan = Scan(
        motion.detection, np.asarray(seen, float), first, partners, np.asarray(weights, float), measured,
        measured_covariance,
    )  # fmt: skip
    over_rows(update_rows, len(modes.mean), before, scan, after, least=_LEAST_ROWS)
    return Modes(*after)


def combined(modes: Modes) -> tuple[Float[Array, "track 4"], Float[Array, "track 4 4"]]:
    """Mean and covariance over the modes. [m, m s⁻¹]"""
    n = len(modes.mean)
    if modes.mean.shape[1] == 1:
        return modes.mean.reshape(n, 4), modes.covariance.reshape(n, 4, 4)
    mean, covariance = np.empty((n, 4)), np.empty((n, 4, 4))
    over_rows(
        combine_rows, n, modes.mean, modes.covariance, modes.probability, mean, covariance, least=_LEAST_ROWS
    )
    return mean, covariance
