"""Peaks of the windows' strength, and what speaks for a vehicle at each: the numbers that a law weighs.

Each is followed back along straight motions (`straight_motion`), held against a
standstill, and against how restless its place has been for longer.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.track.detect.footprint import peak_places, peaks
from glintrack.track.detect.straight_motion import support, velocities

FEATURES = ("√support", "strength", "still", "√still", "restless", "√restless", "log spread")
APART_M = 3.0  # of peaks: cars in a queue stand 6 m apart
CAP = 4.0  # of a window's strength: a glint shows no more vehicle than a car
LEAST = 2.0  # strength of a peak in spreads
SPREAD = 0.03, 0.2  # least and most: what the flights hold that calibrate the law
STRONGEST = 6.0  # strength counts no further
SLOWEST_M_S, FASTEST_M_S, STEP_M_S = 2.5, 22.0, 1.2


@dataclass(frozen=True)
class Peaks:
    """Peaks of one frame, likely or not.

    Parameters
    ----------
    place
        Row and column of each in the grid of windows. [cell]
    features
        `FEATURES` of each: root of the mean strength along the best straight motion; its own strength; the
        mean at a standstill, which speaks against a vehicle; the mean over the last seconds at its place,
        which speaks for one: where something moved before is a road; and the logarithm of the frame's
        spread, since the more readings a window holds the more a strength says. [1]
    velocity
        East and north speed of that motion. [m s⁻¹]
    """

    place: Float[Array, "peak 2"]
    features: Float[Array, "peak feature"]
    velocity: Float[Array, "peak 2"]

    def __len__(self) -> int:
        """Count of peaks."""
        return len(self.place)


def no_peaks() -> Peaks:
    """Nothing stands out."""
    return Peaks(np.empty((0, 2)), np.empty((0, len(FEATURES))), np.empty((0, 2)))


def find(
    means: Float[Array, "row column"],
    usual: float,
    spread: float,
    past: tuple[Float[Array, "frame row column"], Float[Array, "frame"], Float[Array, "row column"]],
    cell_m: float,
) -> Peaks:
    """Peaks of a frame.

    Parameters
    ----------
    means, usual, spread
        Evidence on the ground under the windows, its median, and the median of what lies above it, less
        that: of the ground at rest, since vehicles are few. [1]
    past
        Strength in the frames before and how long ago they were [1, s], and the mean over the last seconds.
    cell_m
        Of the grid. [m]
    """
    spread = float(np.clip(spread, *SPREAD))
    cells = peaks(means, usual + LEAST * spread, APART_M, cell_m)
    now = means[tuple(cells.T)] - usual
    place = peak_places(means - np.float32(usual), cells)
    layers, ages_s, restless = past
    capped = np.clip(now, 0.0, CAP)
    velocity = velocities(SLOWEST_M_S, FASTEST_M_S, STEP_M_S)
    best, motion, still = support(layers, ages_s, cells, capped, velocity, cell_m)
    often, strength = restless[tuple(cells.T)], np.minimum(now, STRONGEST)
    whole = np.full(len(cells), np.log(spread))
    features = [np.sqrt(best), strength, still, np.sqrt(still), often, np.sqrt(often), whole]
    return Peaks(place, np.stack(features, axis=-1), motion)
