"""Read ground and surface heights from a raster in any CRS, in metres."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rasterio
from jaxtyping import Float
from rasterio.transform import Affine
from rasterio.windows import Window

from glintrack.core.arrays import Array
from glintrack.io.crs import change_crs
from glintrack.io.read_raster import open_bands, read_height_band

_MAX_HEIGHTS = 400e6


@dataclass(frozen=True)
class Heights:
    """A raster of heights, in memory.

    Parameters
    ----------
    values
        Heights, NaN where there are none. [m]
    transform
        Transform from (column, row) of corners to the CRS.
    crs, name
        CRS and file name.
    """

    values: Float[Array, "row column"]
    transform: Affine
    crs: str
    name: str

    @property
    def to_pixel(self) -> Affine:
        """Transform from coordinates of the CRS to (column, row), pixel centres at integers."""
        return Affine.translation(-0.5, -0.5) * ~self.transform


class NotReachedError(ValueError):
    """Heights do not cover the ground that a photograph sees."""


def read_height_range(
    path: Path, option: str, area: tuple[float, float, float, float] | None = None, crs: str = ""
) -> tuple[float, float]:
    """Read the lowest and highest height of a raster over an area, from an overview of it. [m]

    Parameters
    ----------
    path, option
        File, and its name in error messages.
    area, crs
        West, south, east, north, and their CRS; all of the raster by default.

    Raises
    ------
    ValueError
        As `read_heights`, or if no height is known over the area.
    """
    with _open_heights(path, option) as file:
        window = Window(0, 0, file.width, file.height)  # pyright: ignore[reportCallIssue]
        if area is not None:
            x, y = np.linspace(area[0], area[2], 33), np.linspace(area[1], area[3], 33)
            window = _window_over(file, option, *np.meshgrid(x, y), crs)
        values = read_height_band(file, option, window, (min(window.height, 1024), min(window.width, 1024)))
    values = values[np.isfinite(values)]
    if values.size == 0:
        where = "" if area is None else " where the frame looks. Fill it with gdal_fillnodata.py"
        raise ValueError(f"`{option}` must hold heights; got none in {path.name}{where}.")
    return float(values.min()), float(values.max())


def read_heights(
    path: Path, option: str, x: Float[Array, "*place"], y: Float[Array, "*place"], crs: str
) -> Heights:
    """Read the part of a raster of heights that lies under some positions.

    Parameters
    ----------
    path, option
        File, and its name in error messages.
    x, y, crs
        Positions, and their CRS; any.

    Raises
    ------
    ValueError
        If the file is no raster, has no CRS, or does not cover the positions at all.
    """
    with _open_heights(path, option) as file:
        window = _window_over(file, option, x, y, crs)
        count = window.width * window.height
        if count > _MAX_HEIGHTS:
            raise ValueError(f"`{option}` must be coarser, or `area` smaller; got {count:.3g} heights")
        values = read_height_band(file, option, window)
        return Heights(values, file.window_transform(window), file.crs.to_wkt(), path.name)


def _window_over(file: rasterio.DatasetReader, option: str, x: Array, y: Array, crs: str) -> Window:
    """Smallest part of a raster under some positions, three pixels wider."""
    name = Path(file.name).name
    transform = change_crs(crs, file.crs.to_wkt()).transform
    places = np.stack(transform(np.ravel(x), np.ravel(y)))
    places = places[:, np.isfinite(places).all(axis=0)]
    if places.size == 0:
        raise ValueError(f"`{option}` must reach the frame's ground; got a CRS that cannot: {name}")
    pixel = np.stack(transform_points(~file.transform, *places))
    low, high = np.floor(pixel.min(axis=1)) - 3, np.ceil(pixel.max(axis=1)) + 3
    low, high = np.maximum(low, 0), np.minimum(high, (file.width, file.height))
    if not (high - low >= 1).all():  # also if they are NaN
        raise NotReachedError(
            f"`{option}` must reach the frame's ground; got {name} over "
            f"{', '.join(f'{v:.6g}' for v in file.bounds)} in {file.crs}"
        )
    return Window(*low.astype(int).tolist(), *(high - low).astype(int).tolist())  # pyright: ignore[reportCallIssue]


def is_within(path: Path, option: str, x: float, y: float, crs: str) -> bool:
    """Return True if a position lies in a raster, or outside by at most its width."""
    with _open_heights(path, option) as file:
        place = change_crs(crs, file.crs.to_wkt()).transform(x, y)
        column, row = transform_points(~file.transform, *(np.asarray(v) for v in place))
        return bool(abs(column / file.width - 0.5) <= 1.5 and abs(row / file.height - 0.5) <= 1.5)


def transform_points(
    affine: Affine, x: Float[Array, "*place"], y: Float[Array, "*place"]
) -> tuple[Array, Array]:
    """Transform positions by an affine transform."""
    return affine.a * x + affine.b * y + affine.c, affine.d * x + affine.e * y + affine.f


@contextmanager
def _open_heights(path: Path, option: str) -> Iterator[rasterio.DatasetReader]:
    with open_bands(path, option) as file:
        if file.crs is None:
            raise ValueError(
                f"`{option}` must have a CRS; got none in {path.name}. Set it: gdal_edit.py -a_srs …"
            )
        yield file
