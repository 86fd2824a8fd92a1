"""Write pictures and figures as PNG or JPEG, frames and rectified images as GeoTIFF (COG) or NetCDF-4."""

import io
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib.image
import numpy as np
import PIL.Image
import pyproj
import rasterio
import rasterio.errors
import rasterio.transform
import xarray as xr
from jaxtyping import Float, UInt
from matplotlib.figure import Figure
from rasterio.enums import ColorInterp

from glintrack.core.arrays import Array
from glintrack.core.schema import RADIANCE
from glintrack.io.atomic import temporary_path, write_bytes
from glintrack.io.netcdf import write_dataset
from glintrack.io.untrusted import use_own_proj

DOTS_PER_INCH = 150  # of a figure


def write_frame(path: Path, image: xr.Dataset, crs: str, origin_m: tuple[float, float]) -> None:
    """Write a rectified frame as Cloud Optimized GeoTIFF: pan, I, Q, U and DoLP bands, NaN for no data.

    Parameters
    ----------
    path
        File to write.
    image
        Schema ``image``.
    crs
        CRS of the raster.
    origin_m
        Easting and northing of the frame's origin. [m]
    """
    gsd = float(image.attrs["gsd_m"])
    corner = (float(image["x"][0]) - gsd / 2 + origin_m[0], float(image["y"][0]) + gsd / 2 + origin_m[1])
    stokes = image["stokes_radiance"].values
    bands = [image["pan"].values, *np.moveaxis(stokes[..., :3], -1, 0), image["dolp"].values]
    units = dict.fromkeys(("pan", "I", "Q", "U"), RADIANCE) | {"dolp": "1"}
    tags = {"time_s": image.attrs.get("time_s", 0.0), "stokes_frame": "meridian"}
    transform = rasterio.transform.from_origin(*corner, gsd, gsd)
    _write(path, bands, list(units), crs, transform, tags, units=list(units.values()))


def write_polarization(path: Path, frame: xr.Dataset, time_s: float | None) -> None:
    """Write a frame in camera geometry as Cloud Optimized GeoTIFF: pan, I, Q, U, DoLP and AoP.

    Parameters
    ----------
    path
        File to write.
    frame
        Schema ``frame`` with ``dolp`` and ``aop``; one pixel for each superpixel.
    time_s
        Tag ``time_s``; None if it is not known. [s]
    """
    stokes = frame["stokes_radiance"]
    pan, dolp, aop = (frame[name].values for name in ("pan", "dolp", "aop"))
    bands = [pan, *np.moveaxis(stokes.values, -1, 0), dolp, aop]
    unit = str(stokes.attrs["units"])
    tags: dict[str, Any] = {"stokes_frame": "detector", "units": unit}
    tags |= {} if time_s is None else {"time_s": time_s}
    names, units = ("pan", "I", "Q", "U", "dolp", "aop"), [unit] * 4 + ["1", "rad"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        _write(path, bands, names, None, None, tags, units=units)


def write_bands(
    path: Path,
    bands: Float[Array, "y x band"],
    names: Sequence[str],
    x: Float[Array, "x"],
    y: Float[Array, "y"],
    crs: str,
    tags: Mapping[str, str | float],
    dtype: str = "float32",
) -> None:
    """Write a rectified image as Cloud Optimized GeoTIFF or, by its ending, NetCDF-4.

    Parameters
    ----------
    path
        ``.tif``, ``.tiff`` or ``.nc``.
    bands, names
        Values, NaN for no data, and name of each band.
    x, y
        Centres of the cells in the CRS, evenly spaced; y falls.
    crs
        CRS of the raster; in NetCDF a CF grid mapping.
    tags
        Metadata of the file.
    dtype
        Type of a GeoTIFF. Integers are rounded, and a mask marks missing data instead of NaN.

    Raises
    ------
    ValueError
        If the ending is not one of these.
    """
    ending = path.suffix.lower()
    if ending not in (".tif", ".tiff", ".nc"):
        raise ValueError(f"`output` must end in .tif or .nc; got {path.name!r}.")
    if ending == ".nc":
        mapping = pyproj.CRS.from_user_input(crs)
        axes = mapping.axis_info
        unit = "degree" if mapping.is_geographic else "m" if not axes else axes[0].unit_name
        unit = {"metre": "m"}.get(unit, unit)
        dataset = xr.Dataset(
            {
                name: (("y", "x"), bands[..., k], {"grid_mapping": "spatial_ref"})
                for k, name in enumerate(names)
            },
            coords={"y": ("y", y, {"units": unit}), "x": ("x", x, {"units": unit})},
            attrs=dict(tags),
        )
        write_dataset(path, dataset.assign_coords(spatial_ref=((), 0, mapping.to_cf())))
        return
    west, north = 1.5 * x[0] - 0.5 * x[1], 1.5 * y[0] - 0.5 * y[1]
    transform = rasterio.transform.from_origin(west, north, x[1] - x[0], y[0] - y[1])
    wkt = pyproj.CRS.from_user_input(crs).to_wkt()
    _write(path, list(np.moveaxis(bands, -1, 0)), names, wkt, transform, tags, dtype)


def _write(
    path: Path,
    bands: Sequence[Array],
    names: Sequence[str],
    crs: str | None,
    transform,
    tags,
    dtype: str = "float32",
    units: Sequence[str] = (),
) -> None:
    use_own_proj()
    height, width = bands[0].shape
    profile = {"driver": "COG", "height": height, "width": width, "count": len(bands), "dtype": dtype}
    profile |= {"crs": crs, "transform": transform, "compress": "deflate"}
    is_integer = np.issubdtype(dtype, np.integer)
    if not is_integer:
        profile["nodata"] = np.nan
    colours = [ColorInterp.red, ColorInterp.green, ColorInterp.blue]
    kinds = colours if list(names[:3]) == [kind.name for kind in colours] else [ColorInterp.gray]
    # in memory first: GDAL does not report a full disk
    with rasterio.Env(GDAL_TIFF_INTERNAL_MASK=True), rasterio.MemoryFile() as memory:
        with memory.open(**profile) as file:
            for k, (name, values) in enumerate(zip(names, bands, strict=True), start=1):
                if is_integer:
                    limits = np.iinfo(dtype)
                    values = np.nan_to_num(np.clip(np.rint(values), limits.min, limits.max))
                file.write(values.astype(dtype, copy=False), k)
                file.set_band_description(k, name)
            if units:
                file.units = units
            file.colorinterp = kinds + [ColorInterp.undefined] * (len(names) - len(kinds))
            if is_integer:
                file.write_mask(np.isfinite(bands).all(axis=0))
            file.update_tags(**tags)
        write_bytes(path, memory.read())


def write_picture(path: Path, picture: Float[Array, "y x 3"]) -> None:
    """Write an sRGB picture, 0 to 1, as PNG or JPEG by its ending."""
    quality: dict[str, Any] | None = {"quality": 82} if path.suffix.lower() in (".jpg", ".jpeg") else None
    with temporary_path(path) as partial:
        matplotlib.image.imsave(partial, np.clip(picture, 0, 1), pil_kwargs=quality)
        partial.rename(path)


def write_figure(path: Path, figure: Figure, dpi: int = DOTS_PER_INCH) -> None:
    """Write a figure as PNG or JPEG by its ending, whole or not at all."""
    with temporary_path(path) as partial:
        figure.savefig(partial, dpi=dpi)
        partial.rename(path)


def write_counts(path: Path, counts: UInt[Array, "row column"]) -> None:
    """Write counts of 16 bits as a PNG without loss, whole or not at all."""
    buffer = io.BytesIO()
    PIL.Image.fromarray(np.ascontiguousarray(counts, np.uint16)).save(buffer, "PNG")
    write_bytes(path, buffer.getvalue())
