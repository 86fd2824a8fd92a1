"""Evidence of vehicles in the residuals of raw elements: change, peaks, motion and likelihood ratio.

1. Squared change of elements (``pan``, ``all``) or of S1/S0 and S2/S0 of superpixels (``dolp``) over its
   variance. DoLP and angle of polarization follow from those two ratios. Readings are compared with the
   *predicted readings of the same elements*, so the effect of the polarizers' different positions cancels.
2. Its mean logarithm on a ground grid.
3. Peaks of the means under windows: of a vehicle's size, or in ``all``, where signs tell vehicles from
   edges, smaller than a car, so that two cars side by side are two peaks.
4. Track before detect: support of each peak by the best straight motion through earlier frames. An earlier
   frame has at most the strength of the peak itself, so that one strong glint elsewhere gives no support.
5. A logistic model of these features, in ``all`` with those of signed change (`mosaic_windows`), gives the
   log-likelihood ratio of vehicle against clutter. Its constants are in ``data/calibration/mosaic.toml``;
   ``python tools/calibrate.py`` fits and writes them.
6. In ``all`` one peak for each vehicle: roof and shadow, or front and rear, may be two.
"""

from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Float, Int
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.core.records import Mosaic
from glintrack.track.calibration import read_calibration
from glintrack.track.detect.footprint import peak_places, peaks
from glintrack.track.detect.mosaic_model import ElementPrediction
from glintrack.track.detect.mosaic_windows import WINDOW_FEATURES

CAP = 4.0  # of a window's strength: a glint counts as much as a car
MIN_STRENGTH_SPREADS = 2.0  # of a peak
SPREAD_RANGE = 0.03, 0.2  # of the flights that calibrate the model
MAX_STRENGTH = 6.0  # limit of the strength as a feature
MIN_SPEED_M_S, SPEED_STEP_M_S = 2.5, 1.2
_MOTION = "support_root", "strength", "still", "still_root", "restless", "restless_root", "log_spread"
FEATURES = {"pan": _MOTION, "dolp": _MOTION, "all": _MOTION + WINDOW_FEATURES}
MAX_RATIO = 8.0  # beyond it the calibration flights have no clutter
MIN_RATIO = 1.1  # of a detection: with less false tracks come, with more tracks are lost
_ROUNDING = 1 - 1e-9  # rounding of a sum must not exclude the best motion


@dataclass(frozen=True)
class Search:
    """Windows of a channel: their size and the least distance of peaks [m], and the least strength. [1]"""

    window_m: tuple[float, float]
    apart_m: float
    strength: float


_WIDE = Search((4.6, 2.6), 3.0, 0.0)  # cars in a queue stand 6 m apart
SEARCHES = {"pan": _WIDE, "dolp": _WIDE, "all": Search((2.6, 1.2), 1.6, 0.35)}


@dataclass(frozen=True)
class PastStrength:
    """Strength of the windows in earlier frames.

    Parameters
    ----------
    layers, ages_s
        Strength in each frame, the greatest within a cell [1], and its age [s].
    restless
        Mean over the last seconds. [1]
    """

    layers: Float[Array, "frame row column"]
    ages_s: Float[Array, "frame"]
    restless: Float[Array, "row column"]


@dataclass(frozen=True)
class Peaks:
    """Peaks of one frame, likely vehicles or not.

    Parameters
    ----------
    cells, place
        Row and column of the cell and of the centroid of each, in the grid of windows. [cell]
    features
        `FEATURES` of each: root of the mean strength along the best straight motion; its own strength; the
        mean at a standstill, which is evidence against a vehicle; the mean over the last seconds at its
        place, which is evidence for one, since other vehicles moved there; and the logarithm of the frame's
        spread, since a strength is better known in windows with more readings. In ``all`` the detector adds
        `WINDOW_FEATURES`. [1]
    velocity
        East and north speed of that motion. [m s⁻¹]
    """

    cells: Int[Array, "peak 2"]
    place: Float[Array, "peak 2"]
    features: Float[Array, "peak feature"]
    velocity: Float[Array, "peak 2"]

    def __len__(self) -> int:
        """Count of peaks."""
        return len(self.place)


def no_peaks(channel: str) -> Peaks:
    """Return an empty set of peaks."""
    pairs = np.empty((0, 2))
    return Peaks(pairs.astype(int), pairs, np.empty((0, len(FEATURES[channel]))), pairs)


def select_elements(layout: tuple[tuple[str | float, ...], ...], channel: str) -> tuple[tuple[int, int], ...]:
    """Select the elements of a superpixel that a channel searches.

    Pan is all elements without a polarizer; without such elements it is the polarizers.

    Raises
    ------
    ValueError
        If the channel is DoLP and fewer than three polarizers are there.
    """
    every = [(i, j) for i, row in enumerate(layout) for j in range(len(row))]
    polarizers = [(i, j) for i, j in every if not isinstance(layout[i][j], str)]
    if channel == "dolp":
        if len(polarizers) < 3:
            raise ValueError(
                "`mosaic` must have three polarizers in a superpixel for channel 'dolp'; "
                f"got {len(polarizers)}."
            )
        return tuple(polarizers)
    open_ = [place for place in every if place not in polarizers]
    return tuple(open_ if channel == "pan" and open_ else every)


def element_change(
    seen: ElementPrediction, mosaic: Mosaic, places: tuple[tuple[int, int], ...], channel: str
) -> tuple[tuple[Float[Array, "row column"], ...], Float[Array, "plane 2"]]:
    """Squared change over its variance, and the position of each of its planes in the superpixel.

    Parameters
    ----------
    seen, mosaic, places
        Prediction of these kinds of elements, and the mosaic.
    channel
        ``pan``, ``dolp`` or ``all``.
    """
    if channel != "dolp":
        return seen.z2, np.array(places, float)
    gains = np.array([mosaic.gains[place] for place in places])
    to_stokes = np.linalg.pinv(gains)
    out = np.empty(seen.z2[0].shape, np.float32)
    expected = tuple(one[..., 0] for one in seen.fitted)
    stack = (np.stack(part, axis=-1) for part in (seen.readings, expected, seen.var))
    over_rows(_stokes_change, len(out), *stack, to_stokes, out)
    return (out,), np.array([np.mean(places, axis=0)])


@nb.njit(cache=True, nogil=True)
def _stokes_change(start, stop, readings, expected, var, to_stokes, out):
    """Mahalanobis distance of (S1, S2)/S0 from its prediction, halved: equivalent to one z²."""
    n = readings.shape[2]
    s, t = np.empty(3), np.empty(3)
    for i in range(start, stop):
        for j in range(out.shape[1]):
            for k in range(3):
                s[k] = t[k] = 0.0
                for p in range(n):
                    s[k] += to_stokes[k, p] * readings[i, j, p]
                    t[k] += to_stokes[k, p] * expected[i, j, p]
            if not (s[0] > 0.0 and t[0] > 0.0):
                out[i, j] = np.nan
                continue
            q, u = t[1] / t[0], t[2] / t[0]
            a = b = c = 0.0
            for p in range(n):
                jq = (to_stokes[1, p] - q * to_stokes[0, p]) / t[0]
                ju = (to_stokes[2, p] - u * to_stokes[0, p]) / t[0]
                a += jq * jq * var[i, j, p]
                b += jq * ju * var[i, j, p]
                c += ju * ju * var[i, j, p]
            dq, du = s[1] / s[0] - q, s[2] / s[0] - u
            det = a * c - b * b
            out[i, j] = (c * dq * dq - 2 * b * dq * du + a * du * du) / det if det > 0.0 else np.nan


def find_peaks(
    means: Float[Array, "row column"],
    usual: float,
    spread: float,
    past: PastStrength,
    search: Search,
    cell_m: float,
    max_speed_m_s: float,
) -> Peaks:
    """Find the peaks of a frame and the features of their motion.

    Parameters
    ----------
    means, usual, spread
        Evidence on the ground under the windows, its median, and the median of the values above it, less
        that: statistics of the ground at rest, since vehicles are few. [1]
    past
        Strength in the frames before.
    search
        Windows of the channel.
    cell_m
        Side of a cell. [m]
    max_speed_m_s
        Greatest speed of the motions that are tried. [m s⁻¹]
    """
    spread = float(np.clip(spread, *SPREAD_RANGE))
    least = usual + max(search.strength, MIN_STRENGTH_SPREADS * spread)
    cells = peaks(means, least, search.apart_m, cell_m)
    now = means[tuple(cells.T)] - usual
    place = peak_places(means - np.float32(usual), cells)
    velocity = velocities(MIN_SPEED_M_S, max_speed_m_s, SPEED_STEP_M_S)
    # mean strength along the best straight motion and at a standstill; off the grid a frame counts as half
    best, motion, still = np.empty(len(cells)), np.zeros((len(cells), 2)), np.empty(len(cells))
    layers, ages_s = np.ascontiguousarray(past.layers, np.float32), np.asarray(past.ages_s, float)
    strength = np.clip(now, 0.0, CAP)
    over_rows(_support, len(cells), layers, ages_s, cells, strength, velocity, cell_m, best, motion, still)
    often, strength = past.restless[tuple(cells.T)], np.minimum(now, MAX_STRENGTH)
    whole = np.full(len(cells), np.log(spread))
    features = [np.sqrt(best), strength, still, np.sqrt(still), often, np.sqrt(often), whole]
    return Peaks(cells, place, np.stack(features, axis=-1), motion)


def select_peaks(
    position_m: Float[Array, "peak 2"],
    velocity_m_s: Float[Array, "peak 2"],
    ratio: Float[Array, "peak"],
    channel: str,
) -> Int[Array, "selected"]:
    """Select likely peaks, by falling ratio; in ``all`` one for each vehicle.

    Near a likelier peak another one is a vehicle of its own only in dense traffic, where further peaks are
    likely around both, and in another lane.

    Parameters
    ----------
    position_m, velocity_m_s, ratio
        Place and motion of each peak, east and north [m, m s⁻¹], and its log-likelihood ratio [nat].
    channel
        ``pan``, ``dolp`` or ``all``.

    Returns
    -------
    Indices of the selected peaks.
    """
    likely = np.flatnonzero(ratio > MIN_RATIO)
    likely = likely[np.argsort(-ratio[likely], kind="stable")]
    if channel != "all":
        return likely
    known = read_calibration("mosaic").constants["one_vehicle"]
    at, selected = position_m[likely], np.ones(len(likely), bool)
    ahead = velocity_m_s[likely] / np.hypot(*velocity_m_s[likely].T)[:, None]
    tree = KDTree(at)
    within, near = (tree.query_ball_point(at, d, return_length=True) for d in known["neighbours_m"])
    dense = within - near >= known["neighbours"]
    for k, around in enumerate(tree.query_ball_point(at, known["reach_m"])):
        if selected[k]:
            other = np.array(around)
            gap = at[other] - at[k]
            in_line = np.abs(gap @ (ahead[k, ::-1] * (1, -1))) < known["across_m"]
            own_lane = dense[k] & dense[other] & ~in_line & (np.hypot(*gap.T) > known["lane_m"])
            selected[other[(other > k) & ~own_lane]] = False
    return likely[selected]


def velocities(slowest_m_s: float, fastest_m_s: float, step_m_s: float) -> Float[Array, "velocity 2"]:
    """East and north speeds on a square lattice, between two speeds. [m/s]"""
    count = int(np.ceil(fastest_m_s / step_m_s))
    axis = step_m_s * np.arange(-count, count + 1)
    east, north = np.meshgrid(axis, axis)
    speed = np.hypot(east, north)
    inside = (speed >= slowest_m_s) & (speed <= fastest_m_s)
    return np.stack([east[inside], north[inside]], axis=-1)


@nb.njit(cache=True, nogil=True, error_model="numpy")
def _support(start, stop, layers, ages, peak, strength, velocity, cell, out, best, still):
    frames, rows, columns = layers.shape
    back = np.empty((len(velocity), frames, 2), np.int64)  # cells from a peak to where it was
    for v in range(len(velocity)):
        for f in range(frames):
            back[v, f, 0] = int(np.floor(velocity[v, 1] * ages[f] / cell + 0.5))
            back[v, f, 1] = int(np.floor(0.5 - velocity[v, 0] * ages[f] / cell))
    for p in range(start, stop):
        now, i, j = strength[p], peak[p, 0], peak[p, 1]
        standing = now
        for f in range(frames):
            standing += min(layers[f, i, j], now)
        still[p] = standing / (frames + 1)
        most = -1.0
        for v in range(len(velocity)):
            total = now
            for f in range(frames):
                r, c = i + back[v, f, 0], j + back[v, f, 1]
                if 0 <= r < rows and 0 <= c < columns:
                    total += min(layers[f, r, c], now)
                else:
                    total += 0.5 * now
                if total + (frames - 1 - f) * now < _ROUNDING * most:  # for any strength in the other frames
                    break
            if total > most:
                most = total
                best[p, 0], best[p, 1] = velocity[v, 0], velocity[v, 1]
        out[p] = most / (frames + 1)


def log_likelihood_ratio(channel: str, features: Float[Array, "peak feature"]) -> Float[Array, "peak"]:
    """Log-likelihood ratio of vehicle against clutter for peaks of the channel's `FEATURES`. [nat]"""
    return np.minimum(read_calibration("mosaic").models[channel].log_odds(features), MAX_RATIO)


def detection_ratio(channel: str, ratio: Float[Array, "peak"]) -> Float[Array, "peak"]:
    """Log-likelihood ratio among the peaks beyond `MIN_RATIO`, which contain little clutter. [nat]

    Bayes's rule needs p(features, detected | vehicle) over the density of the clutter that is detected, which
    the tracker measures. So the logarithm of the ratio of the two detection probabilities is subtracted.
    """
    return ratio - read_calibration("mosaic").constants["detection_ratio"][channel]
