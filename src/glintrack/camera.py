"""Camera, pose and collinearity: the only place where rotations between world and detector array are built.

World is ENU (X east, Y north, Z up, metres). The array's axes are x = image right, y = image up,
z = backward along the optical axis, so that with all angles zero they coincide with ENU: the camera looks
straight down and image up is north. Implements Eqs. (4)–(6) of Presnar et al. (2010).
"""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array
from glintrack.core.distortion import NO_DISTORTION, Distortion, bend_all


@dataclass(frozen=True)
class Camera:
    """A frame camera, a pinhole or with a distorting lens, counted in elements.

    Parameters
    ----------
    focal_length_m
        Principal distance f. [m]
    pitch_m
        Spacing of the elements, square. [m]
    rows, columns
        Size of the array in elements.
    principal_row, principal_column
        Where the optical axis meets the array; the array's centre by default. [element]
    distortion
        Of the lens, about the principal point; none by default.
    """

    focal_length_m: float
    pitch_m: float
    rows: int
    columns: int
    principal_row: float | None = None
    principal_column: float | None = None
    distortion: Distortion | None = None

    def __post_init__(self):
        """Check the design once and put the principal point at the centre if none is given."""
        for name in ("focal_length_m", "pitch_m", "rows", "columns"):
            value = getattr(self, name)
            if not (value > 0 and math.isfinite(value)):
                raise ValueError(f"`{name}` must be positive; got {value}.")
        for name, count in (("principal_row", self.rows), ("principal_column", self.columns)):
            if getattr(self, name) is None:
                object.__setattr__(self, name, (count - 1) / 2)
        if self.distortion == Distortion():
            object.__setattr__(self, "distortion", None)
        if self.distortion is not None:
            self._check_distortion(self.distortion)

    def _check_distortion(self, distortion: Distortion) -> None:
        """Refuse a distortion that is not one-to-one up to the edge of the frame."""
        edge = np.linspace(-0.5, 0.5, 9)
        ring = np.concatenate(
            [np.stack([edge, 0 * edge + s], -1)[:, ::o] for s in (-0.5, 0.5) for o in (1, -1)]
        )
        x, y = self._tangents((ring + 0.5) * (self.rows, self.columns) - 0.5)
        if not np.isfinite(x + y).all():
            raise ValueError(
                "`distortion` must image each place of the array from one direction; got "
                f"{', '.join(f'{k} = {v:g}' for k, v in distortion)}, which fold the picture within it."
            )

    @property
    def bending(self) -> Float[Array, "coefficient"]:
        """Coefficients for `distortion.distort`; empty for a pinhole."""
        return NO_DISTORTION if self.distortion is None else self.distortion.coefficients

    def _tangents(self, pixels: Array) -> tuple[Array, Array]:
        """Tangents of the field angle, right and down, that pixels see; NaN where the lens images none."""
        row, column = self.principal_point
        scale = self.pitch_m / self.focal_length_m
        x, y = (pixels[..., 1] - column) * scale, (pixels[..., 0] - row) * scale
        return (x, y) if self.distortion is None else _bend(x, y, self.bending, inverse=True)

    @property
    def principal_point(self) -> tuple[float, float]:
        """(row, column) where the optical axis meets the array. [element]"""
        return float(self.principal_row or 0.0), float(self.principal_column or 0.0)


@dataclass(frozen=True)
class Pose:
    """Position and attitude of the camera at one instant.

    Parameters
    ----------
    east_m, north_m, up_m
        Lens centre in ENU. [m]
    heading_rad
        Of the airframe, clockwise from north. [rad]
    roll_rad
        Right wing down is positive: the camera then looks left. [rad]
    pitch_rad
        Nose up is positive: the camera then looks ahead. [rad]
    gimbal_azimuth_rad
        Commanded azimuth of the line of sight, clockwise from the airframe's nose. [rad]
    gimbal_depression_rad
        Commanded depression of the line of sight below the airframe's horizon; π/2 looks straight
        down. Image up is then the direction of look. [rad]
    kind
        ``"true"`` or ``"reported"``: rendering uses the true pose, all after the sensor the reported one.
    """

    east_m: float
    north_m: float
    up_m: float
    heading_rad: float = 0.0
    roll_rad: float = 0.0
    pitch_rad: float = 0.0
    gimbal_azimuth_rad: float = 0.0
    gimbal_depression_rad: float = math.pi / 2
    kind: Literal["true", "reported"] = "true"

    def __post_init__(self):
        """Refuse a pose that is not a number: it would spread through every pixel."""
        for name, value in vars(self).items():
            if name != "kind" and not math.isfinite(value):
                raise ValueError(f"`pose.{name}` must be finite; got {value}.")
        if self.kind not in ("true", "reported"):
            raise ValueError(f"`pose.kind` must be 'true' or 'reported'; got {self.kind!r}.")

    @property
    def position(self) -> Float[Array, "3"]:
        """Lens centre in ENU. [m]"""
        return np.array([self.east_m, self.north_m, self.up_m], dtype=float)


def _turn(angle_rad: float) -> Float[Array, "3 3"]:
    """Rotation of the axes clockwise about z (heading, gimbal azimuth)."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])


def _bank(angle_rad: float) -> Float[Array, "3 3"]:
    """Rotation of the axes about y, right side down (roll)."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, 0, -s], [0, 1.0, 0], [s, 0, c]])


def _tilt(angle_rad: float) -> Float[Array, "3 3"]:
    """Rotation of the axes about x, −z (the line of sight) ahead (pitch, gimbal)."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[1.0, 0, 0], [0, c, s], [0, -s, c]])


def rotation(pose: Pose) -> Float[Array, "3 3"]:
    """Matrix m from ENU to the array's axes, Eq. (6): heading, then roll, then pitch, then gimbal.

    Its rows are the array's x (image right), y (image up) and z (backward) axes in ENU. [1]
    """
    airframe = _tilt(pose.pitch_rad) @ _bank(pose.roll_rad) @ _turn(pose.heading_rad)
    gimbal = _tilt(math.pi / 2 - pose.gimbal_depression_rad) @ _turn(pose.gimbal_azimuth_rad)
    return gimbal @ airframe


def look_at(pose: Pose, target_enu: ArrayLike) -> Pose:
    """Point a pose's gimbal at a ground point (a stare point).

    Parameters
    ----------
    pose
        Its airframe attitude stays, its gimbal is replaced.
    target_enu
        Point to put on the optical axis, (east, north, up). [m]

    Returns
    -------
    A pose with an optical axis through ``target_enu``.
    """
    airframe = rotation(Pose(0, 0, 0, pose.heading_rad, pose.roll_rad, pose.pitch_rad))
    x, y, z = airframe @ (np.asarray(target_enu, dtype=float) - pose.position)
    if x == y == z == 0:
        raise ValueError("`target_enu` must differ from the lens centre; got the same point.")
    across = math.hypot(x, y)
    azimuth = math.atan2(x, y) if across > 0 else 0.0
    return Pose(
        *pose.position.tolist(),
        heading_rad=pose.heading_rad,
        roll_rad=pose.roll_rad,
        pitch_rad=pose.pitch_rad,
        gimbal_azimuth_rad=azimuth,
        gimbal_depression_rad=math.atan2(-z, across),
        kind=pose.kind,
    )


def with_rotation(pose: Pose, matrix: Float[Array, "3 3"]) -> Pose:
    """Rotate a pose's airframe so that `rotation` gives ``matrix``; the gimbal stays.

    Parameters
    ----------
    pose
        Its place, gimbal and kind stay.
    matrix
        From ENU to the array's axes, a proper rotation. [1]

    Raises
    ------
    ValueError
        If the matrix is not a rotation.
    """
    m = np.asarray(matrix, dtype=float)
    if m.shape != (3, 3) or not (np.allclose(m @ m.T, np.eye(3), atol=1e-6) and np.linalg.det(m) > 0):
        raise ValueError(f"`matrix` must be a rotation; got {m.tolist()}.")
    gimbal = rotation(replace(pose, heading_rad=0.0, roll_rad=0.0, pitch_rad=0.0))
    m = gimbal.T @ m
    return replace(
        pose,
        heading_rad=math.atan2(-m[0, 1], m[0, 0]),
        roll_rad=-math.asin(min(max(float(m[0, 2]), -1.0), 1.0)),
        pitch_rad=math.atan2(m[1, 2], m[2, 2]),
    )


def from_yaw_pitch_roll(pose: Pose) -> Pose:
    """Convert a pose whose angles turn heading, then pitch, then roll, as inertial systems give them.

    Parameters
    ----------
    pose
        Its heading, pitch and roll in the order of ARINC 705; its place, gimbal and kind stay.

    Returns
    -------
    The same attitude as heading, then roll, then pitch.
    """
    airframe = _bank(pose.roll_rad) @ _tilt(pose.pitch_rad) @ _turn(pose.heading_rad)
    gimbal = rotation(replace(pose, heading_rad=0.0, roll_rad=0.0, pitch_rad=0.0))
    return with_rotation(pose, gimbal @ airframe)


def rotate_line_of_sight(pose: Pose, right_rad: float, up_rad: float) -> Pose:
    """Rotate a pose's line of sight toward image right and image up, as vibration does.

    The airframe's attitude is changed, so that a gimbal that looks straight down is not singular. [rad]
    """
    return with_rotation(pose, _tilt(up_rad) @ _bank(-right_rad) @ rotation(pose))


def from_omega_phi_kappa(
    position: ArrayLike,
    omega_rad: float,
    phi_rad: float,
    kappa_rad: float,
    kind: Literal["true", "reported"] = "reported",
) -> Pose:
    """Pose from photogrammetry's angles, in a world of east, north, up.

    Parameters
    ----------
    position
        Perspective centre (east, north, up). [m]
    omega_rad, phi_rad, kappa_rad
        Turns of the image's axes (x right, y up, z backward) about x, then the turned y, then the turned z,
        each positive counter-clockwise seen from the axis' positive end. [rad]
    kind
        Of the pose.

    References
    ----------
    Wolf & Dewitt, Elements of Photogrammetry, 3rd ed. (2000), Appendix C: M = M_kappa M_phi M_omega.
    """
    co, so = math.cos(omega_rad), math.sin(omega_rad)
    cp, sp = math.cos(phi_rad), math.sin(phi_rad)
    ck, sk = math.cos(kappa_rad), math.sin(kappa_rad)
    about_x = np.array([[1.0, 0, 0], [0, co, so], [0, -so, co]])
    about_y = np.array([[cp, 0, -sp], [0, 1.0, 0], [sp, 0, cp]])
    about_z = np.array([[ck, sk, 0], [-sk, ck, 0], [0, 0, 1.0]])
    east, north, up = np.asarray(position, dtype=float).tolist()
    return with_rotation(Pose(east, north, up, kind=kind), about_z @ about_y @ about_x)


def omega_phi_kappa(pose: Pose) -> tuple[float, float, float]:
    """Photogrammetry's angles of a pose, as `from_omega_phi_kappa` takes them. [rad]"""
    m = rotation(pose)
    return (
        math.atan2(-m[2, 1], m[2, 2]),
        math.asin(min(max(float(m[2, 0]), -1.0), 1.0)),
        math.atan2(-m[1, 0], m[0, 0]),
    )


def project(camera: Camera, pose: Pose, enu: ArrayLike) -> Float[Array, "... 2"]:
    """Image position of ground points by collinearity, Eqs. (4)–(5).

    Parameters
    ----------
    camera, pose
        The frame camera and where it is.
    enu
        Points (east, north, up) on the last axis. [m]

    Returns
    -------
    (row, column), not clipped to the array; NaN for points at or behind the lens, and for points so far off
    the axis that a distorting lens's polynomials fold. [element]
    """
    delta = np.asarray(enu, dtype=float) - pose.position
    x, y, z = np.moveaxis(delta @ rotation(pose).T, -1, 0)
    ahead = np.where(z < 0, -z, np.nan)
    scale = camera.focal_length_m / camera.pitch_m
    row, column = camera.principal_point
    right, down = x / ahead, -y / ahead
    if camera.distortion is not None:
        right, down = _bend(right, down, camera.bending, inverse=False)
    return np.stack([row + scale * down, column + scale * right], axis=-1)


def _bend(x: Array, y: Array, coefficients: Array, inverse: bool) -> tuple[Array, Array]:
    flat = np.array([np.ravel(x), np.ravel(y)], dtype=float)
    bend_all(flat[0], flat[1], coefficients, inverse)
    return flat[0].reshape(np.shape(x)), flat[1].reshape(np.shape(y))


def rays(camera: Camera, pose: Pose, pixels: ArrayLike | None = None) -> Float[Array, "... 3"]:
    """Directions of look through pixels, in ENU; the inverse of `project`.

    Parameters
    ----------
    camera, pose
        The frame camera and where it is.
    pixels
        (row, column) on the last axis, centres at integers; every element of the array by default. [element]

    Returns
    -------
    Unit vectors from the lens toward the scene, ``pixels.shape[:-1] + (3,)``, or (rows, columns, 3). [1]
    """
    if pixels is None:
        pixels = np.moveaxis(np.mgrid[: camera.rows, : camera.columns], 0, -1)
    pixels = np.asarray(pixels, dtype=float)
    x, y = camera._tangents(pixels)
    directions = np.stack([x, -y, np.full_like(x, -1.0)], axis=-1) @ rotation(pose)
    return directions / np.linalg.norm(directions, axis=-1, keepdims=True)


def ground_points(
    camera: Camera, pose: Pose, pixels: ArrayLike, height_m: ArrayLike = 0.0
) -> Float[Array, "... 3"]:
    """Intersect the rays through pixels with a level plane.

    Parameters
    ----------
    camera, pose
        The frame camera and where it is.
    pixels
        (row, column) on the last axis. [element]
    height_m
        Height of the plane, broadcast against the pixels. [m]

    Returns
    -------
    (east, north, up); NaN for rays that never come down to the plane. [m]
    """
    direction = rays(camera, pose, pixels)
    with np.errstate(divide="ignore", invalid="ignore"):
        distance = (np.asarray(height_m, dtype=float) - pose.up_m) / direction[..., 2]
    distance = np.where(np.isfinite(distance) & (distance > 0), distance, np.nan)
    return pose.position + distance[..., None] * direction
