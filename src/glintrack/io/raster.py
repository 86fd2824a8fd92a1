"""Write rasters block by block: ENVI, GeoTIFF, NetCDF-4 and Zarr.

A file is written beside its name and renamed at the end; whatever goes wrong before, nothing is left. ENVI
rows come band-interleaved by line where a file is written row by row (camera geometry), band-sequential where
it is written channel by channel (rectified), so that every block is one or few straight writes.
"""

import contextlib
import errno
import math
import os
import re
import shutil
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Protocol

import h5netcdf
import numcodecs
import numpy as np
import pyproj
import rasterio
import rasterio.errors
import rasterio.transform
import rasterio.windows
import zarr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.records import RasterLayout
from glintrack.io.atomic import reserve
from glintrack.io.untrusted import use_own_proj

_NAMED = re.compile(r"description = \{.*?\}(?=\nsamples)", re.DOTALL)  # how GDAL begins the header
NO_DATA = -9999.0  # readers of ENVI headers know no NaN
_NATURAL_UM = (0.64, 0.55, 0.46)  # red, green and blue for a quick look
_CACHE_MB = 64


class _GdalWriter:
    """A raster that GDAL writes; ``profile`` are the format's own options."""

    def __init__(self, path: Path, layout: RasterLayout, profile: dict[str, Any]):
        use_own_proj()
        self.layout = layout
        whole = {"height": layout.rows, "width": layout.columns, "count": layout.count, "dtype": "float32"}
        if (place := layout.place) is not None:
            corner = rasterio.transform.from_origin(place.west_m, place.north_m, place.gsd_m, place.gsd_m)
            whole |= {"crs": place.crs, "transform": corner}
        # no file of GDAL's own beside
        with rasterio.Env(GDAL_CACHEMAX=_CACHE_MB, GDAL_PAM_ENABLED=False), warnings.catch_warnings():
            # camera geometry has no place on the map, and says so in its facts
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            self.file = rasterio.open(path, "w", **{**whole, **profile})
        for k, name in enumerate(layout.band_names, start=1):
            self.file.set_band_description(k, name)

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        components, channels, rows, columns = values.shape
        window = rasterio.windows.Window(0, row, columns, rows)  # pyright: ignore[reportCallIssue]
        bands = [
            k * len(self.layout.channels) + channel + c + 1
            for k in range(components)
            for c in range(channels)
        ]
        self.file.write(np.ascontiguousarray(values.reshape(-1, rows, columns)), bands, window=window)

    def close(self) -> None:
        """Finish the file."""
        with rasterio.Env(GDAL_PAM_ENABLED=False):
            self.file.close()


class GeotiffWriter(_GdalWriter):
    """One TIFF band a flat band; 8 bits for a picture, float32 else."""

    def __init__(self, path: Path, layout: RasterLayout):
        self._picture = layout.name == "rgb"
        kind = {"dtype": "uint8", "interleave": "pixel"} if self._picture else {"interleave": "band"}
        nodata = {} if self._picture else {"nodata": np.nan}
        super().__init__(path, layout, {"driver": "GTiff", "bigtiff": "IF_SAFER", **kind, **nodata})
        for k in range(layout.count if layout.wavelength_um else 0):
            c = k % len(layout.channels)
            self.file.update_tags(
                k + 1,
                wavelength=f"{layout.wavelength_um[c]:.6g}",
                fwhm=f"{layout.width_um[c]:.6g}",
                wavelength_units="Micrometers",
            )
        facts = {**dict(layout.attributes), "units": layout.units}
        if layout.stokes_frame:
            facts["stokes_frame"] = layout.stokes_frame
        self.file.update_tags(**facts)

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        if self._picture:
            values = np.rint(np.clip(values, 0, 1) * 255).astype(np.uint8)
        super().write(row, channel, values)


class EnviWriter:
    """Raw float32 in ``path`` beside a text header of its name with the ending ``.hdr``.

    GDAL makes the header; the values are written straight, because GDAL says nothing of a full disk.
    """

    def __init__(self, path: Path, layout: RasterLayout):
        self.layout = layout
        self.by_line = layout.block[1] >= len(layout.channels)
        profile = {"driver": "ENVI", "interleave": "bil" if self.by_line else "bsq", "nodata": NO_DATA}
        made = _GdalWriter(path, layout, profile)
        made.file.update_tags(ns="ENVI", **envi_facts(layout))
        made.close()
        header = path.with_suffix(".hdr")  # in which GDAL has the name that the file has for now
        text = header.read_text(encoding="utf-8", errors="replace")
        header.write_text(_NAMED.sub(lambda _: _description(layout), text, count=1), encoding="utf-8")
        self._file = path.open("r+b")

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        layout = self.layout
        values = np.where(np.isfinite(values), values, NO_DATA).astype("<f4")
        components, channels, _rows, columns = values.shape
        if self.by_line:
            self._put(row * layout.count * columns, np.moveaxis(values, 2, 0))
            return
        for k in range(components):
            for c in range(channels):
                band = k * len(layout.channels) + channel + c
                self._put((band * layout.rows + row) * columns, values[k, c])

    def _put(self, first: int, values: Array) -> None:
        self._file.seek(4 * first)
        self._file.write(np.ascontiguousarray(values).data)

    def close(self) -> None:
        """Finish the data file."""
        self._file.close()


def _description(layout: RasterLayout) -> str:
    return f"description = {{glintrack {layout.name} [{layout.units}]}}"


def envi_facts(layout: RasterLayout) -> dict[str, str]:
    """What the header says beside size, type and place, so that a reader can use the raster without us."""
    facts: dict[str, str] = {}
    if layout.wavelength_um:
        repeats = len(layout.components)
        facts["wavelength_units"] = "Micrometers"
        facts["wavelength"] = _braced(f"{x:.6g}" for x in layout.wavelength_um * repeats)
        facts["fwhm"] = _braced(f"{x:.6g}" for x in layout.width_um * repeats)
        if len(layout.channels) > 3:
            nearest = [int(np.argmin(np.abs(np.array(layout.wavelength_um) - x))) + 1 for x in _NATURAL_UM]
            facts["default_bands"] = _braced(map(str, nearest))
    if layout.stokes_frame:
        facts["stokes_frame"] = layout.stokes_frame
    return facts | {name: str(value) for name, value in layout.attributes}


def _braced(items) -> str:
    return "{" + ", ".join(items) + "}"


_HEADERS = 1_000_000  # bytes: coordinates, attributes and the index of chunks
SUFFIXES = (".tif", ".tiff", ".hdr", ".nc", ".zarr")
Write = Callable[[int, int, Array], None]


class RasterWriter(Protocol):
    """What each format offers."""

    def write(self, row: int, channel: int, values: Float[Array, "component channel y x"]) -> None:
        """Write a block whose first row and channel are given."""
        ...

    def close(self) -> None:
        """Finish the file."""
        ...


@contextlib.contextmanager
def raster_writer(path: Path, layout: RasterLayout) -> Iterator[Write]:
    """A function ``write(first row, first channel, values)``, values being (y, x, channel, component).

    Parameters
    ----------
    path
        Its suffix chooses the format: ``.hdr`` (ENVI, data in ``.img`` beside it), ``.nc``, ``.zarr`` or
        ``.tif``. A file of that name is replaced, a Zarr folder must be new.
    layout
        What the file will hold.

    Raises
    ------
    ValueError
        If the suffix is unknown or the place cannot be written.
    """
    finals = output_files(path)
    partials = [p.with_name(f".partial-{os.getpid()}-{p.name}") for p in finals]
    writer: RasterWriter | None = None
    try:
        with _gdal_told(path):
            try:
                writer = _open(path.suffix.lower(), partials, layout)
            except OSError as error:
                why = error.strerror or error
                raise ValueError(f"`output` must be writable, got {path} ({why})") from error
        opened = writer

        def write(row: int, channel: int, values: Array) -> None:
            opened.write(row, channel, np.moveaxis(values, (3, 2), (0, 1)))

        with _gdal_told(path):
            yield write
            writer.close()
        for partial, final in zip(partials, finals, strict=True):
            partial.rename(final)
    except BaseException:
        if writer is not None:
            with contextlib.suppress(Exception):  # the fault that brought us here is the one to report
                writer.close()
        for partial in partials:
            shutil.rmtree(partial) if partial.is_dir() else partial.unlink(missing_ok=True)
        raise


@contextlib.contextmanager
def _gdal_told(path: Path) -> Iterator[None]:
    """Make one sentence of what GDAL raises where it cannot write; it does not say why."""
    try:
        yield
    except Exception as error:
        if not (isinstance(error, SystemError) or type(error).__module__.startswith("rasterio")):
            raise
        raise OSError(errno.EIO, "it cannot be written (is the disk full?)", str(path)) from error


def output_files(path: Path) -> list[Path]:
    """The files that a raster of this name consists of, data before header, once they can be written.

    Raises
    ------
    ValueError
        If the suffix is unknown, the folder is missing or may not be written, or a Zarr folder exists.
    """
    suffix = path.suffix.lower()
    if suffix not in SUFFIXES:
        raise ValueError(f"`output` must end in one of {', '.join(SUFFIXES)}, got {path.name!r}")
    check_place(path)
    if suffix == ".zarr" and path.exists():
        raise ValueError(f"`output` must be a new folder, got {path}, which exists (choose another -o)")
    return [path.with_suffix(".img"), path] if suffix == ".hdr" else [path]


def check_place(path: Path) -> None:
    """Refuse, before any work is done, a file that could not be written."""
    if not path.parent.is_dir():
        raise ValueError(f"`output` must lie in an existing folder, got {path}")
    if not os.access(path.parent, os.W_OK) or (path.is_dir() and path.suffix.lower() != ".zarr"):
        raise ValueError(f"`output` must be writable, got {path}")


def _open(suffix: str, paths: list[Path], layout: RasterLayout) -> RasterWriter:
    if suffix == ".hdr":
        return EnviWriter(paths[0], layout)
    if suffix == ".nc":
        return _NetcdfWriter(paths[0], layout)
    return _ZarrWriter(paths[0], layout) if suffix == ".zarr" else GeotiffWriter(paths[0], layout)


class _NetcdfWriter:
    """NetCDF-4 with CF coordinates and grid mapping."""

    def __init__(self, path: Path, layout: RasterLayout):
        self.layout = layout
        sizes, chunks = _sizes(layout), _chunks(layout)
        stored = [-(-sizes[d] // c) * c for d, c in zip(layout.dims, chunks, strict=True)]
        reserve(path, 4 * math.prod(stored) + _HEADERS)  # HDF5 crashes on a disk that fills up
        self._file = h5netcdf.File(path, "w")
        coordinates, attributes = _labels(layout)
        self._file.attrs.update(attributes)
        self._file.dimensions = {d: sizes[d] for d in layout.dims}
        for name, (dims, values, facts) in coordinates.items():
            if values.dtype.kind == "U":
                variable = self._file.create_variable(name, dims, dtype=h5netcdf.core.h5py.string_dtype())
                variable[...] = values.astype(object)
            else:
                variable = self._file.create_variable(name, dims, data=values)
            variable.attrs.update(facts)
        self._variable = self._file.create_variable(
            layout.name, layout.dims, np.float32, fillvalue=np.float32(np.nan), chunks=chunks
        )
        self._variable.attrs.update(_facts(layout))

    def write(self, row: int, channel: int, values: Array) -> None:
        where, block = _block(self.layout, row, channel, values)
        self._variable[where] = block

    def close(self) -> None:
        self._file.close()


class _ZarrWriter:
    """Zarr of format 2, which GDAL and older readers know too; one chunk a block."""

    def __init__(self, path: Path, layout: RasterLayout):
        self.layout = layout
        coordinates, attributes = _labels(layout)
        self._path = str(path)
        group = zarr.open_group(self._path, mode="w-", zarr_format=2, attributes=attributes)
        for name, (dims, values, facts) in coordinates.items():
            facts = {**facts, "_ARRAY_DIMENSIONS": list(dims)}
            group.create_array(name, data=np.asarray(values), attributes=facts)
        sizes, facts = _sizes(layout), {**_facts(layout), "_ARRAY_DIMENSIONS": list(layout.dims)}
        if layout.place is not None:  # where GDAL's driver looks
            facts["_CRS"] = {"wkt": pyproj.CRS.from_user_input(layout.place.crs).to_wkt()}
        self._array = group.create_array(
            layout.name,
            shape=tuple(sizes[d] for d in layout.dims),
            chunks=_chunks(layout),
            dtype="float32",
            fill_value=float("nan"),
            compressors=numcodecs.Zlib(1),
            attributes=facts,
        )

    def write(self, row: int, channel: int, values: Array) -> None:
        where, block = _block(self.layout, row, channel, values)
        self._array[where] = block.astype(np.float32)

    def close(self) -> None:
        zarr.consolidate_metadata(self._path)  # one file of metadata, which xarray looks for


def _sizes(layout: RasterLayout) -> dict[str, int]:
    return {
        layout.component_dim: len(layout.components),
        layout.channel_dim: len(layout.channels),
        "y": layout.rows,
        "x": layout.columns,
    }


def _chunks(layout: RasterLayout) -> tuple[int, ...]:
    rows, channels = layout.block
    size = {
        layout.component_dim: len(layout.components),
        layout.channel_dim: min(channels, len(layout.channels)),
        "y": min(rows, layout.rows),
        "x": layout.columns,
    }
    return tuple(size[d] for d in layout.dims)


def _block(layout: RasterLayout, row: int, channel: int, values: Array) -> tuple[tuple, Array]:
    """Where a block goes in a labelled file, and the block without the dims that the file has not."""
    _, channels, rows, _ = values.shape
    where: list[slice] = []
    if layout.component_dim:
        where.append(slice(None))
    if layout.channel_dim:
        where.append(slice(channel, channel + channels))
    where += [slice(row, row + rows), slice(None)]
    shape = tuple(n for n, d in zip(values.shape[:2], _leading(layout), strict=True) if d) + values.shape[2:]
    return tuple(where), np.ascontiguousarray(values).reshape(shape)


def _leading(layout: RasterLayout) -> tuple[str, str]:
    return layout.component_dim, layout.channel_dim


def _facts(layout: RasterLayout) -> dict:
    facts = {"units": layout.units}
    if layout.stokes_frame:
        facts["stokes_frame"] = layout.stokes_frame
    if layout.place is not None:
        facts["grid_mapping"] = "spatial_ref"
    return facts


def _labels(layout: RasterLayout) -> tuple[dict[str, tuple[tuple[str, ...], Array, dict]], dict]:
    """Coordinates as (dims, values, attributes), and the file's own attributes."""
    coordinates: dict[str, tuple[tuple[str, ...], Array, dict]] = {}
    if layout.component_dim:
        coordinates[layout.component_dim] = (layout.component_dim,), np.array(layout.components), {}
    if layout.channel_dim == "wavelength":
        wavelength = np.array(layout.wavelength_um)
        coordinates["wavelength"] = ("wavelength",), wavelength, {"units": "um", "long_name": "wavelength"}
    elif layout.channel_dim:
        coordinates[layout.channel_dim] = (layout.channel_dim,), np.array(layout.channels), {}
    if layout.width_um and layout.channel_dim:
        coordinates["fwhm"] = (layout.channel_dim,), np.array(layout.width_um), {"units": "um"}
    place = layout.place
    if place is None:
        for name, count in (("y", layout.rows), ("x", layout.columns)):
            facts = {"units": "1", "long_name": "element of the array, row 0 at the top"}
            coordinates[name] = (name,), np.arange(count, dtype=float), facts
    else:
        north = place.north_m - place.gsd_m * (np.arange(layout.rows) + 0.5)
        east = place.west_m + place.gsd_m * (np.arange(layout.columns) + 0.5)
        for name, values in (("y", north), ("x", east)):
            facts = {"units": "m", "standard_name": f"projection_{name}_coordinate"}
            coordinates[name] = (name,), values, facts
        crs = pyproj.CRS.from_user_input(place.crs)
        mapping = {k: v for k, v in crs.to_cf().items() if isinstance(v, (str, float, int))}
        mapping["spatial_ref"] = crs.to_wkt()
        mapping["GeoTransform"] = f"{place.west_m} {place.gsd_m} 0 {place.north_m} 0 {-place.gsd_m}"
        coordinates["spatial_ref"] = (), np.array(0, np.int32), mapping
    return coordinates, {"Conventions": "CF-1.10", **dict(layout.attributes)}
