"""Triangle meshes of the scene: merging, flat polygons, walls, extrusion, boxes and roofs.

Faces run counter-clockwise seen from outside (from above for ground). Plan geometry is shapely's, in metres.
"""

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import NamedTuple

import mapbox_earcut
import numpy as np
import shapely
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from shapely.geometry import Polygon
from shapely.geometry.base import BaseGeometry

from glintrack.core.arrays import Array
from glintrack.core.records import Extent

PAINT = -1  # material index that stands for "the instance's own paint"
_COARSE_TILES = 16
SLIVER_M2 = 0.02  # smaller polygons are rounding of the overlay, not surfaces


@dataclass(frozen=True)
class Mesh:
    """Triangles with one material each.

    Parameters
    ----------
    vertices
        [m]
    faces
        Indices into ``vertices``, counter-clockwise seen from outside.
    material
        Index into the material library, or `PAINT`.
    """

    vertices: Float[Array, "vertex 3"]
    faces: Int[Array, "face 3"]
    material: Int[Array, "face"]

    def __post_init__(self):
        """Refuse arrays that do not belong together."""
        for name, array in (("vertices", self.vertices), ("faces", self.faces)):
            if array.ndim != 2 or array.shape[1] != 3:
                raise ValueError(f"`{name}` must have shape (n, 3); got {array.shape}.")
        if self.material.shape != (len(self.faces),):
            raise ValueError(f"`material` must have shape ({len(self.faces)},); got {self.material.shape}.")
        if not np.isfinite(self.vertices).all():
            raise ValueError("`vertices` must be finite; got some that are not.")
        if len(self.faces) and not (0 <= self.faces.min() and self.faces.max() < len(self.vertices)):
            raise ValueError(
                f"`faces` must index the {len(self.vertices)} vertices; "
                f"got {self.faces.min()} to {self.faces.max()}."
            )


@dataclass
class MeshBuilder:
    """Collects patches of surface by material name, and joins them into one `Mesh` at the end."""

    index: dict[str, int]
    _vertices: list[Array] = field(default_factory=list)
    _faces: list[Array] = field(default_factory=list)
    _material: list[Array] = field(default_factory=list)
    _count: int = 0

    def add(self, material: str, patch: tuple[Array, Array]) -> None:
        """Add vertices and faces of one material (the name ``"paint"`` is the instance's own paint)."""
        vertices, faces = patch
        if len(faces) == 0:
            return
        number = PAINT if material == "paint" else self.index[material]
        self._append(np.asarray(vertices), np.asarray(faces), np.full(len(faces), number))

    def add_mesh(self, mesh: Mesh, transform: Float[Array, "3 4"], paint: int) -> None:
        """Add a transformed copy of a mesh, with a material index for its paint."""
        vertices = mesh.vertices @ transform[:, :3].T + transform[:, 3]
        self._append(vertices, mesh.faces, np.where(mesh.material == PAINT, paint, mesh.material))

    def mark(self) -> int:
        """Return a mark of the present state, for `raise_since`."""
        return len(self._vertices)

    def raise_since(self, mark: int, rise: Callable[[Array], Array] | float) -> None:
        """Raise all patches added since a mark by a height, or by a function of the vertices. [m]"""
        if mark == len(self._vertices):
            return
        raised = np.concatenate(self._vertices[mark:]).astype(float)
        ends = np.cumsum([len(v) for v in self._vertices[mark:]])
        raised[:, 2] += rise(raised) if callable(rise) else rise
        self._vertices[mark:] = np.split(raised, ends[:-1])

    def mesh(self) -> Mesh:
        """Return the mesh of all patches."""
        return Mesh(
            np.concatenate([np.zeros((0, 3)), *self._vertices]).astype(np.float32),
            np.concatenate([np.zeros((0, 3), int), *self._faces]).astype(np.int32),
            np.concatenate([np.zeros(0, int), *self._material]).astype(np.int16),
        )

    def _append(self, vertices: Array, faces: Array, material: Array) -> None:
        self._vertices.append(vertices)
        self._faces.append(faces + self._count)
        self._material.append(material)
        self._count += len(vertices)


# vertices [m] and faces; unnamed sizes, because one call may hand over several patches
Patch = tuple[Float[Array, "_ 3"], Int[Array, "_ 3"]]
EMPTY: Patch = (np.zeros((0, 3)), np.zeros((0, 3), int))


def join(patches: Iterable[Patch]) -> Patch:
    """Join several patches into one."""
    vertices, faces, count = [EMPTY[0]], [EMPTY[1]], 0
    for v, f in patches:
        vertices.append(np.asarray(v, float))
        faces.append(np.asarray(f, int) + count)
        count += len(v)
    return np.concatenate(vertices), np.concatenate(faces)


def polygons(shape: BaseGeometry) -> list[Polygon]:
    """List the polygons of any plan geometry without slivers."""
    parts = [shape] if isinstance(shape, Polygon) else shapely.get_parts(shapely.get_parts(shape))
    return [p for p in parts if isinstance(p, Polygon) and p.area > SLIVER_M2]


def outline(polygon: Polygon, tolerance_m: float) -> Polygon:
    """Outline of a polygon with fewer corners, counter-clockwise."""
    return shapely.geometry.polygon.orient(polygons(polygon.simplify(tolerance_m))[0])


def cut_into_tiles(shape: BaseGeometry, size_m: float = 60.0) -> list[Polygon]:
    """Cut a shape along a square grid [m], for ear clipping, which is quadratic in a polygon's corners."""
    pieces = []
    for polygon in polygons(shape):
        west, south, east, north = polygon.bounds
        if max(east - west, north - south) <= size_m:
            pieces.append(polygon)
            continue
        if max(east - west, north - south) > _COARSE_TILES * size_m:  # first into coarse tiles: clipping a
            coarse = cut_into_tiles(polygon, _COARSE_TILES / 2 * size_m)  # large polygon often is slow
            pieces += [piece for part in coarse for piece in cut_into_tiles(part, size_m)]
            continue
        for x in np.arange(math.floor(west / size_m), math.ceil(east / size_m)) * size_m:
            for y in np.arange(math.floor(south / size_m), math.ceil(north / size_m)) * size_m:
                pieces += polygons(clip(polygon, Extent(x, y, x + size_m, y + size_m)))
    return pieces


def clip(shape: BaseGeometry, bounds_m: tuple[float, float, float, float]) -> BaseGeometry:
    """Clip a shape to west, south, east, north. [m]"""
    try:
        return shapely.clip_by_rect(shape, *bounds_m)
    except shapely.GEOSException:  # clip_by_rect fails on slivers along the rectangle
        return shape.intersection(shapely.box(*bounds_m))


def flat(shape: BaseGeometry, height_m: float) -> Patch:
    """Level surface over a plan shape with its holes, facing up."""
    if not (parts := polygons(shape)):
        return EMPTY
    rings, part = shapely.get_rings(parts, return_index=True)
    closed, ring = shapely.get_coordinates(rings, return_index=True)
    inner = np.append(ring[1:] == ring[:-1], False)  # each ring's last corner is its first
    corners, ring = closed[inner], ring[inner]
    faces, first = [EMPTY[1]], 0
    for sizes in np.split(np.bincount(ring), np.flatnonzero(np.diff(part)) + 1):
        last = first + sizes.sum()
        cut = mapbox_earcut.triangulate_float64(corners[first:last], np.cumsum(sizes, dtype=np.uint32))
        faces.append(cut.reshape(-1, 3).astype(int) + first)
        first = last
    vertices = np.column_stack([corners, np.full(len(corners), height_m)])
    return facing_up((vertices, np.concatenate(faces)))


def facing_up(patch: Patch) -> Patch:
    """Orient every face of a patch so that its normal points up."""
    vertices, faces = patch
    (ax, ay), (bx, by), (cx, cy) = vertices[faces, :2].transpose(1, 2, 0)
    down = (bx - ax) * (cy - ay) - (by - ay) * (cx - ax) < 0
    return vertices, np.where(down[:, None], faces[:, ::-1], faces)


def walls(shape: BaseGeometry, bottom_m: float, top_m: float, inward: bool = False) -> Patch:
    """Upright walls around a plan shape and its holes, facing away from the shape (or into it)."""
    patches = []
    for polygon in polygons(shape):
        polygon = shapely.geometry.polygon.orient(polygon)
        for ring in (polygon.exterior, *polygon.interiors):
            corners = np.asarray(ring.coords)[:, :2]
            a, b = corners[:-1], corners[1:]
            patches.append(upright(a, b, bottom_m, top_m) if not inward else upright(b, a, bottom_m, top_m))
    return join(patches)


def upright(
    start: Float[Array, "n 2"], end: Float[Array, "n 2"], bottom_m: ArrayLike, top_m: ArrayLike
) -> Patch:
    """Upright rectangles from ``start`` to ``end``, facing right of that direction."""
    low, high = (np.broadcast_to(height, len(start)) for height in (bottom_m, top_m))
    corners = np.stack([np.c_[start, low], np.c_[end, low], np.c_[end, high], np.c_[start, high]], axis=1)
    base = 4 * np.arange(len(start))[:, None]
    return corners.reshape(-1, 3), np.vstack([base + [0, 1, 2], base + [0, 2, 3]])


def extrude(shape: BaseGeometry, bottom_m: float, top_m: float) -> Patch:
    """Extrude a plan shape into a closed prism."""
    vertices, faces = flat(shape, bottom_m)
    return join([walls(shape, bottom_m, top_m), flat(shape, top_m), (vertices, faces[:, ::-1])])


def box_patch(centre: Float[Array, "3"], size: Float[Array, "3"], heading_rad: float = 0.0) -> Patch:
    """Box by centre and (length, width, height), its length along ``heading_rad`` from east, ccw. [m, rad]"""
    unit = np.array(
        [[x, y, z] for z in (-0.5, 0.5) for x, y in ((-0.5, -0.5), (0.5, -0.5), (0.5, 0.5), (-0.5, 0.5))]
    )
    x, y, z = (unit * np.asarray(size, float)).T
    c, s = math.cos(heading_rad), math.sin(heading_rad)
    vertices = np.c_[x * c - y * s, x * s + y * c, z] + np.asarray(centre, float)
    quads = [(0, 3, 2, 1), (4, 5, 6, 7), (0, 1, 5, 4), (1, 2, 6, 5), (2, 3, 7, 6), (3, 0, 4, 7)]
    return vertices, np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], dtype=int)


class BoundingRectangle(NamedTuple):
    """Smallest rectangle around a footprint: centre, unit vector of its long axis, length and width. [m]"""

    centre: Float[Array, "2"]
    axis: Float[Array, "2"]
    length: float
    width: float


def bounding_rectangle(shape: Polygon) -> BoundingRectangle:
    """Find the smallest rectangle around a footprint."""
    corners = shapely.get_coordinates(shapely.minimum_rotated_rectangle(shape))[:4]
    first, second = corners[1] - corners[0], corners[2] - corners[1]
    length, width = np.hypot(*first), np.hypot(*second)
    axis = first / max(length, 1e-9)
    if length < width:
        length, width, axis = width, length, second / max(width, 1e-9)
    return BoundingRectangle(corners.mean(axis=0), axis, float(length), float(width))


def gable_or_hip_roof(
    shape: Polygon, eaves_m: float, slope_rad: float, hip: bool, overhang_m: float = 0.4
) -> tuple[Patch, Patch]:
    """Gable or hip roof over a footprint's smallest rectangle, as a closed solid.

    Parameters
    ----------
    shape
        Footprint.
    eaves_m
        Height of the eaves. [m]
    slope_rad
        Slope of the planes. [rad]
    hip
        Four planes; else two planes and two gable walls.
    overhang_m
        Overhang of the roof beyond the walls. [m]

    Returns
    -------
    The roof planes, and the rest (gables and underside).
    """
    centre, axis, length, width = bounding_rectangle(shape)
    half_length, half_width = length / 2 + overhang_m, width / 2 + overhang_m
    ridge = eaves_m + half_width * math.tan(slope_rad)
    ridge_half = half_length - (min(half_width, 0.9 * half_length) if hip else 0.0)
    across = np.array([-axis[1], axis[0]])
    u = np.array([-half_length, half_length, half_length, -half_length, -ridge_half, ridge_half])[:, None]
    v = np.array([-half_width, -half_width, half_width, half_width, 0.0, 0.0])[:, None]
    vertices = np.c_[centre + u * axis + v * across, [eaves_m] * 4 + [ridge] * 2]
    planes = [(0, 1, 5), (0, 5, 4), (2, 3, 4), (2, 4, 5)]
    ends = [(1, 2, 5), (3, 0, 4)]
    underside = [(0, 3, 2), (0, 2, 1)]
    if hip:
        return (vertices, np.array(planes + ends)), (vertices, np.array(underside))
    return (vertices, np.array(planes)), (vertices, np.array(ends + underside))


def mansard_roof(shape: Polygon, eaves_m: float, slope_rad: float, inset_m: float) -> tuple[Patch, Patch]:
    """Roof of any footprint: planes rising inward from the eaves to a flat top.

    Returns
    -------
    The sloping planes and the flat top; without planes where the footprint is too narrow for the inset.
    """
    inner = shape.buffer(-inset_m, join_style="mitre", mitre_limit=3)
    if len(polygons(inner)) != 1 or inner.area < 0.1 * shape.area:
        return EMPTY, flat(shape, eaves_m)
    top = eaves_m + inset_m * math.tan(slope_rad)
    vertices, faces = flat(shape.difference(inner), eaves_m)
    on_edge = shapely.distance(shapely.points(vertices[:, :2]), shape.boundary) < 0.5 * inset_m
    raised = np.c_[vertices[:, :2], np.where(on_edge, eaves_m, top)]
    return facing_up((raised, faces)), flat(inner, top)


def parapet_roof(shape: Polygon, deck_m: float, parapet_m: float) -> tuple[Patch, Patch]:
    """Flat roof behind a parapet: the deck, and the parapet's inner face and coping."""
    inner = shape.buffer(-0.3, join_style="mitre")
    if not polygons(inner):
        return flat(shape, deck_m), EMPTY
    top = deck_m + parapet_m
    coping = join([flat(shape.difference(inner), top), walls(inner, deck_m, top, inward=True)])
    return flat(inner, deck_m), coping
