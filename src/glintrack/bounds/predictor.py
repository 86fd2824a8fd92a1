"""Fixed predictor of a frame's background from past frames, the same for every detector.

Each element's point of the scene is projected into the past frames. A plane in row and column is fitted there
to its 3 × 3 neighbours of the same kind by least squares, weighed by distance and age. Its value at the point
is the prediction; its residuals give the variance of the error.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float

from glintrack.camera import Camera, Pose, rotation
from glintrack.core.arrays import Array
from glintrack.core.distortion import distort
from glintrack.core.parallel import over_rows

PAST = 8  # frames
NEAR_ELEMENTS = 0.8  # RMS distance at which a neighbour's weight falls to e^(−½)
AGE_S = 5.0
_MIN_SAMPLES = 6
_RIDGE = 0.02  # of the slopes, against samples on one line


class PastFrame(NamedTuple):
    """Earlier frame for the prediction.

    Parameters
    ----------
    electrons
        Expected electrons of each element, without noise. [e]
    occluded
        Elements with a vehicle or its shadow, which are not used.
    pose
        True or reported pose.
    time_s
        Time of the frame. [s]
    """

    electrons: Float[Array, "row column"]
    occluded: Bool[Array, "row column"]
    pose: Pose
    time_s: float


class PredictedBackground(NamedTuple):
    """Electrons expected without vehicles, and the variance of the error of each; NaN if unknown. [e, e²]"""

    electrons: Float[Array, "row column"]
    variance: Float[Array, "row column"]


def predict(
    past: list[PastFrame], points: Float[Array, "row column 3"], camera: Camera, side: int, time_s: float
) -> PredictedBackground:
    """Predict a frame's elements.

    Parameters
    ----------
    past
        Earlier frames; `PAST` of them at most are used, the latest.
    points
        Points of the scene that the elements see; NaN where not known. [m]
    camera
        The camera.
    side
        Elements along a superpixel: the spacing of elements of one kind.
    time_s
        Time of the frame. [s]
    """
    past = sorted(past, key=lambda p: p.time_s)[-PAST:]
    shape = points.shape[:2]
    out = PredictedBackground(np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32))
    if not past:
        return out
    views = _Views(
        np.stack([p.pose.position for p in past]),
        np.stack([rotation(p.pose) for p in past]),
        camera.focal_length_m / camera.pitch_m,
        *camera.principal_point,
        camera.bending,
    )
    weights = np.array([math.exp(-(time_s - p.time_s) / AGE_S) for p in past])
    electrons = np.stack([p.electrons.astype(np.float32) for p in past])
    occluded, points = np.stack([p.occluded for p in past]), np.ascontiguousarray(points, float)
    over_rows(_predict, shape[0], electrons, occluded, points, views, weights, side, *out)
    return out


class _Views(NamedTuple):
    """Poses and projection of past frames, as `camera.project` uses them."""

    position: Float[Array, "frame 3"]
    rotation: Float[Array, "frame 3 3"]
    scale: float
    row: float
    column: float
    bending: Float[Array, "coefficient"]


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _predict(start, stop, electrons, occluded, points, views, age_weight, side, out, variance):
    frames, rows, columns = electrons.shape
    samples = np.empty((4, 9 * frames))
    down, across = np.empty(3), np.empty(3)
    for i in range(start, stop):
        for j in range(columns):
            n = 0
            for k in range(frames):
                row, column = _place(points[i, j], views, k)
                if not (0 <= row < rows and 0 <= column < columns):
                    continue
                r0 = math.floor((row - i % side) / side + 0.5) * side + i % side
                c0 = math.floor((column - j % side) / side + 0.5) * side + j % side
                _weigh(r0 - row, side, down)
                _weigh(c0 - column, side, across)
                for a in range(-1, 2):
                    r = r0 + a * side
                    if r < 0 or r >= rows:
                        continue
                    for b in range(-1, 2):
                        c = c0 + b * side
                        if c < 0 or c >= columns or occluded[k, r, c]:
                            continue
                        if (r - row) ** 2 + (c - column) ** 2 > 9.0 * side * NEAR_ELEMENTS**2:
                            continue
                        samples[0, n], samples[1, n], samples[2, n] = electrons[k, r, c], r - row, c - column
                        samples[3, n] = age_weight[k] * down[a + 1] * across[b + 1]
                        n += 1
            if n >= _MIN_SAMPLES:
                out[i, j], variance[i, j] = _plane(samples, n)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _place(point, views, k):
    """Row and column of a point in a past frame (`camera.project`), NaN behind the lens; single precision."""
    turn, lens = views.rotation[k], views.position[k]
    x, y, z = point[0] - lens[0], point[1] - lens[1], point[2] - lens[2]
    ahead = -(turn[2, 0] * x + turn[2, 1] * y + turn[2, 2] * z)
    if not ahead > 0.0:
        return np.float32(np.nan), np.float32(np.nan)
    right = (turn[0, 0] * x + turn[0, 1] * y + turn[0, 2] * z) / ahead
    down = -(turn[1, 0] * x + turn[1, 1] * y + turn[1, 2] * z) / ahead
    if views.bending.size > 0:
        right, down = distort(right, down, views.bending)
    return np.float32(views.row + views.scale * down), np.float32(views.column + views.scale * right)


@nb.njit(cache=True, error_model="numpy", forceinline=True)
def _weigh(nearest, side, weight):
    """e^(−d²/2) of the nearest neighbour along one axis, and of those before and after it."""
    square = NEAR_ELEMENTS * NEAR_ELEMENTS
    ratio = math.exp(-nearest * side / square)
    weight[1] = math.exp(-0.5 * nearest * nearest / square)
    next_to = weight[1] * math.exp(-0.5 * side * side / square)
    weight[0], weight[2] = next_to / ratio, next_to * ratio


@nb.njit(cache=True, fastmath={"reassoc", "contract", "nsz", "arcp"}, forceinline=True, error_model="numpy")
def _plane(samples, count):
    """Value of the fitted plane at the origin, and the variance of a further sample about it.

    ``samples`` holds value, row, column and weight of each.
    """
    s0 = mr = mc = mv = squares = 0.0
    for k in range(count):
        v, r, c, w = samples[0, k], samples[1, k], samples[2, k], samples[3, k]
        s0 += w
        mr += w * r
        mc += w * c
        mv += w * v
        squares += w * w
    mr, mc, mv = mr / s0, mc / s0, mv / s0
    rr = rc = cc = rv = cv = 0.0
    for k in range(count):
        w = samples[3, k]
        v, r, c = samples[0, k] - mv, samples[1, k] - mr, samples[2, k] - mc
        rr += w * r * r
        rc += w * r * c
        cc += w * c * c
        rv += w * r * v
        cv += w * c * v
    rr, cc = rr + _RIDGE * s0, cc + _RIDGE * s0
    det = rr * cc - rc * rc
    gr, gc = (rv * cc - cv * rc) / det, (cv * rr - rv * rc) / det
    value = mv - gr * mr - gc * mc
    misfit = 0.0
    for k in range(count):
        e = samples[0, k] - value - gr * samples[1, k] - gc * samples[2, k]
        misfit += samples[3, k] * e * e
    effective = s0 * s0 / squares
    spread = misfit / s0 * effective / max(effective - 3.0, 1.0)
    lever = (mr * mr * cc - 2 * mr * mc * rc + mc * mc * rr) / det * s0 / effective
    return value, spread * (1.0 + 1.0 / effective + min(lever, 1.0))
