"""Rasters for work: ENVI, NetCDF-4, Zarr and GeoTIFF, written block by block and published whole.

A file is written beside its name and renamed at the end; whatever goes wrong before, nothing is left.
"""

import contextlib
import errno
import math
import os
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

import h5netcdf
import numcodecs
import numpy as np
import pyproj
import zarr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.records import RasterLayout
from glintrack.io.atomic import reserve
from glintrack.io.gdal import EnviWriter, GeotiffWriter

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
