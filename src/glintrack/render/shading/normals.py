"""A grid over the directions of a sphere: the octahedron unfolded to a square, up at its middle node."""

import numba as nb
import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array

NORMAL_NODES = 33  # along each side of the square: about 6° apart


@nb.njit(cache=True)
def on_square(nx, ny, nz, nodes):
    """Node coordinates (0 to nodes − 1) of a unit vector on the unfolded octahedron."""
    scale = 1.0 / (abs(nx) + abs(ny) + abs(nz))
    a, b = nx * scale, ny * scale
    if nz < 0:
        folded = (1.0 - abs(b)) * (1.0 if a >= 0 else -1.0)
        b = (1.0 - abs(a)) * (1.0 if b >= 0 else -1.0)
        a = folded
    half = 0.5 * (nodes - 1)
    return (a + 1.0) * half, (b + 1.0) * half


@nb.njit(cache=True)
def square_cell(nx, ny, nz, stride):
    """Corner (i, j) of the cell that holds a unit vector, and its parts along each side; stride in nodes.

    A part within rounding of a node is put on it, so that level ground reads one node.
    """
    coarse = (NORMAL_NODES - 1) // stride
    x, y = on_square(nx, ny, nz, coarse + 1)
    i, j = min(int(x + 1e-4), coarse - 1), min(int(y + 1e-4), coarse - 1)
    fx, fy = x - i, y - j
    if fx < 1e-4:
        fx = 0.0
    if fy < 1e-4:
        fy = 0.0
    return i * stride, j * stride, fx, fy


def node_normals() -> Float[Array, "normal 3"]:
    """Unit vector of each node, row by row."""
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, NORMAL_NODES)], indexing="ij")
    z = 1 - np.abs(x) - np.abs(y)
    below = z < 0
    folded = [(1 - np.abs(other)) * np.where(own >= 0, 1, -1) for own, other in ((x, y), (y, x))]
    vectors = np.stack([np.where(below, folded[0], x), np.where(below, folded[1], y), z], axis=-1)
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).reshape(-1, 3)
