"""Binning of elements that are finer than the detector is fitted for, by kind, before the detection.

A binned element is the mean of b × b elements of its kind. Independent noise then has the standard deviation
of one element over b. So the statistic of the detector is the same for fine elements as for coarse ones with
as many electrons in all. On oblique views the binned elements stay as oblique as those of the calibration.
"""

import math
from dataclasses import replace
from typing import cast

import numpy as np
from jaxtyping import Float

from glintrack.camera import Camera, Pose, ground_points
from glintrack.core.arrays import Array
from glintrack.core.records import Mosaic
from glintrack.track.detect.frame import Frame

MIN_GSD_M = 0.35  # of a binned element: the finest of data/calibration/mosaic.toml is 0.375 m


def binning_factor(gsd_m: float) -> int:
    """Count of elements along a binned one, for elements of a ground sample distance. [m]"""
    return max(1, math.ceil(MIN_GSD_M / gsd_m - 1e-6))


def frame_binning(frame: Frame) -> int:
    """Count of elements along a binned one, for the ground at the centre of a frame with mosaic and pose."""
    camera, side = cast(Camera, frame.camera), len(cast(Mosaic, frame.mosaic).layout)
    row, column = (camera.rows - 1) / 2, (camera.columns - 1) / 2
    pixels = np.array([[row, column], [row + 1, column], [row, column + 1]])
    points = ground_points(camera, cast(Pose, frame.pose), pixels, np.full(3, frame.mean_height_m))[:, :2]
    gsd_m = float(np.hypot(*(points[1:] - points[0]).T).min())
    return min(binning_factor(gsd_m), max(min(camera.rows, camera.columns) // (2 * side), 1))


def bin_frame(frame: Frame, factor: int) -> Frame:
    """Frame with binned mosaic and camera; the frame itself for a factor of 1."""
    if factor == 1 or frame.mosaic is None or frame.camera is None:
        return frame
    camera = bin_camera(frame.camera, len(frame.mosaic.layout), factor)
    return replace(frame, mosaic=bin_mosaic(frame.mosaic, factor), camera=camera)


def bin_camera(camera: Camera, side: int, factor: int) -> Camera:
    """Camera of the binned elements, in whole superpixels.

    Parameters
    ----------
    camera, side
        Camera of the elements, and elements along a superpixel.
    factor
        Elements along a binned one.
    """
    row, column = ((at + 0.5) / factor - 0.5 for at in camera.principal_point)
    rows, columns = (n // (side * factor) * side for n in (camera.rows, camera.columns))
    return replace(
        camera, pitch_m=factor * camera.pitch_m, rows=rows, columns=columns, principal_row=row,
        principal_column=column,
    )  # fmt: skip


def bin_mosaic(mosaic: Mosaic, factor: int) -> Mosaic:
    """Mean of the elements of each kind around the centres of binned elements; see `bin_camera`.

    Parameters
    ----------
    mosaic
        Readings. Unknown ones are left out of a mean.
    factor
        Elements along a binned one.
    """
    side = len(mosaic.layout)
    shape = tuple(n // (side * factor) * side for n in mosaic.electrons.shape)
    electrons, sigma_e = np.empty(shape, np.float32), np.empty(shape, np.float32)
    for i in range(side):
        for j in range(side):
            own = slice(i, None, side), slice(j, None, side)
            # among its kind, the first whose block is centred on the first binned element
            first = [round((factor - 1) * (2 * k + 1 - side) / (2 * side)) for k in (i, j)]
            size, both = electrons[own].shape, (mosaic.electrons, mosaic.sigma_e)
            blocks = [_blocks(one[own], first, size, factor) for one in both]
            known = np.isfinite(blocks[0])
            count = known.sum(axis=(1, 3), dtype=np.float32)
            with np.errstate(invalid="ignore", divide="ignore"):
                electrons[own] = np.where(known, blocks[0], 0).sum(axis=(1, 3)) / count
                sigma_e[own] = np.sqrt(np.where(known, blocks[1] ** 2, 0).sum(axis=(1, 3))) / count
    return replace(mosaic, electrons=electrons, sigma_e=sigma_e)


def _blocks(
    plane: Float[Array, "row column"], first: list[int], size: tuple[int, int], factor: int
) -> Float[Array, "row factor column factor"]:
    """Blocks of a plane from a first row and column on; NaN outside the plane."""
    wide = np.pad(np.asarray(plane, np.float32), factor, constant_values=np.nan)
    rows, columns = (slice(factor + a, factor + a + n * factor) for a, n in zip(first, size, strict=True))
    return wide[rows, columns].reshape(size[0], factor, size[1], factor)
