"""Read a photograph, its camera and its pose from files (docs/howto/my_frames.md).

Coordinates are those of the pose file's projected CRS. Inside they start from an origin near the lens, for
precision.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, Self

import numpy as np
import pandas as pd
import pyproj
from jaxtyping import Float
from pydantic import Field, model_validator

from glintrack.camera import Camera, Pose, from_omega_phi_kappa, from_yaw_pitch_roll
from glintrack.core.arrays import Array
from glintrack.core.designs import Design, types_of, validate_design
from glintrack.core.distortion import Distortion
from glintrack.io.crs import change_crs, check_not_exchanged, metric_crs, warn_off_map
from glintrack.io.read_raster import read_raster
from glintrack.io.readings import report_reading
from glintrack.io.tables import read_csv
from glintrack.io.toml import read_toml, to_toml

_ANGLES = (("heading_deg", "roll_deg", "pitch_deg"), ("omega_deg", "phi_deg", "kappa_deg"))
_POSITIONS = (("easting_m", "northing_m"), ("longitude_deg", "latitude_deg"))
_ORIGIN_STEP_M = 1000.0
_MAX_AFFINITY = 0.1  # of b1 and b2; sensors have less than 0.001
_MIN_PITCH_UM = 0.1  # no detector array has smaller pixels
_MAX_FIELD_DEG = 160.0  # of a frame camera across its longer side; wider ones are no pinholes


def _optional(limit: float, description: str = "") -> Any:
    return Field(default=None, ge=-limit, le=limit, description=description or None)


class CameraFile(Design):
    """A camera file: a frame camera with square pixels, and its lens's distortion."""

    focal_length_mm: float = Field(gt=0, le=1e5, description="Principal distance")
    pitch_um: float = Field(gt=0, le=1e4, description="Spacing of the pixels")
    rows: int = Field(ge=2, le=100_000, description="Rows of the image")
    columns: int = Field(ge=2, le=100_000, description="Columns of the image")
    principal_row: float | None = _optional(
        1e6, "Pixel centres at integers, row 0 on top; (rows - 1)/2 if left out"
    )
    principal_column: float | None = _optional(1e6, "Likewise, column 0 at the left")
    distortion: Distortion = Distortion()

    @model_validator(mode="after")
    def _check_geometry(self) -> Self:
        if self.pitch_um < _MIN_PITCH_UM:
            raise ValueError(
                f"`pitch_um` must be at least {_MIN_PITCH_UM:g} µm; got {self.pitch_um:g} µm. Is it in mm?"
            )
        for name, count in (("row", self.rows), ("column", self.columns)):
            at = getattr(self, f"principal_{name}")
            if at is not None and not -0.5 <= at <= count - 0.5:
                raise ValueError(
                    f"`principal_{name}` must lie in the image, 0 to {count - 1}; got {at:g}. If it is an "
                    f"offset from the middle, add {(count - 1) / 2:g}."
                )
        for name in ("b1", "b2"):
            if abs(value := getattr(self.distortion, name)) > _MAX_AFFINITY:
                raise ValueError(
                    f"`distortion.{name}` must lie within ±{_MAX_AFFINITY:g}; got {value:g}. If it is in "
                    "pixels, divide it by the principal distance in pixels."
                )
        longer_mm = max(self.rows, self.columns) * self.pitch_um * 1e-3
        field_deg = 2 * math.degrees(math.atan(longer_mm / (2 * self.focal_length_mm)))
        if field_deg > _MAX_FIELD_DEG:
            raise ValueError(
                f"`focal_length_mm` must see at most {_MAX_FIELD_DEG:g}° with {longer_mm:.3g} mm of pixels; "
                f"got {self.focal_length_mm:g} mm, which sees {field_deg:.1f}°. Are they in mm and µm?"
            )
        return self

    def camera(self) -> Camera:
        """Make the frame camera."""
        size = self.focal_length_mm * 1e-3, self.pitch_um * 1e-6, self.rows, self.columns
        return Camera(*size, self.principal_row, self.principal_column, self.distortion)


class PoseFile(Design):
    """A pose file: position of the lens and attitude of the image."""

    crs: str = Field(min_length=1, description="Projected, in metres: EPSG code, PROJ string or WKT")
    easting_m: float | None = _optional(1e8)
    northing_m: float | None = _optional(1e8)
    longitude_deg: float | None = Field(default=None, ge=-180, le=360, description="WGS 84")
    latitude_deg: float | None = _optional(90, "WGS 84")
    height_m: float = Field(ge=-1000, le=1e6, description="Height of the lens, in the datum of the DEM")
    heading_deg: float | None = _optional(3600, "Clockwise from north")
    roll_deg: float | None = _optional(3600, "Right wing down is positive")
    pitch_deg: float | None = _optional(3600, "Nose up is positive")
    order: Literal["heading-roll-pitch", "yaw-pitch-roll"] | None = Field(
        default=None, description="Order of the turns: as Presnar et al., or as inertial systems write them"
    )
    gimbal_azimuth_deg: float = Field(default=0.0, ge=-3600, le=3600, description="Clockwise from the nose")
    gimbal_depression_deg: float = Field(
        default=90.0, ge=-360, le=360, description="Below the airframe's horizontal plane; 90 is down"
    )
    omega_deg: float | None = _optional(3600, "First rotation, about x (east)")
    phi_deg: float | None = _optional(3600, "Second rotation, about the rotated y")
    kappa_deg: float | None = _optional(3600, "Third rotation, about the rotated z")
    north: Literal["grid", "true"] = Field(default="grid", description="North that the heading counts from")

    @model_validator(mode="after")
    def _check_keys(self) -> Self:
        for what, choices in (("place", _POSITIONS), ("attitude", _ANGLES)):
            given = tuple(name for names in choices for name in names if getattr(self, name) is not None)
            if given not in choices:
                known = " or as ".join(", ".join(names) for names in choices)
                raise ValueError(f"`pose` must give its {what} as {known}; got {', '.join(given) or 'none'}.")
        if self.omega_deg is not None and (self.north == "true" or self.gimbal_depression_deg != 90):
            raise ValueError("`pose` must count omega, phi, kappa from grid north and without a gimbal")
        return self


@dataclass(frozen=True)
class PlacedPose:
    """A reported pose in metres from an origin in a projected CRS.

    Parameters
    ----------
    pose, crs, origin_m
        Pose, CRS, and easting and northing of the origin. [m]
    other_order
        Pose by the other order of angles, if the file does not state its order.
    """

    pose: Pose
    crs: str
    origin_m: tuple[float, float]
    other_order: Pose | None = None


def camera_file(camera: Camera) -> str:
    """Text of a camera file, for `read_camera`."""
    values = {
        "focal_length_mm": float(f"{camera.focal_length_m * 1e3:.12g}"),
        "pitch_um": float(f"{camera.pitch_m * 1e6:.12g}"),
        "rows": camera.rows,
        "columns": camera.columns,
    }
    if camera.principal_point != ((camera.rows - 1) / 2, (camera.columns - 1) / 2):
        values |= dict(zip(("principal_row", "principal_column"), camera.principal_point, strict=True))
    distortion = {} if camera.distortion is None else {"distortion": dict(camera.distortion)}
    return to_toml({**values, **distortion})


def pose_file(placed: PlacedPose) -> str:
    """Text of a pose file, for `read_pose`."""
    pose, (east_m, north_m) = placed.pose, placed.origin_m
    angles = {
        f"{name}_deg": math.degrees(getattr(pose, f"{name}_rad"))
        for name in ("heading", "roll", "pitch", "gimbal_azimuth", "gimbal_depression")
    }
    angles["heading_deg"] %= 360
    place = {"easting_m": east_m + pose.east_m, "northing_m": north_m + pose.north_m, "height_m": pose.up_m}
    order = {"order": "heading-roll-pitch"}
    return to_toml({"crs": placed.crs, **order, **{k: float(v) for k, v in {**place, **angles}.items()}})


def read_camera(path: Path) -> Camera:
    """Read a camera from a TOML file, its keys at the top or in a table ``[camera]``."""
    table = read_toml(path, "camera")
    table = table.get("camera", table)
    _check_kind("camera", table, path)
    return validate_design(CameraFile, table).camera()


def read_pose(path: Path, frame_name: str) -> PlacedPose:
    """Read the pose of one frame from a TOML file, or from its row of a CSV file.

    Parameters
    ----------
    path
        ``.toml``, its keys at the top or in a table ``[pose]``; or ``.csv`` with a header of the same keys
        and a column ``name`` with frame names, with or without their endings.
    frame_name
        File name of the frame.

    Raises
    ------
    ValueError
        In one sentence: the fault of the file.
    """
    if path.suffix.lower() == ".csv":
        return read_poses(path, [frame_name])[0]
    table = read_toml(path, "pose")
    return _place(table.get("pose", table), path)


def read_poses(path: Path, frame_names: Sequence[str]) -> list[PlacedPose]:
    """Read the pose of each frame, in the order of the names.

    Parameters
    ----------
    path
        A CSV file as in `read_pose`, or a folder with a file ``NAME.pose.toml`` for each frame, NAME without
        its ending.
    frame_names
        File names of the frames.

    Raises
    ------
    ValueError
        If the pose of a frame is missing, twice, or invalid.
    """
    if path.suffix.lower() == ".csv":
        return [_place(row, path) for row in _read_rows(path, frame_names)]
    if not path.is_dir():
        raise ValueError(f"`poses` must be a CSV file with a row for each frame, or a folder; got {path}.")
    files = [path / f"{Path(name).stem}.pose.toml" for name in frame_names]
    if missing := [file.name for file in files if not file.is_file()]:
        raise ValueError(
            f"`poses` must have a file for each frame; got none for {len(missing)} of {len(files)}, "
            f"first {missing[0]}."
        )
    return [read_pose(file, "") for file in files]


def _place(table: Mapping[str, Any], path: Path) -> PlacedPose:
    """Check the values of a pose file, and place them in its CRS."""
    _check_kind("pose", table, path)
    file = validate_design(PoseFile, table)
    crs = metric_crs(file.crs)
    to_crs = change_crs("EPSG:4326", crs)
    if file.easting_m is not None and file.northing_m is not None:
        x, y = file.easting_m, file.northing_m
    else:
        check_not_exchanged(crs, file.longitude_deg or 0.0, file.latitude_deg or 0.0, "pose")
        x, y = to_crs.transform(file.longitude_deg, file.latitude_deg)
    if not (math.isfinite(x) and math.isfinite(y)):
        raise ValueError(f"`pose` must lie within {crs.name}; got {file.longitude_deg}, {file.latitude_deg}.")
    warn_off_map(crs, x, y)  # refuses positions outside every map
    origin = (_ORIGIN_STEP_M * round(x / _ORIGIN_STEP_M), _ORIGIN_STEP_M * round(y / _ORIGIN_STEP_M))
    place = (x - origin[0], y - origin[1], file.height_m)
    if file.omega_deg is not None:
        angles = (file.omega_deg, file.phi_deg, file.kappa_deg)
        omega, phi, kappa = (math.radians(angle or 0.0) for angle in angles)
        pose = from_omega_phi_kappa(place, omega, phi, kappa)
    else:
        heading = math.radians(file.heading_deg or 0.0)
        if file.north == "true":
            heading += _true_north(to_crs, x, y)
        angles = (file.roll_deg, file.pitch_deg, file.gimbal_azimuth_deg, file.gimbal_depression_deg)
        pose = Pose(*place, heading, *(math.radians(angle or 0.0) for angle in angles), kind="reported")
        if file.order is None:
            return PlacedPose(pose, crs.to_wkt(), origin, from_yaw_pitch_roll(pose))
        pose = from_yaw_pitch_roll(pose) if file.order == "yaw-pitch-roll" else pose
    return PlacedPose(pose, crs.to_wkt(), origin)


def _check_kind(expected: str, table: Mapping[str, Any], path: Path) -> None:
    """Refuse a file of the other kind, by its keys."""
    kinds: dict[str, type[Design]] = {"camera": CameraFile, "pose": PoseFile}
    own, (other, its) = kinds.pop(expected), kinds.popitem()
    if set(table) & set(its.model_fields) and not set(table) & set(own.model_fields):
        raise ValueError(
            f"`{expected}` must be a {expected} file; got a {other} file, {path.name}. "
            "Are the camera and the pose exchanged?"
        )


def _read_rows(path: Path, frame_names: Sequence[str]) -> list[dict[str, str | float]]:
    """Values of the frames' rows in a CSV file of poses; numbers where the key is a number."""
    table = read_csv(path, "pose", types=str)
    if "name" not in table:
        raise ValueError(f"`pose` must have a header with a column `name`; got none in {path.name}.")
    names, found = table.pop("name"), []
    for frame_name in frame_names:
        mine = np.flatnonzero(names.isin((frame_name, Path(frame_name).stem)))
        if len(mine) != 1:
            raise ValueError(
                f"`pose` must have one row named {frame_name}; got {len(mine)} among {len(table)} rows in "
                f"{path.name}."
            )
        found.append(int(mine[0]))
    others = len(table) - len(set(found))
    report_reading(path, "poses", len(table), len(set(found)), {"of other frames": others})
    return [_row_values(table.iloc[k]) for k in found]


def _row_values(row: pd.Series) -> dict[str, str | float]:
    cells = {str(key): str(value).strip() for key, value in row.items()}
    values: dict[str, str | float] = {key: cell for key, cell in cells.items() if cell}
    for key in values:
        if float in types_of(PoseFile, key):
            with suppress(ValueError):
                values[key] = float(values[key])
    return values


def _true_north(to_crs: pyproj.Transformer, x: float, y: float) -> float:
    """Direction of true north, clockwise from grid north. [rad]"""
    longitude, latitude = to_crs.transform(x, y, direction="INVERSE")
    step_deg = 1e-4  # ten metres
    south, north = (to_crs.transform(longitude, latitude + s) for s in (-step_deg, step_deg))
    return math.atan2(north[0] - south[0], north[1] - south[1])


def read_picture(path: Path) -> tuple[Float[Array, "row column band"], list[str], str]:
    """Read the bands of a photograph: values, NaN where masked; their names; type of the values."""
    raster = read_raster(path, "FRAME", "an image", north_up=False)
    report_reading(path, "bands", len(raster.bands), len(raster.bands), notes=raster.notes)
    return np.moveaxis(raster.bands, 0, -1), list(raster.names), raster.dtype
