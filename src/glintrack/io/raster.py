"""Write rasters block by block: ENVI, GeoTIFF, NetCDF-4 and Zarr.

A file is written under a temporary name and renamed at the end; after an error nothing is left. ENVI rows are
band-interleaved by line if a file is written row by row (camera geometry), and band-sequential if it is
written channel by channel (rectified), so that every block is one or few contiguous writes.
"""

import contextlib
import errno
import math
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import h5netcdf
import numcodecs
import numpy as np
import pyproj
import rasterio
import rasterio.errors
import rasterio.transform
import rasterio.windows
import xarray as xr
import zarr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.records import RasterLayout
from glintrack.io.atomic import reserve
from glintrack.io.untrusted import use_own_proj

NO_DATA = -9999.0  # readers of ENVI headers know no NaN
SUFFIXES = (".tif", ".tiff", ".hdr", ".nc", ".zarr")
_DESCRIPTION = re.compile(r"description = \{.*?\}(?=\nsamples)", re.DOTALL)  # in a header of GDAL
_NATURAL_UM = (0.64, 0.55, 0.46)  # red, green and blue for a quick look
_CACHE_MB = 64
_HEADER_BYTES = 1_000_000  # of a NetCDF file: coordinates, attributes and the index of chunks
Write = Callable[[int, int, Array], None]


class _GdalWriter:
    """A raster that GDAL writes; ``profile`` holds the options of the format."""

    def __init__(self, path: Path, layout: RasterLayout, profile: dict[str, Any]):
        use_own_proj()
        self.layout = layout
        whole = {"height": layout.rows, "width": layout.columns, "count": layout.count, "dtype": "float32"}
        if (place := layout.place) is not None:
            corner = rasterio.transform.from_origin(place.west_m, place.north_m, place.gsd_m, place.gsd_m)
            whole |= {"crs": place.crs, "transform": corner}
        # without auxiliary files of GDAL
        with rasterio.Env(GDAL_CACHEMAX=_CACHE_MB, GDAL_PAM_ENABLED=False), warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)  # camera geometry
            self.file = rasterio.open(path, "w", **{**whole, **profile})
        for k, name in enumerate(layout.band_names, start=1):
            self.file.set_band_description(k, name)
            self.file.set_band_unit(k, layout.units)

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        components, channels, rows, columns = values.shape
        window = rasterio.windows.Window(0, row, columns, rows)  # pyright: ignore[reportCallIssue]
        firsts = [k * len(self.layout.channels) + channel + 1 for k in range(components)]
        bands = [first + c for first in firsts for c in range(channels)]
        self.file.write(np.ascontiguousarray(values.reshape(-1, rows, columns)), bands, window=window)

    def close(self) -> None:
        """Finish the file."""
        with rasterio.Env(GDAL_PAM_ENABLED=False):
            self.file.close()


class _GeotiffWriter(_GdalWriter):
    """One TIFF band for each band of the layout; 8 bits for a picture, else float32."""

    def __init__(self, path: Path, layout: RasterLayout):
        self._is_picture = layout.name == "rgb"
        kind: dict[str, Any] = {"interleave": "band", "nodata": np.nan}
        if self._is_picture:
            kind = {"dtype": "uint8", "interleave": "pixel"}
        super().__init__(path, layout, {"driver": "GTiff", "bigtiff": "IF_SAFER", **kind})
        for k in range(layout.count if layout.wavelength_um else 0):
            c = k % len(layout.channels)
            middle, width = f"{layout.wavelength_um[c]:.6g}", f"{layout.width_um[c]:.6g}"
            self.file.update_tags(k + 1, wavelength=middle, fwhm=width, wavelength_units="Micrometers")
        self.file.update_tags(**dict(layout.attributes), **_attributes(layout))

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        if self._is_picture:
            values = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
        super().write(row, channel, values)


class _EnviWriter:
    """Raw float32 in ``path`` and a text header of the same name with the ending ``.hdr``.

    GDAL makes the header; the values are written directly, because GDAL does not report a full disk.
    """

    def __init__(self, path: Path, layout: RasterLayout):
        self.layout = layout
        self.by_line = layout.block[1] >= len(layout.channels)
        profile = {"driver": "ENVI", "interleave": "bil" if self.by_line else "bsq", "nodata": NO_DATA}
        made = _GdalWriter(path, layout, profile)
        made.file.update_tags(ns="ENVI", **_envi_tags(layout))
        made.close()
        header = path.with_suffix(".hdr")  # in which GDAL has written the temporary name
        text = header.read_text(encoding="utf-8", errors="replace")
        description = f"description = {{glintrack {layout.name} [{layout.units}]}}"
        header.write_text(_DESCRIPTION.sub(lambda _: description, text, count=1), encoding="utf-8")
        self._file = path.open("r+b")

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        layout = self.layout
        values = np.where(np.isfinite(values), values, NO_DATA).astype("<f4")
        components, channels, _rows, columns = values.shape
        pieces = [(row * layout.count * columns, np.moveaxis(values, 2, 0))]
        if not self.by_line:
            pieces = [
                (((k * len(layout.channels) + channel + c) * layout.rows + row) * columns, values[k, c])
                for k in range(components)
                for c in range(channels)
            ]
        for first, piece in pieces:
            self._file.seek(4 * first)
            self._file.write(np.ascontiguousarray(piece).data)

    def close(self) -> None:
        """Finish the data file."""
        self._file.close()


def _envi_tags(layout: RasterLayout) -> dict[str, str]:
    """Header entries other than size, type and position."""

    def join_in_braces(items: Iterable[str]) -> str:
        return "{" + ", ".join(items) + "}"

    tags: dict[str, str] = {}
    if layout.wavelength_um:
        repeats = len(layout.components)
        tags["wavelength_units"] = "Micrometers"
        tags["wavelength"] = join_in_braces(f"{x:.6g}" for x in layout.wavelength_um * repeats)
        tags["fwhm"] = join_in_braces(f"{x:.6g}" for x in layout.width_um * repeats)
        if len(layout.channels) > 3:
            nearest = [int(np.argmin(np.abs(np.array(layout.wavelength_um) - x))) + 1 for x in _NATURAL_UM]
            tags["default_bands"] = join_in_braces(map(str, nearest))
    if layout.stokes_frame:
        tags["stokes_frame"] = layout.stokes_frame
    return tags | {name: str(value) for name, value in layout.attributes}


class _LabelledWriter:
    """An array with labelled dims, that subclasses open as ``array``."""

    array: Any

    def __init__(self, layout: RasterLayout):
        self.layout = layout
        rows, channels = layout.block
        sizes = {layout.component_dim: (len(layout.components),) * 2, "x": (layout.columns,) * 2}
        sizes[layout.channel_dim] = len(layout.channels), min(channels, len(layout.channels))
        sizes["y"] = layout.rows, min(rows, layout.rows)
        mapping = {} if layout.place is None else {"grid_mapping": "spatial_ref"}
        self.attributes = _attributes(layout) | mapping
        self.shape, self.chunks = zip(*(sizes[dim] for dim in layout.dims), strict=True)

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        _, channels, rows, _ = values.shape
        at = {self.layout.component_dim: slice(None), "y": slice(row, row + rows), "x": slice(None)}
        at[self.layout.channel_dim] = slice(channel, channel + channels)
        gone = tuple(k for k in (0, 1) if not (self.layout.component_dim, self.layout.channel_dim)[k])
        self.array[tuple(at[dim] for dim in self.layout.dims)] = np.squeeze(values, gone).astype(np.float32)


class _NetcdfWriter(_LabelledWriter):
    """NetCDF-4 with CF coordinates and grid mapping."""

    def __init__(self, path: Path, layout: RasterLayout):
        super().__init__(layout)
        stored = [-(-size // chunk) * chunk for size, chunk in zip(self.shape, self.chunks, strict=True)]
        reserve(path, 4 * math.prod(stored) + _HEADER_BYTES)  # HDF5 crashes on a disk that fills up
        self._file = h5netcdf.File(path, "w")
        labels = _labels(layout)
        self._file.attrs.update(labels.attrs)
        self._file.dimensions = dict(zip(layout.dims, self.shape, strict=True))
        for name, variable in labels.variables.items():
            if variable.dtype.kind == "U":
                made = self._file.create_variable(
                    name, variable.dims, dtype=h5netcdf.core.h5py.string_dtype()
                )
                made[...] = variable.values.astype(object)
            else:
                made = self._file.create_variable(name, variable.dims, data=variable.values)
            made.attrs.update(variable.attrs)
        self.array = self._file.create_variable(
            layout.name, layout.dims, np.float32, fillvalue=np.float32(np.nan), chunks=self.chunks
        )
        self.array.attrs.update(self.attributes)

    def close(self) -> None:
        """Finish the file."""
        self._file.close()


class _ZarrWriter(_LabelledWriter):
    """Zarr of format 2, which GDAL and older readers know too; one chunk for each block."""

    def __init__(self, path: Path, layout: RasterLayout):
        super().__init__(layout)
        labels, self._path = _labels(layout), str(path)
        group = zarr.open_group(self._path, mode="w-", zarr_format=2, attributes=labels.attrs)
        for name, variable in labels.variables.items():
            attributes = {**variable.attrs, "_ARRAY_DIMENSIONS": list(variable.dims)}
            group.create_array(str(name), data=variable.values, attributes=attributes)
        attributes = {**self.attributes, "_ARRAY_DIMENSIONS": list(layout.dims)}
        if layout.place is not None:  # where GDAL's driver looks
            attributes["_CRS"] = {"wkt": pyproj.CRS.from_user_input(layout.place.crs).to_wkt()}
        self.array = group.create_array(
            layout.name,
            shape=self.shape,
            chunks=self.chunks,
            dtype="float32",
            fill_value=float("nan"),
            compressors=numcodecs.Zlib(1),
            attributes=attributes,
        )

    def close(self) -> None:
        """Finish the folder."""
        zarr.consolidate_metadata(self._path)  # one file of metadata, which xarray looks for


_WRITERS = {".hdr": _EnviWriter, ".nc": _NetcdfWriter, ".zarr": _ZarrWriter}


def _attributes(layout: RasterLayout) -> dict[str, Any]:
    """Return unit and Stokes frame of the raster's variable."""
    frame = {"stokes_frame": layout.stokes_frame} if layout.stokes_frame else {}
    return {"units": layout.units, **frame}


def _labels(layout: RasterLayout) -> xr.Dataset:
    """Coordinates of a labelled file as variables, and the file's own attributes."""
    labels: dict[str, tuple] = {}
    channel = layout.channel_dim
    if layout.component_dim:
        labels[layout.component_dim] = layout.component_dim, np.array(layout.components)
    if channel == "wavelength":
        about = {"units": "um", "long_name": "wavelength"}
        labels["wavelength"] = "wavelength", np.array(layout.wavelength_um), about
    elif channel:
        labels[channel] = channel, np.array(layout.channels)
    if layout.width_um and channel:
        labels["fwhm"] = channel, np.array(layout.width_um), {"units": "um"}
    y, x = np.arange(layout.rows, dtype=float), np.arange(layout.columns, dtype=float)
    if (place := layout.place) is None:
        about = {"units": "1", "long_name": "element of the array, row 0 at the top"}
        labels |= {"y": ("y", y, about), "x": ("x", x, about)}
    else:
        y, x = place.north_m - place.gsd_m * (y + 0.5), place.west_m + place.gsd_m * (x + 0.5)
        for name, values in (("y", y), ("x", x)):
            labels[name] = name, values, {"units": "m", "standard_name": f"projection_{name}_coordinate"}
        crs = pyproj.CRS.from_user_input(place.crs)
        mapping = {k: v for k, v in crs.to_cf().items() if isinstance(v, (str, float, int))}
        mapping["spatial_ref"] = crs.to_wkt()
        mapping["GeoTransform"] = f"{place.west_m} {place.gsd_m} 0 {place.north_m} 0 {-place.gsd_m}"
        labels["spatial_ref"] = (), np.array(0, np.int32), mapping
    return xr.Dataset(labels, attrs={"Conventions": "CF-1.10", **dict(layout.attributes)})


@contextlib.contextmanager
def raster_writer(path: Path, layout: RasterLayout) -> Iterator[Write]:
    """Open a raster and yield a function ``write(first_row, first_channel, values)``.

    Parameters
    ----------
    path
        File to write. Its suffix selects the format: ``.hdr`` (ENVI, with data in ``.img``), ``.nc``,
        ``.zarr`` or ``.tif``. An existing file is replaced, a Zarr folder must be new.
    layout
        Content of the file; ``values`` have the dims (y, x, channel, component).

    Raises
    ------
    ValueError
        If the suffix is unknown or the path cannot be written.
    """
    finals = output_files(path)
    partials = [p.with_name(f".partial-{os.getpid()}-{p.name}") for p in finals]
    writer = None
    try:
        with _gdal_errors(path):
            try:
                writer = _WRITERS.get(path.suffix.lower(), _GeotiffWriter)(partials[0], layout)
            except OSError as error:
                why = error.strerror or error
                raise ValueError(f"`output` must be writable; got {path}: {why}.") from error
        write = writer.write
        with _gdal_errors(path):
            yield lambda row, channel, values: write(row, channel, np.moveaxis(values, (3, 2), (0, 1)))
            writer.close()
        for partial, final in zip(partials, finals, strict=True):
            partial.rename(final)
    except BaseException:
        if writer is not None:
            with contextlib.suppress(Exception):  # the first error is the one to report
                writer.close()
        for partial in partials:
            shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _gdal_errors(path: Path) -> Iterator[None]:
    """Raise one OSError for whatever GDAL raises if it cannot write; it does not say why."""
    try:
        yield
    except Exception as error:
        if not (isinstance(error, SystemError) or type(error).__module__.startswith("rasterio")):
            raise
        raise OSError(errno.EIO, "it cannot be written (is the disk full?)", str(path)) from error


def output_files(path: Path) -> list[Path]:
    """Files that a raster of this name consists of, data before header; they can be written.

    Raises
    ------
    ValueError
        If the suffix is unknown, the folder is missing or not writable, or a Zarr folder exists.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"`output` must end in one of {', '.join(SUFFIXES)}; got {path.name!r}.")
    check_place(path)
    if suffix == ".zarr" and path.exists():
        raise ValueError(f"`output` must be a new folder; got {path}, which exists. Choose another -o.")
    return [path.with_suffix(".img"), path] if suffix == ".hdr" else [path]


def check_place(path: Path) -> None:
    """Refuse, before any work is done, a file that could not be written."""
    if not path.parent.is_dir():
        raise ValueError(f"`output` must lie in an existing folder; got {path}.")
    if not os.access(path.parent, os.W_OK) or (path.is_dir() and path.suffix.lower() != ".zarr"):
        raise ValueError(f"`output` must be writable; got {path}.")
