"""Rasters of others: opened by named drivers alone, which neither follow references nor reach a network."""

import contextlib
import struct
import zlib
from pathlib import Path

import numpy as np
import rasterio
import rasterio.errors
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.io.proj import forget_foreign_proj
from glintrack.io.untrusted import FARTHEST_M, HIGHEST_M, LOWEST_M, check_file

forget_foreign_proj()

RASTER_DRIVERS = (
    *("GTiff", "PNG", "JPEG", "JP2OpenJPEG", "WEBP", "BMP"),
    *("ENVI", "EHdr", "AAIGrid", "HFA", "SRTMHGT", "DTED"),
)
_MOST_CELLS = 400_000_000
_MOST_CELLS_PER_BYTE = 4000  # more than a megacell from a kilobyte is no picture
_FEW_CELLS = 25_000_000


def open_raster(path: str | Path, name: str, requirement: str = "a raster") -> rasterio.DatasetReader:
    """Open a raster by one of `RASTER_DRIVERS`, read-only, without network, of bounded size.

    Raises
    ------
    ValueError
        If it is no such raster or too large.
    """
    path = check_file(path, name)
    file = None
    with rasterio.Env(CPL_VSIL_CURL_ALLOWED_FILENAME="none"):
        for driver in RASTER_DRIVERS:
            with contextlib.suppress(rasterio.errors.RasterioError, ValueError):
                file = rasterio.open(path, driver=driver)
                break
    if file is None:
        kinds = "GeoTIFF, PNG, JPEG, JPEG 2000, WebP, BMP, ENVI, ESRI or DTED"
        raise ValueError(f"`{name}` must be {requirement} ({kinds}), got {path}")
    if file.driver == "PNG" and not _is_whole_png(path):
        file.close()
        raise ValueError(f"`{name}` must be a whole PNG file, got {path}, which is cut off or damaged")
    cells = file.width * file.height * file.count
    if cells > _MOST_CELLS or cells > max(_FEW_CELLS, _MOST_CELLS_PER_BYTE * path.stat().st_size):
        file.close()
        raise ValueError(
            f"`{name}` must have at most {_MOST_CELLS:.0e} cells, and data for them, got {path} with "
            f"{file.width} × {file.height} × {file.count}"
        )
    placed = tuple(file.transform)[:6]
    if not all(abs(value) <= FARTHEST_M for value in placed):
        file.close()
        raise ValueError(
            f"`{name}` must have a finite geotransform within ±{FARTHEST_M:g}, got {placed} in {path}"
        )
    return file


def _is_whole_png(path: Path) -> bool:
    """Whether all chunks of a PNG file are there and have the sum that they tell.

    GDAL gives what its memory happened to hold in the place of what is missing, and no error.
    """
    size = path.stat().st_size
    with path.open("rb") as file:
        file.seek(8)  # the signature, which the driver knows
        while len(head := file.read(8)) == 8:
            length, kind = struct.unpack(">I4s", head)
            if length > size:  # no memory is asked for what is not there
                return False
            body, told = file.read(length), file.read(4)
            if len(told) < 4 or zlib.crc32(kind + body) != int.from_bytes(told, "big"):
                return False
            if kind == b"IEND":
                return True
    return False


def check_heights(values: Float[Array, "..."], name: str, path: str | Path) -> None:
    """Refuse heights that no ground has: a void's filler value, or another unit.

    Raises
    ------
    ValueError
        With how many, one of them, and the remedy.
    """
    told = np.isfinite(values)
    bad = told & ((values < LOWEST_M) | (values > HIGHEST_M))
    if bad.any():
        raise ValueError(
            f"`{name}` must hold heights of {LOWEST_M:g} to {HIGHEST_M:g} m, got {values[bad].flat[0]:g} in "
            f"{100 * bad.sum() / told.sum():.2g} % of {path} (tell what stands for no height: "
            "gdal_edit.py -a_nodata …)"
        )
