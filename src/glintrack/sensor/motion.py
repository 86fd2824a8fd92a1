"""Motion while the shutter is open: the image's path over the exposure, and the blur it leaves.

The path is that of the point on the optical axis, taken for the whole frame: right for turns of the line
of sight and for flight over ground of one height; what a turn about the line of sight does to corners is
left out.
"""

import math
from collections.abc import Callable

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.ndimage import convolve

from glintrack.camera import Camera, Pose, ground_points, project
from glintrack.core.arrays import Array
from glintrack.core.records import Radiance

WORTH_ELEMENTS = 0.05  # a smaller RMS motion blurs less than a hundredth of the lens's spot


def image_motion(
    camera: Camera,
    pose_at: Callable[[float], Pose],
    time_s: float,
    integration_s: float,
    ground_m: float = 0.0,
    samples: int = 33,
) -> Float[Array, "sample 2"]:
    """Path of the image over one exposure, about its mean.

    Parameters
    ----------
    camera
        The frame camera.
    pose_at
        True pose as a function of time, as `Flight.pose`.
    time_s, integration_s
        Middle and length of the exposure. [s]
    ground_m
        Height of the ground on the optical axis. [m]
    samples
        Instants over the exposure, each standing for an equal part of it.

    Returns
    -------
    (row, column) of the point that is on the optical axis in mid-exposure. [element]
    """
    centre = pose_at(time_s)
    target = ground_points(camera, centre, camera.principal_point, ground_m)
    if not np.isfinite(target).all():  # looking at the sky: something very far off
        far = 1e6
        target = ground_points(camera, centre, camera.principal_point, centre.up_m + far)
    instants = time_s + integration_s * ((np.arange(samples) + 0.5) / samples - 0.5)
    path = np.array([project(camera, pose_at(t), target) for t in instants])
    return path - path.mean(axis=0)


def motion_kernel(path: Float[Array, "sample 2"]) -> Float[Array, "row column"]:
    """Blur kernel of a path, odd in size and of sum one, each instant shared between four elements.

    Parameters
    ----------
    path
        From `image_motion`. [element]
    """
    reach = math.ceil(float(np.abs(path).max(initial=0.0)))
    kernel = np.zeros((2 * reach + 3, 2 * reach + 3))
    corner = np.floor(path).astype(int)
    part = path - corner
    for row in (0, 1):
        for column in (0, 1):
            weight = np.abs(1 - row - part[:, 0]) * np.abs(1 - column - part[:, 1])
            np.add.at(kernel, (corner[:, 0] + row + reach + 1, corner[:, 1] + column + reach + 1), weight)
    return kernel / kernel.sum()


def smear(radiance: Radiance, path: Float[Array, "sample 2"]) -> Radiance:
    """The light as the elements integrate it over the exposure: the same function, its frames blurred.

    Parameters
    ----------
    radiance
        ``radiance(channels)`` as `expose` takes it; single pixels (the spectrometer's) are left as they are.
    path
        From `image_motion`; under `WORTH_ELEMENTS` nothing changes. [element]
    """
    if math.hypot(*np.std(path, axis=0)) < WORTH_ELEMENTS:
        return radiance
    kernel = motion_kernel(path)

    def moved(channels: Array, pixels: Array | None = None) -> xr.DataArray:
        if pixels is not None:
            return radiance(channels, pixels)
        light = radiance(channels)
        values = convolve(light.values, kernel[(...,) + (None,) * (light.ndim - 2)], mode="nearest")
        return light.copy(data=values)

    return moved
