"""Trees and hedges: a few models of leaf cards, placed many times.

A tree model is a trunk and a crown of leaf cards in clusters, one metre high. A hedge is a row of two-metre
pieces, each a dark core covered by leaf cards. A card represents a spray of leaves: a bent quadrilateral that
faces outward and up. It is a two-sided sheet, not a closed body. An instance is a model rotated about its
trunk and scaled by the tree's height; its leaves have the instance's own material (`PAINT`).
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, Int
from shapely.geometry import LineString

from glintrack.core.arrays import Array
from glintrack.scene.objects.geometry import Mesh, MeshBuilder, Patch, box_patch, join

Kind = Literal["broadleaf", "conifer"]
_CLUSTERS = 16
_CARDS_PER_CLUSTER = 10
_TRUNK_SIDES = 5
_ROOT = 0.03  # depth of the trunk in the ground, of the height, for slopes
_TREE_SEED = 20100406
# kind and crown radius over height of each model: those of `draw_tree`, in even steps
_SHAPES: tuple[tuple[Kind, float], ...] = (
    *(("broadleaf", ratio) for ratio in (0.31, 0.33, 0.35, 0.37, 0.39, 0.41)),
    *(("conifer", ratio) for ratio in (0.144, 0.156, 0.169)),
)


@dataclass(frozen=True)
class Tree:
    """A tree: foot of its trunk, size [m], shape of its crown, material of its leaves."""

    east_m: float
    north_m: float
    height_m: float
    crown_radius_m: float
    kind: Kind = "broadleaf"
    leaf: str = "leaf"


def draw_tree(east_m: float, north_m: float, rng: np.random.Generator, height_m: tuple[float, float]) -> Tree:
    """Draw a tree of random kind and size, between two heights. [m]"""
    height = rng.uniform(*height_m)
    if rng.random() < 0.15:
        radius = height * rng.uniform(0.16, 0.2)
        return Tree(east_m, north_m, height * 1.15, radius, "conifer", "leaf_conifer")
    leaf = "leaf" if rng.random() < 0.65 else "leaf_walnut"
    return Tree(east_m, north_m, height, height * rng.uniform(0.3, 0.42), "broadleaf", leaf)


def tree_models(index: dict[str, int]) -> tuple[Mesh, ...]:
    """Build the tree models, one metre high, foot of the trunk at the origin; the same in every city."""
    angle = 2 * math.pi * np.arange(_TRUNK_SIDES) / _TRUNK_SIDES
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    radius, top = 0.025, 0.7
    foot = np.c_[ring * radius, np.full(_TRUNK_SIDES, -_ROOT)]
    head = np.c_[ring * radius * 0.4, np.full(_TRUNK_SIDES, top)]
    k = np.arange(_TRUNK_SIDES)
    lower, upper = np.c_[k, (k + 1) % _TRUNK_SIDES], np.c_[k, (k + 1) % _TRUNK_SIDES] + _TRUNK_SIDES
    faces = np.vstack([np.c_[lower, upper[:, 1]], np.c_[k, upper[:, ::-1]]])
    models = []
    for number, (kind, ratio) in enumerate(_SHAPES):
        builder = MeshBuilder(index)
        builder.add("bark", (np.vstack([foot, head]), faces))
        builder.add("paint", _crown(kind, ratio, np.random.default_rng((_TREE_SEED, number))))
        models.append(builder.mesh())
    return tuple(models)


def tree_model_of(trees: Sequence[Tree]) -> Int[Array, "tree"]:
    """Index of the model of the same kind with the nearest proportions, for each tree."""
    ratio = np.array([tree.crown_radius_m / tree.height_m for tree in trees])
    conifer = np.array([tree.kind == "conifer" for tree in trees], bool)
    off = np.abs(ratio[:, None] - np.array([shape[1] for shape in _SHAPES]))
    off += conifer[:, None] != np.array([shape[0] == "conifer" for shape in _SHAPES])  # 1 is beyond any ratio
    return off.argmin(axis=1)


def _crown(kind: Kind, crown_radius: float, rng: np.random.Generator) -> Patch:
    count = _CLUSTERS * _CARDS_PER_CLUSTER
    if kind == "conifer":
        level = np.sqrt(rng.random(count))  # more needles low down, where the cone is wide
        angle = rng.uniform(0, 2 * math.pi, count)
        radius = crown_radius * level * rng.uniform(0.5, 1.0, count)
        height = 1 - 0.85 * level
        centres = np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
        outward = np.stack([np.cos(angle), np.sin(angle), np.full(count, 0.6)], axis=1)
        size = crown_radius * rng.uniform(0.13, 0.24, count)
    else:
        half_height = 0.36
        semi = np.array([crown_radius, crown_radius, half_height])
        knots = _directions(_CLUSTERS, rng) * rng.uniform(0.4, 0.8, (_CLUSTERS, 1))
        spread = _directions(count, rng) * rng.uniform(0.12, 0.42, (count, 1))
        inner = np.repeat(knots, _CARDS_PER_CLUSTER, axis=0) + spread
        centres = [0.0, 0.0, 1 - half_height] + inner * semi
        outward = inner + spread
        size = crown_radius * rng.uniform(0.11, 0.2, count)
    return leaf_cards(centres, outward, size, rng)


def leaf_cards(
    centres: Float[Array, "card 3"],
    outward: Float[Array, "card 3"],
    size: Float[Array, "card"],
    rng: np.random.Generator,
) -> Patch:
    """Bent quadrilaterals about the centres, fronts toward ``outward`` and up, tumbled at random."""
    count = len(centres)
    normal = outward / np.linalg.norm(outward, axis=1, keepdims=True)
    normal = normal + [0.0, 0.0, 0.5] + 0.6 * _directions(count, rng)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    across = np.cross(normal, _directions(count, rng))
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    along = np.cross(normal, across)
    u, v, lift = across * size[:, None], along * size[:, None], normal * (0.25 * size)[:, None]
    stretch = rng.uniform(0.8, 1.5, (count, 1))
    corners = np.stack(
        [centres - u - lift, centres - v * stretch + lift, centres + u - lift, centres + v * stretch + lift],
        axis=1,
    )
    base = 4 * np.arange(count)[:, None]
    faces = np.vstack([base + [0, 1, 2], base + [0, 2, 3]])
    vertices = corners.reshape(-1, 3)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    wrong = np.sum(np.cross(b - a, c - a) * np.vstack([normal, normal]), axis=1) < 0
    return vertices, np.where(wrong[:, None], faces[:, ::-1], faces)


def _directions(count: int, rng: np.random.Generator) -> Float[Array, "count 3"]:
    v = rng.standard_normal((count, 3))
    return v / np.linalg.norm(v, axis=1, keepdims=True)


PIECE_M = 2.0
HALF_WIDTH_M = 0.45
_TOP_M, _ROOT_M = 1.2, 0.25  # height, and depth in the ground for slopes
_CARDS = 70
_HEDGE_SEED = 20100407


@dataclass(frozen=True)
class HedgePiece:
    """Middle of a piece of hedge [m], its heading clockwise from north [rad], the material of its leaves."""

    east_m: float
    north_m: float
    heading_rad: float
    leaf: str = "leaf"


def hedge_along(line: LineString, leaf: str) -> list[HedgePiece]:
    """Place whole pieces along a straight line, centred on it. [m]"""
    count = int(line.length / PIECE_M)
    (x0, y0), (x1, y1) = line.coords[0], line.coords[-1]
    heading = float(np.arctan2(x1 - x0, y1 - y0) % (2 * np.pi))
    start = (line.length - count * PIECE_M) / 2
    middles = [line.interpolate(start + (k + 0.5) * PIECE_M) for k in range(count)]
    return [HedgePiece(p.x, p.y, heading, leaf) for p in middles]


def hedge_model(index: dict[str, int]) -> Mesh:
    """Build one piece along x, its foot at the origin; the leaves have the instance's own material."""
    rng = np.random.default_rng(_HEDGE_SEED)
    middle = (_TOP_M - _ROOT_M) / 2
    builder = MeshBuilder(index)
    core = np.array([PIECE_M, HALF_WIDTH_M, _TOP_M + _ROOT_M - 0.2])
    builder.add("paint", box_patch(np.array([0.0, 0.0, middle - 0.1]), core))
    half = np.array([PIECE_M / 2, HALF_WIDTH_M - 0.12, _TOP_M / 2 - 0.06])
    place = rng.uniform(-1, 1, (_CARDS, 3))
    side = rng.random(_CARDS) < 0.35  # on the top; the others are on the two long faces
    place[side, 2], place[~side, 1] = 1.0, np.sign(place[~side, 1])
    outward = np.where(side[:, None], [0.0, 0.0, 1.0], place * [0.0, 1.0, 0.0])
    centres = place * half + [0.0, 0.0, _TOP_M / 2]
    builder.add("paint", join([leaf_cards(centres, outward, rng.uniform(0.12, 0.22, _CARDS), rng)]))
    return builder.mesh()
