"""Stabilize frames of a moving camera: a homography of each one onto one ground plane.

SIFT features (Lowe, IJCV 2004) of a frame are matched with those of a keyframe, and MAGSAC++ (Barath et al.,
CVPR 2020) finds the homography of the dominant plane, which is the ground. The oldest keyframe that overlaps
enough is tried first, so that errors do not add up while the camera looks at one place. Roofs and crowns keep
their parallax, which the detector `median-motion` suppresses.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float, UInt8
from scipy import ndimage

from glintrack.core.arrays import Array
from glintrack.core.installation import require_extra
from glintrack.io.orthoimages import FrameSource, Geotransform, image_of

FEATURES = 3000
RATIO = 0.75  # of the distances of the best and the second match (Lowe)
INLIER_PX = 1.5
MIN_INLIERS, MIN_INLIER_SHARE = 60, 0.3
MIN_OVERLAP = 0.6  # of a frame with its keyframe: below it the frame becomes one
MAX_KEYFRAMES = 12  # tried for a frame
MAX_SIDES = 2.0  # of a frame, by which the grid exceeds the reference frame on each side
KERNEL_PX = 3  # half width of the cubic kernel, and half a pixel of rounding

Homography = Float[Array, "3 3"]


@dataclass(frozen=True)
class _Keyframe:
    """Features of a frame, and its homography onto the first frame."""

    points: Float[Array, "feature 2"]
    descriptors: Float[Array, "feature 128"]
    onto_first: Homography


@dataclass(frozen=True)
class StabilizedGrid:
    """Pixel grid that holds all frames.

    Parameters
    ----------
    shape
        Rows and columns.
    onto_grid
        Homography of each frame, from column and row to those of the grid; None for a frame that could not
        be registered. [pixel]
    reference
        Column and row of the reference frame's first pixel.
    """

    shape: tuple[int, int]
    onto_grid: tuple[Homography | None, ...]
    reference: tuple[int, int]


def register_frames(images: Iterable[Float[Array, "y x"]]) -> Iterator[Homography | None]:
    """Yield the homography of each frame onto the first registered one, column and row. [pixel]

    It is None for a frame that matches no keyframe; a later one may match again.
    """
    cv2 = _opencv()
    sift, matcher = cv2.SIFT_create(FEATURES), cv2.BFMatcher()
    keyframes, last = list[_Keyframe](), np.eye(3)
    for image in images:
        features, descriptors = sift.detectAndCompute(_to_bytes(image), None)
        if len(features) < MIN_INLIERS:
            yield None
            continue
        now = _Keyframe(np.array([one.pt for one in features]), descriptors, np.eye(3))
        shares = [overlap_share(np.linalg.inv(one.onto_first) @ last, image.shape) for one in keyframes]
        # the oldest of those that overlap enough, then all others for reacquisition
        order = sorted(range(len(keyframes)), key=lambda k: (-min(shares[k], MIN_OVERLAP), k))
        onto = None if keyframes else np.eye(3)
        share = 0.0
        for k in order[:MAX_KEYFRAMES]:
            between = _match(cv2, matcher, now, keyframes[k])
            if between is not None:
                onto, share = keyframes[k].onto_first @ between, overlap_share(between, image.shape)
                break
        if onto is not None:
            last = onto
            if share < MIN_OVERLAP:
                keyframes.append(_Keyframe(now.points, now.descriptors, onto))
        yield onto


def _match(cv2: ModuleType, matcher: Any, now: _Keyframe, keyframe: _Keyframe) -> Homography | None:
    """Homography of a frame onto a keyframe, or None if too few matches agree."""
    pairs = [pair for pair in matcher.knnMatch(now.descriptors, keyframe.descriptors, k=2) if len(pair) == 2]
    good = [first for first, second in pairs if first.distance < RATIO * second.distance]
    if len(good) < MIN_INLIERS:
        return None
    here = now.points[[one.queryIdx for one in good]]
    there = keyframe.points[[one.trainIdx for one in good]]
    found, inliers = cv2.findHomography(
        here, there, cv2.USAC_MAGSAC, INLIER_PX, maxIters=5000, confidence=0.999
    )
    return None if found is None or inliers.sum() < max(MIN_INLIERS, MIN_INLIER_SHARE * len(good)) else found


def overlap_share(onto: Homography, shape: tuple[int, ...]) -> float:
    """Share of a frame that a homography maps into another one of its size. [1]"""
    x, y = transform_points(onto, _lattice(shape)).T
    return float(((x >= 0) & (x < shape[1]) & (y >= 0) & (y < shape[0])).mean())


def transform_points(onto: Homography, points: Float[Array, "n 2"]) -> Float[Array, "n 2"]:
    """Map points (column, row) by a homography; NaN on and beyond its horizon. [pixel]"""
    x, y, w = onto @ np.vstack([points.T, np.ones(len(points))])
    return np.stack([x, y], axis=-1) / np.where(w > 1e-6, w, np.nan)[:, None]


def _lattice(shape: tuple[int, ...], count: int = 12) -> Float[Array, "n 2"]:
    """Points (column, row) over a frame, its corners among them."""
    rows, columns = (np.linspace(0, n - 1, count) for n in shape)
    return np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)


def plan_grid(onto_first: Sequence[Homography | None], shape: tuple[int, int]) -> StabilizedGrid:
    """Grid around all frames, in the pixels of the middle registered one.

    Parameters
    ----------
    onto_first
        From `register_frames`.
    shape
        Rows and columns of a frame.
    """
    known = [one for one in onto_first if one is not None]
    if not known:
        raise ValueError(
            f"`frames` must have {MIN_INLIERS} features that match to be stabilized; got none that do."
        )
    onto_reference = np.linalg.inv(known[len(known) // 2])
    size = np.array(shape[::-1])
    boxes = np.array([transform_points(onto_reference @ one, _lattice(shape)) for one in known])
    boxes = np.where(np.isnan(boxes), np.inf, boxes)
    low, high = boxes.min(axis=(0, 1)), boxes.max(axis=(0, 1))
    first = np.floor(np.maximum(low, -MAX_SIDES * size))
    last = np.ceil(np.minimum(high, (1 + MAX_SIDES) * size))
    move = np.array([[1.0, 0.0, -first[0]], [0.0, 1.0, -first[1]], [0.0, 0.0, 1.0]])
    columns, rows = (last - first + 1).astype(int).tolist()
    onto_grid = tuple(None if one is None else move @ onto_reference @ one for one in onto_first)
    return StabilizedGrid((rows, columns), onto_grid, (int(-first[0]), int(-first[1])))


def stabilize(source: FrameSource, onto_first: Sequence[Homography | None]) -> FrameSource:
    """Frames of a source on one grid, without those that could not be registered.

    Parameters
    ----------
    source
        Frames from the first one on, one for each homography.
    onto_first
        From `register_frames`, of the same frames.

    Raises
    ------
    ValueError
        If no frame could be registered.
    """

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        grid, place = None, None
        for k, (time_s, image) in enumerate(source.frames):
            pan = image["pan"].values
            if grid is None:
                grid = plan_grid(onto_first, pan.shape)
                place = _place_of(image, grid)
            if (onto := grid.onto_grid[k]) is not None and place is not None:
                yield time_s, image_of({"pan": warp_frame(pan, onto, grid.shape)}, place)

    used = sum(one is not None for one in onto_first)
    return replace(source, count=used, dolp=False, frames=frames())


def _place_of(image: xr.Dataset, grid: StabilizedGrid) -> Geotransform:
    """Place of the grid, which holds the reference frame's pixels where its own geotransform has them."""
    x, y = image["x"].values, image["y"].values
    gsd_m = float(x[1] - x[0])
    left, top = grid.reference
    return Geotransform(float(x[0]) - gsd_m * (left + 0.5), float(y[0]) + gsd_m * (top + 0.5), gsd_m)


def warp_frame(image: Float[Array, "y x"], onto: Homography, shape: tuple[int, int]) -> Float[Array, "y x"]:
    """Resample a frame on the grid by cubic interpolation; NaN where the kernel lacks data."""
    cv2 = _opencv()
    known = ndimage.binary_erosion(np.isfinite(image), np.ones((3, 3)), KERNEL_PX).astype(np.uint8)
    filled = np.nan_to_num(image).astype(np.float32)
    size = shape[::-1]
    out = cv2.warpPerspective(filled, onto, size, flags=cv2.INTER_CUBIC)
    inside = cv2.warpPerspective(known, onto, size, flags=cv2.INTER_NEAREST)
    return np.where(inside > 0, out, np.float32(np.nan))


def _to_bytes(image: Float[Array, "y x"]) -> UInt8[Array, "y x"]:
    """Stretch a frame to 8 bits; missing data become 0."""
    known = image[np.isfinite(image)]
    low, high = np.quantile(known, (0.005, 0.995)) if len(known) else (0.0, 1.0)
    stretched = 255 * (np.nan_to_num(image, nan=low) - low) / max(high - low, 1e-12)
    return np.clip(stretched, 0, 255).astype(np.uint8)


def _opencv() -> ModuleType:
    return require_extra("cv2", "stabilize", "stabilize frames")
