"""Read rectified frames: a folder of rasters, a NetCDF or Zarr stack, or a video with a position.

Frames are read one at a time. The tracker needs panchromatic radiance on a north-up square grid. Files with
bands named I, Q and U, as glintrack writes them, give DoLP as well.
"""

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.core.arrays import Array
from glintrack.core.installation import require_extra
from glintrack.core.schema import RADIANCE
from glintrack.io.crs import longitude_latitude, metric_crs
from glintrack.io.read_raster import open_bands, read_raster
from glintrack.io.readings import report_reading
from glintrack.io.stacks import open_stack
from glintrack.io.tables import read_csv, read_numbers
from glintrack.io.times import check_rate, check_steps
from glintrack.io.untrusted import MAX_CELL_M, MAX_CELLS, MAX_COORDINATE_M, check_file, sort_by_number

_MIN_CELL_M = 0.005  # a car has half a million of them
_CHANNELS = ("all", "dolp", "pan")  # first part of the names of a result's frames
_DEMUXERS = {
    **{".avi": "avi", ".mkv": "matroska", ".webm": "matroska"},
    **{".mpg": "mpeg", ".mpeg": "mpeg", ".gif": "gif"},
}
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".m4v", ".mpg", ".mpeg", ".webm", ".gif")
STACKS = (".nc", ".nc4", ".h5", ".zarr")
RASTERS = ((".tif", ".tiff"), (".png",), (".jpg", ".jpeg"), (".jp2",), (".bmp",))  # in order of preference
SQUARE = 1e-4  # relative tolerance of square pixels
_FIRST = 20  # frames whose times are checked before any work
_MIN_CLOCK_HZ = 50.0  # on which a video is sampled: the error of a time is at most half a period


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
    times_s
        Times of the frames that were read, also of those left out. [s]
    """

    count: int | None
    crs: str | None
    dolp: bool
    frames: Iterator[tuple[float, xr.Dataset]]
    times_s: list[float] = field(default_factory=list)


def open_frames(
    path: Path,
    rate_hz: float | None = None,
    geotransform: Geotransform | None = None,
    times_s: Sequence[float] | None = None,
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
    times_s
        Times of all frames, which replace their own and the rate. [s]

    Raises
    ------
    ValueError
        In one sentence: the requirement and what was found.
    """
    if times_s is not None:
        source = open_frames(path, 1.0, geotransform)
        return replace(source, frames=_replace_times(source.frames, times_s, path))
    if rate_hz is not None:
        check_rate(rate_hz)
    if geotransform is not None:
        check_grid(geotransform, "`geotransform`")
    suffix = path.suffix.lower()
    if not path.exists():
        raise ValueError(f"`frames` must be a folder or file that exists; got {path}.")
    if suffix in STACKS:
        return _from_stack(path, rate_hz, geotransform)
    if path.is_dir():
        return _rasters(path, rate_hz, geotransform)
    if suffix in VIDEOS:
        return _video(path, rate_hz, geotransform)
    known = " ".join((*STACKS, *VIDEOS))
    raise ValueError(f"`frames` must be a folder of rasters, a stack or a video ({known}); got {path}.")


def leave_out_repeated(source: FrameSource, path: Path) -> FrameSource:
    """Leave out frames that are equal to the frame before, because vehicles would seem to stop in them.

    Such frames occur in a video with a higher frame rate than its camera.
    """

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        used, before = 0, np.empty(0)
        for time_s, image in source.frames:
            source.times_s.append(time_s)
            if not np.array_equal(pan := image["pan"].values, before, equal_nan=True):
                used, before = used + 1, pan
                yield time_s, image
        if repeated := len(source.times_s) - used:
            left_out = {"equal to the frame before": repeated}
            report_reading(path, "frames compared", used + repeated, used, left_out)

    return replace(source, frames=frames())


def _replace_times(
    frames: Iterator[tuple[float, xr.Dataset]], times_s: Sequence[float], path: Path
) -> Iterator[tuple[float, xr.Dataset]]:
    k = -1
    for k, (_, image) in enumerate(frames):
        if k >= len(times_s):
            break
        yield float(times_s[k]), image
    if k + 1 != len(times_s):
        got = f"{len(times_s)} for {'more' if k >= len(times_s) else k + 1} frames"
        raise ValueError(f"`times` must have one row for each frame; got {got} in {path}.")


def read_frame_times(path: Path) -> list[float]:
    """Read the times of frames in their order, from the column ``time_s`` of a CSV file. [s]

    Raises
    ------
    ValueError
        If a time is missing or not later than the one before it, or the times are not in seconds.
    """
    table = read_csv(path, "times", only=lambda name: name == "time_s")
    if "time_s" not in table:
        raise ValueError(f"`times` must have a column time_s; got none in {path}.")
    times = read_numbers(table, path, ("time_s",))[:, 0]
    falls = np.flatnonzero(~(np.diff(times) > 0))
    if len(falls):
        got = f"{times[falls[0] + 1]:g} after {times[falls[0]]:g} s in {path}"
        raise ValueError(f"`times` must be numbers that rise; got {got}.")
    check_steps(times, "time_s", path)
    return times.tolist()


def check_grid(grid: Geotransform, what: str) -> None:
    """Refuse pixels that no map can have."""
    is_near = all(abs(edge_m) <= MAX_COORDINATE_M for edge_m in (grid.west_m, grid.north_m))
    if not (is_near and _MIN_CELL_M <= grid.gsd_m <= MAX_CELL_M):
        raise ValueError(
            f"{what} must have edges within ±{MAX_COORDINATE_M:g} m and pixels of {_MIN_CELL_M:g} to "
            f"{MAX_CELL_M:g} m; got {grid.west_m:g} {grid.north_m:g} {grid.gsd_m:g}."
        )


def list_frames(folder: Path, kinds: Sequence[Sequence[str]] = RASTERS) -> tuple[list[Path], int]:
    """List the files of the first kind that a folder has, in natural order, and count all others."""
    found = [[p for p in folder.iterdir() if p.suffix.lower() in kind] for kind in kinds]
    files = sort_by_number(next((one for one in found if one), []), "frames")
    if not files:
        known = " ".join(suffix for kind in kinds for suffix in kind)
        raise ValueError(f"`frames` must be a folder with rasters ({known}); got none in {folder}.")
    return files, sum(map(len, found)) - len(files)


def _rasters(folder: Path, rate_hz: float | None, geotransform: Geotransform | None) -> FrameSource:
    files, others = list_frames(folder)
    channels = sorted({file.name.split("_")[0] for file in files} & set(_CHANNELS))
    if len(channels) > 1:
        raise ValueError(
            f"`frames` must be of one channel; got {', '.join(channels)} in {folder}. Copy those of one "
            "channel into a folder."
        )
    first = _raster(files[0], geotransform)
    _check_place(first.crs, first.grid)
    dolp = {"I", "Q", "U"} <= set(first.bands)
    left_out = {f"not {files[0].suffix}": others}
    pan = "band pan" if "pan" in first.bands else "band I" if dolp else f"mean of {', '.join(first.bands)}"
    notes = f"radiance: {pan}", *first.notes
    report_reading(folder, "frames", len(files) + others, len(files), left_out, notes)
    if rate_hz is None:
        known_s = [time for file in files[:_FIRST] if (time := read_frame_time(file)) is not None]
        check_steps(known_s, "time_s", folder)

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        for k, file in enumerate(files):
            one = _raster(file, geotransform)
            _check_same_ground(file, one, first)
            if one.time_s is None and rate_hz is None:
                raise ValueError(f"`frames` must have a tag time_s or need --rate; got neither in {file}.")
            time_s = k / rate_hz if rate_hz is not None else float(one.time_s or 0.0)
            yield time_s, image_of(one.bands, one.grid)

    return FrameSource(len(files), first.crs, dolp, frames())


def read_frame_time(path: Path) -> float | None:
    """Read the tag ``time_s`` of a raster; None without one. [s]"""
    with open_bands(path, "frames", "readable rasters") as file:
        return time_tag(file.tags(), path)


def time_tag(tags: Mapping[str, str], path: Path) -> float | None:
    """Tag ``time_s`` of a file; None without one. [s]"""
    if (tag := tags.get("time_s")) is None:
        return None
    try:
        time_s = float(tag)
        if not math.isfinite(time_s):
            raise ValueError(tag)
    except ValueError as error:
        raise ValueError(f"`time_s` must be a number of seconds; got {tag!r} in {path}.") from error
    return time_s


def _check_place(crs: str | None, grid: Geotransform) -> None:
    """Refuse a CRS that is not in metres on the ground of the frames."""
    if crs is not None:
        longitude_latitude(crs, np.array([grid.west_m]), np.array([grid.north_m]))


@dataclass(frozen=True)
class _PlacedRaster:
    """Bands of one frame, with its CRS, time [s], grid, and how its values were understood."""

    crs: str | None
    time_s: float | None
    grid: Geotransform
    bands: dict[str, Array]
    notes: tuple[str, ...]

    @property
    def shape(self) -> tuple[int, ...]:
        """Rows and columns."""
        return next(iter(self.bands.values())).shape


def _check_same_ground(path: Path, mine: _PlacedRaster, first: _PlacedRaster) -> None:
    """Refuse a frame of another CRS, grid or size than the first."""
    near = 1e-3 * first.grid.gsd_m
    apart = [abs(a - b) > near for a, b in zip(astuple(mine.grid), astuple(first.grid), strict=True)]
    if mine.crs != first.crs or mine.shape != first.shape or any(apart):
        own, other = (
            f"{one.crs} {one.grid.west_m:.9g}, {one.grid.north_m:.9g}: {one.shape[1]} × {one.shape[0]} cells "
            f"of {one.grid.gsd_m:g} m"
            for one in (mine, first)
        )
        raise ValueError(
            f"`frames` must all have the first one's CRS, place and size, {other}; got {own} in {path}."
        )


def _raster(path: Path, geotransform: Geotransform | None) -> _PlacedRaster:
    raster = read_raster(path, "frames", "readable rasters")
    t, crs = raster.transform, raster.crs
    if geotransform is not None and not t.is_identity:
        warnings.warn("--geotransform replaces the position in the files", stacklevel=2)
    if crs is not None:
        metric_crs(crs.to_wkt())
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
        check_grid(geotransform, f"`frames` ({path.name})")
    bands = dict(zip(raster.names, raster.bands, strict=True))
    bands.pop("occluded", None)  # of glintrack ortho; hidden cells have no data
    crs = crs.to_string() if crs else None
    return _PlacedRaster(crs, time_tag(raster.tags, path), geotransform, bands, raster.notes)


def _from_stack(path: Path, rate_hz: float | None, geotransform: Geotransform | None) -> FrameSource:
    stack = open_stack(path)
    grid = geotransform or Geotransform(*stack.corner_and_gsd(path))
    times = stack.times_s(path, rate_hz)
    check_grid(grid, f"`frames` ({path.name})")
    _check_place(stack.crs, grid)
    place = "no CRS" if stack.crs is None else metric_crs(stack.crs).name
    report_reading(path, "frames", stack.count, stack.count, notes=(f"variable {stack.variable}", place))

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        with stack.dataset:
            for k in range(stack.count):
                yield float(times[k]), image_of({"pan": stack.frame(k)}, grid)

    return FrameSource(stack.count, stack.crs, False, frames())


def _video(path: Path, rate_hz: float | None, geotransform: Geotransform | None) -> FrameSource:
    if geotransform is None:
        raise ValueError(
            f"`frames` must have a geotransform; got the video {path}. Give --geotransform WEST NORTH GSD."
        )
    imageio_ffmpeg = require_extra("imageio_ffmpeg", "video", "read a video")
    # in the format of its ending and from this file alone: a playlist could refer to other files
    as_named = ["-protocol_whitelist", "file", "-f", _DEMUXERS.get(path.suffix.lower(), "mov")]
    file = str(check_file(path, "frames"))
    try:
        about = next(imageio_ffmpeg.read_frames(file, input_params=as_named))
    except (OSError, RuntimeError, StopIteration) as error:
        raise ValueError(f"`frames` must be a video that ffmpeg can read; got {path}.") from error
    width, height = about["size"]
    if width * height > MAX_CELLS:
        raise ValueError(f"`frames` must have at most {MAX_CELLS:,} pixels; got {width} × {height}: {path}.")
    check_rate(rate_hz or about["fps"])
    # With a rate, every picture is read once. Without one, the timestamps are sampled on a fine clock, and
    # repetitions are dropped.
    clock_hz = rate_hz or about["fps"] * math.ceil(_MIN_CLOCK_HZ / about["fps"])
    timing = ["-fps_mode", "passthrough"] if rate_hz else ["-vf", f"fps={clock_hz:.6f}"]
    grid = geotransform

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        pictures = imageio_ffmpeg.read_frames(
            file, "gray", bits_per_pixel=8, input_params=as_named, output_params=timing
        )
        next(pictures)  # what is known about the video
        before = None
        for k, data in enumerate(pictures):
            if rate_hz is None and data == before:
                continue
            before = data
            pan = np.frombuffer(data, np.uint8).reshape(height, width).astype(np.float32)
            yield k / clock_hz, image_of({"pan": pan}, grid)

    return FrameSource(None, None, False, frames())


def image_of(bands: dict[str, Array], grid: Geotransform) -> xr.Dataset:
    """Dataset of the schema ``image`` from bands on a grid; pan is band pan, I, or the mean of all."""
    has_stokes = {"I", "Q", "U"} <= set(bands)
    named = bands.get("pan", bands["I"] if has_stokes else None)
    pan = np.stack(list(bands.values())).mean(axis=0) if named is None else named
    height, width = np.shape(pan)
    if has_stokes:
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
