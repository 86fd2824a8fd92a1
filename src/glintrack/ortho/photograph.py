"""Orthophoto of a user's photograph by its camera, its pose and the heights under it, in any CRS."""

import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.camera import Camera, project, rays
from glintrack.core.arrays import Array
from glintrack.core.schema import check
from glintrack.io import images, netcdf
from glintrack.io.heights import NotReachedError, read_height_range
from glintrack.io.photographs import PlacedPose, read_camera, read_picture, read_pose
from glintrack.io.untrusted import MAX_HEIGHT_M, MIN_HEIGHT_M
from glintrack.ortho.rasters import (
    MapGrid,
    check_area,
    displacement_against,
    footprint,
    frame_border,
    heights_under,
    hint_of_exchange,
    occlusion_by_raster,
)
from glintrack.ortho.rectify import GridCells, rectify_frame, rectify_onto

_EXACT = ("uint8", "uint16", "int16")  # types with numbers that are exact in float32
_NARROWINGS = 3  # iterations: footprint between two heights, then heights in the footprint


@dataclass(frozen=True)
class Photograph:
    """An image of whole pixels, or a frame of superpixels, with its camera and reported pose.

    Parameters
    ----------
    values, names
        (row, column, band), and the name of each band; no values where there is a frame.
    dtype
        Type of the values in their file.
    camera, placed
        The frame camera, and its pose in metres from an origin in a projected CRS.
    frame
        Schema ``frame``.
    """

    values: Array
    names: list[str]
    dtype: str
    camera: Camera
    placed: PlacedPose
    frame: xr.Dataset | None = None

    @classmethod
    def read(cls, source: Path | xr.Dataset, camera: Camera, placed: PlacedPose) -> "Photograph":
        """Read an image by GDAL, or one of our frames (``.nc``, or its dataset).

        Raises
        ------
        ValueError
            If it cannot be read or has another size than the camera.
        """
        if isinstance(source, xr.Dataset) or source.suffix.lower() == ".nc":
            whole = source if isinstance(source, xr.Dataset) else netcdf.read_dataset(source, "FRAME")
            frame = check(whole, "frame")
            size = tuple(round(float(2 * frame[n][0] + frame[n].diff(n).sum() + 1)) for n in ("y", "x"))
            found = cls(np.empty(0), ["pan", "I", "Q", "U"], "float32", camera, placed, frame)
        else:
            values, names, dtype = read_picture(source)
            size, found = values.shape[:2], cls(values, names, dtype, camera, placed)
        if size != (camera.rows, camera.columns):
            raise ValueError(
                f"`FRAME` must be {camera.columns} pixels wide and {camera.rows} high as in the camera "
                f"file; got {size[1]} and {size[0]}."
            )
        return found

    def onto(
        self, east: Float[Array, "y x"], north: Float[Array, "y x"], ground: Float[Array, "y x"], method: str
    ) -> Float[Array, "y x band"]:
        """Sample its bands at places from the pose's origin, as in `rectify_onto`."""
        pose = self.placed.pose
        if self.frame is None:
            return rectify_onto(self.values, self.camera, pose, east, north, ground, method)
        cells = GridCells.of(east, north, ground)
        pan, stokes, _ = rectify_frame(self.frame, self.camera, pose, cells, method)
        return np.concatenate([pan[..., None], stokes[..., :3]], axis=-1)


@dataclass(frozen=True)
class Orthophoto:
    """A rectified photograph.

    Parameters
    ----------
    bands, names
        Values (y, x, band), NaN for no data, and the name of each band.
    grid
        Its cells.
    tags
        Source, method, the corrected displacement if it was registered [cell], and
        ``ground_without_height``, the share of the ground in the frame that is NaN for that [1].
    dtype
        Type of its GeoTIFF: the photograph's if of 8 or 16 bits, else float32.
    """

    bands: Float[Array, "y x band"]
    names: list[str]
    grid: MapGrid
    tags: dict[str, str | float]
    dtype: str = "float32"

    def write(self, path: Path | str) -> None:
        """Write a Cloud Optimized GeoTIFF or, by its ending, NetCDF-4 in float32.

        A GeoTIFF of whole numbers has a mask for no data, one of float32 NaN.
        """
        axes = self.grid.x, self.grid.y, self.grid.crs
        images.write_bands(Path(path), self.bands, self.names, *axes, self.tags, self.dtype)


def rectify(
    frame: Path | str | xr.Dataset,
    camera: Path | str | Camera,
    pose: Path | str | PlacedPose,
    ground: Path | str | float,
    *,
    surface: Path | str | None = None,
    crs: str | None = None,
    gsd: float | None = None,
    area: tuple[float, float, float, float] | None = None,
    method: str = "bilinear",
    register: Path | str | None = None,
) -> Orthophoto:
    """Rectify a photograph by collinearity with its pose, Eqs. (4)–(6), onto heights in any CRS.

    Parameters
    ----------
    frame
        Image that GDAL reads, or one of our frames (``.nc``, or its dataset).
    camera, pose
        Files as in docs/howto/my_frames.md, or their records, as from `glintrack.expose`.
    ground
        Raster of heights in any CRS, or one height for all. [m]
    surface
        Raster with the heights of roofs and crowns: hidden cells become NaN and are marked in a band
        ``occluded``. [m]
    crs
        CRS of the result; the pose's by default.
    gsd
        Size of a cell; a pixel's by default. [unit of crs]
    area
        West, south, east, north of the result; the photograph's footprint by default. [unit of crs]
    method
        ``"nearest"``, ``"bilinear"`` or ``"cubic"``.
    register
        Reference raster: the result is shifted onto its first band's content.

    Returns
    -------
    The orthophoto, to be saved by `Orthophoto.write`.

    Raises
    ------
    ValueError
        If a file is invalid, the photograph sees the horizon, or no height is known under it.

    Warns
    -----
    UserWarning
        If heights are missing under a part of it: NaN there.
    """
    lens = camera if isinstance(camera, Camera) else read_camera(Path(camera))
    source = frame if isinstance(frame, xr.Dataset) else Path(frame)
    name = "" if isinstance(source, xr.Dataset) else source.name
    placed = pose if isinstance(pose, PlacedPose) else read_pose(Path(pose), name)
    check_pose(lens, placed, is_whole=area is None)
    levels = ground_levels(ground, lens, placed, area, crs)
    photograph = Photograph.read(source, lens, placed)
    grid = MapGrid.over(lens, placed, levels, crs, gsd, area)
    east, north = grid.places(placed)
    level = isinstance(ground, int | float)
    height = np.full(east.shape, ground, float) if level else heights_under(Path(ground), "dem", grid, placed)
    void = _void_share(height, lens, placed, east, north)
    bands = photograph.onto(east, north, height, method)
    tags: dict[str, str | float] = {"frame": name, "method": method}
    if void:
        tags["ground_without_height"] = void
    if register is not None:
        rows, columns = displacement_against(bands, Path(register), grid)
        bands = photograph.onto(*grid.shift(rows, columns).places(placed), height, method)
        tags |= {"registration_rows": rows, "registration_columns": columns}
    names = photograph.names
    if surface is not None:
        dark = occlusion_by_raster(Path(surface), grid, placed, east, north, height)
        bands[dark] = np.nan
        bands = np.concatenate([bands, dark[..., None].astype(np.float32)], axis=-1)
        names = [*names, "occluded"]
    if not np.isfinite(bands[..., : len(photograph.names)]).any():
        raise ValueError(
            f"`area` and `gsd` must give cells on ground that the frame sees; got {bands.shape[0]} × "
            f"{bands.shape[1]} cells without any. Both are in units of the CRS: degrees for EPSG:4326."
        )
    return Orthophoto(bands, names, grid, tags, photograph.dtype if photograph.dtype in _EXACT else "float32")


def ground_levels(
    ground: Path | str | float,
    camera: Camera,
    placed: PlacedPose,
    area: tuple[float, float, float, float] | None = None,
    crs: str | None = None,
) -> tuple[float, float]:
    """Lowest and highest ground that a frame sees or an area has, see `rectify`. [m]

    Raises
    ------
    ValueError
        If no height is known there, or the lens is not above the ground.
    """
    if area is not None:
        check_area(area)
    if isinstance(ground, int | float):
        if not MIN_HEIGHT_M <= ground <= MAX_HEIGHT_M:
            raise ValueError(
                f"`height` must lie within {MIN_HEIGHT_M:g} to {MAX_HEIGHT_M:g} m; got {ground:g}."
            )
        _check_above(placed, ground)
        return float(ground), float(ground)
    path, own = Path(ground), placed.crs if crs is None else crs
    levels = MIN_HEIGHT_M, MAX_HEIGHT_M
    lens = placed.origin_m[0] + placed.pose.east_m, placed.origin_m[1] + placed.pose.north_m
    try:
        for _ in range(_NARROWINGS):
            seen = footprint(camera, placed, levels, own) if area is None else area
            levels = read_height_range(path, "dem", seen, own)
            _check_above(placed, levels[0])
    except NotReachedError as error:
        raise ValueError(f"{error}{hint_of_exchange(path, 'dem', placed)}") from error
    with suppress(NotReachedError):  # the raster need not reach the ground under the lens
        _check_above(placed, read_height_range(path, "dem", (*lens, *lens), placed.crs)[0])
    return levels


def _check_above(placed: PlacedPose, ground_m: float) -> None:
    if placed.pose.up_m <= ground_m:
        raise ValueError(
            f"`pose.height_m` must be above the ground, {ground_m:g} m; got {placed.pose.up_m:g} m. Are both "
            "in the same heights, and not above take-off?"
        )


def check_pose(camera: Camera, placed: PlacedPose, is_whole: bool) -> None:
    """Refuse a pose at the horizon (with any pixel if the frame is taken whole) or unclear."""
    pixels = frame_border(camera) if is_whole else np.array([camera.principal_point])
    if (rays(camera, placed.pose, pixels)[..., 2] > -1e-3).any():
        remedy = "Give --area to rectify a part." if is_whole else "Check the angles' signs and units."
        raise ValueError(
            f"`pose` must look below the horizon; got a line of sight at or above it in the frame. {remedy}"
        )
    _check_order(camera, placed)


def _check_order(camera: Camera, placed: PlacedPose) -> None:
    """Refuse a pose whose file does not state the order of its angles, if that matters by a pixel."""
    if placed.other_order is None:
        return
    border, far_m = frame_border(camera), 1000.0
    seen = placed.pose.position + far_m * rays(camera, placed.pose, border)
    apart = np.linalg.norm(project(camera, placed.other_order, seen) - border, axis=-1).max()
    if not apart <= 1:  # also if it is NaN, for a place behind the lens
        raise ValueError(
            f"`pose.order` must be given; got none, and places differ by up to {apart:,.0f} pixels. Add "
            'order = "yaw-pitch-roll" for angles of an inertial system, else "heading-roll-pitch".'
        )


def _void_share(ground: Array, camera: Camera, placed: PlacedPose, east: Array, north: Array) -> float:
    """Share of the ground in the frame without height, which becomes NaN; warn, and refuse all of it."""
    missing = ~np.isfinite(ground)
    if not missing.any():
        return 0.0
    level = np.full(east.shape, 0.0 if missing.all() else float(np.nanmedian(ground)))
    frame = np.zeros((camera.rows, camera.columns), np.float32)
    seen = np.isfinite(rectify_onto(frame, camera, placed.pose, east, north, level, "nearest"))
    share = float((missing & seen).sum() / max(seen.sum(), 1))
    remedy = "Fill it with gdal_fillnodata.py, or give a smaller area or a height."
    if share == 1:
        raise ValueError(f"`dem` must have heights where the frame looks; got none there. {remedy}")
    if share:
        warnings.warn(
            f"`dem` has no height in {100 * share:.2g} % of the ground in the frame: NaN there. {remedy}",
            stacklevel=3,
        )
    return share
