"""Peaks of the windows' strength, and what speaks for a vehicle at each: the numbers that a law weighs.

Each is followed back along straight motions (`straight_motion`), held against a
standstill, and against how restless its place has been for longer.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.track.detect.footprint import peak_places, peaks
from glintrack.track.detect.straight_motion import support, velocities

FEATURES = ("support", "root of support", "strength", "still", "restless")
APART_M = 3.0  # of peaks: cars in a queue stand 6 m apart
CAP = 4.0  # of a window's strength: a glint shows no more vehicle than a car
LEAST = 0.25  # strength of a peak
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
        `FEATURES` of each: mean strength along the best straight motion, and its root; its own strength; the
        mean at a standstill, which speaks against a vehicle; and the mean over the last seconds at its
        place, which speaks for one: where something moved before is a road. [1]
    """

    place: Float[Array, "peak 2"]
    features: Float[Array, "peak feature"]

    def __len__(self) -> int:
        """Count of peaks."""
        return len(self.place)


def no_peaks() -> Peaks:
    """Nothing stands out."""
    return Peaks(np.empty((0, 2)), np.empty((0, len(FEATURES))))


def find(
    means: Float[Array, "row column"],
    usual: float,
    past: tuple[Float[Array, "frame row column"], Float[Array, "frame"], Float[Array, "row column"]],
    cell_m: float,
) -> Peaks:
    """Peaks of a frame.

    Parameters
    ----------
    means, usual
        Evidence on the ground under the windows, and its median. [1]
    past
        Strength in the frames before and how long ago they were [1, s], and the mean over the last seconds.
    cell_m
        Of the grid. [m]
    """
    cells = peaks(means, usual + LEAST, APART_M, cell_m)
    now = means[tuple(cells.T)] - usual
    place = peak_places(means - np.float32(usual), cells)
    layers, ages_s, restless = past
    capped = np.clip(now, 0.0, CAP)
    velocity = velocities(SLOWEST_M_S, FASTEST_M_S, STEP_M_S)
    best, _, still = support(layers, ages_s, cells, capped, velocity, cell_m)
    often = restless[tuple(cells.T)]
    features = [best, np.sqrt(best), np.minimum(now, STRONGEST), still, often]
    return Peaks(place, np.stack(features, axis=-1))
