"""Input of a detector from one frame: rectified image, raw mosaic, pose, ground."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.camera import Camera, Pose
from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.core.records import Mosaic


@dataclass(frozen=True)
class Grid:
    """Ground grid of the frames.

    Parameters
    ----------
    shape
        Rows and columns.
    corner_m
        East and north of the centre of pixel (0, 0). [m]
    gsd_m
        Spacing. [m]
    """

    shape: tuple[int, int]
    corner_m: tuple[float, float]
    gsd_m: float

    def pixel_of(self, position_m: Float[Array, "n 2"]) -> tuple[Int[Array, "n"], Int[Array, "n"]]:
        """Row and column of the pixel nearest to each ground point, which may be off the grid."""
        rows = np.rint((self.corner_m[1] - position_m[:, 1]) / self.gsd_m).astype(int)
        return rows, np.rint((position_m[:, 0] - self.corner_m[0]) / self.gsd_m).astype(int)


@dataclass(frozen=True)
class Frame:
    """One frame, with all inputs of a detector; the truth is not among them.

    Only `time_s` and one of `image` and `grid` must be given. `simulate` gives all; rectified frames of a
    user have no mosaic, camera, pose or ground.

    Parameters
    ----------
    time_s
        Epoch. [s]
    image
        Rectified, of the schema ``image``; NaN where there is no data.
    mosaic
        Readings of the elements, before demosaicking and rectification.
    camera, pose
        Camera of the mosaic, in elements, and reported pose, with the navigator's errors.
    terrain, surface
        Heights of the ground, and of all objects on it, of the schema ``terrain``.
    lanes
        Centre lines of lanes (east, north), if the design uses a road map. [m]
    grid
        Area in which vehicles are tracked; the image's own, if there is an image.
    channel
        Channel of the design: ``pan``, ``dolp`` or ``all``. The tracker sets it.
    interval_s
        Time since the frame before, 0 for the first. The tracker sets it. [s]
    slow_m
        Predicted positions of confirmed tracks that moved and are now slow or stand. The tracker sets it. [m]
    """

    time_s: float
    image: xr.Dataset | None = None
    mosaic: Mosaic | None = None
    camera: Camera | None = None
    pose: Pose | None = None
    terrain: xr.Dataset | None = None
    surface: xr.Dataset | None = None
    lanes: Sequence[Float[Array, "point 2"]] = ()
    grid: Grid | None = None
    channel: str = "pan"
    interval_s: float = 0.0
    slow_m: Float[Array, "slow 2"] = field(default_factory=lambda: np.empty((0, 2)))

    @property
    def mean_height_m(self) -> float:
        """Mean height of the ground; 0 without a terrain. [m]"""
        return 0.0 if self.terrain is None else float(np.mean(self.terrain["height"].values))

    @property
    def planes(self) -> tuple[str, ...]:
        """Variables of the image in the channel."""
        return ("pan", "dolp") if self.channel == "all" else (self.channel,)


def grid_of(frame: Frame, expected: Grid | None) -> Grid:
    """Return the frame's grid, checked against its image's schema and the grid of the frames before.

    The schema is checked on one row; the other rows may be NaN.

    Raises
    ------
    ValueError
        If the image breaks its schema, or the grid is missing, not square or another than expected.
    """
    grid = frame.grid if frame.image is None else _grid_of_image(frame.image)
    if grid is None:
        raise ValueError("`frame` must have an image, or a grid without one; got neither.")
    if expected is not None and grid.shape != expected.shape:
        raise ValueError(f"`image` must keep its size {expected.shape}; got {grid.shape}.")
    if expected is not None and not np.allclose(
        (*grid.corner_m, grid.gsd_m), (*expected.corner_m, expected.gsd_m), rtol=0, atol=0.01 * grid.gsd_m
    ):
        raise ValueError(
            f"`image` must keep its grid (corner {expected.corner_m}, GSD {expected.gsd_m:g} m); "
            f"got corner {grid.corner_m}, GSD {grid.gsd_m:g} m."
        )
    return grid


def _grid_of_image(image: xr.Dataset) -> Grid:
    if not isinstance(image, xr.Dataset) or not {"y", "x"} <= set(image.coords):
        raise ValueError("`image` must be a Dataset with coordinates y and x [m]; got none.")
    schema.check(image.isel(y=slice(0, 1)), "image")
    for name, array in image.data_vars.items():
        axis = array.attrs.get("stokes_frame", "meridian")
        if axis != "meridian":
            raise ValueError(f"`image.{name}` must be in the meridian frame; got {axis!r}. Rectify it first.")
    y, x = image["y"].values, image["x"].values
    if len(y) < 2 or len(x) < 2:
        raise ValueError(f"`image` must have at least 2 × 2 pixels; got {len(y)} × {len(x)}.")
    gsd_m = float(x[1] - x[0])
    # a hundredth of a pixel over the whole grid
    if not (
        gsd_m > 0
        and np.allclose(np.diff(x), gsd_m, atol=0.01 * gsd_m)
        and np.allclose(np.diff(y), -gsd_m, atol=0.01 * gsd_m)
    ):
        raise ValueError(
            f"`image` must be a square grid, x rising and y falling; "
            f"got steps {gsd_m:g} and {float(y[1] - y[0]):g} m."
        )
    return Grid((len(y), len(x)), (float(x[0]), float(y[0])), gsd_m)


def plane(frame: Frame, name: str) -> Float[Array, "y x"]:
    """One variable of the frame's image as a plain array, NaN under its mask ``occluded``.

    Raises
    ------
    ValueError
        If the frame has no image.
    """
    if frame.image is None:
        raise ValueError("`frame` must have a rectified image for this detector; got none.")
    values = np.ascontiguousarray(frame.image[name].values, dtype=np.float32)
    if "occluded" in frame.image:
        values = np.where(frame.image["occluded"].values > 0, np.float32(np.nan), values)
    return values


def in_view(frame: Frame, grid: Grid, position_m: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Share of the 3 × 3 pixels around each point that have data; 0 off the grid, 1 without an image."""
    if frame.image is None:
        return np.ones(len(position_m))
    values = plane(frame, frame.planes[0])
    rows, columns = grid.pixel_of(position_m)
    count = np.zeros(len(position_m))
    for dy, dx in product((-1, 0, 1), repeat=2):
        y, x = rows + dy, columns + dx
        inside = (y >= 0) & (y < grid.shape[0]) & (x >= 0) & (x < grid.shape[1])
        count[inside] += np.isfinite(values[y[inside], x[inside]])
    return count / 9
