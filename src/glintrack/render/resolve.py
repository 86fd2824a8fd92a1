"""From what an intersector says (primitive, slot, barycentrics) to point, normal, material and vehicle."""

from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from ..scene import Mesh, Snapshot
from ..threads import over_rows

Array = np.ndarray
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


@dataclass(frozen=True)
class Surfaces:
    """Where rays landed; see `Hits` for the fields.

    Parameters
    ----------
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
    lifted: Float[Array, "ray 3"]
    sun_cosine: Float[Array, "ray"]


def resolve(
    origins: Float[Array, "_ 3"],
    directions: Float[Array, "ray 3"],
    met: tuple[Array, Array, Array, Array],
    faces: FaceTable,
    snapshot: Snapshot,
    surroundings: int,
    sun_direction: Float[Array, "3"],
    sheets: Bool[Array, "material"],
) -> Surfaces:
    """Surfaces that rays met.

    Parameters
    ----------
    origins, directions
        As they were traced; one common origin or one for each ray. [m, 1]
    met
        What `Tracer.intersect` returned for them.
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
    count = len(directions)
    ranges, primitives, slots, barycentrics = met
    found = Surfaces(
        np.empty((count, 3), np.float32),
        np.empty((count, 3), np.float32),
        np.empty(count, np.float32),
        np.empty(count, np.int16),
        np.empty(count, np.int32),
        np.empty((count, 3), np.float32),
        np.empty(count, np.float32),
    )
    over_rows(
        _resolve,
        count,
        np.asarray(origins, dtype=np.float64),
        directions,
        ranges,
        primitives,
        slots,
        barycentrics,
        (faces.vertices, faces.corners, faces.start, faces.material),
        np.asarray(snapshot.transforms, dtype=np.float64),
        np.asarray(snapshot.model, dtype=np.int64),
        np.asarray(snapshot.paint, dtype=np.int16),
        np.asarray(snapshot.vehicle_id, dtype=np.int32),
        np.int16(surroundings),
        np.asarray(sun_direction, dtype=np.float64),
        np.asarray(sheets, dtype=np.bool_),
        found.point,
        found.normal,
        found.range_m,
        found.material,
        found.vehicle_id,
        found.lifted,
        found.sun_cosine,
        least=1024,
    )
    return found


@nb.njit(nogil=True, cache=True)
def _resolve(
    start,
    stop,
    origins,
    directions,
    ranges,
    primitives,
    slots,
    barycentrics,
    faces,
    transforms,
    models,
    paints,
    vehicle_ids,
    surroundings,
    sun,
    sheets,
    point,
    normal,
    range_m,
    material,
    vehicle_id,
    lifted,
    sun_cosine,
):
    """Hit point from barycentrics (not from o + t·d, which is too coarse for shadows), normal and ids."""
    vertices, corner, face_start, face_material = faces
    p, e, f, n = np.empty(3), np.empty(3), np.empty(3), np.empty(3)
    for i in range(start, stop):
        d = directions[i]
        vehicle_id[i] = -1
        range_m[i] = ranges[i]
        if primitives[i] == NO_HIT:
            lens = origins[i if origins.shape[0] > 1 else 0]
            material[i] = _miss(lens, d, surroundings, point[i], normal[i], range_m[i : i + 1])
            for c in range(3):
                lifted[i, c] = point[i, c] + SHADOW_OFFSET_M * normal[i, c]
            sun_cosine[i] = max(normal[i, 2] * sun[2], 0.0)
            continue
        instance = np.int64(slots[i]) - 1
        mesh = 0 if instance < 0 else models[instance] + 1
        face = face_start[mesh] + np.int64(primitives[i])
        a, b, c3 = corner[face, 0], corner[face, 1], corner[face, 2]
        u, v = barycentrics[i, 0], barycentrics[i, 1]
        for c in range(3):
            e[c] = vertices[b, c] - vertices[a, c]
            f[c] = vertices[c3, c] - vertices[a, c]
            p[c] = vertices[a, c] + u * e[c] + v * f[c]
        n[0], n[1], n[2] = e[1] * f[2] - e[2] * f[1], e[2] * f[0] - e[0] * f[2], e[0] * f[1] - e[1] * f[0]
        if instance >= 0:  # a rotation and a uniform scale: the normal turns as the body does
            t = transforms[instance]
            for c in range(3):
                e[c] = t[c, 0] * p[0] + t[c, 1] * p[1] + t[c, 2] * p[2] + t[c, 3]
                f[c] = t[c, 0] * n[0] + t[c, 1] * n[1] + t[c, 2] * n[2]
            p[:], n[:] = e, f
            vehicle_id[i] = vehicle_ids[instance]
        length = (n[0] * n[0] + n[1] * n[1] + n[2] * n[2]) ** 0.5
        if length == 0.0:  # a sliver without area has no normal: let it face the camera
            n[0], n[1], n[2], length = -d[0], -d[1], -d[2], 1.0
        scale = (-1.0 if n[0] * d[0] + n[1] * d[1] + n[2] * d[2] > 0 else 1.0) / length
        for c in range(3):
            point[i, c] = p[c]
            normal[i, c] = scale * n[c]
        m = face_material[face]
        material[i] = m if m >= 0 else paints[instance]
        cosine = scale * (n[0] * sun[0] + n[1] * sun[1] + n[2] * sun[2])
        side = SHADOW_OFFSET_M
        if cosine < 0:
            if material[i] < sheets.size and sheets[material[i]]:
                side = -SHADOW_OFFSET_M
            else:
                cosine = 0.0
        sun_cosine[i] = cosine
        for c in range(3):
            lifted[i, c] = p[c] + side * (scale * n[c])


@nb.njit(cache=True)
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
