"""Read rasters, for all readers of heights, photographs and frames: bands in physical units, north up.

Scale and offset of a band, gains of an ENVI header, palettes and masks are applied. Heights become metres by
the unit of the band, or else by the vertical CRS.
"""

import functools
import warnings
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj.database
import rasterio
import rasterio.errors
from jaxtyping import Float
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.transform import Affine
from rasterio.windows import Window

from glintrack.core.arrays import Array
from glintrack.io.crs import any_crs
from glintrack.io.readings import report_reading
from glintrack.io.untrusted import check_heights, open_raster

_COLOURS = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)
_PLURALS = {
    **dict.fromkeys(("meter", "meters", "metres"), "metre"),
    **dict.fromkeys(("feet", "international foot"), "foot"),
    **dict.fromkeys(("us foot", "us survey feet", "ftus"), "us survey foot"),
}
_FILLERS = (-9999, -32767, -32768)  # for missing heights, in files that do not mark them


@dataclass(frozen=True)
class Raster:
    """Bands of a raster, without alpha, a palette as its colours.

    Parameters
    ----------
    bands, names
        Values in physical units, NaN where masked or transparent, and the name of each band.
    dtype
        Type of the values: that in the file, or float32 if they were scaled.
    transform, crs
        Transform from (column, row) of corners to the CRS; identity and None without one.
    tags
        Metadata of the file.
    notes
        How the values were understood, one phrase each.
    """

    bands: Float[Array, "band row column"]
    names: tuple[str, ...]
    dtype: str
    transform: Affine
    crs: CRS | None
    tags: Mapping[str, str]
    notes: tuple[str, ...]


def read_raster(path: Path, name: str, requirement: str = "a raster", *, north_up: bool = True) -> Raster:
    """Read all bands of a raster.

    Parameters
    ----------
    path, name, requirement
        File, its name in error messages, and what it must be.
    north_up
        Flip a raster whose rows run northward.

    Raises
    ------
    ValueError
        If it cannot be read or holds no real numbers.
    """
    with open_bands(path, name, requirement) as file:
        numbers = [k for k, kind in enumerate(file.colorinterp, start=1) if kind != ColorInterp.alpha] or [1]
        kinds = tuple(file.colorinterp[k - 1] for k in numbers)
        dtype = np.result_type(*(file.dtypes[k - 1] for k in numbers))
        names = [file.descriptions[k - 1] for k in numbers]
        transform = file.transform
        is_colour = kinds[:3] == _COLOURS and np.issubdtype(dtype, np.unsignedinteger)
        is_picture = is_colour or kinds == (ColorInterp.palette,)
        if is_picture:
            # one mask for all bands: a pixel with no-data in blue alone is a colour
            values, hidden = file.read(numbers), file.dataset_mask() == 0
            if kinds == (ColorInterp.palette,):
                colours = _palette(file)[values[0]]
                values, hidden = np.moveaxis(colours[..., :3], -1, 0), hidden | (colours[..., 3] == 0)
                kinds, names = _COLOURS, []
            bands = values.astype(np.float32)
            bands[:, hidden] = np.nan
        else:
            bands = _read_masked(file, name, numbers).astype(np.float32)
        bands, is_scaled = _to_physical(file, name, numbers, bands)
        tags, crs, notes = file.tags(), file.crs, _notes(file, numbers)
    if north_up and transform.e > 0 and not transform.is_identity:
        bands, transform = bands[:, ::-1], transform * Affine(1, 0, 0, 0, -1, bands.shape[1])
        notes = (*notes, "rows run northward: flipped")
    if kinds[:3] == _COLOURS:
        names[:3] = [kind.name for kind in _COLOURS]
    found = tuple(str(one or f"band_{k}") for k, one in enumerate(names, start=1))
    kind = "float32" if is_scaled else dtype.name
    return Raster(bands, found, kind, transform, crs, tags, notes=notes)


@contextmanager
def open_bands(path: Path, name: str, requirement: str = "a raster") -> Iterator[rasterio.DatasetReader]:
    """Open a raster without a warning that it has no position; report a file that is cut short."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        file = open_raster(path, name, requirement)
    with file:
        pages = len(file.subdatasets) if file.driver == "GTiff" else 1
        if pages > 1:
            raise ValueError(
                f"`{name}` must be {requirement} of one picture; got {pages} pages in {path}. Split it, "
                "as tiffsplit does."
            )
        try:
            yield file
        except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as error:
            raise ValueError(f"`{name}` must be a whole raster; got {path}: {error}.") from error


def read_height_band(
    file: rasterio.DatasetReader,
    option: str,
    window: Window | None = None,
    shape: tuple[int, int] | None = None,
) -> Float[Array, "row column"]:
    """Read the first band of an open raster as heights, NaN where there are none. [m]

    Parameters
    ----------
    file, option
        Raster, and its name in error messages.
    window, shape
        Part of it, and size of an overview of it; all by default.

    Raises
    ------
    ValueError
        If it is a picture, its unit of height is unknown, or the heights are on no ground.
    """
    name = Path(file.name).name
    if file.colorinterp[0] in (ColorInterp.red, ColorInterp.palette):
        raise ValueError(f"`{option}` must hold heights; got the colours of a picture in {name}.")
    metres = _height_unit_m(file, option)
    rest = {"only the first band is heights": file.count - 1}
    unit = f"no unit of height: metres (if they are feet: gdal_edit.py -units ft {name})"
    unit = unit if metres is None else f"heights times {metres:.9g} m" if metres != 1 else "heights in metres"
    report_reading(name, "bands", file.count, 1, rest, (*_notes(file, [1]), unit))
    raw = _read_masked(file, option, [1], window, shape)
    values, is_scaled = _to_physical(file, option, [1], raw)
    if is_scaled and np.isin(raw, _FILLERS).any():
        raise ValueError(
            f"`{option}` must mark missing heights; got {raw[np.isin(raw, _FILLERS)][0]:g} before its scale "
            f"in {name}. Mark them: gdal_edit.py -a_nodata …"
        )
    heights = values[0] * (metres or 1.0)
    check_heights(heights, option, name)
    return heights


def length_unit_m(unit: str) -> float | None:
    """Length of a unit by its name or abbreviation; None if it is unknown. [m]"""
    words = unit.strip().lower().replace("_", " ")
    known = _length_units_m()
    return next((known[one] for one in (words, _PLURALS.get(words)) if one in known), None)


@functools.lru_cache(maxsize=1)
def _length_units_m() -> dict[str, float]:
    """Lengths of PROJ's units by their names and abbreviations. [m]"""
    units = pyproj.database.get_units_map(category="linear").values()
    known = {key.lower(): one.conv_factor for one in units for key in (one.name, one.proj_short_name) if key}
    return known | dict.fromkeys(("dm", "decimeter", "decimetre"), 0.1)  # 0.01 in PROJ 9


def _height_unit_m(file: rasterio.DatasetReader, option: str) -> float | None:
    """Return the unit of heights: that of the band, else of the vertical CRS, else None for metres. [m]"""
    name, unit = Path(file.name).name, file.units[0] or ""
    remedy = f"gdal_edit.py -units m {name}, or -units ft"
    axes = any_crs(file.crs).axis_info if file.crs else []
    if any(axis.direction == "down" for axis in axes):
        raise ValueError(f"`{option}` must hold heights; got depths in {name}, by its vertical CRS.")
    if unit.strip():
        if (length_m := length_unit_m(unit)) is None:
            raise ValueError(
                f"`{option}` must have heights in a known unit; got {unit!r} in {name}. Set it: {remedy}."
            )
        return length_m
    if heights := [axis.unit_conversion_factor for axis in axes if axis.direction == "up"]:
        return heights[0]
    if any(axis.unit_name not in ("metre", "degree") for axis in axes):
        raise ValueError(
            f"`{option}` must state the unit of its heights; got {name} with a CRS in {axes[0].unit_name} "
            f"and no unit of its band. Set it: {remedy}."
        )
    return None


def _read_masked(
    file: rasterio.DatasetReader,
    name: str,
    numbers: Sequence[int],
    window: Window | None = None,
    shape: tuple[int, int] | None = None,
) -> Float[Array, "band row column"]:
    """Read bands as stored, NaN where masked."""
    if "complex" in "".join(file.dtypes):
        raise ValueError(f"`{name}` must hold real numbers; got complex ones in {file.name}.")
    size = None if shape is None else (len(numbers), *shape)
    return file.read(numbers, window=window, out_shape=size, masked=True).astype(float).filled(np.nan)


def _scales_and_offsets(file: rasterio.DatasetReader, numbers: Sequence[int]) -> tuple[Array, Array]:
    """Scale and offset of bands, divided by an ENVI header's reflectance scale factor."""
    try:
        divisor = float(file.tags(ns="ENVI").get("reflectance_scale_factor", 1.0)) or np.nan
    except ValueError:
        divisor = np.nan
    stated = np.array([(file.scales[k - 1], file.offsets[k - 1]) for k in numbers]) / divisor
    return stated[:, 0], stated[:, 1]


def _notes(file: rasterio.DatasetReader, numbers: Sequence[int]) -> tuple[str, ...]:
    """Phrase on scale and offset of bands, if there are any."""
    found = {(float(s), float(o)) for s, o in zip(*_scales_and_offsets(file, numbers), strict=True)}
    return tuple(f"values times {s:.6g} plus {o:.6g}" for s, o in sorted(found - {(1.0, 0.0)})[:3])


def _to_physical(
    file: rasterio.DatasetReader, name: str, numbers: Sequence[int], values: Array
) -> tuple[Float[Array, "band row column"], bool]:
    """Apply scale and offset of each band; also return whether there are any."""
    scales, offsets = _scales_and_offsets(file, numbers)
    if not (np.isfinite(scales).all() and scales.all() and np.isfinite(offsets).all()):
        raise ValueError(
            f"`{name}` must have a finite scale other than 0, and a finite offset; got {scales.tolist()} and "
            f"{offsets.tolist()} in {file.name}. Set them: gdal_edit.py -scale … -offset …"
        )
    if (scales == 1).all() and not offsets.any():
        return values, False
    scaled = values * scales[:, None, None].astype(values.dtype) + offsets[:, None, None].astype(values.dtype)
    return scaled, True


def _palette(file: rasterio.DatasetReader) -> Float[Array, "entry 4"]:
    """Colours of a palette: red, green, blue, alpha. [0 to 255]"""
    colours = np.zeros((np.iinfo(file.dtypes[0]).max + 1, 4), np.float32)
    for number, colour in file.colormap(1).items():
        if number < len(colours):
            colours[number] = colour
    return colours
