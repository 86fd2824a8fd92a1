"""Change statistic of a mosaic against its prediction: z² of elements or superpixels, gathered on the ground.

``pan`` takes the elements without a polarizer, ``all`` every element. ``dolp`` takes S1/S0 and S2/S0 of each
superpixel, of which DoLP and angle of polarization are made: of the readings against those of the *expected
readings of the same elements*. What the polarizers' different places make of an edge is in both and cancels.
"""

import numba as nb
import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.core.records import Mosaic
from glintrack.track.detect.mosaic_model import Prediction

FREEDOM = 3.0  # of Student's t: one wild element is no vehicle


def kinds_of(layout: tuple[tuple[str | float, ...], ...], channel: str) -> tuple[tuple[int, int], ...]:
    """Row and column in the superpixel of the elements that a channel needs.

    Without a mirror or an open element, pan is what the polarizers see.

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
                "`mosaic` must have three polarizers in a superpixel for channel 'dolp', "
                f"got {len(polarizers)}"
            )
        return tuple(polarizers)
    bare = [place for place in every if place not in polarizers]
    return tuple(bare if channel == "pan" and bare else every)


def strength(
    seen: Prediction, mosaic: Mosaic, places: tuple[tuple[int, int], ...], channel: str
) -> tuple[tuple[Float[Array, "row column"], ...], Float[Array, "plane 2"]]:
    """Squared change over its variance, and where in the superpixel each plane of it lies.

    Parameters
    ----------
    seen, mosaic, places
        The prediction of these kinds of elements, and what it was made of.
    channel
        ``pan``, ``dolp`` or ``all``.
    """
    if channel != "dolp":
        return seen.z2, np.array(places, float)
    gains = np.array([mosaic.gains[place] for place in places])
    to_stokes = np.linalg.pinv(gains)
    out = np.empty(seen.z2[0].shape, np.float32)
    stack = (np.stack(part, axis=-1) for part in (seen.readings, seen.expected, seen.var))
    over_rows(_normalized_stokes, len(out), *stack, to_stokes, out)
    return (out,), np.array([np.mean(places, axis=0)])


@nb.njit(cache=True, nogil=True)
def _normalized_stokes(start, stop, readings, expected, var, to_stokes, out):
    """Mahalanobis distance of (S1, S2)/S0 from its expectation, halved: like one z² for two numbers."""
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


def evidence(
    planes: tuple[Float[Array, "row column"], ...],
    offsets: Float[Array, "plane 2"],
    side: int,
    element: tuple[Float[Array, "y x"], Float[Array, "y x"]],
) -> Float[Array, "y x"]:
    """Mean over the planes of log(1 + z²/ν) where each cell of a ground grid is seen; 0 where unknown.

    Parameters
    ----------
    planes, offsets
        From `strength`.
    side
        Elements along a superpixel.
    element
        Row and column of the element that sees each cell.
    """
    out = np.zeros(element[0].shape, np.float32)
    logs = np.log1p(np.stack(planes) * np.float32(1 / FREEDOM))
    over_rows(_gather, len(out), logs, offsets, side, *element, out)
    return out


@nb.njit(cache=True, nogil=True)
def _gather(start, stop, planes, offsets, side, row, column, out):
    n, rows, columns = planes.shape
    per_side, share = np.float32(1 / side), np.float32(1 / n)
    for k in range(n):
        first_row = np.float32(0.5 - offsets[k, 0] / side)
        first_column = np.float32(0.5 - offsets[k, 1] / side)
        for i in range(start, stop):
            for j in range(out.shape[1]):
                r, c = row[i, j] * per_side + first_row, column[i, j] * per_side + first_column
                if r >= 0 and c >= 0 and r < rows and c < columns:  # False of what sees nothing
                    value = planes[k, int(r), int(c)]
                    if value == value:
                        out[i, j] += share * value
