"""Rectification: detector frames to a fixed ground grid by collinearity with the *reported* pose.

The ground grid is swept, each cell is given the terrain's height and projected into the frame, Eqs. (4)–(6)
of Presnar et al. (2010). Stokes vectors leave in the ``meridian`` frame, so that the angle of polarization
does not turn with the aircraft.
"""

import numpy as np
import xarray as xr
from jaxtyping import Float

from ..camera import Camera, Pose, rotation
from ..schema import RADIANCE, check
from ..stokes import dolp
from ..threads import over_rows
from . import kernels
from .grid import ground_grid, terrain_on
from .occlusion import hidden

Array = np.ndarray
METHODS = ("nearest", "bilinear", "cubic")  # in the order of the kernels' numbers


def orthorectify(
    frame: xr.Dataset,
    camera: Camera,
    reported_pose: Pose,
    terrain: xr.Dataset,
    gsd_m: float,
    area_m: tuple[float, float, float, float],
    method: str = "bilinear",
    surface: xr.Dataset | None = None,
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
        ``"nearest"`` as in the paper, ``"bilinear"`` or ``"cubic"``.
    surface
        Schema ``terrain`` with the heights of roofs and crowns: cells that they hide from the camera are NaN.

    Returns
    -------
    Schema ``image``; NaN where the frame has no data. With a surface model also ``occluded``, 1 where hidden.

    Raises
    ------
    ValueError
        If the grid is empty or the method unknown.
    """
    check(frame, "frame")
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, got {method!r}")
    east, north, height = _grid(area_m, gsd_m, terrain)
    pan, stokes = rectify_frame(frame, camera, reported_pose, east, north, height, method)
    coords = {
        "y": ("y", north[:, 0].copy(), {"units": "m"}),
        "x": ("x", east[0].copy(), {"units": "m"}),
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
    if surface is not None:
        image = _without_hidden(image, hidden(surface, reported_pose, east, north, height))
    return check(image, "image")


def _without_hidden(image: xr.Dataset, occluded: Array) -> xr.Dataset:
    seen = xr.DataArray(~occluded, dims=("y", "x"))
    masked = {str(name): image[name].where(seen) for name in ("pan", "stokes_radiance", "dolp")}
    flag = ("occluded", (("y", "x"), occluded.astype(np.int8), {"units": "1"}))
    return image.assign({**masked, flag[0]: flag[1]})


def rectify_frame(
    frame: xr.Dataset,
    camera: Camera,
    reported_pose: Pose,
    east: Float[Array, "y x"],
    north: Float[Array, "y x"],
    height: Float[Array, "y x"],
    method: str = "bilinear",
) -> tuple[Float[Array, "y x"], Float[Array, "y x stokes"]]:
    """Pan and Stokes vectors, in the ``meridian`` frame, of a frame at any places; see `rectify_onto`."""
    check(frame, "frame")
    pan, stokes = (
        rectify_onto(
            frame[name].values,
            camera,
            reported_pose,
            east,
            north,
            height,
            method,
            first=(
                float(frame["y"][0]) + float(frame[name].attrs.get("row_offset", 0.0)),
                float(frame["x"][0]) + float(frame[name].attrs.get("column_offset", 0.0)),
            ),
            pitch=float(frame["y"][1] - frame["y"][0]),
        )
        for name in ("pan", "stokes_radiance")
    )
    if frame["stokes_radiance"].attrs["stokes_frame"] == "detector":
        over_rows(
            kernels.to_meridian,
            len(stokes),
            stokes,
            rotation(reported_pose),
            reported_pose.position,
            east,
            north,
            height,
        )
    return pan, stokes


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
    return rectify_onto(values, camera, reported_pose, *_grid(area_m, gsd_m, terrain), method)


def rectify_stokes(
    values: Float[Array, "row column channel stokes"],
    camera: Camera,
    pose: Pose,
    terrain: xr.Dataset,
    gsd_m: float,
    area_m: tuple[float, float, float, float],
    method: str = "bilinear",
) -> Float[Array, "y x channel stokes"]:
    """Map Stokes vectors of whole elements to the ground grid; arguments as `orthorectify`.

    They come in the ``detector`` frame and leave in ``meridian``. NaN where no data.
    """
    out = rectify_array(values, camera, pose, terrain, gsd_m, area_m, method)
    east, north, height = _grid(area_m, gsd_m, terrain)
    for channel in range(out.shape[2]):
        turned = np.ascontiguousarray(out[:, :, channel])
        over_rows(kernels.to_meridian, len(north), turned, rotation(pose), pose.position, east, north, height)
        out[:, :, channel] = turned
    return out


def rectify_onto(
    values: Float[Array, "row column *band"],
    camera: Camera,
    reported_pose: Pose,
    east: Float[Array, "y x"],
    north: Float[Array, "y x"],
    height: Float[Array, "y x"],
    method: str = "bilinear",
    first: tuple[float, float] = (0.0, 0.0),
    pitch: float = 1.0,
) -> Float[Array, "y x *band"]:
    """Sample a frame at any places on the ground, by collinearity, Eqs. (4)–(6).

    Parameters
    ----------
    values
        The frame, its pixels ``pitch`` elements apart.
    camera, reported_pose
        The frame camera and where the navigator says it was.
    east, north, height
        The places, ENU; NaN heights give NaN. [m]
    method
        ``"nearest"``, ``"bilinear"`` or ``"cubic"`` (Keys' cubic convolution).
    first, pitch
        Row and column of the first pixel, and the spacing of pixels. [element]

    Returns
    -------
    float32; NaN where the frame has no data.

    Raises
    ------
    ValueError
        If the method is unknown or the frame has less than two pixels a side.
    """
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, got {method!r}")
    if min(values.shape[:2]) < 2:
        raise ValueError(f"`values` must have two pixels a side at least, got {values.shape[:2]}")
    shape = np.broadcast_shapes(np.shape(east), np.shape(north), np.shape(height))
    source = np.ascontiguousarray(values, np.float32).reshape(*values.shape[:2], -1)
    out = np.empty((*shape, source.shape[2]), np.float32)
    over_rows(
        kernels.sample,
        shape[0],
        source.ravel(),
        source.shape,
        float(first[0]),
        float(first[1]),
        float(pitch),
        rotation(reported_pose),
        reported_pose.position,
        camera.focal_length_m / camera.pitch_m,
        camera.principal_point,
        camera.bending,
        *(np.broadcast_to(np.asarray(a, float), shape) for a in (east, north, height)),
        METHODS.index(method),
        out.reshape(shape[0], -1),
    )
    return out.reshape(*shape, *values.shape[2:])


def _grid(area_m, gsd_m: float, terrain: xr.Dataset) -> tuple[Array, Array, Array]:
    """East, north and height of a grid's cells, as rows and columns that broadcast."""
    x, y = ground_grid(area_m, gsd_m)
    shape = (len(y), len(x))
    east, north = np.broadcast_to(x[None], shape), np.broadcast_to(y[:, None], shape)
    return east, north, terrain_on(terrain, x[None], y[:, None])
