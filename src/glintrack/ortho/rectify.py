"""Rectify detector frames to a fixed ground grid by collinearity with the *reported* pose, and register them.

The ground grid is swept, each cell is given the terrain's height and projected into the frame, Eqs. (4)–(6)
of Presnar et al. (2010). Stokes vectors leave in the ``meridian`` frame, so that the angle of polarization
does not turn with the aircraft.
"""

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.ndimage import shift as shifted

from glintrack.camera import Camera, Pose, ground_points, rotation
from glintrack.core.arrays import Array
from glintrack.core.interpolation import height_at
from glintrack.core.parallel import over_rows
from glintrack.core.schema import RADIANCE, check
from glintrack.ortho import kernels
from glintrack.ortho.grid import ground_grid
from glintrack.ortho.image_shift import displacement_between
from glintrack.ortho.occlusion import occlusion_mask

_NOWHERE = np.zeros(0)
_LOOKED_AT = 16  # heights along each axis; they only say where rounding is least


@dataclass(frozen=True)
class GridCells:
    """Where each cell of a grid lies.

    Parameters
    ----------
    east, north
        Arrays of two axes that broadcast to the grid. [m]
    height
        One height, one for each cell, or the nodes of a terrain; NaN gives no data. [m]
    node_row, node_column
        Place of each row and column of the grid among the terrain's nodes; empty without a terrain. [node]
    """

    east: Float[Array, "a b"]
    north: Float[Array, "c d"]
    height: Float[Array, "e f"]
    node_row: Float[Array, "y"]
    node_column: Float[Array, "x"]

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the grid."""
        if self.node_row.size:
            return len(self.node_row), len(self.node_column)
        rows, columns = np.broadcast_shapes(self.east.shape, self.north.shape, self.height.shape)
        return rows, columns

    @property
    def level_m(self) -> float:
        """A height amid those of the cells. [m]"""
        steps = tuple(max(n // _LOOKED_AT, 1) for n in self.height.shape)
        heights = self.height[:: steps[0], :: steps[1]]
        heights = heights[np.isfinite(heights)]
        return float(0.5 * (heights.min() + heights.max())) if heights.size else 0.0

    def nearest_to(self, place: Float[Array, "3"]) -> Float[Array, "3"]:
        """A place among the cells, near another as far as corners allow; amid them if that is NaN. [m]"""
        found = [*place[:2], self.level_m]
        for axis, values in enumerate((self.east, self.north)):
            ends = sorted((float(values[0, 0]), float(values[-1, -1])))
            found[axis] = (
                min(max(found[axis], ends[0]), ends[1]) if np.isfinite(place).all() else sum(ends) / 2
            )
        return np.array(found, dtype=float)

    @classmethod
    def of(cls, east: Array, north: Array, height: Array) -> "GridCells":
        """Cells by arrays, or numbers, that broadcast to two axes; what only repeats is kept once."""
        shape = np.broadcast_shapes((1, 1), np.shape(east), np.shape(north), np.shape(height))
        east, north, height = (
            np.broadcast_to(np.asarray(a, dtype=float), shape) for a in (east, north, height)
        )
        if east.strides[0] == 0 and north.strides[1] == 0:
            east, north = east[:1].copy(), north[:, :1].copy()
        height = height[:1, :1].copy() if height.strides == (0, 0) else np.ascontiguousarray(height)
        return cls(np.ascontiguousarray(east), np.ascontiguousarray(north), height, _NOWHERE, _NOWHERE)

    @classmethod
    def over(cls, terrain: xr.Dataset, x: Float[Array, "x"], y: Float[Array, "y"]) -> "GridCells":
        """An even grid over a dataset of schema ``terrain``: bilinear heights, held beyond its edges."""
        nodes = check(terrain, "terrain")["height"].values.astype(float)
        if np.ptp(nodes) == 0:
            return cls.of(x[None], y[:, None], nodes[0, 0])
        across, down = (terrain[n].values.astype(float) for n in ("x", "y"))
        column = np.interp(x, across, np.arange(len(across)))
        row = np.interp(-y, -down, np.arange(len(down)))
        nodes = np.pad(nodes, [(0, 2 - min(n, 2)) for n in nodes.shape], mode="edge")
        return cls(x[None].copy(), y[:, None].copy(), nodes, row, column)


WORTH_PX = 0.02  # a smaller displacement changes less than the interpolation does


def register(image: xr.Dataset, reference: xr.Dataset, most_px: float = 16.0) -> xr.Dataset:
    """Move a rectified frame to where its panchromatic content lies in the reference.

    Parameters
    ----------
    image, reference
        Schema ``image`` on one grid.
    most_px
        Larger displacements are not looked for. [pixel]

    Returns
    -------
    The frame moved by bilinear interpolation, with attributes ``registration_rows`` and
    ``registration_columns``: the displacement taken out; nought where none stood out. [pixel]
    """
    check(image, "image")
    check(reference, "image")
    rows, columns, clearness = displacement_between(image["pan"].values, reference["pan"].values, most_px)
    found = math.isfinite(rows)
    taken = {
        "registration_rows": rows if found else 0.0,
        "registration_columns": columns if found else 0.0,
        "registration_clearness": clearness,
    }
    if not found or math.hypot(rows, columns) < WORTH_PX:
        return image.assign_attrs(taken)
    moved = {
        name: image[name].copy(
            data=shifted(
                image[name].values,
                (-rows, -columns) + (0,) * (image[name].ndim - 2),
                order=1,
                mode="constant",
                cval=np.nan,
                prefilter=False,
            )
        )
        for name in ("pan", "stokes_radiance", "dolp")
    }
    return check(image.assign(moved).assign_attrs(taken), "image")


_NONE = np.empty((0, 0), np.float32)
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
    _known(method)
    x, y = ground_grid(area_m, gsd_m)
    floor = float(frame.attrs.get("dolp_floor", 0.0))
    pan, stokes, dolp = _rectify_frame(
        frame, camera, reported_pose, GridCells.over(terrain, x, y), method, floor
    )
    coords = {
        "y": ("y", y, {"units": "m"}),
        "x": ("x", x, {"units": "m"}),
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
            "dolp": (("y", "x"), dolp, {"units": "1"}),
        },
        coords=coords,
        attrs={**frame.attrs, "gsd_m": gsd_m},
    )
    if surface is not None:
        height = height_at(check(terrain, "terrain"), x[None], y[:, None])
        image = _without_occluded(image, occlusion_mask(surface, reported_pose, x[None], y[:, None], height))
    return check(image, "image")


def _without_occluded(image: xr.Dataset, occluded: Array) -> xr.Dataset:
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
    _known(method)
    return _rectify_frame(frame, camera, reported_pose, GridCells.of(east, north, height), method, 0.0)[:2]


def _rectify_frame(
    frame: xr.Dataset, camera: Camera, pose: Pose, cells: GridCells, method: str, dolp_floor: float
) -> tuple[Array, Array, Array]:
    """Pan, Stokes vectors, and their DoLP where it is above the floor."""
    pitch, found = float(frame["y"][1] - frame["y"][0]), {}
    dolp = np.empty(cells.shape, np.float32)
    for name in ("pan", "stokes_radiance"):
        values, where = frame[name].values, frame[name].attrs
        first = (
            float(frame["y"][0]) + float(where.get("row_offset", 0.0)),
            float(frame["x"][0]) + float(where.get("column_offset", 0.0)),
        )
        turned = values.shape[-1] if where.get("stokes_frame") == "detector" else 0
        degree = dolp if name == "stokes_radiance" else _NONE
        found[name] = _sweep(values, camera, pose, cells, method, first, pitch, turned, dolp_floor, degree)
    return found["pan"], found["stokes_radiance"], dolp


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
    return _rectify_whole(values, camera, reported_pose, terrain, gsd_m, area_m, method, 0)


def _rectify_whole(values, camera, pose, terrain, gsd_m, area_m, method, polarized) -> Array:
    _known(method)
    if values.shape[:2] != (camera.rows, camera.columns):
        raise ValueError(
            f"`values` must be {camera.rows} × {camera.columns} elements, got {values.shape[:2]}"
        )
    cells = GridCells.over(terrain, *ground_grid(area_m, gsd_m))
    return _sweep(values, camera, pose, cells, method, (0.0, 0.0), 1.0, polarized)


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
    return _rectify_whole(values, camera, pose, terrain, gsd_m, area_m, method, values.shape[-1])


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
    _known(method)
    shape = np.broadcast_shapes(np.shape(east), np.shape(north), np.shape(height))
    cells = GridCells.of(east, north, height)
    out = _sweep(values, camera, reported_pose, cells, method, first, pitch, 0)
    return out.reshape(*shape, *values.shape[2:])


def _sweep(
    values: Array,
    camera: Camera,
    pose: Pose,
    cells: GridCells,
    method: str,
    first: tuple[float, float],
    pitch: float,
    polarized: int,
    dolp_floor: float = 0.0,
    dolp: Array = _NONE,
) -> Array:
    """Samples at every cell; ``polarized`` as `kernels.sample` takes it, which writes ``dolp``."""
    if min(values.shape[:2]) < 2:
        raise ValueError(f"`values` must have two pixels a side at least, got {values.shape[:2]}")
    source = np.ascontiguousarray(values, np.float32).reshape(*values.shape[:2], -1)
    out = np.empty((*cells.shape, source.shape[2]), np.float32)
    centre = (camera.rows - 1) / 2, (camera.columns - 1) / 2
    middle = cells.nearest_to(ground_points(camera, pose, centre, cells.level_m))
    collinearity = _collinearity(camera, pose, middle, first, pitch)
    over_rows(
        kernels.sample,
        len(out),
        source.ravel(),
        (*source.shape, out.shape[1]),
        collinearity,
        kernels.CellPlaces(cells.east, cells.north, cells.height, cells.node_row, cells.node_column),
        METHODS.index("bilinear" if method == "cubic" and min(values.shape[:2]) < 4 else method),
        np.concatenate([pose.position - collinearity.origin[:3], rotation(pose)[0]]),
        polarized,
        dolp_floor,
        out.ravel(),
        dolp,
    )
    return out.reshape(*cells.shape, *values.shape[2:])


def _collinearity(
    camera: Camera, pose: Pose, middle: Array, first: tuple[float, float], pitch: float
) -> kernels.Collinearity:
    """Collinearity as the kernel takes it, about a place amid the grid."""
    m, scale = rotation(pose), camera.focal_length_m / (camera.pitch_m * pitch)
    principal = [(p - f) / pitch for p, f in zip(camera.principal_point, first, strict=True)]
    delta = middle - pose.position
    ahead, down, right = -m[2], -scale * m[1], scale * m[0]
    distance = ahead @ delta
    linear = np.zeros((3, 5))
    linear[0, :4] = [distance, *ahead]
    for k, (direction, centre) in enumerate(zip((down, right), principal, strict=True), 1):
        there = direction @ delta / distance if distance > 0 else 0.0
        slopes = direction - there * ahead
        linear[k] = [slopes @ delta, *slopes, centre + there]
    return kernels.Collinearity(np.array([*middle, *principal, scale]), linear, camera.bending)


def _known(method: str) -> None:
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}, got {method!r}")
