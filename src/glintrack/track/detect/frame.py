"""The rectified frame as the tracker takes it: its grid checked, its modality a plain array."""

from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack import schema
from glintrack.arrays import Array
from glintrack.track.design import TrackDesign


@dataclass(frozen=True)
class Grid:
    """The ground grid of the frames.

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
        """Row and column of the pixel nearest to each ground point, perhaps off the grid."""
        rows = np.rint((self.corner_m[1] - position_m[:, 1]) / self.gsd_m).astype(int)
        return rows, np.rint((position_m[:, 0] - self.corner_m[0]) / self.gsd_m).astype(int)


def unpack(
    image: xr.Dataset, design: TrackDesign, expected: Grid | None
) -> tuple[Grid, dict[str, Float[Array, "y x"]]]:
    """Grid and plain array of each product; the schema is checked on one row, the rest may be NaN anyway.

    What an image's mask ``occluded`` says is hidden has no data.
    """
    if not isinstance(image, xr.Dataset) or not {"y", "x"} <= set(image.coords):
        raise ValueError("`image` must be a Dataset with coordinates y and x [m], got none")
    schema.check(image.isel(y=slice(0, 1)), "image")
    for name, array in image.data_vars.items():
        frame = array.attrs.get("stokes_frame", "meridian")
        if frame != "meridian":
            raise ValueError(
                f"`image.{name}` must be in the meridian frame, got {frame!r} (rectify it first)"
            )
    y, x = image["y"].values, image["x"].values
    if len(y) < 2 or len(x) < 2:
        raise ValueError(f"`image` must have at least 2 × 2 pixels, got {len(y)} × {len(x)}")
    gsd_m = float(x[1] - x[0])
    # a hundredth of a pixel over the whole grid
    if not (
        gsd_m > 0
        and np.allclose(np.diff(x), gsd_m, atol=0.01 * gsd_m)
        and np.allclose(np.diff(y), -gsd_m, atol=0.01 * gsd_m)
    ):
        raise ValueError(
            f"`image` must be a square grid, x rising and y falling, "
            f"got steps {gsd_m:g} and {float(y[1] - y[0]):g} m"
        )
    grid = Grid((len(y), len(x)), (float(x[0]), float(y[0])), gsd_m)
    if expected is not None and grid.shape != expected.shape:
        raise ValueError(f"`image` must keep its size {expected.shape}, got {grid.shape}")
    if expected is not None and not np.allclose(
        (*grid.corner_m, grid.gsd_m), (*expected.corner_m, expected.gsd_m), atol=0.01 * gsd_m
    ):
        raise ValueError(
            f"`image` must keep its grid (corner {expected.corner_m}, GSD {expected.gsd_m:g} m), "
            f"got corner {grid.corner_m}, GSD {grid.gsd_m:g} m"
        )
    return grid, {name: _product(image, name, design) for name in design.products}


def _product(image: xr.Dataset, name: str, design: TrackDesign) -> Float[Array, "y x"]:
    values = np.ascontiguousarray(image[name].values, dtype=np.float32)
    if name == "dolp":  # NaN stays NaN
        values = np.minimum(values * np.float32(design.dolp_boost), np.float32(1.0))
        values = np.maximum(values, np.float32(design.dolp_threshold))
    if "occluded" in image:
        values = np.where(image["occluded"].values > 0, np.float32(np.nan), values)
    return values


def visible_fraction(values, grid: Grid, position_m: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """Share of the 3 × 3 pixels about each point that have data; 0 off the grid."""
    rows, columns = grid.pixel_of(position_m)
    count = np.zeros(len(position_m))
    for dy in (-1, 0, 1):
        for dx in (-1, 0, 1):
            y, x = rows + dy, columns + dx
            inside = (y >= 0) & (y < grid.shape[0]) & (x >= 0) & (x < grid.shape[1])
            count[inside] += np.isfinite(values[y[inside], x[inside]])
    return count / 9
