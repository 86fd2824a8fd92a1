"""A user's own photograph: its camera, its pose, the heights under it, from files (docs/howto/my_frames.md).

Coordinates are those of the pose file's projected CRS; inside they are taken from an origin near the lens, so
that metres keep their digits.
"""

import math
import warnings
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import pyproj
import rasterio
import rasterio.errors
from jaxtyping import Float
from pydantic import Field, model_validator
from rasterio.enums import ColorInterp
from rasterio.transform import Affine
from rasterio.windows import Window

from glintrack.camera import Camera, Pose, from_omega_phi_kappa
from glintrack.core.arrays import Array
from glintrack.core.designs import Design, types_of, validate_design
from glintrack.core.distortion import Distortion
from glintrack.io.crs import change_crs, metric_crs, warn_off_map
from glintrack.io.tables import read_csv
from glintrack.io.toml import read_toml, to_toml
from glintrack.io.untrusted import check_heights, open_raster

_ANGLES = {
    "heading_deg, roll_deg, pitch_deg": ("heading_deg", "roll_deg", "pitch_deg"),
    "omega_deg, phi_deg, kappa_deg": ("omega_deg", "phi_deg", "kappa_deg"),
}
_PLACES = {
    "easting_m, northing_m": ("easting_m", "northing_m"),
    "longitude_deg, latitude_deg": ("longitude_deg", "latitude_deg"),
}
_ORIGIN_STEP_M = 1000.0
_MOST_AFFINITY = 0.1  # of b1 and b2; sensors have less than 0.001
_FINEST_UM = 0.1  # pixel; no detector has finer ones
_WIDEST_DEG = 160.0  # of a frame camera across its longer side: wider ones are no pinholes
_MOST_HEIGHTS = 400e6
_COLOURS: tuple[ColorInterp, ...] = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)


class CameraFile(Design):
    """A camera file: a frame camera with square pixels, and its lens's distortion."""

    focal_length_mm: float = Field(gt=0, le=1e5, description="Principal distance")
    pitch_um: float = Field(gt=0, le=1e4, description="Spacing of the pixels")
    rows: int = Field(ge=2, le=100_000, description="Of the image")
    columns: int = Field(ge=2, le=100_000, description="Of the image")
    principal_row: float | None = Field(
        default=None,
        ge=-1e6,
        le=1e6,
        description="Pixel centres at integers, row 0 on top; the middle, (rows - 1)/2, if left out",
    )
    principal_column: float | None = Field(
        default=None, ge=-1e6, le=1e6, description="Likewise, column 0 at the left"
    )
    distortion: Distortion = Distortion()

    @model_validator(mode="after")
    def _a_frame_camera(self) -> Self:
        if self.pitch_um < _FINEST_UM:
            raise ValueError(
                f"`pitch_um` must be at least {_FINEST_UM:g} µm, got {self.pitch_um:g} µm (in mm?)"
            )
        for name, count in (("row", self.rows), ("column", self.columns)):
            at = getattr(self, f"principal_{name}")
            if at is not None and not -0.5 <= at <= count - 0.5:
                raise ValueError(
                    f"`principal_{name}` must lie in the image, 0 to {count - 1}, got {at:g} (an offset from "
                    f"the middle is to be added to {(count - 1) / 2:g})"
                )
        for name in ("b1", "b2"):
            if abs(value := getattr(self.distortion, name)) > _MOST_AFFINITY:
                raise ValueError(
                    f"`distortion.{name}` must lie within ±{_MOST_AFFINITY:g}, got {value:g} (in pixels? "
                    "divide it by the principal distance in pixels)"
                )
        longer_mm = max(self.rows, self.columns) * self.pitch_um * 1e-3
        field_deg = 2 * math.degrees(math.atan(longer_mm / (2 * self.focal_length_mm)))
        if field_deg > _WIDEST_DEG:
            raise ValueError(
                f"`focal_length_mm` must see at most {_WIDEST_DEG:g}° with {longer_mm:.3g} mm of pixels, got "
                f"{self.focal_length_mm:g} mm, which sees {field_deg:.1f}° (are they in mm and µm?)"
            )
        return self

    def camera(self) -> Camera:
        """The frame camera."""
        return Camera(
            self.focal_length_mm * 1e-3,
            self.pitch_um * 1e-6,
            self.rows,
            self.columns,
            principal_row=self.principal_row,
            principal_column=self.principal_column,
            distortion=self.distortion,
        )


class PoseFile(Design):
    """A pose file: where the lens was and how the image was turned."""

    crs: str = Field(min_length=1, description="Projected, in metres: EPSG code, PROJ string or WKT")
    easting_m: float | None = Field(default=None, ge=-1e8, le=1e8)
    northing_m: float | None = Field(default=None, ge=-1e8, le=1e8)
    longitude_deg: float | None = Field(default=None, ge=-180, le=360, description="WGS 84")
    latitude_deg: float | None = Field(default=None, ge=-90, le=90, description="WGS 84")
    height_m: float = Field(ge=-1000, le=1e6, description="Of the lens, in the heights of the DEM")
    heading_deg: float | None = Field(default=None, ge=-3600, le=3600, description="Clockwise from north")
    roll_deg: float | None = Field(default=None, ge=-3600, le=3600, description="Right wing down is positive")
    pitch_deg: float | None = Field(default=None, ge=-3600, le=3600, description="Nose up is positive")
    gimbal_azimuth_deg: float = Field(default=0.0, ge=-3600, le=3600, description="Clockwise from the nose")
    gimbal_depression_deg: float = Field(
        default=90.0, ge=-360, le=360, description="Below the airframe's level; 90 is down"
    )
    omega_deg: float | None = Field(default=None, ge=-3600, le=3600, description="About x (east), first")
    phi_deg: float | None = Field(default=None, ge=-3600, le=3600, description="About the turned y, second")
    kappa_deg: float | None = Field(default=None, ge=-3600, le=3600, description="About the turned z, third")
    north: Literal["grid", "true"] = Field(default="grid", description="What the heading counts from")

    @model_validator(mode="after")
    def _one_place_and_one_attitude(self) -> Self:
        for what, choices in (("place", _PLACES), ("attitude", _ANGLES)):
            given = [name for names in choices.values() for name in names if getattr(self, name) is not None]
            if tuple(given) not in choices.values():
                raise ValueError(
                    f"`pose` must give its {what} as {' or as '.join(choices)}, "
                    f"got {', '.join(given) or 'none'}"
                )
        if self.omega_deg is not None and (self.north == "true" or self.gimbal_depression_deg != 90):
            raise ValueError("`pose` must count omega, phi, kappa from grid north and without a gimbal")
        return self


@dataclass(frozen=True)
class PlacedPose:
    """A reported pose in metres from an origin in a projected CRS."""

    pose: Pose
    crs: str
    origin_m: tuple[float, float]


def camera_file(camera: Camera) -> str:
    """Camera file of a frame camera, as `read_camera` takes it."""
    values = {
        "focal_length_mm": float(f"{camera.focal_length_m * 1e3:.12g}"),
        "pitch_um": float(f"{camera.pitch_m * 1e6:.12g}"),
        "rows": camera.rows,
        "columns": camera.columns,
    }
    if camera.principal_point != ((camera.rows - 1) / 2, (camera.columns - 1) / 2):
        values |= dict(zip(("principal_row", "principal_column"), camera.principal_point, strict=True))
    bent = {} if camera.distortion is None else {"distortion": dict(camera.distortion)}
    return to_toml({**values, **bent})


def pose_file(placed: PlacedPose) -> str:
    """Pose file of a placed pose, as `read_pose` takes it."""
    pose, (east_m, north_m) = placed.pose, placed.origin_m
    angles = {
        f"{name}_deg": math.degrees(getattr(pose, f"{name}_rad"))
        for name in ("heading", "roll", "pitch", "gimbal_azimuth", "gimbal_depression")
    }
    angles["heading_deg"] %= 360
    place = {"easting_m": east_m + pose.east_m, "northing_m": north_m + pose.north_m, "height_m": pose.up_m}
    return to_toml({"crs": placed.crs, **{k: float(v) for k, v in {**place, **angles}.items()}})


@dataclass(frozen=True)
class Heights:
    """A raster of heights, in memory.

    Parameters
    ----------
    values
        NaN where it has none. [m]
    to_pixel
        From its own coordinates to (column, row), pixel centres at integers.
    crs
        Its own.
    name
        Of the file.
    """

    values: Float[Array, "row column"]
    to_pixel: Affine
    crs: str
    name: str


class NotReachedError(ValueError):
    """Heights do not reach the ground that a photograph sees."""


def read_camera(path: Path) -> Camera:
    """Camera of a TOML file, its keys at the top or in a table ``[camera]``."""
    table = read_toml(path, "camera")
    table = table.get("camera", table)
    _check_kind("camera", table, path)
    return validate_design(CameraFile, table).camera()


def read_pose(path: Path, frame_name: str) -> PlacedPose:
    """Pose of one frame from a TOML file, or from its row of a CSV file.

    Parameters
    ----------
    path
        ``.toml``, its keys at the top or in a table ``[pose]``; or ``.csv`` with a header of the same keys
        and a column ``name``, in which ``frame_name`` stands with or without its ending.
    frame_name
        File name of the frame.

    Raises
    ------
    ValueError
        In one sentence: what is wrong with the file.
    """
    if path.suffix.lower() == ".csv":
        table = _row_of(path, frame_name)
    else:
        table = read_toml(path, "pose")
        table = table.get("pose", table)
    _check_kind("pose", table, path)
    return _placed(validate_design(PoseFile, table))


def _check_kind(wanted: str, table: Mapping[str, Any], path: Path) -> None:
    """Refuse a file of the other kind, by its keys, in one sentence for all of them."""
    kinds: dict[str, type[Design]] = {"camera": CameraFile, "pose": PoseFile}
    ours, (other, its) = kinds.pop(wanted), kinds.popitem()
    if set(table) & set(its.model_fields) and not set(table) & set(ours.model_fields):
        raise ValueError(
            f"`{wanted}` must be a {wanted} file, got a {other} file, {path.name} "
            "(were the camera and the pose given the wrong way round?)"
        )


def _row_of(path: Path, frame_name: str) -> dict[str, str | float]:
    table = read_csv(path, "pose", types=str)
    if "name" not in table:
        raise ValueError(f"`pose` must have a header with a column `name`, got none in {path.name}")
    mine = table[table["name"].isin((frame_name, Path(frame_name).stem))]
    if len(mine) != 1:
        raise ValueError(f"`pose` must have one row named {frame_name}, got {len(mine)} in {path.name}")
    cells = {str(key): str(value).strip() for key, value in mine.iloc[0].items()}
    return {key: _as_number(key, value) for key, value in cells.items() if key != "name" and value}


def _as_number(key: str, cell: str) -> str | float:
    """What a cell of a pose says: a number where its key takes one, and it is one."""
    if float in types_of(PoseFile, key):
        with suppress(ValueError):
            return float(cell)
    return cell


def _placed(file: PoseFile) -> PlacedPose:
    crs = metric_crs(file.crs)
    to_crs = change_crs("EPSG:4326", crs)
    if file.easting_m is not None and file.northing_m is not None:
        x, y = file.easting_m, file.northing_m
    else:
        x, y = to_crs.transform(file.longitude_deg, file.latitude_deg)
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError(f"`pose` must lie within {crs.name}, got {file.longitude_deg}, {file.latitude_deg}")
    warn_off_map(crs, x, y)  # refuses a place of no map
    origin = (_ORIGIN_STEP_M * round(x / _ORIGIN_STEP_M), _ORIGIN_STEP_M * round(y / _ORIGIN_STEP_M))
    place = (x - origin[0], y - origin[1], file.height_m)
    if file.omega_deg is not None:
        turns = (math.radians(v or 0.0) for v in (file.omega_deg, file.phi_deg, file.kappa_deg))
        omega, phi, kappa = turns
        pose = from_omega_phi_kappa(place, omega, phi, kappa)
    else:
        heading = math.radians(file.heading_deg or 0.0)
        if file.north == "true":
            heading += _true_north(to_crs, x, y)
        angles = (file.roll_deg, file.pitch_deg, file.gimbal_azimuth_deg, file.gimbal_depression_deg)
        pose = Pose(*place, heading, *(math.radians(a or 0.0) for a in angles), kind="reported")
    return PlacedPose(pose, crs.to_wkt(), origin)


def _true_north(to_crs: pyproj.Transformer, x: float, y: float) -> float:
    """Direction of true north, clockwise from grid north. [rad]"""
    longitude, latitude = to_crs.transform(x, y, direction="INVERSE")
    step_deg = 1e-4  # ten metres
    south, north = (to_crs.transform(longitude, latitude + s) for s in (-step_deg, step_deg))
    return math.atan2(north[0] - south[0], north[1] - south[1])


def read_picture(path: Path) -> tuple[Float[Array, "row column band"], list[str], str]:
    """Bands of any raster that GDAL reads, float32, NaN where masked or transparent.

    With them come their names (red, green and blue of a colour photograph) and the type they had in the file.
    """
    try:
        with _raster(path, "FRAME", "an image") as file:
            bands, kinds, dtype = _bands(file)
            told = file.descriptions
    except rasterio.errors.RasterioError as error:
        raise ValueError(f"`FRAME` must be an image that GDAL reads, got {path}") from error
    if tuple(kinds[:3]) == _COLOURS:
        told = [kind.name for kind in _COLOURS] + list(told[3:])
    names = [told[k] if k < len(told) and told[k] else f"band_{k + 1}" for k in range(len(bands))]
    return np.moveaxis(bands, 0, -1), [str(name) for name in names], dtype


def _bands(file: rasterio.DatasetReader) -> tuple[Array, list[ColorInterp], str]:
    """Bands of a picture without its alpha, a palette's as the colours they stand for; NaN where masked."""
    seen = [k for k, kind in enumerate(file.colorinterp, start=1) if kind != ColorInterp.alpha] or [1]
    kinds = [file.colorinterp[k - 1] for k in seen]
    dtype = np.result_type(*(file.dtypes[k - 1] for k in seen)).name
    if not np.issubdtype(dtype, np.integer):
        return file.read(seen, masked=True).astype(np.float32).filled(np.nan), kinds, dtype
    # one mask for all: where only blue is what stands for no data, it is a colour
    values, hidden = file.read(seen), file.dataset_mask() == 0
    if kinds == [ColorInterp.palette]:
        colours = np.zeros((int(values.max(initial=0)) + 1, 4), np.float32)
        for number, colour in file.colormap(1).items():
            if number < len(colours):
                colours[number] = colour
        shown = np.moveaxis(colours[values[0]], -1, 0)
        values, hidden, kinds = shown[:3], hidden | (shown[3] == 0), [*_COLOURS]
    bands = values.astype(np.float32)
    bands[:, hidden] = np.nan
    return bands, kinds, dtype


def read_height_range(path: Path, option: str) -> tuple[float, float]:
    """Lowest and highest height of a raster, by an overview of it. [m]"""
    with _opened(path, option) as file:
        size = min(file.height, 1024), min(file.width, 1024)
        try:
            values = file.read(1, out_shape=size, masked=True).astype(float).compressed()
        except rasterio.errors.RasterioError as error:
            raise ValueError(f"`{option}` must be a whole raster, got {path}") from error
    values = values[np.isfinite(values)]
    check_heights(values, option, path.name)
    if values.size == 0:
        raise ValueError(f"`{option}` must hold heights, got none in {path.name}")
    return float(values.min()), float(values.max())


def read_heights(
    path: Path, option: str, x: Float[Array, "*place"], y: Float[Array, "*place"], crs: str
) -> Heights:
    """The part of a raster of heights that lies under some places.

    Parameters
    ----------
    path, option
        The file, and what the user calls it.
    x, y, crs
        The places, and the CRS they are in; any.

    Raises
    ------
    ValueError
        If the file is no raster, has no CRS, or does not reach the places at all.
    """
    with _opened(path, option) as file:
        own = file.crs.to_wkt()
        transform = change_crs(crs, own).transform
        places = np.stack(transform(np.ravel(x), np.ravel(y)))
        places = places[:, np.isfinite(places).all(axis=0)]
        if places.size == 0:
            raise ValueError(
                f"`{option}` must reach the frame's ground, got a CRS that does not: {path.name}"
            )
        pixel = np.stack(transform_points(~file.transform, *places))
        low, high = np.floor(pixel.min(axis=1)) - 3, np.ceil(pixel.max(axis=1)) + 3
        low, high = np.maximum(low, 0), np.minimum(high, (file.width, file.height))
        if not (high - low >= 1).all():  # nor where they are no numbers
            raise NotReachedError(
                f"`{option}` must reach the frame's ground, got {path.name} over "
                f"{', '.join(f'{v:.6g}' for v in file.bounds)} in {file.crs}"
            )
        if np.prod(high - low) > _MOST_HEIGHTS:
            raise ValueError(
                f"`{option}` must be coarser, or `area` smaller, got {np.prod(high - low):.3g} heights"
            )
        window = Window(*low, *(high - low))  # pyright: ignore[reportCallIssue]
        try:
            values = file.read(1, window=window, masked=True).astype(float).filled(np.nan)
        except rasterio.errors.RasterioError as error:
            raise ValueError(f"`{option}` must be a whole raster, got {path}") from error
        check_heights(values, option, path.name)
        corner = file.window_transform(window)
    half = Affine.translation(-0.5, -0.5)  # from corners to centres
    return Heights(values, half * ~corner, own, path.name)


def is_within(path: Path, option: str, x: float, y: float, crs: str) -> bool:
    """Whether a place lies in a raster, or as far beyond it as it is wide."""
    with _opened(path, option) as file:
        place = change_crs(crs, file.crs.to_wkt()).transform(x, y)
        column, row = transform_points(~file.transform, *(np.asarray(v) for v in place))
        return bool(abs(column / file.width - 0.5) <= 1.5 and abs(row / file.height - 0.5) <= 1.5)


def transform_points(
    affine: Affine, x: Float[Array, "*place"], y: Float[Array, "*place"]
) -> tuple[Array, Array]:
    """Places through an affine transform."""
    return affine.a * x + affine.b * y + affine.c, affine.d * x + affine.e * y + affine.f


def _opened(path: Path, option: str):
    file = _raster(path, option)
    if file.crs is None:
        file.close()
        raise ValueError(f"`{option}` must have a CRS, got none in {path.name} (gdal_edit.py -a_srs …)")
    return file


def _raster(path: Path, name: str, requirement: str = "a raster") -> rasterio.DatasetReader:
    """A raster; that a photograph has no place on the map is no news to who rectifies it."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
        return open_raster(path, name, requirement)
