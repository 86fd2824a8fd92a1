"""Read untrusted files: they cannot block or crash the program, fill its memory or refer to other files.

All readers of a user's files use this module. It imports nothing else of ours.

- Text and archives have a largest size.
- NetCDF-4 files are first read in a process with limited time and memory, because HDF5 loops or crashes on
  some damaged files. That process runs this module as a program. Links to other files are refused, and more
  data than a file of its size can hold.
- Rasters are opened only by drivers that neither follow references nor use a network.
"""

import bz2
import contextlib
import functools
import gzip
import json
import os
import re
import signal
import struct
import subprocess
import sys
import warnings
import zlib
from collections.abc import Iterable
from decimal import Decimal
from io import BufferedIOBase
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Float

if TYPE_CHECKING:  # a command line is checked without these libraries
    import h5py
    import rasterio

MAX_TEXT_BYTES = 256_000_000
MAX_COORDINATE_M, MAX_CELL_M = 1e8, 1e5  # of projected coordinates and cells of a map
_DECIMAL_AT_END = re.compile(r"(?:^|[^A-Za-z0-9.])[0-9]+\.[0-9]+$")  # of a name, as in frame_12.5
MIN_HEIGHT_M, MAX_HEIGHT_M = -500.0, 9000.0  # of ground and roofs: the Dead Sea's shore, Everest
_MAX_MESSAGE_LENGTH = 2000
_HDF5_SIGNATURE = b"\x89HDF\r\n\x1a\n"
# of an HDF5 file
_MAX_BYTES, _ALWAYS_ALLOWED_BYTES, _MAX_RATIO = 16e9, 64e6, 1000
_MAX_OBJECTS, _MAX_DEPTH, _MAX_STRING_BYTES = 20_000, 32, 1_000_000
_SLAB_BYTES = 32e6
_MAX_MEMORY_BYTES, _CPU_S, _BYTES_PER_CPU_S = 3_000_000_000, 2, 10e6
_WALL_S, _BYTES_PER_WALL_S = 60.0, 5e6
# of a raster
RASTER_DRIVERS = (
    *("GTiff", "PNG", "JPEG", "JP2OpenJPEG", "WEBP", "BMP"),
    *("ENVI", "EHdr", "AAIGrid", "HFA", "SRTMHGT", "DTED"),
)
MAX_CELLS = 400_000_000
_MAX_CELLS_PER_BYTE = 4000  # more than a megacell from a kilobyte is no picture
_ALWAYS_ALLOWED_CELLS = 25_000_000
_PROJ_VARIABLES = ("PROJ_DATA", "PROJ_LIB")


def plain(message: object, most: int = _MAX_MESSAGE_LENGTH) -> str:
    """Message for a terminal: control codes and codes that reverse text escaped, of limited length."""
    text = re.sub(
        r"[\x00-\x09\x0b-\x1f\x7f-\x9f\u200e\u200f\u2028-\u202e\u2066-\u2069\ud800-\udfff]",
        lambda found: found[0].encode("unicode_escape").decode("ascii"),
        str(message),
    )
    return text if len(text) <= most else f"{text[: most - 1]}…"


def check_file(path: str | Path, name: str, most_bytes: int | None = None) -> Path:
    """Refuse a path that is no regular file (a device or a pipe may never end), or too large a file.

    Raises
    ------
    ValueError
        If there is no such file, or it is too large.
    """
    path = Path(path)
    try:
        regular, size = path.is_file(), path.stat().st_size
    except (OSError, ValueError) as error:
        reason = getattr(error, "strerror", None) or error
        raise ValueError(f"`{name}` must be a readable file; got {path}: {reason}.") from error
    if not regular:
        kind = "a folder (name a file in it)" if path.is_dir() else "no regular file"
        raise ValueError(f"`{name}` must be a readable file; got {path}, which is {kind}.")
    if most_bytes is not None and size > most_bytes:
        raise ValueError(
            f"`{name}` must have at most {most_bytes / 1e6:g} MB; got {path} with {size / 1e6:.0f}."
        )
    return path


def sort_by_number(paths: Iterable[Path], name: str) -> list[Path]:
    """Sort paths by the numbers in their names, 2 before 10; names that are decimal numbers by their value.

    Raises
    ------
    ValueError
        If the numbers after a point could be counts or decimals, as in frame_1.5 and frame_1.10.
    """
    paths = list(paths)
    if all(re.fullmatch(r"[0-9]+(\.[0-9]+)?", path.stem) for path in paths):
        return sorted(paths, key=lambda path: (_numbers(path.parent), Decimal(path.stem), path.suffix))
    by_count = sorted(paths, key=_numbers)
    by_value = sorted(paths, key=functools.partial(_numbers, has_decimals=True))
    if by_count != by_value:
        example = next(one for one, other in zip(by_count, by_value, strict=True) if one != other)
        raise ValueError(
            f"`{name}` must have names in one order; got names such as {example.name}, whose last number is "
            "a count or decimals. Give all names the same number of digits."
        )
    return by_count


def _numbers(path: Path, has_decimals: bool = False) -> list[tuple[int, float, str]]:
    """Return a sort key of the texts and numbers of a path, with decimals at the end if asked for."""
    parts = re.split(r"([0-9]+)", str(path.parent / path.stem))
    key: list[tuple[int, float, str]] = [
        (0, int(part), part) if k % 2 else (1, 0, part) for k, part in enumerate(parts)
    ]
    if has_decimals and _DECIMAL_AT_END.search(path.stem):
        key[-2] = 0, float(f"0.{parts[-2]}"), parts[-2]
    return [*key, (1, 0, path.suffix)]


def resolve_path(path: str | Path) -> Path:
    """Absolute path with links followed; a circle of links remains, and is an error when it is read."""
    return Path(os.path.realpath(path))


def is_file(path: Path) -> bool:
    """Return True if there is a file; False for a name that the system refuses."""
    try:
        return path.is_file()
    except (OSError, ValueError):  # too long, or with a NUL
        return False


def read_bytes(path: str | Path, name: str, most_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Bytes of a file, unzipped if it is a gzip or bzip2 archive; both of limited size.

    Raises
    ------
    ValueError
        If the file cannot be read, is a damaged archive, or is too large.
    """
    with open_unzipped(check_file(path, name, most_bytes), name) as file:
        try:
            content = file.read(most_bytes + 1)
        except (OSError, EOFError, zlib.error) as error:
            raise ValueError(f"`{name}` must be a whole gzip or bzip2 file; got {path}: {error}.") from error
    if len(content) > most_bytes:
        raise ValueError(f"`{name}` must unzip to at most {most_bytes / 1e6:g} MB; got more in {path}.")
    return content


def open_unzipped(path: str | Path, name: str) -> BufferedIOBase:
    """Open a file to be read in pieces, unzipped if it is a gzip or bzip2 archive; bound what you read.

    Raises
    ------
    ValueError
        If there is no such file, or it cannot be read.
    """
    path = check_file(path, name)
    try:
        with path.open("rb") as file:
            head = file.read(3)
        if head == b"BZh":
            return bz2.open(path)
        return gzip.open(path) if head[:2] == b"\x1f\x8b" else path.open("rb")
    except OSError as error:
        raise ValueError(f"`{name}` must be a readable file; got {path}: {error.strerror}.") from error


def read_text(path: str | Path, name: str, most_bytes: int = MAX_TEXT_BYTES) -> str:
    """Text of a UTF-8 file, without a byte-order mark, unzipped as by `read_bytes`.

    Raises
    ------
    ValueError
        If the file cannot be read, is too large or not UTF-8.
    """
    try:
        return read_bytes(path, name, most_bytes).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise ValueError(f"`{name}` must be UTF-8 text; got {path} with a byte that is not.") from error


def read_json(path: str | Path, name: str) -> Any:
    """Content of a JSON file.

    Raises
    ------
    ValueError
        If the file cannot be read, is too large, or is not JSON in UTF-8.
    """
    try:
        return json.loads(read_bytes(path, name).decode("utf-8"))
    except RecursionError as error:
        raise ValueError(f"`{name}` must be JSON; got {path}, nested too deeply.") from error
    except (UnicodeDecodeError, json.JSONDecodeError) as error:
        raise ValueError(f"`{name}` must be JSON in UTF-8; got {path}: {plain(error, 200)}.") from error


def check_netcdf(path: str | Path, name: str) -> Path:
    """Refuse a NetCDF-4 file that cannot be read to its end within bounds of time and memory.

    Raises
    ------
    ValueError
        If the file is none, is damaged, refers to other files, or holds far more than its size.
    """
    path = check_file(path, name)
    with path.open("rb") as file:
        if file.read(8) != _HDF5_SIGNATURE:
            raise ValueError(f"`{name}` must be a readable NetCDF-4 file; got {path}.")
    about = path.stat()
    fault = _netcdf_fault(str(path.resolve()), about.st_size, about.st_mtime_ns)
    if fault:
        raise ValueError(f"`{name}` must be a whole NetCDF-4 file; got {path}: {fault}.")
    return path


@functools.lru_cache(maxsize=256)
def _netcdf_fault(path: str, size: int, _changed_ns: int) -> str:
    """Read a file in another process and return what is wrong with it; empty if nothing is."""
    seconds = _WALL_S + size / _BYTES_PER_WALL_S
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
    command = [sys.executable, "-P", __file__, path]
    try:
        done = subprocess.run(command, capture_output=True, timeout=seconds, env=environment, check=False)
    except subprocess.TimeoutExpired:
        return "reading it does not end"
    if done.returncode in (-getattr(signal, "SIGXCPU", 24), -getattr(signal, "SIGKILL", 9)):
        return "reading it does not end"
    if done.returncode:
        return "the HDF5 library cannot read it"
    return plain(done.stdout.decode("utf-8", "replace").strip(), 200)


class _FaultError(Exception):
    """A fault of a file, in a few words."""


def _visit_all(path: Path) -> None:
    """Read every group, attribute and chunk of a file."""
    import h5py

    size = path.stat().st_size
    total = count = 0
    with h5py.File(path, "r") as file:
        waiting: list[tuple[h5py.Group, int]] = [(file, 0)]
        seen = {h5py.h5o.get_info(file.id).addr}  # pyright: ignore[reportAttributeAccessIssue]
        while waiting:
            group, depth = waiting.pop()
            _check_attributes(group)
            for name in group:
                if not isinstance(group.get(name, getlink=True), h5py.HardLink):
                    raise _FaultError("it links to elsewhere")
                item = group[name]
                count += 1
                if count > _MAX_OBJECTS or depth > _MAX_DEPTH:
                    raise _FaultError("it holds too many groups and variables")
                address = h5py.h5o.get_info(item.id).addr  # pyright: ignore[reportAttributeAccessIssue]
                if address in seen:
                    raise _FaultError("one variable has two names")
                seen.add(address)
                if isinstance(item, h5py.Group):
                    waiting.append((item, depth + 1))
                elif isinstance(item, h5py.Dataset):
                    _check_attributes(item)
                    total += item.nbytes
                    if total > min(_MAX_BYTES, max(_ALWAYS_ALLOWED_BYTES, _MAX_RATIO * size)):
                        raise _FaultError(f"it says to hold {total / 1e6:.0f} MB in {size / 1e6:.3f}")
                    _check_data(item)


def _check_attributes(item: "h5py.Group | h5py.Dataset") -> None:
    for value in item.attrs.values():
        if isinstance(value, (str, bytes)) and len(value) > _MAX_STRING_BYTES:
            raise _FaultError("a text in it is too long")


def _check_data(data: "h5py.Dataset") -> None:
    if data.external or data.is_virtual:
        raise _FaultError("its data lie in other files")
    if data.shape is None or not data.size:
        return
    if not data.shape:
        data[()]
        return
    if data.dtype.kind == "O" and data.size > _MAX_STRING_BYTES:
        raise _FaultError("it holds too many texts")
    rows = max(int(_SLAB_BYTES // max(data.nbytes / data.shape[0], 1)), 1)
    for start in range(0, data.shape[0], rows):
        np.asarray(data[start : start + rows])


def _hdf5_fault(path: Path) -> str:
    """Read an HDF5 file in this process and return what is wrong with it; empty if nothing is."""
    try:
        _visit_all(path)
    except _FaultError as reason:
        return str(reason)
    except MemoryError:
        return "it takes too much memory"
    except Exception as error:  # whatever a damaged file makes the library say
        return str(error).split("\n")[0][:120] or type(error).__name__
    return ""


def _limit_resources(size: int) -> None:
    """Limit time and memory of this process for a file of that size. [byte]"""
    try:
        import resource
    except ImportError:  # on Windows only the waiting process's time limit holds
        return
    seconds = int(_CPU_S + size / _BYTES_PER_CPU_S)
    for limit, soft, hard in (
        (resource.RLIMIT_CPU, seconds, seconds + 1),
        (resource.RLIMIT_AS, _MAX_MEMORY_BYTES, _MAX_MEMORY_BYTES + 1),
        (resource.RLIMIT_CORE, 0, 0),
    ):
        with contextlib.suppress(ValueError, OSError):  # a lower limit holds already
            resource.setrlimit(limit, (soft, hard))


def open_raster(path: str | Path, name: str, requirement: str = "a raster") -> "rasterio.DatasetReader":
    """Open a raster by one of `RASTER_DRIVERS`, read-only, without network, of bounded size.

    Raises
    ------
    ValueError
        If it is no such raster or too large.
    """
    import rasterio
    import rasterio.errors

    use_own_proj()
    path = check_file(path, name)
    file = None
    with rasterio.Env(CPL_VSIL_CURL_ALLOWED_FILENAME="none"):
        for driver in RASTER_DRIVERS:
            with contextlib.suppress(rasterio.errors.RasterioError, ValueError):
                file = rasterio.open(path, driver=driver)
                break
    if file is None:
        kinds = "GeoTIFF, PNG, JPEG, JPEG 2000, WebP, BMP, ENVI, ESRI or DTED"
        raise ValueError(f"`{name}` must be {requirement} ({kinds}); got {path}.")
    cells, corner = file.width * file.height * file.count, tuple(file.transform)[:6]
    fault = ""
    if file.driver == "PNG" and not _is_whole_png(path):
        fault = f"`{name}` must be a whole PNG file; got {path}, which is cut off or damaged."
    elif cells > min(MAX_CELLS, max(_ALWAYS_ALLOWED_CELLS, _MAX_CELLS_PER_BYTE * path.stat().st_size)):
        fault = (
            f"`{name}` must have at most {MAX_CELLS:,} cells, and data for them; got {path} with "
            f"{file.width} × {file.height} × {file.count}."
        )
    elif not all(abs(value) <= MAX_COORDINATE_M for value in corner):
        fault = (
            f"`{name}` must have a finite geotransform within ±{MAX_COORDINATE_M:g}; got {corner} in {path}."
        )
    if fault:
        file.close()
        raise ValueError(fault)
    return file


def _is_whole_png(path: Path) -> bool:
    """Return True if all chunks of a PNG file are complete; GDAL does not report missing ones."""
    from PIL.PngImagePlugin import ChunkStream

    with path.open("rb") as file:
        file.seek(8)  # the signature, which the driver knows
        try:
            return ChunkStream(file).verify() is not None
        except (OSError, SyntaxError, ValueError, struct.error):
            return False


def check_heights(values: Float[np.ndarray, "..."], name: str, path: str | Path) -> None:
    """Refuse heights that no ground has: a filler value of missing data, or another unit.

    Raises
    ------
    ValueError
        With the share of such heights, one of them, and the remedy.
    """
    known = np.isfinite(values)
    bad = known & ((values < MIN_HEIGHT_M) | (values > MAX_HEIGHT_M))
    if bad.any():
        raise ValueError(
            f"`{name}` must hold heights of {MIN_HEIGHT_M:g} to {MAX_HEIGHT_M:g} m; got "
            f"{values[bad].flat[0]:g} in {100 * bad.sum() / known.sum():.2g} % of {path}. "
            "Mark missing heights: gdal_edit.py -a_nodata …"
        )


@functools.lru_cache(maxsize=1)
def use_own_proj() -> None:
    """Ignore PROJ_DATA and PROJ_LIB, with a warning, where they name a database that rasterio cannot read.

    SUMO's Python package, conda environments and database servers set them for a PROJ of their own. Then
    rasterio knows no EPSG code. Call it before rasters are read or written.
    """
    named = {name: os.environ[name] for name in _PROJ_VARIABLES if os.environ.get(name)}
    if not named or _knows_epsg():
        return
    for name in named:
        del os.environ[name]
    if _knows_epsg():
        given = " and ".join(f"{name}={value}" for name, value in named.items())
        warnings.warn(f"{given} belongs to another PROJ and is not used", stacklevel=3)
    else:
        os.environ.update(named)


def _knows_epsg() -> bool:
    import rasterio
    import rasterio.crs
    import rasterio.errors

    with rasterio.Env():  # which reads the variables
        try:
            return bool(rasterio.crs.CRS.from_epsg(4326))
        except rasterio.errors.CRSError:
            return False


if __name__ == "__main__":
    _file = Path(sys.argv[1])
    _limit_resources(_file.stat().st_size)
    sys.stdout.buffer.write(_hdf5_fault(_file).encode("utf-8", "replace"))
