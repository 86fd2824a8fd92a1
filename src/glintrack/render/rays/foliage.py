"""Leaf cards: sheets that stand for a spray of leaves and are partly holes.

A ray of look meets a card or passes through one of its holes, which are fixed in the card: the same leaves
are seen in every frame. Light on its way to a point is weakened by the mean of what it passes, because an
element is wider than a hole: a crown's shadow is half shade, not a pattern too fine to sample.
"""

import numba as nb
import numpy as np

LEAST_LIGHT = 0.02  # light that has passed so many cards is not followed further
_CELLS = 6  # along a face's edges: holes of a tenth to a quarter of a metre in cards of a metre


@nb.njit(nogil=True, cache=True)
def is_hole(face, u, v, gap):
    """Whether a card's point is a hole, for a card of which the part ``gap`` is holes.

    Parameters
    ----------
    face
        Number of the face within its mesh.
    u, v
        Barycentric coordinates of the point. [1]
    gap
        Part of the face that is holes, 0 to 1. [1]

    References
    ----------
    The finaliser of MurmurHash3 (Appleby, public domain) mixes face and cell.
    """
    cell = np.uint32(u * _CELLS) + np.uint32(16) * np.uint32(v * _CELLS)
    mixed = np.uint32(face) * np.uint32(0x9E3779B1) + np.uint32(cell) * np.uint32(0x85EBCA77)
    mixed = np.uint32(mixed ^ (mixed >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    mixed = np.uint32(mixed ^ (mixed >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    mixed = np.uint32(np.uint32(mixed) ^ (np.uint32(mixed) >> np.uint32(16)))
    return np.float64(mixed) < gap * 4294967296.0
