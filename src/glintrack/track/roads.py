"""Road map of the tracker: vehicles are on roads, and drive along them."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from scipy.spatial import KDTree

from glintrack.core.arrays import Array

SIGMA_M = 2.0  # width of the Gaussian by which the density of vehicles falls beyond the road
MAX_COST_NAT = 4.0  # of a detection off the road: vehicles may stand anywhere
HALF_WIDTH_M = 3.0  # within this distance of a lane's centre line a detection is on the road
ACROSS_SIGMA_M_S = 2.0  # standard deviation of a new track's speed across its road
SPACING_M = 1.0  # of the points that stand for a line: distances are too long by less than 0.13 m at 1 m


@dataclass(frozen=True)
class Roads:
    """Centre lines of lanes as points with directions.

    Parameters
    ----------
    tree
        Tree of the points. [m]
    along
        Unit vector along the line at each point.
    """

    tree: KDTree
    along: Float[Array, "point 2"]

    def off_road_cost(self, position_m: Float[Array, "n 2"]) -> Float[Array, "n"]:
        """Cost of a detection off the road: −ln of the density of vehicles relative to the road. [nat]"""
        distance, _ = self.tree.query(position_m)
        excess = np.maximum(distance - HALF_WIDTH_M, 0.0) / SIGMA_M
        return np.minimum(0.5 * excess**2, MAX_COST_NAT)

    def speed_covariance(self, position_m: Float[Array, "n 2"], along_m_s: float) -> Float[Array, "n 2 2"]:
        """Covariance of the velocity of a vehicle on the nearest road, either way along it. [m² s⁻²]"""
        _, nearest = self.tree.query(position_m)
        u = self.along[nearest]
        outer = u[:, :, None] * u[:, None, :]
        return along_m_s**2 * outer + ACROSS_SIGMA_M_S**2 * (np.eye(2) - outer)


def roads_of(lines: Sequence[Float[Array, "point 2"]]) -> Roads:
    """Roads from centre lines, each a chain of points (east, north). [m]

    Raises
    ------
    ValueError
        If there is no line with a length.
    """
    points, along = [], []
    for line in lines:
        line = np.asarray(line, float)
        if line.ndim != 2 or line.shape[1] != 2 or not np.isfinite(line).all():
            raise ValueError(f"`roads` must be lines of finite points (east, north); got shape {line.shape}.")
        steps = np.diff(line, axis=0)
        lengths = np.hypot(*steps.T)
        for start, step, length in zip(line, steps, lengths, strict=False):
            if length == 0:
                continue
            count = max(1, round(length / SPACING_M))
            share = (np.arange(count) + 0.5) / count
            points.append(start + share[:, None] * step)
            along.append(np.repeat(step[None] / length, len(share), axis=0))
    if not points:
        raise ValueError("`roads` must hold a line with a length; got none.")
    return Roads(KDTree(np.concatenate(points)), np.concatenate(along))
