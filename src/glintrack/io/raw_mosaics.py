"""Read raw mosaics of a polarization camera: 8- to 16-bit TIFF, PNG and other rasters, and NumPy files."""

from collections import Counter
from pathlib import Path

import numpy as np
from jaxtyping import UInt

from glintrack.core.arrays import Array
from glintrack.io.read_raster import open_bands
from glintrack.io.readings import report_reading
from glintrack.io.untrusted import check_file, sort_by_number

RAW_SUFFIXES = (".tif", ".tiff", ".png", ".npy")
_UNFRAMED = (".raw", ".bin", ".dat", ".img")  # endings of counts without a header
_UNPACK = (
    "Unpack 12-bit counts to 16 bits and save them by numpy.save (docs/howto/my_polarization_camera.md)."
)
_MAX_NPY_BYTES = 800_000_000
_MAX_HEADER_BYTES = 4096


def raw_files(sources: list[Path]) -> list[Path]:
    """List raws of files and of folders in the natural order of their paths, 2 before 10.

    Raises
    ------
    ValueError
        If a folder holds none, or two raws have one name.
    """
    found: list[Path] = []
    for source in sources:
        inside = [source]
        if source.is_dir():
            there = [p for p in source.iterdir() if p.is_file()]
            inside = [p for p in there if p.suffix.lower() in RAW_SUFFIXES]
            others = {f"not {' '.join(RAW_SUFFIXES)}": len(there) - len(inside)}
            report_reading(source, "files", len(there), len(inside), others)
        if not inside:
            remedy = _UNPACK if any(p.suffix.lower() in _UNFRAMED for p in source.iterdir()) else ""
            raise ValueError(
                f"`RAW` must hold raws ({' '.join(RAW_SUFFIXES)}); got none in {source}. {remedy}"
            )
        found += inside
    found = sort_by_number(found, "RAW")
    repeated = sorted(stem for stem, count in Counter(path.stem for path in found).items() if count > 1)
    if repeated:
        raise ValueError(f"`RAW` must have names that differ before the ending; got {repeated[0]} twice.")
    return found


def read_raw(path: str | Path) -> UInt[Array, "row column"]:
    """Read the counts of one raw mosaic, as stored.

    Parameters
    ----------
    path
        ``.npy`` without pickled objects, or a raster of one band; unsigned integers of 8 or 16 bits, which
        hold counts of 10, 12 and 14 bits as well.

    Raises
    ------
    ValueError
        If the file is no raw mosaic.
    """
    path = Path(path)
    counts = _read_npy(path) if path.suffix.lower() == ".npy" else _read_raster(path)
    if counts.size == 0:
        raise ValueError(f"`RAW` must hold elements; got {counts.shape[0]} × {counts.shape[1]} in {path}.")
    return counts


def _check_type(path: Path, dtype: np.dtype, bands: int) -> None:
    if bands != 1:
        raise ValueError(
            f"`RAW` must be one mosaic, rows × columns; got {bands} bands in {path}. Give one band as the "
            "camera reads it, before any demosaicking."
        )
    if dtype not in (np.uint8, np.uint16):
        raise ValueError(f"`RAW` must hold counts of 8 or 16 bits without sign; got {dtype} in {path}.")


def _read_raster(path: Path) -> Array:
    if path.suffix.lower() in _UNFRAMED and not path.with_suffix(".hdr").exists():
        raise ValueError(f"`RAW` must be a file that states its size and bits; got {path}. {_UNPACK}")
    with open_bands(path, "RAW", "a raw mosaic") as file:
        _check_type(path, np.dtype(file.dtypes[0]), file.count)
        return file.read(1)


def _read_npy(path: Path) -> Array:
    """Array of a NumPy file, mapped so that its header is checked against its size before it is read."""
    check_file(path, "RAW", _MAX_NPY_BYTES)
    try:
        mapped = np.load(path, mmap_mode="r", allow_pickle=False, max_header_size=_MAX_HEADER_BYTES)
    except Exception as error:  # whatever a damaged header makes the parser raise
        raise ValueError(
            f"`RAW` must be a whole NumPy file; got {path} with another header or size."
        ) from error
    if not isinstance(mapped, np.ndarray) or mapped.ndim != 2:
        shape = getattr(mapped, "shape", "no array")
        raise ValueError(f"`RAW` must be one mosaic, rows × columns; got {shape} in {path}. {_UNPACK}")
    dtype = mapped.dtype.newbyteorder("=")
    _check_type(path, dtype, 1)
    return np.array(mapped, dtype, order="C")
