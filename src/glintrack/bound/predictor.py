"""The background of a frame, predicted from past frames: one frozen predictor, whatever detector flies.

Each element's point of the scene is projected into the past frames; of its own kind's 3 × 3 neighbours there
a plane in row and column is fitted by least squares, weighed by distance and age, and read at the point. Its
residuals say how far past frames agree, which is the prediction's own error.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float

from glintrack.arrays import Array
from glintrack.camera import Camera, Pose, project
from glintrack.parallel import over_rows

PAST = 8  # frames
NEAR_ELEMENTS = 0.8  # RMS distance at which a neighbour's weight falls to e^(−½)
AGE_S = 5.0
_LEAST = 6  # samples
_RIDGE = 0.02  # of the slopes, against samples that all lie on one line


class Past(NamedTuple):
    """What is known of one earlier frame.

    Parameters
    ----------
    electrons
        Expected of each element, without noise. [e]
    occluded
        Elements that a vehicle or its shadow touches: left out.
    pose
        True or reported.
    time_s
        When. [s]
    """

    electrons: Float[Array, "row column"]
    occluded: Bool[Array, "row column"]
    pose: Pose
    time_s: float


class Prediction(NamedTuple):
    """Expected electrons and the variance of their error; NaN where the past says nothing. [e, e²]"""

    electrons: Float[Array, "row column"]
    variance: Float[Array, "row column"]


def predict(
    past: list[Past], points: Float[Array, "row column 3"], camera: Camera, side: int, time_s: float
) -> Prediction:
    """Predict a frame's elements.

    Parameters
    ----------
    past
        Earlier frames; `PAST` of them at most are used, the latest.
    points
        Of the scene, which the elements look at. NaN where none is known. [m]
    camera
        The camera.
    side
        Elements along a superpixel: neighbours of one kind lie so far apart.
    time_s
        Of the frame. [s]
    """
    past = sorted(past, key=lambda p: p.time_s)[-PAST:]
    shape = points.shape[:2]
    out = Prediction(np.full(shape, np.nan, np.float32), np.full(shape, np.nan, np.float32))
    if not past:
        return out
    places = np.stack([project(camera, p.pose, points).astype(np.float32) for p in past])
    weights = np.array([math.exp(-(time_s - p.time_s) / AGE_S) for p in past])
    electrons = np.stack([p.electrons.astype(np.float32) for p in past])
    occluded = np.stack([p.occluded for p in past])
    over_rows(_predict, shape[0], electrons, occluded, places, weights, side, *out)
    return out


@nb.njit(nogil=True, cache=True)
def _predict(start, stop, electrons, occluded, places, age_weight, side, out, variance):
    frames, rows, columns = electrons.shape
    most = 9 * frames
    v, dr, dc, w = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    for i in range(start, stop):
        for j in range(columns):
            n = 0
            for k in range(frames):
                row, column = places[k, i, j, 0], places[k, i, j, 1]
                if not (0 <= row < rows and 0 <= column < columns):
                    continue
                r0 = math.floor((row - i % side) / side + 0.5) * side + i % side
                c0 = math.floor((column - j % side) / side + 0.5) * side + j % side
                for a in range(-1, 2):
                    r = r0 + a * side
                    if r < 0 or r >= rows:
                        continue
                    for b in range(-1, 2):
                        c = c0 + b * side
                        if c < 0 or c >= columns or occluded[k, r, c]:
                            continue
                        far = ((r - row) ** 2 + (c - column) ** 2) / NEAR_ELEMENTS**2
                        if far > 9.0 * side:
                            continue
                        v[n], dr[n], dc[n] = electrons[k, r, c], r - row, c - column
                        w[n] = age_weight[k] * math.exp(-0.5 * far)
                        n += 1
            if n >= _LEAST:
                out[i, j], variance[i, j] = _plane(v[:n], dr[:n], dc[:n], w[:n])


@nb.njit(nogil=True, cache=True)
def _plane(v, dr, dc, w):
    """Value of the fitted plane at the origin, and the variance of a further sample about it."""
    s0 = w.sum()
    mr, mc, mv = (w * dr).sum() / s0, (w * dc).sum() / s0, (w * v).sum() / s0
    rr = rc = cc = rv = cv = 0.0
    for k in range(len(v)):
        r, c, d = dr[k] - mr, dc[k] - mc, v[k] - mv
        rr += w[k] * r * r
        rc += w[k] * r * c
        cc += w[k] * c * c
        rv += w[k] * r * d
        cv += w[k] * c * d
    rr, cc = rr + _RIDGE * s0, cc + _RIDGE * s0
    det = rr * cc - rc * rc
    gr, gc = (rv * cc - cv * rc) / det, (cv * rr - rv * rc) / det
    value = mv - gr * mr - gc * mc
    misfit = squares = 0.0
    for k in range(len(v)):
        e = v[k] - value - gr * dr[k] - gc * dc[k]
        misfit += w[k] * e * e
        squares += w[k] * w[k]
    effective = s0 * s0 / squares
    spread = misfit / s0 * effective / max(effective - 3.0, 1.0)
    lever = (mr * mr * cc - 2 * mr * mc * rc + mc * mc * rr) / det * s0 / effective
    return value, spread * (1.0 + 1.0 / effective + min(lever, 1.0))
