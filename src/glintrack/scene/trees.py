"""Trees: a trunk, and a crown of leaf cards in clusters, ragged at its edge and partly seen through.

A card stands for a spray of leaves: a bent quadrilateral of about a metre whose front faces outward and up.
It is a sheet, not a closed body, and has two sides: rays meet it from below as well.
"""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float

from glintrack.scene.geometry import MeshBuilder, Patch

Array = np.ndarray
_CLUSTERS = 10
_CARDS_PER_CLUSTER = 6
_TRUNK_SIDES = 4


@dataclass(frozen=True)
class Tree:
    """One tree.

    Parameters
    ----------
    east_m, north_m
        Foot of the trunk. [m]
    height_m, crown_radius_m
        [m]
    kind
        Shape of its crown.
    leaf
        Material of its leaves.
    """

    east_m: float
    north_m: float
    height_m: float
    crown_radius_m: float
    kind: Literal["broadleaf", "conifer"] = "broadleaf"
    leaf: str = "leaf"


def draw_tree(east_m: float, north_m: float, rng: np.random.Generator, height_m: tuple[float, float]) -> Tree:
    """A tree of random kind and size at a place, between two heights. [m]."""
    height = rng.uniform(*height_m)
    if rng.random() < 0.15:
        return Tree(
            east_m, north_m, height * 1.15, height * rng.uniform(0.16, 0.2), "conifer", "leaf_conifer"
        )
    leaf = "leaf" if rng.random() < 0.65 else "leaf_walnut"
    return Tree(east_m, north_m, height, height * rng.uniform(0.3, 0.42), "broadleaf", leaf)


def add_tree(builder: MeshBuilder, tree: Tree, rng: np.random.Generator) -> None:
    """Build trunk and crown."""
    builder.add("bark", _trunk(tree))
    builder.add(tree.leaf, _crown(tree, rng))


def _trunk(tree: Tree) -> Patch:
    radius, top = 0.025 * tree.height_m, 0.7 * tree.height_m
    angle = 2 * math.pi * np.arange(_TRUNK_SIDES) / _TRUNK_SIDES
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    foot = np.c_[ring * radius + [tree.east_m, tree.north_m], np.full(_TRUNK_SIDES, -0.1)]
    head = np.c_[ring * radius * 0.4 + [tree.east_m, tree.north_m], np.full(_TRUNK_SIDES, top)]
    k = np.arange(_TRUNK_SIDES)
    after = (k + 1) % _TRUNK_SIDES
    faces = np.vstack(
        [np.c_[k, after, after + _TRUNK_SIDES], np.c_[k, after + _TRUNK_SIDES, k + _TRUNK_SIDES]]
    )
    return np.vstack([foot, head]), faces


def _crown(tree: Tree, rng: np.random.Generator) -> Patch:
    base = np.array([tree.east_m, tree.north_m, 0.0])
    count = _CLUSTERS * _CARDS_PER_CLUSTER
    if tree.kind == "conifer":
        level = np.sqrt(rng.random(count))  # more needles low down, where the cone is wide
        angle = rng.uniform(0, 2 * math.pi, count)
        radius = tree.crown_radius_m * level * rng.uniform(0.55, 1.0, count)
        height = tree.height_m * (1 - 0.85 * level)
        centres = base + np.stack([radius * np.cos(angle), radius * np.sin(angle), height], axis=1)
        outward = np.stack([np.cos(angle), np.sin(angle), np.full(count, 0.6)], axis=1)
    else:
        half_height = 0.36 * tree.height_m
        middle = base + [0.0, 0.0, tree.height_m - half_height]
        semi = np.array([tree.crown_radius_m, tree.crown_radius_m, half_height])
        knots = _directions(_CLUSTERS, rng) * rng.uniform(0.45, 0.8, (_CLUSTERS, 1))
        spread = _directions(count, rng) * rng.uniform(0.15, 0.42, (count, 1))
        inner = np.repeat(knots, _CARDS_PER_CLUSTER, axis=0) + spread
        centres = middle + inner * semi
        outward = inner + spread
    size = tree.crown_radius_m * rng.uniform(0.18, 0.32, count)
    return _cards(centres, outward, size, rng)


def _cards(
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
