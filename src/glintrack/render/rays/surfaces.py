"""Interface of an intersector, holes of leaf cards, and the surfaces that rays meet.

An intersector returns the primitive, slot and barycentrics of a ray's end. `resolve` turns them into point,
normal, material and vehicle. Leaf cards are sheets that represent a spray of leaves and are partly holes. A
ray of look meets a card or passes through one of its holes. The holes are fixed in the card, so that every
frame shows the same leaves. Light on its way to a point is weakened by the mean gap of the cards that it
passes, because an element is wider than a hole.
"""

import math
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
        """Allocate arrays for a number of rays."""
        face, slot = (np.empty(count, np.uint32) for _ in range(2))
        return cls(np.empty(count, np.float32), face, slot, np.empty((count, 2), np.float32))


class Tracer(Protocol):
    """An intersector: one static mesh and any number of instances of a few models.

    Constructor arguments: the static mesh, the models, transforms and models of the instances that never move
    (slots from 1 on), and the gap fraction of each face, static mesh first. Faces without holes come first in
    each mesh.
    """

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances; their slots follow those of the fixed ones.

        Parameters
        ----------
        transforms
            Model to world, (k, 3, 4). [m]
        models
            Index of the model of each, (k,).
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
            True if consecutive rays are neighbours with nearly the same direction.
        past
            "all", or "still" for the static mesh and the fixed instances only.
        """
        ...

    def transmittance(
        self, origins: Array, directions: Array, wanted: Array, coherent: bool = False, past: Past = "all"
    ) -> Array:
        """Transmittance along each ray that is ``wanted``: 0 past any face, between 0 and 1 past cards.

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


NO_TRANSFORMS, NO_MODELS = np.zeros((0, 3, 4)), np.zeros(0, np.int64)  # of no instance


def box_corners(points: Float[Array, "point 3"]) -> Float[Array, "8 3"]:
    """Corners of the bounding box of some points."""
    ends = np.stack([points.min(axis=0), points.max(axis=0)], axis=1).astype(float)
    return np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)


MIN_LIGHT = 0.02  # transmittance under which light is not followed further [1]
_CELLS = 6  # along a face's edges: holes of a tenth to a quarter of a metre in cards of a metre


@nb.njit(nogil=True, cache=True)
def is_hole(face, u, v, gap):
    """Return True if a point of a card of gap fraction ``gap`` is a hole.

    Parameters
    ----------
    face
        Number of the face within its mesh.
    u, v
        Barycentric coordinates of the point. [1]
    gap
        Gap fraction of the face, 0 to 1. [1]

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


class FaceTable(NamedTuple):
    """Faces of all meshes of a scene; mesh k starts at ``start[k]`` (mesh 0 is the static one)."""

    vertices: Float[Array, "vertex 3"]
    corners: Int[Array, "face 3"]
    start: Int[Array, "mesh"]
    material: Int[Array, "face"]

    @classmethod
    def of(cls, meshes: tuple[Mesh, ...]) -> "FaceTable":
        """Concatenate meshes, in the order of an intersector's submodels."""
        vertex_start = np.cumsum([0, *(len(m.vertices) for m in meshes)])
        corners = [m.faces.reshape(-1, 3) + s for m, s in zip(meshes, vertex_start, strict=False)]
        return cls(
            np.concatenate([np.asarray(m.vertices, dtype=np.float32).reshape(-1, 3) for m in meshes]),
            np.concatenate(corners).astype(np.int32),
            np.cumsum([0, *(len(m.faces) for m in meshes)]),
            np.concatenate([np.asarray(m.material, dtype=np.int16) for m in meshes]),
        )


def _ids(snapshot: Snapshot) -> Int[Array, "instance"]:
    """Ids of moving vehicles, −2, −3, … of parked ones, −1 of all else."""
    ids = np.array(snapshot.vehicle_id, np.int32)
    ids[snapshot.parked] = -2 - np.arange(len(snapshot.parked))
    return ids


class SurfaceHits(NamedTuple):
    """Surfaces that rays meet; see `Hits` for the other fields.

    Parameters
    ----------
    instance
        Index of the snapshot's instance; −1 for the static mesh and for none.
    lifted
        Origin of further rays: `SHADOW_OFFSET_M` off the facets, of sheets on the side of the sun. [m]
    sun_cosine
        Cosine of the sun's incidence. With the sun behind the facet negative for sheets and 0 for all
        others; 0 for sky. [1]
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
        """Allocate arrays for a number of rays."""
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
    """Find the surfaces that rays meet.

    Parameters
    ----------
    origins, directions
        Rays as traced; one common origin or one for each ray. [m, 1]
    met
        From `Tracer.intersect`.
    faces
        Faces of the same tracer.
    snapshot
        Snapshot with the placed instances.
    surroundings
        Material of the level ground at height 0 (or 1 m below where a ray starts lower than that), seen by
        rays that go down and miss everything.
    sun_direction
        Unit vector toward the sun, ENU. [1]
    sheets
        Materials of leaf cards, which the sun may also light from behind.
    """
    found = SurfaceHits.empty(len(directions))
    instances = (
        np.asarray(snapshot.transforms, dtype=np.float64),
        np.asarray(snapshot.model, dtype=np.int64),
        np.asarray(snapshot.paint, dtype=np.int16),
        _ids(snapshot),
    )
    query = np.asarray(origins, dtype=np.float64), directions, met
    light = np.int16(surroundings), np.asarray(sun_direction, np.float64), np.asarray(sheets, np.bool_)
    over_rows(_resolve, len(directions), *query, faces, *instances, *light, found, least=1024)
    return found


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _resolve(
    start, stop, origins, directions, met, faces, transforms, models, paints, vehicle_ids, surroundings, sun,
    sheets, found,
):  # fmt: skip
    """Hit point from barycentrics (not from o + t·d, which is too coarse for shadows), normal and ids."""
    primitives, barycentrics, vertices = met.face, met.barycentric, faces.vertices
    point, normal, lifted = found.point, found.normal, found.lifted
    sx, sy, sz = sun[0], sun[1], sun[2]
    last_face, last_instance = np.int64(-1), np.int64(-1)
    ax = ay = az = np.float32(0.0)
    ex = ey = ez = fx = fy = fz = gx = gy = gz = size = 0.0
    for i in range(start, stop):
        found.vehicle_id[i], found.instance[i] = -1, -1
        found.range_m[i] = met.range_m[i]
        if primitives[i] == NO_HIT:
            point[i], normal[i], found.material[i] = 0.0, 0.0, -1
            if directions[i, 2] < 0:  # level ground beyond the scene's edge; else sky
                lens = origins[i if origins.shape[0] > 1 else 0]
                drop = max(lens[2], 1.0)
                distance = -drop / directions[i, 2]
                for c in range(2):
                    point[i, c] = lens[c] + distance * directions[i, c]
                point[i, 2], normal[i, 2] = lens[2] - drop, 1.0
                found.range_m[i], found.material[i] = distance, surroundings
            for c in range(3):
                lifted[i, c] = point[i, c] + SHADOW_OFFSET_M * normal[i, c]
            found.sun_cosine[i] = max(normal[i, 2] * sz, 0.0)
            continue
        instance = np.int64(met.slot[i]) - 1
        mesh = 0 if instance < 0 else models[instance] + 1
        face, t = faces.start[mesh] + np.int64(primitives[i]), instance
        if face != last_face or instance != last_instance:  # neighbours mostly meet the same
            last_face, last_instance = face, instance
            a, b, c = faces.corners[face, 0], faces.corners[face, 1], faces.corners[face, 2]
            ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
            ex, ey = _double(vertices[b, 0] - ax), _double(vertices[b, 1] - ay)
            fx, fy = _double(vertices[c, 0] - ax), _double(vertices[c, 1] - ay)
            ez, fz = _double(vertices[b, 2] - az), _double(vertices[c, 2] - az)
            gx, gy, gz = ey * fz - ez * fy, ez * fx - ex * fz, ex * fy - ey * fx
            if instance >= 0:  # a rotation and a uniform scale: the normal turns as the body does
                gx, gy, gz = turn_vector(transforms[t], gx, gy, gz)
            size = math.sqrt(gx * gx + gy * gy + gz * gz)
        nx, ny, nz, length = gx, gy, gz, size
        u, v = _double(barycentrics[i, 0]), _double(barycentrics[i, 1])
        px, py, pz = ax + u * ex + v * fx, ay + u * ey + v * fy, az + u * ez + v * fz
        if instance >= 0:
            px, py, pz = turn_vector(transforms[t], px, py, pz)
            px, py, pz = px + transforms[t, 0, 3], py + transforms[t, 1, 3], pz + transforms[t, 2, 3]
            found.vehicle_id[i], found.instance[i] = vehicle_ids[instance], instance
        dx, dy, dz = _double(directions[i, 0]), _double(directions[i, 1]), _double(directions[i, 2])
        if length == 0.0:  # a sliver without area has no normal: let it face the camera
            nx, ny, nz, length = -dx, -dy, -dz, 1.0
        scale = (-1.0 if nx * dx + ny * dy + nz * dz > 0 else 1.0) / length
        nx, ny, nz = scale * nx, scale * ny, scale * nz
        point[i, 0], point[i, 1], point[i, 2] = px, py, pz
        normal[i, 0], normal[i, 1], normal[i, 2] = nx, ny, nz
        m = faces.material[face]
        m = m if m >= 0 else paints[instance]
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


@nb.njit(cache=True, forceinline=True)
def turn_vector(m, x, y, z):
    """Rotate and scale a vector by the first three columns of a transform."""
    return (
        m[0, 0] * x + m[0, 1] * y + m[0, 2] * z,
        m[1, 0] * x + m[1, 1] * y + m[1, 2] * z,
        m[2, 0] * x + m[2, 1] * y + m[2, 2] * z,
    )
