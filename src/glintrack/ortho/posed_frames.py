"""Frames of a moving camera on one ground grid, by collinearity with the pose of each, Eqs. (4)–(6)."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.camera import Camera
from glintrack.core.records import Extent
from glintrack.io import netcdf, orthoimages
from glintrack.io.crs import metric_crs
from glintrack.io.photographs import PlacedPose, read_camera, read_poses
from glintrack.io.readings import collect_readings, report_reading
from glintrack.io.times import check_rate, check_steps
from glintrack.ortho.photograph import check_pose, ground_levels, rectify
from glintrack.ortho.rasters import MAX_CELLS_PER_PIXEL, MapGrid, footprint

METHOD = "cubic"  # the least blur that depends on the frame
_OWN = ".nc"  # frames of `glintrack sensor expose`


def rectify_frames(
    folder: Path,
    camera: Path,
    poses: Path,
    ground: Path | float,
    *,
    crs: str | None = None,
    gsd_m: float | None = None,
    area_m: tuple[float, float, float, float] | None = None,
    rate_hz: float | None = None,
    times_s: Sequence[float] | None = None,
) -> orthoimages.FrameSource:
    """Rectify all frames of a folder onto one grid; each is read when its turn comes.

    Parameters
    ----------
    folder
        Images that GDAL reads, in the natural order of their names, or frames of glintrack (``.nc``).
    camera
        Camera file, as in `io.photographs.read_camera`.
    poses
        Poses of the frames, as in `io.photographs.read_poses`.
    ground
        Raster of heights, or one height for all ground. [m]
    crs
        Projected CRS of the grid; that of the first pose by default.
    gsd_m
        Size of a cell; a pixel's in the middle frame by default. [m]
    area_m
        West, south, east, north of the grid; by default the ground of all frames. [m]
    rate_hz, times_s
        Frame rate [Hz], or times of all frames [s]; by default the files' tags ``time_s``.

    Raises
    ------
    ValueError
        If a pose or time is missing or invalid, a frame sees none of the grid, or the grid is too large.
    """
    if not folder.is_dir():
        raise ValueError(f"`frames` must be a folder of images to be placed by their poses; got {folder}.")
    files, others = orthoimages.list_frames(folder, (*orthoimages.RASTERS, (_OWN,)))
    lens, placed = read_camera(camera), read_poses(poses, [file.name for file in files])
    own = crs or placed[0].crs
    metric_crs(own)
    seen, levels = list[Extent](), list[tuple[float, float]]()
    for file, one in zip(files, placed, strict=True):
        with _named(file):
            check_pose(lens, one, is_whole=area_m is None)
            levels.append(ground_levels(ground, lens, one, area_m, own))
            if area_m is None:
                seen.append(footprint(lens, one, levels[-1], own))
    west, south, east, north = zip(*seen, strict=True) if area_m is None else ((edge,) for edge in area_m)
    area = Extent(min(west), min(south), max(east), max(north))
    middle = len(placed) // 2
    grid = _plan_grid(lens, placed[middle], levels[middle], own, gsd_m, area)
    times = _frame_times(folder, files, rate_hz, times_s)
    report_reading(folder, "frames", len(files) + others, len(files), {f"not {files[0].suffix}": others})

    def frames() -> Iterator[tuple[float, xr.Dataset]]:
        corner = orthoimages.Geotransform(grid.x[0] - grid.gsd / 2, grid.y[0] + grid.gsd / 2, grid.gsd)
        for time_s, file, one in zip(times, files, placed, strict=True):
            with _named(file), collect_readings():
                found = rectify(file, lens, one, ground, crs=own, gsd=grid.gsd, area=area, method=METHOD)
            bands = dict(zip(found.names, np.moveaxis(found.bands, -1, 0), strict=True))
            yield time_s, orthoimages.image_of(bands, corner)

    return orthoimages.FrameSource(len(files), own, files[0].suffix.lower() == _OWN, frames())


@contextmanager
def _named(file: Path) -> Iterator[None]:
    """Begin the message of an error with the frame's name."""
    try:
        yield
    except ValueError as error:
        raise ValueError(f"frame {file.name}: {error}") from error


def _plan_grid(
    camera: Camera,
    placed: PlacedPose,
    levels_m: tuple[float, float],
    crs: str,
    gsd_m: float | None,
    area_m: Extent,
) -> MapGrid:
    grid = MapGrid.over(camera, placed, levels_m, crs, gsd_m, area_m)
    most = MAX_CELLS_PER_PIXEL * camera.rows * camera.columns
    if len(grid.x) * len(grid.y) > most:
        raise ValueError(
            f"`area` must have at most {most:,} cells of `gsd`, {MAX_CELLS_PER_PIXEL} for each pixel of a "
            f"frame; got {len(grid.x):,} × {len(grid.y):,}. Give a smaller --area or a larger --gsd, or "
            "track the flight in parts."
        )
    return grid


def _frame_times(
    folder: Path, files: Sequence[Path], rate_hz: float | None, times_s: Sequence[float] | None
) -> list[float]:
    """Time of each frame. [s]"""
    if times_s is not None:
        if len(times_s) != len(files):
            raise ValueError(
                f"`times` must have one row for each frame; got {len(times_s)} for {len(files)} frames in "
                f"{folder}."
            )
        return list(times_s)
    if rate_hz is not None:
        check_rate(rate_hz)
        return [k / rate_hz for k in range(len(files))]
    found = list[float]()
    for file in files:
        is_own = file.suffix.lower() == _OWN
        time_s = (
            netcdf.read_dataset(file, "FRAME").attrs.get("time_s")
            if is_own
            else orthoimages.read_frame_time(file)
        )
        if time_s is None:
            raise ValueError(f"`frames` must have a tag time_s or need --rate; got neither in {file}.")
        found.append(float(time_s))
    check_steps(found, "time_s", folder)
    return found
