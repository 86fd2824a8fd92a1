"""Read rectified frames: a folder of rasters, a NetCDF or Zarr stack, or a video with a position.

Frames are read one at a time. The tracker needs panchromatic radiance on a north-up square grid. Files with
bands named I, Q and U, as glintrack writes them, give DoLP as well.
"""

import math
import re
import warnings
from collections.abc import Iterator
from dataclasses import astuple, dataclass
from pathlib import Path

import numpy as np
import rasterio
import rasterio.errors
import xarray as xr
from rasterio.enums import ColorInterp

from glintrack.core.arrays import Array
from glintrack.core.installation import require_extra
from glintrack.core.schema import RADIANCE
from glintrack.io.crs import longitude_latitude, metric_crs
from glintrack.io.untrusted import MAX_CELL_M, MAX_COORDINATE_M, check_file, check_netcdf, open_raster

_MIN_HZ, _MAX_HZ, _MIN_CELL_M = 1e-6, 1e6, 1e-4
_CHANNELS = ("all", "dolp", "pan")  # first part of the names of a result's frames
_DEMUXERS = {
    **{".avi": "avi", ".mkv": "matroska", ".webm": "matroska"},
    **{".mpg": "mpeg", ".mpeg": "mpeg", ".gif": "gif"},
}
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".gif")
STACKS = (".nc", ".nc4", ".h5", ".zarr")
RASTERS = ((".tif", ".tiff"), (".png",), (".jpg", ".jpeg"), (".jp2",), (".bmp",))  # in order of preference
SQUARE = 1e-4  # relative tolerance of square pixels and regular steps


@dataclass(frozen=True)
class Geotransform:
    """A north-up square grid: its north-west corner and the side of a pixel. [m]"""

    west_m: float
    north_m: float
    gsd_m: float


@dataclass(frozen=True)
class FrameSource:
    """Frames of a source, read one by one.

    Parameters
    ----------
    count
        Number of frames; None if the file does not say.
    crs
        CRS of the grid; None if unknown.
    dolp
        True if the frames hold polarization.
    frames
        Time [s] and Dataset of the schema ``image``.
    """

    count: int | None
    crs: str | None
    dolp: bool
    frames: Iterator[tuple[float, xr.Dataset]]


def open_frames(
    path: Path, rate_hz: float | None = None, geotransform: Geotransform | None = None
) -> FrameSource:
    """Open a source of frames.

    Parameters
    ----------
    path
        A folder with GeoTIFFs, or PNG, JPEG, JPEG 2000 or BMP files with or without world files (in the order
        of their names, 2 before 10), a NetCDF or Zarr stack with dims time, y, x, or a video.
    rate_hz
        Frame rate if the files have no times (tag ``time_s``, coordinate ``time``). [Hz]
    geotransform
        Position of the pixels, for videos and files without one.

    Raises
    ------
    ValueError
        In one sentence: the requirement and what was found.
    """
    if rate_hz is not None and not _MIN_HZ <= rate_hz <= _MAX_HZ:
        raise ValueError(f"`rate` must be {_MIN_HZ:g} to {_MAX_HZ:g} Hz; got {rate_hz:g}.")
    if geotransform is not None:
        _check_grid(geotransform, "`geotransform`")
    suffix = path.suffix.lower()
    if not path.exists():
        raise ValueError(f"`frames` must be a folder or file that exists; got {path}.")
    if suffix in STACKS:
        return _stack(path, rate_hz, geotransform)
    if path.is_dir():
        return _rasters(path, rate_hz, geotransform)
    if suffix in VIDEOS:
        return _video(path, rate_hz, geotransform)
    known = " ".join((*STACKS, *VIDEOS))
    raise ValueError(f"`frames` must be a folder of rasters, a stack or a video ({known}); got {path}.")


def _check_grid(grid: Geotransform, what: str) -> None:
    """Refuse pixels that no map can have."""
    is_near = all(abs(edge_m) <= MAX_COORDINATE_M for edge_m in (grid.west_m, grid.north_m))
    if not (is_near and _MIN_CELL_M <= grid.gsd_m <= MAX_CELL_M):
        raise ValueError(
            f"{what} must have edges within ±{MAX_COORDINATE_M:g} m and pixels of {_MIN_CELL_M:g} to "
            f"{MAX_CELL_M:g} m; got {grid.west_m:g} {grid.north_m:g} {grid.gsd_m:g}."
        )


def _rasters(folder: Path, rate_hz: float | None, geotransform: Geotransform | None) -> FrameSource:
    kinds = ([p for p in folder.iterdir() if p.suffix.lower() in kind] for kind in RASTERS)
    files = sorted(next((one for one in kinds if one), []), key=_natural_order)
    if not files:
        known = " ".join(suffix for kind in RASTERS for suffix in kind)
        raise ValueError(f"`frames` must be a folder with rasters ({known}); got none in {folder}.")
    channels = sorted({file.name.split("_")[0] for file in files} & set(_CHANNELS))
    if len(channels) > 1:
        raise ValueError(
            f"`frames` must be of one channel; got {', '.join(channels)} in {folder}. Copy those of one "
            "channel into a folder."
        )
    crs, (_, ground), bands = _raster(files[0], geotransform)
    shape = next(iter(bands.values())).shape
    _check_place(crs, ground)
    dolp = {"I", "Q", "U"} <= set(bands)

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        for k, file in enumerate(files):
            own, (tag, grid), bands = _raster(file, geotransform)
            _check_same_ground(file, (own, grid, next(iter(bands.values())).shape), (crs, ground, shape))
            if tag is None and rate_hz is None:
                raise ValueError(f"`frames` must have a tag time_s or need --rate; got neither in {file}.")
            yield (k / rate_hz if rate_hz is not None else float(tag or 0.0)), image_of(bands, grid)

    return FrameSource(len(files), crs, dolp, frames())


def _natural_order(path: Path) -> list[tuple[int, int, str]]:
    """Sort key of names with numbers, 2 before 10."""
    parts = re.split(r"([0-9]+)", path.name)
    return [(0, int(part), part) if k % 2 else (1, 0, part) for k, part in enumerate(parts)]


def _check_place(crs: str | None, grid: Geotransform) -> None:
    """Refuse a CRS that is not in metres on the ground of the frames."""
    if crs is not None:
        longitude_latitude(crs, np.array([grid.west_m]), np.array([grid.north_m]))


def _check_same_ground(path: Path, mine: tuple, first: tuple) -> None:
    """Refuse a frame of another CRS, grid or size than the first."""
    (crs, grid, shape), (first_crs, first_grid, first_shape) = mine, first
    near = 1e-3 * first_grid.gsd_m
    apart = [abs(a - b) > near for a, b in zip(astuple(grid), astuple(first_grid), strict=True)]
    if crs != first_crs or shape != first_shape or any(apart):
        texts = [
            f"{of} {place.west_m:.9g}, {place.north_m:.9g}: {size[1]} × {size[0]} cells of {place.gsd_m:g} m"
            for of, place, size in (mine, first)
        ]
        raise ValueError(
            f"`frames` must all have the first one's CRS, place and size, {texts[1]}; "
            f"got {texts[0]} in {path}."
        )


def _raster(path: Path, geotransform: Geotransform | None):
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            file = open_raster(path, "frames", "readable rasters")
        with file:
            t, tag, crs = file.transform, file.tags().get("time_s"), file.crs
            seen = [k for k, kind in enumerate(file.colorinterp) if kind != ColorInterp.alpha] or [0]
            names = [file.descriptions[k] or f"band {k + 1}" for k in seen]
            values = file.read([k + 1 for k in seen], masked=True).astype(np.float32).filled(np.nan)
    except (rasterio.errors.RasterioError, rasterio.errors.CRSError) as error:
        raise ValueError(f"`frames` must be readable rasters; got {path}: {error}.") from error
    if geotransform is not None and not t.is_identity:
        warnings.warn("--geotransform replaces the position in the files", stacklevel=2)
    if geotransform is None:
        if t.is_identity:
            raise ValueError(
                f"`frames` must have a geotransform or a world file; got none in {path}. Give --geotransform "
                f"WEST NORTH GSD: 0 0 1 if a pixel is 1 m and the place does not matter."
            )
        if t.b or t.d or t.a <= 0 or t.e >= 0 or not math.isclose(t.a, -t.e, rel_tol=SQUARE):
            raise ValueError(
                f"`frames` must be north-up with square pixels; got the transform {tuple(t)[:6]} in {path}. "
                f"Rectify them first with `glintrack ortho`."
            )
        geotransform = Geotransform(t.c, t.f, t.a)
        _check_grid(geotransform, f"`frames` ({path.name})")
    try:
        time_s = None if tag is None else float(tag)
        if time_s is not None and not math.isfinite(time_s):
            raise ValueError(tag)
    except ValueError as error:
        raise ValueError(f"`time_s` must be a number of seconds; got {tag!r} in {path}.") from error
    if crs is not None:
        metric_crs(crs.to_wkt())
    return (crs.to_string() if crs else None), (time_s, geotransform), dict(zip(names, values, strict=True))


def _stack(path: Path, rate_hz: float | None, geotransform: Geotransform | None) -> FrameSource:
    zarr = path.suffix.lower() == ".zarr"
    if not zarr:
        check_netcdf(path, "frames")
    try:
        stack = xr.open_zarr(path) if zarr else xr.open_dataset(path, engine="h5netcdf")
    except Exception as error:  # whatever a damaged file makes the decoders say
        raise ValueError(f"`frames` must be a readable NetCDF-4 or Zarr stack; got {path}.") from error
    names = [str(n) for n, v in stack.data_vars.items() if v.dims[-3:] == ("time", "y", "x")]
    name = "pan" if "pan" in names else names[0] if len(names) == 1 else ""
    if not name:
        raise ValueError(
            f"`frames` must hold one variable over time, y, x, or one called pan; got {names or 'none'} "
            f"in {path}."
        )
    grid = geotransform or _grid_of(stack, path)
    if rate_hz is None and "time" not in stack.coords:
        raise ValueError(f"`frames` must have a coordinate time or come with --rate; got neither in {path}.")
    count = stack.sizes["time"]
    if rate_hz is not None:
        times = np.arange(count) / rate_hz
    elif np.issubdtype((times := stack["time"].values).dtype, np.datetime64):
        times = (times - times[0]) / np.timedelta64(1, "s")
    else:
        times = times.astype(float)
    if not np.isfinite(times).all():
        raise ValueError(f"`time` must be finite at every frame; got others in {path}.")
    crs = stack.attrs.get("crs", stack[name].attrs.get("crs"))
    crs = None if crs is None else str(crs)
    _check_place(crs, grid)

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        with stack:
            for k in range(count):
                pan = stack[name].isel(time=k).values.astype(np.float32)
                yield float(times[k]), image_of({"pan": pan}, grid)

    return FrameSource(count, crs, False, frames())


def _grid_of(stack: xr.Dataset, path: Path) -> Geotransform:
    if not {"x", "y"} <= set(stack.coords):
        raise ValueError(
            f"`frames` must have coordinates x and y in metres; got none in {path}. "
            f"Give --geotransform WEST NORTH GSD."
        )
    x, y = stack["x"].values.astype(float), stack["y"].values.astype(float)
    if len(x) < 2 or len(y) < 2:
        raise ValueError(f"`frames` must have at least 2 × 2 pixels; got {len(y)} × {len(x)} in {path}.")
    gsd = float(x[1] - x[0])
    even = np.allclose(np.diff(x), gsd, rtol=SQUARE) and np.allclose(np.diff(y), -gsd, rtol=SQUARE)
    if not (gsd > 0 and even):
        raise ValueError(f"`frames` must have x rising and y falling in equal steps; got others in {path}.")
    return Geotransform(float(x[0]) - gsd / 2, float(y[0]) + gsd / 2, gsd)


def _video(path: Path, rate_hz: float | None, geotransform: Geotransform | None) -> FrameSource:
    if geotransform is None:
        raise ValueError(
            f"`frames` must have a geotransform; got the video {path}. Give --geotransform WEST NORTH GSD."
        )
    imageio_ffmpeg = require_extra("imageio_ffmpeg", "video", "read a video")
    # in the format of its ending and from this file alone: a playlist could refer to other files
    as_named = ["-protocol_whitelist", "file", "-f", _DEMUXERS.get(path.suffix.lower(), "mov")]
    reader = imageio_ffmpeg.read_frames(str(check_file(path, "frames")), "gray", input_params=as_named)
    try:
        about = next(reader)
    except (OSError, RuntimeError, StopIteration) as error:
        raise ValueError(f"`frames` must be a video that ffmpeg can read; got {path}.") from error
    width, height = about["size"]
    rate = rate_hz or float(about["fps"])
    grid = geotransform

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        for k, data in enumerate(reader):
            pan = np.frombuffer(data, np.uint8).reshape(height, width).astype(np.float32)
            yield k / rate, image_of({"pan": pan}, grid)

    return FrameSource(None, None, False, frames())


def image_of(bands: dict[str, Array], grid: Geotransform) -> xr.Dataset:
    """Dataset of the schema ``image`` from bands on a grid; pan is the mean of unnamed bands."""
    pan = bands["pan"] if "pan" in bands else np.stack(list(bands.values())).mean(axis=0)
    height, width = np.shape(pan)
    if {"I", "Q", "U"} <= set(bands):
        stokes = np.stack([bands[name] for name in "IQU"], axis=-1)
        with np.errstate(divide="ignore", invalid="ignore"):
            dolp = np.hypot(stokes[..., 1], stokes[..., 2]) / stokes[..., 0]
        dolp = np.where(np.isfinite(dolp), dolp, np.nan).astype(np.float32)
    else:
        stokes = np.broadcast_to(np.float32(np.nan), (height, width, 3))
        dolp = stokes[..., 0]
    x = grid.west_m + grid.gsd_m * (np.arange(width) + 0.5)
    y = grid.north_m - grid.gsd_m * (np.arange(height) + 0.5)
    light = {"units": RADIANCE}
    return xr.Dataset(
        {
            "pan": (("y", "x"), np.where(np.isfinite(pan), pan, np.nan), light),
            "stokes_radiance": (("y", "x", "stokes"), stokes, {**light, "stokes_frame": "meridian"}),
            "dolp": (("y", "x"), dolp, {"units": "1"}),
        },
        coords={"y": ("y", y, {"units": "m"}), "x": ("x", x, {"units": "m"}), "stokes": ["I", "Q", "U"]},
    )
