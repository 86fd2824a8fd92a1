"""Raw mosaics of a polarization camera: 8- to 16-bit TIFF, PNG and other rasters, and NumPy files."""

import math
import warnings
from pathlib import Path

import numpy as np
import rasterio.errors
from jaxtyping import UInt

from glintrack.core.arrays import Array
from glintrack.io.untrusted import check_file, open_raster

RAW_SUFFIXES = (".tif", ".tiff", ".png", ".npy")
_TYPES = (np.dtype(np.uint8), np.dtype(np.uint16))
_MOST_NPY_BYTES = 800_000_000
_LONGEST_HEADER = 4096
_NPY_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


def raw_files(sources: list[Path]) -> list[Path]:
    """Raws of files and of folders, those of a folder in the order of their names.

    Raises
    ------
    ValueError
        If a folder holds none, or two raws have one name.
    """
    found: list[Path] = []
    for source in sources:
        if not source.is_dir():
            found.append(source)
            continue
        inside = sorted(p for p in source.iterdir() if p.suffix.lower() in RAW_SUFFIXES)
        if not inside:
            raise ValueError(f"`RAW` must hold raws ({' '.join(RAW_SUFFIXES)}), got none in {source}")
        found += inside
    stems = [path.stem for path in found]
    twice = sorted({stem for stem in stems if stems.count(stem) > 1})
    if twice:
        raise ValueError(f"`RAW` must have names that differ before the ending, got {twice[0]} twice")
    return found


def read_raw(path: str | Path) -> UInt[Array, "row column"]:
    """Counts of one raw mosaic, as stored.

    Parameters
    ----------
    path
        ``.npy`` without pickled objects, or a raster of one band; of 8 or 16 bits without sign, which hold
        10, 12 and 14 bits as well.

    Raises
    ------
    ValueError
        If the file is no such thing.
    """
    path = Path(path)
    counts = _npy(path) if path.suffix.lower() == ".npy" else _raster(path)
    if counts.size == 0:
        raise ValueError(f"`RAW` must hold elements, got {counts.shape[0]} × {counts.shape[1]} in {path}")
    return counts


def _check_kind(path: Path, dtype: np.dtype, bands: int) -> None:
    if bands != 1:
        raise ValueError(
            f"`RAW` must be one mosaic, rows × columns, got {bands} bands in {path} (one band as the camera "
            "reads it, before any demosaicking)"
        )
    if dtype not in _TYPES:
        raise ValueError(f"`RAW` must hold counts of 8 or 16 bits without sign, got {dtype} in {path}")


def _raster(path: Path) -> Array:
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            with open_raster(path, "RAW", "a raw mosaic") as file:
                _check_kind(path, np.dtype(file.dtypes[0]), file.count)
                return file.read(1)
    except rasterio.errors.RasterioError as error:
        raise ValueError(f"`RAW` must be a whole raw mosaic, got {path}") from error


def _npy(path: Path) -> Array:
    """An array of NumPy's own format, its header checked before anything of its size is made."""
    check_file(path, "RAW", _MOST_NPY_BYTES)
    with path.open("rb") as file:
        try:
            version = np.lib.format.read_magic(file)
            shape, by_column, dtype = _NPY_HEADERS[version](file, max_header_size=_LONGEST_HEADER)
        except Exception as error:  # whatever a damaged header makes a parser of Python say
            raise ValueError(f"`RAW` must be a NumPy file, got {path} with another header") from error
        if dtype.hasobject or len(shape) != 2:
            raise ValueError(
                f"`RAW` must be one mosaic, rows × columns, got {dtype} of shape {shape} in {path}"
            )
        _check_kind(path, dtype.newbyteorder("="), 1)
        data = file.read()
    if len(data) != math.prod(shape) * dtype.itemsize:
        raise ValueError(f"`RAW` must be a whole NumPy file, got {path} with another size than its header's")
    counts = np.frombuffer(data, dtype).reshape(shape, order="F" if by_column else "C")
    return np.ascontiguousarray(counts, dtype.newbyteorder("="))
