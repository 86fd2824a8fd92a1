"""What an intersector offers, holes of leaf cards, and surfaces from its answers.

An intersector says primitive, slot and barycentrics of a ray's end; `resolve` gives point, normal, material
and vehicle. Leaf cards are sheets that stand for a spray of leaves and are partly holes. A ray of look
meets a card or passes through one of its holes, which are fixed in the card: the same leaves are seen in
every frame. Light on its way to a point is weakened by the mean of what it passes, because an element is
wider than a hole: a crown's shadow is half shade, not a pattern too fine to sample.
"""

import math
from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.scene import Mesh, Snapshot

Past = Literal["all", "still"]


class Intersections(NamedTuple):
    """Nearest hits of some rays.

    Parameters
    ----------
    range_m
        Distance along the ray; infinite for a miss. [m]
    face
        Number of the face in its mesh; `NO_HIT` for a miss.
    slot
        Instance met: 0 for the static mesh, then the fixed and the moving ones; `NO_HIT` for a miss.
    barycentric
        Place on the face. [1]
    """

    range_m: Float[Array, "ray"]
    face: Int[Array, "ray"]
    slot: Int[Array, "ray"]
    barycentric: Float[Array, "ray 2"]

    @classmethod
    def empty(cls, count: int) -> "Intersections":
        """Arrays for so many rays, not yet filled."""
        face, slot = (np.empty(count, np.uint32) for _ in range(2))
        return cls(np.empty(count, np.float32), face, slot, np.empty((count, 2), np.float32))


class Tracer(Protocol):
    """An intersector: one static mesh and any number of instances of a few models.

    It is made of the static mesh, the models, transforms and models of instances that never move (slots from
    1 on), and which part of each face is holes, static mesh first; in a mesh faces without holes come first.
    """

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances; their slots follow those of the fixed ones.

        Parameters
        ----------
        transforms
            Model to world, (k, 3, 4). [m]
        models
            Which model each is, (k,).
        """
        ...

    def intersect(
        self, origins: Array, directions: Array, coherent: bool = False, past: Past = "all"
    ) -> Intersections:
        """Nearest hits of rays.

        Parameters
        ----------
        origins
            One common origin (1, 3) or one for each ray (n, 3), float32. [m]
        directions
            Unit vectors (n, 3), float32. [1]
        coherent
            Whether rays that follow each other are neighbours, of nearly one direction.
        past
            Look at everything, or only at what stands still.
        """
        ...

    def transmittance(
        self, origins: Array, directions: Array, wanted: Array, coherent: bool = False, past: Past = "all"
    ) -> Array:
        """Part of the light that comes along each ray that is ``wanted``: 0 past any face, less past cards.

        Parameters
        ----------
        origins
            (n, 3), or (1, 3) for one common origin, float32. [m]
        directions
            (n, 3), or (1, 3) for one common direction, float32. [1]
        wanted
            (n,) bool; the others come back 0.
        coherent, past
            As for `intersect`.

        Returns
        -------
        (n,) float32, 0 to 1. [1]
        """
        ...


LEAST_LIGHT = 0.02  # light that has passed so many cards is not followed further
_CELLS = 6  # along a face's edges: holes of a tenth to a quarter of a metre in cards of a metre


@nb.njit(nogil=True, cache=True)
def is_hole(face, u, v, gap):
    """Whether a card's point is a hole, for a card of which the part ``gap`` is holes.

    Parameters
    ----------
    face
        Number of the face within its mesh.
    u, v
        Barycentric coordinates of the point. [1]
    gap
        Part of the face that is holes, 0 to 1. [1]

    References
    ----------
    The finaliser of MurmurHash3 (Appleby, public domain) mixes face and cell.
    """
    cell = np.uint32(u * _CELLS) + np.uint32(16) * np.uint32(v * _CELLS)
    mixed = np.uint32(face) * np.uint32(0x9E3779B1) + np.uint32(cell) * np.uint32(0x85EBCA77)
    mixed = np.uint32(mixed ^ (mixed >> np.uint32(16))) * np.uint32(0x85EBCA6B)
    mixed = np.uint32(mixed ^ (mixed >> np.uint32(13))) * np.uint32(0xC2B2AE35)
    mixed = np.uint32(np.uint32(mixed) ^ (np.uint32(mixed) >> np.uint32(16)))
    return np.float64(mixed) < gap * 4294967296.0


_double = np.float64  # in compiled code `float` leaves a float32 as it is
SHADOW_OFFSET_M = 3e-3  # float32 at 3 km needs 1–5 mm along the normal to clear its own facet
NO_HIT = np.uint32(0xFFFFFFFF)  # primitive and slot of a ray that met nothing


@dataclass(frozen=True)
class FaceTable:
    """All meshes of a scene in one: mesh k's faces start at ``start[k]`` (mesh 0 is the static one)."""

    vertices: Float[Array, "vertex 3"]
    corners: Int[Array, "face 3"]
    start: Int[Array, "mesh"]
    material: Int[Array, "face"]

    @classmethod
    def of(cls, meshes: tuple[Mesh, ...]) -> "FaceTable":
        """Join meshes, in the order of an intersector's submodels."""
        vertex_start = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        corners = [m.faces.reshape(-1, 3) + s for m, s in zip(meshes, vertex_start, strict=False)]
        return cls(
            np.concatenate([np.asarray(m.vertices, dtype=np.float32).reshape(-1, 3) for m in meshes]),
            np.concatenate(corners).astype(np.int32),
            np.cumsum([0, *(len(m.faces) for m in meshes)]),
            np.concatenate([np.asarray(m.material, dtype=np.int16) for m in meshes]),
        )

    def facing_up(self, primitive: int, slot: int, snapshot: Snapshot) -> float:
        """Upward component of a face's own normal, not normalised; NaN if nothing was met."""
        if primitive == NO_HIT:
            return np.nan
        mesh = int(snapshot.model[slot - 1]) + 1 if slot else 0
        a, b, c = self.vertices[self.corners[self.start[mesh] + primitive]].astype(float)
        normal = np.cross(b - a, c - a)
        return float(snapshot.transforms[slot - 1][2, :3] @ normal if slot else normal[2])


class SurfaceHits(NamedTuple):
    """Where rays landed; see `Hits` for the fields.

    Parameters
    ----------
    instance
        Which of the snapshot's instances; −1 for the static mesh and for none.
    lifted
        Where further rays start: `SHADOW_OFFSET_M` off the facets, of sheets on the side of the sun. [m]
    sun_cosine
        Cosine of the sun's incidence; where it stands behind the facet negative for sheets and 0 for all
        else; 0 for sky. [1]
    """

    point: Float[Array, "ray 3"]
    normal: Float[Array, "ray 3"]
    range_m: Float[Array, "ray"]
    material: Int[Array, "ray"]
    vehicle_id: Int[Array, "ray"]
    instance: Int[Array, "ray"]
    lifted: Float[Array, "ray 3"]
    sun_cosine: Float[Array, "ray"]

    @classmethod
    def empty(cls, count: int) -> "SurfaceHits":
        """Arrays for so many rays, not yet filled."""
        return cls(
            point=np.empty((count, 3), np.float32),
            normal=np.empty((count, 3), np.float32),
            range_m=np.empty(count, np.float32),
            material=np.empty(count, np.int16),
            vehicle_id=np.empty(count, np.int32),
            instance=np.empty(count, np.int32),
            lifted=np.empty((count, 3), np.float32),
            sun_cosine=np.empty(count, np.float32),
        )


def resolve(
    origins: Float[Array, "_ 3"],
    directions: Float[Array, "ray 3"],
    met: Intersections,
    faces: FaceTable,
    snapshot: Snapshot,
    surroundings: int,
    sun_direction: Float[Array, "3"],
    sheets: Bool[Array, "material"],
) -> SurfaceHits:
    """Surfaces that rays met.

    Parameters
    ----------
    origins, directions
        As they were traced; one common origin or one for each ray. [m, 1]
    met
        From `Tracer.intersect`.
    faces
        Of the same tracer.
    snapshot
        Whose instances were placed.
    surroundings
        Material of the level ground at height 0 (or 1 m below where a ray starts lower than that), seen by
        rays that go down and miss everything.
    sun_direction
        Unit vector toward the sun, ENU. [1]
    sheets
        Materials of leaf cards, which the sun may light from behind.
    """
    scene = _Scene(
        vertices=faces.vertices,
        corners=faces.corners,
        start=faces.start,
        material=faces.material,
        transforms=np.asarray(snapshot.transforms, dtype=np.float64),
        models=np.asarray(snapshot.model, dtype=np.int64),
        paints=np.asarray(snapshot.paint, dtype=np.int16),
        vehicle_ids=np.asarray(snapshot.vehicle_id, dtype=np.int32),
        surroundings=np.int16(surroundings),
        sun=np.asarray(sun_direction, dtype=np.float64),
        sheets=np.asarray(sheets, dtype=np.bool_),
    )
    found, starts = SurfaceHits.empty(len(directions)), np.asarray(origins, dtype=np.float64)
    over_rows(_resolve, len(directions), starts, directions, met, scene, found, least=1024)
    return found


class _Scene(NamedTuple):
    """Faces (`FaceTable`), instances (`Snapshot`), and the rest of `resolve`'s arguments, for the kernel."""

    vertices: Float[Array, "vertex 3"]
    corners: Int[Array, "face 3"]
    start: Int[Array, "mesh"]
    material: Int[Array, "face"]
    transforms: Float[Array, "instance 3 4"]
    models: Int[Array, "instance"]
    paints: Int[Array, "instance"]
    vehicle_ids: Int[Array, "instance"]
    surroundings: np.int16
    sun: Float[Array, "3"]
    sheets: Bool[Array, "material"]


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _resolve(start, stop, origins, directions, met, scene, found):
    """Hit point from barycentrics (not from o + t·d, which is too coarse for shadows), normal and ids."""
    primitives, barycentrics = met.face, met.barycentric
    vertices, transforms, sheets = scene.vertices, scene.transforms, scene.sheets
    point, normal, lifted = found.point, found.normal, found.lifted
    sx, sy, sz = scene.sun[0], scene.sun[1], scene.sun[2]
    last_face, last_instance = np.int64(-1), np.int64(-1)
    ax = ay = az = np.float32(0.0)
    ex = ey = ez = fx = fy = fz = gx = gy = gz = size = 0.0
    for i in range(start, stop):
        found.vehicle_id[i], found.instance[i] = -1, -1
        found.range_m[i] = met.range_m[i]
        if primitives[i] == NO_HIT:
            lens = origins[i if origins.shape[0] > 1 else 0]
            reach = found.range_m[i : i + 1]
            found.material[i] = _miss(lens, directions[i], scene.surroundings, point[i], normal[i], reach)
            for c in range(3):
                lifted[i, c] = point[i, c] + SHADOW_OFFSET_M * normal[i, c]
            found.sun_cosine[i] = max(normal[i, 2] * sz, 0.0)
            continue
        instance = np.int64(met.slot[i]) - 1
        mesh = 0 if instance < 0 else scene.models[instance] + 1
        face, t = scene.start[mesh] + np.int64(primitives[i]), instance
        if face != last_face or instance != last_instance:  # neighbours mostly meet the same
            last_face, last_instance = face, instance
            a, b, c = scene.corners[face, 0], scene.corners[face, 1], scene.corners[face, 2]
            ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
            ex, ey = _double(vertices[b, 0] - ax), _double(vertices[b, 1] - ay)
            fx, fy = _double(vertices[c, 0] - ax), _double(vertices[c, 1] - ay)
            ez, fz = _double(vertices[b, 2] - az), _double(vertices[c, 2] - az)
            gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
            if instance >= 0:  # a rotation and a uniform scale: the normal turns as the body does
                gx, gy, gz = (
                    transforms[t, 0, 0] * gx + transforms[t, 0, 1] * gy + transforms[t, 0, 2] * gz,
                    transforms[t, 1, 0] * gx + transforms[t, 1, 1] * gy + transforms[t, 1, 2] * gz,
                    transforms[t, 2, 0] * gx + transforms[t, 2, 1] * gy + transforms[t, 2, 2] * gz,
                )
            size = math.sqrt(gx * gx + gy * gy + gz * gz)
        nx, ny, nz, length = gx, gy, gz, size
        u, v = _double(barycentrics[i, 0]), _double(barycentrics[i, 1])
        px, py, pz = ax + u * ex + v * fx, ay + u * ey + v * fy, az + u * ez + v * fz
        if instance >= 0:
            px, py, pz = (
                transforms[t, 0, 0] * px
                + transforms[t, 0, 1] * py
                + transforms[t, 0, 2] * pz
                + transforms[t, 0, 3],
                transforms[t, 1, 0] * px
                + transforms[t, 1, 1] * py
                + transforms[t, 1, 2] * pz
                + transforms[t, 1, 3],
                transforms[t, 2, 0] * px
                + transforms[t, 2, 1] * py
                + transforms[t, 2, 2] * pz
                + transforms[t, 2, 3],
            )
            found.vehicle_id[i], found.instance[i] = scene.vehicle_ids[instance], instance
        dx, dy, dz = _double(directions[i, 0]), _double(directions[i, 1]), _double(directions[i, 2])
        if length == 0.0:  # a sliver without area has no normal: let it face the camera
            nx, ny, nz, length = -dx, -dy, -dz, 1.0
        scale = (-1.0 if nx * dx + ny * dy + nz * dz > 0 else 1.0) / length
        nx, ny, nz = scale * nx, scale * ny, scale * nz
        point[i, 0], point[i, 1], point[i, 2] = px, py, pz
        normal[i, 0], normal[i, 1], normal[i, 2] = nx, ny, nz
        m = scene.material[face]
        m = m if m >= 0 else scene.paints[instance]
        found.material[i] = m
        cosine = nx * sx + ny * sy + nz * sz
        side = SHADOW_OFFSET_M
        if cosine < 0:
            if m < sheets.size and sheets[m]:
                side = -SHADOW_OFFSET_M
            else:
                cosine = 0.0
        found.sun_cosine[i] = cosine
        lifted[i, 0], lifted[i, 1], lifted[i, 2] = px + side * nx, py + side * ny, pz + side * nz


@nb.njit(cache=True, error_model="numpy")
def _miss(lens, d, surroundings, point, normal, range_m):
    """Level ground beyond the scene's edge below the horizon, sky above; returns the material."""
    if d[2] >= 0:
        point[:] = 0.0
        normal[:] = 0.0
        return np.int16(-1)
    drop = max(lens[2], 1.0)
    distance = -drop / d[2]
    range_m[0] = distance
    point[0], point[1], point[2] = lens[0] + distance * d[0], lens[1] + distance * d[1], lens[2] - drop
    normal[0], normal[1], normal[2] = 0.0, 0.0, 1.0
    return surroundings
