"""Track before detect: how well the best straight motion through the frames before supports a peak.

Along each of a set of velocities the peak's place is followed back; of each earlier frame counts what is
there, but no more than the peak itself has, so that one strong glint elsewhere supports nothing.
"""

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows

_BEATEN = 1 - 1e-9  # of the best motion's support: rounding in a sum leaves out none that is better


def velocities(slowest_m_s: float, fastest_m_s: float, step_m_s: float) -> Float[Array, "velocity 2"]:
    """East and north speeds on a square lattice, between two speeds. [m/s]"""
    count = int(np.ceil(fastest_m_s / step_m_s))
    axis = step_m_s * np.arange(-count, count + 1)
    east, north = np.meshgrid(axis, axis)
    speed = np.hypot(east, north)
    held = (speed >= slowest_m_s) & (speed <= fastest_m_s)
    return np.stack([east[held], north[held]], axis=-1)


def support(
    layers: Float[Array, "frame row column"],
    ages_s: Float[Array, "frame"],
    peak: Int[Array, "peak 2"],
    strength: Float[Array, "peak"],
    velocity: Float[Array, "velocity 2"],
    cell_m: float,
) -> tuple[Float[Array, "peak"], Float[Array, "peak 2"], Float[Array, "peak"]]:
    """Mean strength of each peak along its best straight motion, and that motion.

    Parameters
    ----------
    layers, ages_s
        Strength in the frames before, each the greatest within a cell, and how long ago they were. [1, s]
    peak, strength
        Row and column of the peaks of this frame, and their strengths.
    velocity
        To be tried: east and north. [m/s]
    cell_m
        Of the grid. [m]

    Returns
    -------
    Mean over this and the earlier frames, the velocity [m/s], and the same mean for standing still. Off the
    grid an earlier frame counts as half of the peak: it says nothing.
    """
    out, best = np.empty(len(peak)), np.zeros((len(peak), 2))
    still = np.empty(len(peak))
    over_rows(
        _support, len(peak), np.ascontiguousarray(layers, np.float32), np.asarray(ages_s, float), peak,
        strength, velocity, cell_m, out, best, still,
    )  # fmt: skip
    return out, best, still


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
                if total + (frames - 1 - f) * now < _BEATEN * most:  # whatever the other frames show
                    break
            if total > most:
                most = total
                best[p, 0], best[p, 1] = velocity[v, 0], velocity[v, 1]
        out[p] = most / (frames + 1)
