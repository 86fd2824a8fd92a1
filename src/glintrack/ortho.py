"""Rectification: detector frames to a fixed ground grid by collinearity with the *reported* pose.

The ground grid is swept, each cell is given the terrain's height and projected into the frame, Eqs. (4)–(6)
of Presnar et al. (2010). Stokes vectors leave in the ``meridian`` frame, so that the angle of polarization
does not turn with the aircraft.
"""

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float

from .camera import Camera, Pose, rotation
from .schema import RADIANCE, check
from .stokes import axis_turn, dolp, rotate_qu
from .threads import over_rows

Array = np.ndarray
METHODS = ("nearest", "bilinear")


def orthorectify(
    frame: xr.Dataset,
    camera: Camera,
    reported_pose: Pose,
    terrain: xr.Dataset,
    gsd_m: float,
    area_m: tuple[float, float, float, float],
    method: str = "bilinear",
) -> xr.Dataset:
    """Map one frame to a north-up grid.

    Parameters
    ----------
    frame
        Schema ``frame``: superpixels, with y and x in elements. DoLP is masked where S0 is at or below its
        attribute ``dolp_floor``. [W m⁻² sr⁻¹ µm⁻¹]
    camera, reported_pose
        The frame camera and where the navigator says it was.
    terrain
        Schema ``terrain``.
    gsd_m
        Cell of the ground grid. [m]
    area_m
        West, south, east, north edges of the grid, ENU. [m]
    method
        ``"nearest"`` as in the paper, or ``"bilinear"``.

    Returns
    -------
    Schema ``image``; NaN where the frame has no data.

    Raises
    ------
    ValueError
        If the grid is empty or the method unknown.
    """
    check(frame, "frame")
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, got {method!r}")
    east, north = ground_grid(area_m, gsd_m)
    height = _terrain_height(terrain, east, north)
    pitch = float(frame["y"][1] - frame["y"][0])
    pan, stokes = (
        _rectify(
            frame[name].values,
            float(frame["y"][0]) + float(frame[name].attrs.get("row_offset", 0.0)),
            float(frame["x"][0]) + float(frame[name].attrs.get("column_offset", 0.0)),
            pitch,
            camera,
            reported_pose,
            (east, north, height),
            method,
        )
        for name in ("pan", "stokes_radiance")
    )
    if frame["stokes_radiance"].attrs["stokes_frame"] == "detector":
        over_rows(
            _to_meridian,
            len(north),
            stokes,
            rotation(reported_pose),
            reported_pose.position,
            east,
            north,
            height,
        )
    coords = {
        "y": ("y", north, {"units": "m"}),
        "x": ("x", east, {"units": "m"}),
        "stokes": ["I", "Q", "U"],
    }
    image = xr.Dataset(
        {
            "pan": (("y", "x"), pan, {"units": RADIANCE}),
            "stokes_radiance": (
                ("y", "x", "stokes"),
                stokes,
                {"units": RADIANCE, "stokes_frame": "meridian"},
            ),
            "dolp": (
                ("y", "x"),
                dolp(stokes, frame.attrs.get("dolp_floor", 0.0)).astype(np.float32),
                {"units": "1"},
            ),
        },
        coords=coords,
        attrs={**frame.attrs, "gsd_m": gsd_m},
    )
    return check(image, "image")


def rectify_array(
    values: Float[Array, "row column *band"],
    camera: Camera,
    reported_pose: Pose,
    terrain: xr.Dataset,
    gsd_m: float,
    area_m: tuple[float, float, float, float],
    method: str = "bilinear",
) -> Float[Array, "y x *band"]:
    """Map any array of whole elements to the ground grid; arguments as `orthorectify`. NaN where no data."""
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, got {method!r}")
    if values.shape[:2] != (camera.rows, camera.columns):
        raise ValueError(
            f"`values` must be {camera.rows} × {camera.columns} elements, got {values.shape[:2]}"
        )
    east, north = ground_grid(area_m, gsd_m)
    grid = (east, north, _terrain_height(terrain, east, north))
    return _rectify(values, 0.0, 0.0, 1.0, camera, reported_pose, grid, method)


def _rectify(values, row0, column0, pitch, camera, pose, grid, method) -> Array:
    """Sample ``values``, whose first pixel lies at (row0, column0) [element], at the ground grid's cells."""
    east, north, height = grid
    source = np.ascontiguousarray(values, np.float32).reshape(*values.shape[:2], -1)
    out = np.empty((len(north), len(east), source.shape[2]), np.float32)
    focal = camera.focal_length_m / camera.pitch_m
    lens, m = pose.position, rotation(pose)
    nearest = method == "nearest"
    over_rows(
        _sample,
        len(north),
        source,
        row0,
        column0,
        pitch,
        m,
        lens,
        focal,
        camera.principal_point,
        east,
        north,
        height,
        nearest,
        out,
    )
    return out.reshape(*out.shape[:2], *values.shape[2:])


def ground_grid(
    area_m: tuple[float, float, float, float], gsd_m: float
) -> tuple[Float[Array, "x"], Float[Array, "y"]]:
    """Centres of the grid's cells: rising eastings, falling northings. [m]"""
    west, south, east, north = area_m
    if not (gsd_m > 0 and east - west >= gsd_m and north - south >= gsd_m):
        raise ValueError(f"`area_m` must hold at least one cell of {gsd_m} m, got {area_m}")
    columns, rows = round((east - west) / gsd_m), round((north - south) / gsd_m)
    return west + gsd_m * (np.arange(columns) + 0.5), north - gsd_m * (np.arange(rows) + 0.5)


def _terrain_height(terrain: xr.Dataset, east: Array, north: Array) -> Float[Array, "y x"]:
    """Terrain height at the grid's cells, bilinear; held at the edges of the terrain."""
    height = check(terrain, "terrain")["height"]
    values = height.values.astype(float)
    if np.ptp(values) == 0:
        return np.full((len(north), len(east)), values.flat[0])
    x, y = terrain["x"].values.astype(float), terrain["y"].values.astype(float)
    column = np.interp(east, x, np.arange(len(x)))
    row = np.interp(-north, -y, np.arange(len(y)))
    i = np.minimum(row.astype(int), len(y) - 2)[:, None]
    j = np.minimum(column.astype(int), len(x) - 2)[None]
    fy, fx = row[:, None] - i, column[None] - j
    top = (1 - fx) * values[i, j] + fx * values[i, j + 1]
    bottom = (1 - fx) * values[i + 1, j] + fx * values[i + 1, j + 1]
    return (1 - fy) * top + fy * bottom


@nb.njit(nogil=True, cache=True)
def _sample(
    start, stop, source, row0, column0, pitch, m, lens, focal, principal, east, north, height, nearest, out
):
    rows, columns, bands = source.shape
    for i in range(start, stop):
        for j in range(len(east)):
            for b in range(bands):
                out[i, j, b] = np.nan
            x, y, z = east[j] - lens[0], north[i] - lens[1], height[i, j] - lens[2]
            ahead = -(m[2, 0] * x + m[2, 1] * y + m[2, 2] * z)
            if ahead <= 0:
                continue
            right = focal * (m[0, 0] * x + m[0, 1] * y + m[0, 2] * z) / ahead
            up = focal * (m[1, 0] * x + m[1, 1] * y + m[1, 2] * z) / ahead
            r = (principal[0] - up - row0) / pitch
            c = (principal[1] + right - column0) / pitch
            if not (-0.5 <= r < rows - 0.5 and -0.5 <= c < columns - 0.5):
                continue
            if nearest:
                for b in range(bands):
                    out[i, j, b] = source[int(np.floor(r + 0.5)), int(np.floor(c + 0.5)), b]
                continue
            r, c = min(max(r, 0.0), rows - 1.0), min(max(c, 0.0), columns - 1.0)
            i0, j0 = min(int(r), rows - 2), min(int(c), columns - 2)
            fr, fc = r - i0, c - j0
            for b in range(bands):
                total, weight = 0.0, 0.0
                for di in range(2):
                    for dj in range(2):
                        value = source[i0 + di, j0 + dj, b]
                        w = (fr if di else 1 - fr) * (fc if dj else 1 - fc)
                        if np.isfinite(value):
                            total += w * value
                            weight += w
                if weight > 0.5:  # a dark mirror blanks what lies nearer to it than to its neighbours
                    out[i, j, b] = total / weight


@nb.njit(nogil=True, cache=True)
def _to_meridian(start, stop, stokes, m, lens, east, north, height):
    """Turn (Q, U) from the detector's +x to the vertical plane of each ray, in place on our own array."""
    for i in range(start, stop):
        for j in range(len(east)):
            kx, ky, kz = lens[0] - east[j], lens[1] - north[i], lens[2] - height[i, j]
            norm = 1.0 / np.sqrt(kx * kx + ky * ky + kz * kz)
            c, s = axis_turn(m[0, 0], m[0, 1], m[0, 2], 0.0, 0.0, 1.0, kx * norm, ky * norm, kz * norm)
            q, u = rotate_qu(stokes[i, j, 1], stokes[i, j, 2], c, s)
            stokes[i, j, 1], stokes[i, j, 2] = q, u
