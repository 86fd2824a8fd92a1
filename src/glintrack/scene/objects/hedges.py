"""Hedges: two-metre pieces of one model, a dark core in a coat of leaf cards, set in a row along a line."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from shapely.geometry import LineString

from glintrack.core.arrays import Array
from glintrack.scene.objects.geometry import Mesh, MeshBuilder, box_patch, join
from glintrack.scene.objects.plants import leaf_cards

PIECE_M = 2.0
HALF_WIDTH_M = 0.45
_TOP_M, _ROOT_M = 1.2, 0.25  # so deep it stands in the ground, on slopes too
_CARDS = 70
_MODEL_SEED = 20100407


@dataclass(frozen=True)
class HedgePiece:
    """One piece of a hedge.

    Parameters
    ----------
    east_m, north_m
        Its middle. [m]
    heading_rad
        Along it, clockwise from north. [rad]
    leaf
        Material of its leaves.
    """

    east_m: float
    north_m: float
    heading_rad: float
    leaf: str = "leaf"


def hedge_along(line: LineString, leaf: str = "leaf") -> list[HedgePiece]:
    """Whole pieces along a straight line, centred on it. [m]"""
    count = int(line.length / PIECE_M)
    (x0, y0), (x1, y1) = line.coords[0], line.coords[-1]
    heading = float(np.arctan2(x1 - x0, y1 - y0) % (2 * np.pi))
    start = (line.length - count * PIECE_M) / 2
    middles = [line.interpolate(start + (k + 0.5) * PIECE_M) for k in range(count)]
    return [HedgePiece(p.x, p.y, heading, leaf) for p in middles]


def hedge_model(index: dict[str, int]) -> Mesh:
    """One piece along x, its foot at the origin; the leaves are the instance's own material.

    Parameters
    ----------
    index
        Material index by name.
    """
    rng = np.random.default_rng(_MODEL_SEED)
    middle = (_TOP_M - _ROOT_M) / 2
    builder = MeshBuilder(index)
    core = np.array([PIECE_M, HALF_WIDTH_M, _TOP_M + _ROOT_M - 0.2])
    builder.add("paint", box_patch(np.array([0.0, 0.0, middle - 0.1]), core))
    half = np.array([PIECE_M / 2, HALF_WIDTH_M - 0.12, _TOP_M / 2 - 0.06])
    place = rng.uniform(-1, 1, (_CARDS, 3))
    side = rng.random(_CARDS) < 0.35  # on the top; the others stand on the two long faces
    place[side, 2], place[~side, 1] = 1.0, np.sign(place[~side, 1])
    outward = np.where(side[:, None], [0.0, 0.0, 1.0], place * [0.0, 1.0, 0.0])
    centres = place * half + [0.0, 0.0, _TOP_M / 2]
    builder.add("paint", join([leaf_cards(centres, outward, rng.uniform(0.12, 0.22, _CARDS), rng)]))
    return builder.mesh()


def plan_of(pieces: Sequence[HedgePiece]) -> Array:
    """East, north and heading of each piece, shape (k, 3). [m, rad]"""
    return np.array([(p.east_m, p.north_m, p.heading_rad) for p in pieces], float).reshape(-1, 3)
