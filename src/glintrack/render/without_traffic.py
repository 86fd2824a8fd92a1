"""A frame once more by the same rays, with nothing that drives: only what traffic may change is traced anew.

That is every element whose rays may meet a vehicle, or ground in its shadow: those inside the silhouette of
each bounding box drawn out along the sun's rays to the lowest ground; every element with a smooth surface,
which may mirror one or the other; and every one where vehicles take light of the sky.
"""

import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial import ConvexHull, QhullError

from glintrack.camera import Camera, Pose, project
from glintrack.core.arrays import Array
from glintrack.render.hits import Hits, nothing_of
from glintrack.render.observer import Observer
from glintrack.render.trace import MIRROR_ROUGHNESS
from glintrack.scene import Snapshot

_MARGIN_ELEMENTS = 1.5  # an element's rays and those of the sun's edge
_LONGEST_M = 1000.0  # of a shadow


def without_traffic(observer: Observer, snapshot: Snapshot, pose: Pose, hits: Hits) -> Hits:
    """Hits of the same rays without traffic, of the elements alone that it may change.

    Parameters
    ----------
    observer, snapshot, pose
        Of the frame with traffic.
    hits
        What its rays met.
    """
    lowest = float(observer.city.terrain["height"].min()) - 0.1
    sun = np.asarray(observer.sky.sun_direction, float)
    may = in_reach(snapshot, observer.camera, pose, sun, lowest)
    smooth = observer.city.materials["roughness"].values < MIRROR_ROUGHNESS
    mirrors = (hits.material >= 0) & smooth[hits.material]
    may[hits.element[mirrors | (hits.sky_left < 255)]] = True
    elements = np.flatnonzero(may)
    if not elements.size:  # no vehicle near what is seen
        return nothing_of(hits)
    return observer.trace(snapshot.without_traffic(), pose, like=hits, elements=elements)


def in_reach(
    snapshot: Snapshot, camera: Camera, pose: Pose, sun: Float[Array, "3"], lowest_m: float
) -> Bool[Array, "element"]:
    """Elements that may see a moving vehicle or its shadow.

    Parameters
    ----------
    snapshot, camera, pose
        What is looked at, through what, from where.
    sun
        Unit vector toward the sun. [1]
    lowest_m
        Of the ground. [m]
    """
    out = np.zeros((camera.rows, camera.columns), np.bool_)
    models, of_vehicle = np.unique(snapshot.model[snapshot.fixed :], return_inverse=True)
    if not len(models):
        return out.ravel()
    boxes = np.stack([_corners(snapshot.models[model].vertices) for model in models])[of_vehicle]
    turn, place = np.split(snapshot.transforms[snapshot.fixed :], [3], axis=2)
    corners = boxes @ turn.swapaxes(1, 2) + place.swapaxes(1, 2)
    fall = np.minimum((corners[..., 2:] - lowest_m) / max(float(sun[2]), 1e-3), _LONGEST_M)
    pixels = project(camera, pose, np.concatenate([corners, corners - fall * sun], axis=1))
    if not np.isfinite(pixels).all():  # beside or behind the lens
        return np.ones(out.size, np.bool_)
    lows = np.maximum(np.floor(pixels.min(axis=1) - _MARGIN_ELEMENTS), 0).astype(int)
    highs = np.ceil(pixels.max(axis=1) + _MARGIN_ELEMENTS).astype(int) + 1
    for pixel, low, high in zip(pixels, lows, highs, strict=True):
        box = out[low[0] : high[0], low[1] : high[1]] if (high > 0).all() else out[:0]
        if box.size:
            box |= _inside(pixel, low, box.shape)
    return out.ravel()


def _corners(vertices: Array) -> Float[Array, "8 3"]:
    ends = np.stack([vertices.min(axis=0), vertices.max(axis=0)], axis=1)
    return np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3).astype(float)


def _inside(points: Float[Array, "point 2"], low: Array, shape: tuple[int, int]) -> Bool[Array, "y x"]:
    """Which elements of a box lie within the points' convex hull or a margin of it."""
    try:
        sides = ConvexHull(points).equations
    except QhullError:  # seen along a line
        return np.ones(shape, np.bool_)
    rows, columns = low[0] + np.arange(shape[0]), low[1] + np.arange(shape[1])
    out = np.ones(shape, np.bool_)
    for down, right, offset in sides:
        out &= down * rows[:, None] + right * columns[None] + offset <= _MARGIN_ELEMENTS
    return out
