"""Rectify frames to a fixed ground grid by collinearity with the *reported* pose, and register them.

Each cell of the ground grid, with the terrain's height, is projected into the frame, Eqs. (4)–(6) of Presnar
et al. (2010). Stokes vectors of the result are in the ``meridian`` frame, so that the angle of polarization
does not rotate with the aircraft.
"""

import math
from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.ndimage import shift

from glintrack.camera import Camera, Pose, ground_points, rotation
from glintrack.core.arrays import Array
from glintrack.core.interpolation import height_at
from glintrack.core.parallel import over_rows
from glintrack.core.schema import RADIANCE, check
from glintrack.ortho import kernels
from glintrack.ortho.grid import ground_grid
from glintrack.ortho.image_shift import displacement_between
from glintrack.ortho.occlusion import occlusion_mask

_EMPTY = np.zeros(0)
_HEIGHT_SAMPLES = 16  # heights along each axis; they choose the place with the least rounding


class GridCells(NamedTuple):
    """Places of the cells of a grid.

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
    def middle_height_m(self) -> float:
        """A height in the middle of those of the cells. [m]"""
        steps = tuple(max(n // _HEIGHT_SAMPLES, 1) for n in self.height.shape)
        heights = self.height[:: steps[0], :: steps[1]]
        heights = heights[np.isfinite(heights)]
        return float(0.5 * (heights.min() + heights.max())) if heights.size else 0.0

    def clip(self, place: Float[Array, "3"]) -> Float[Array, "3"]:
        """Clip a place to the grid's corners; the middle of the grid if it is NaN. [m]"""
        found, is_known = [*place[:2], self.middle_height_m], np.isfinite(place).all()
        for axis, values in enumerate((self.east, self.north)):
            ends = sorted((float(values[0, 0]), float(values[-1, -1])))
            found[axis] = min(max(found[axis], ends[0]), ends[1]) if is_known else sum(ends) / 2
        return np.array(found, dtype=float)

    @classmethod
    def of(cls, east: Array, north: Array, height: Array) -> "GridCells":
        """Build cells from arrays, or numbers, that broadcast to two axes; store repeated values once."""
        shape = np.broadcast_shapes((1, 1), np.shape(east), np.shape(north), np.shape(height))
        east, north, height = (np.broadcast_to(np.asarray(a, float), shape) for a in (east, north, height))
        if east.strides[0] == 0 and north.strides[1] == 0:
            east, north = east[:1].copy(), north[:, :1].copy()
        height = height[:1, :1].copy() if height.strides == (0, 0) else np.ascontiguousarray(height)
        return cls(np.ascontiguousarray(east), np.ascontiguousarray(north), height, _EMPTY, _EMPTY)

    @classmethod
    def over(cls, terrain: xr.Dataset, x: Float[Array, "x"], y: Float[Array, "y"]) -> "GridCells":
        """Build an even grid over a dataset of schema ``terrain``: bilinear heights, constant outside."""
        nodes = check(terrain, "terrain")["height"].values.astype(float)
        if np.ptp(nodes) == 0:
            return cls.of(x[None], y[:, None], nodes[0, 0])
        across, down = (terrain[n].values.astype(float) for n in ("x", "y"))
        column = np.interp(x, across, np.arange(len(across)))
        row = np.interp(-y, -down, np.arange(len(down)))
        nodes = np.pad(nodes, [(0, 2 - min(n, 2)) for n in nodes.shape], mode="edge")
        return cls(x[None].copy(), y[:, None].copy(), nodes, row, column)


MIN_SHIFT_PX = 0.02  # a smaller displacement changes less than the interpolation does


def register(image: xr.Dataset, reference: xr.Dataset, max_px: float = 16.0) -> xr.Dataset:
    """Shift a rectified frame so that its panchromatic content agrees with the reference.

    Parameters
    ----------
    image, reference
        Schema ``image`` on one grid.
    max_px
        Largest displacement of the search. [pixel]

    Returns
    -------
    The frame shifted by bilinear interpolation, with attributes ``registration_rows`` and
    ``registration_columns``: the corrected displacement; 0 where no peak is significant. [pixel]
    """
    check(image, "image")
    check(reference, "image")
    rows, columns, clearness = displacement_between(image["pan"].values, reference["pan"].values, max_px)
    if not math.isfinite(rows):
        rows = columns = 0.0
    attrs = {"registration_rows": rows, "registration_columns": columns, "registration_clearness": clearness}
    if math.hypot(rows, columns) < MIN_SHIFT_PX:
        return image.assign_attrs(attrs)
    moved = {}
    for name in ("pan", "stokes_radiance", "dolp"):
        by = (-rows, -columns) + (0,) * (image[name].ndim - 2)
        values = shift(image[name].values, by, order=1, mode="constant", cval=np.nan, prefilter=False)
        moved[name] = image[name].copy(data=values)
    return check(image.assign(moved).assign_attrs(attrs), "image")


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
        The frame camera and the navigator's pose.
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
    x, y = ground_grid(area_m, gsd_m)
    cells, floor = GridCells.over(terrain, x, y), float(frame.attrs.get("dolp_floor", 0.0))
    pan, stokes, dolp = rectify_frame(frame, camera, reported_pose, cells, method, floor)
    stokes_attrs = {"units": RADIANCE, "stokes_frame": "meridian"}
    image = xr.Dataset(
        {
            "pan": (("y", "x"), pan, {"units": RADIANCE}),
            "stokes_radiance": (("y", "x", "stokes"), stokes, stokes_attrs),
            "dolp": (("y", "x"), dolp, {"units": "1"}),
        },
        coords={n: (n, values, {"units": "m"}) for n, values in (("y", y), ("x", x))}
        | {"stokes": ["I", "Q", "U"]},
        attrs={**frame.attrs, "gsd_m": gsd_m},
    )
    if surface is not None:
        height = height_at(check(terrain, "terrain"), x[None], y[:, None])
        occluded = occlusion_mask(surface, reported_pose, x[None], y[:, None], height)
        image = image.where(xr.DataArray(~occluded, dims=("y", "x")))
        image["occluded"] = (("y", "x"), occluded.astype(np.int8), {"units": "1"})
    return check(image, "image")


def rectify_frame(
    frame: xr.Dataset, camera: Camera, pose: Pose, cells: GridCells, method: str, dolp_floor: float = 0.0
) -> tuple[Float[Array, "y x"], Float[Array, "y x stokes"], Float[Array, "y x"]]:
    """Pan and Stokes vectors, in the ``meridian`` frame, of a frame at any cells, and DoLP above a floor."""
    check(frame, "frame")
    pitch, found = float(frame["y"][1] - frame["y"][0]), {}
    dolp = np.empty(cells.shape, np.float32)
    for name in ("pan", "stokes_radiance"):
        values, where = frame[name].values, frame[name].attrs
        offsets = float(where.get("row_offset", 0.0)), float(where.get("column_offset", 0.0))
        first = float(frame["y"][0]) + offsets[0], float(frame["x"][0]) + offsets[1]
        components = values.shape[-1] if where.get("stokes_frame") == "detector" else 0
        degree = dolp if name == "stokes_radiance" else _NONE
        found[name] = _sweep(
            values, camera, pose, cells, method, first, pitch, components, dolp_floor, degree
        )
    return found["pan"], found["stokes_radiance"], dolp


def rectify_array(
    values: Float[Array, "row column *band"],
    camera: Camera,
    reported_pose: Pose,
    terrain: xr.Dataset,
    gsd_m: float,
    area_m: tuple[float, float, float, float],
    method: str = "bilinear",
    is_stokes: bool = False,
) -> Float[Array, "y x *band"]:
    """Map any array of whole elements to the ground grid; arguments as `orthorectify`. NaN where no data.

    ``is_stokes``: the last axis holds Stokes vectors in the ``detector`` frame, which are rotated to
    ``meridian``.
    """
    if values.shape[:2] != (camera.rows, camera.columns):
        raise ValueError(
            f"`values` must be {camera.rows} × {camera.columns} elements; got {values.shape[:2]}."
        )
    cells = GridCells.over(terrain, *ground_grid(area_m, gsd_m))
    components = values.shape[-1] if is_stokes else 0
    return _sweep(values, camera, reported_pose, cells, method, (0.0, 0.0), 1.0, components)


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
        The frame camera and the navigator's pose.
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
    """Sample values at every cell; ``polarized`` and ``dolp`` as in `kernels.sample`."""
    if method not in METHODS:
        raise ValueError(f"`method` must be one of {', '.join(METHODS)}; got {method!r}.")
    if min(values.shape[:2]) < 2:
        raise ValueError(f"`values` must have two pixels a side at least; got {values.shape[:2]}.")
    source = np.ascontiguousarray(values, np.float32).reshape(*values.shape[:2], -1)
    out = np.empty((*cells.shape, source.shape[2]), np.float32)
    centre = (camera.rows - 1) / 2, (camera.columns - 1) / 2
    middle = cells.clip(ground_points(camera, pose, centre, cells.middle_height_m))
    collinearity = _collinearity(camera, pose, middle, first, pitch)
    number = METHODS.index("bilinear" if method == "cubic" and min(values.shape[:2]) < 4 else method)
    to_meridian = np.concatenate([pose.position - collinearity.origin[:3], rotation(pose)[0]])
    how = collinearity, cells, number, to_meridian, polarized, dolp_floor
    size = *source.shape, out.shape[1]
    over_rows(kernels.sample, len(out), source.ravel(), size, *how, out.ravel(), dolp)
    return out.reshape(*cells.shape, *values.shape[2:])


def _collinearity(
    camera: Camera, pose: Pose, middle: Array, first: tuple[float, float], pitch: float
) -> kernels.Collinearity:
    """Collinearity for the kernel, about a place in the grid."""
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
