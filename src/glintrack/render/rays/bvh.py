"""A two-level tree of bounding boxes in numba: the intersector where no Embree wheel exists.

Each mesh has a tree over its triangles, built once. Above them are two trees over instances, one of the fixed
and one of the moving ones. Trees are split by the surface-area heuristic (Wald, "On fast Construction of
SAH-based Bounding Volume Hierarchies", 2007). Triangles are intersected by Möller and Trumbore's test (1997),
in double precision because a ray is 3 km long.
"""

import math
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.rays.surfaces import (
    MIN_LIGHT,
    NO_HIT,
    NO_MODELS,
    NO_TRANSFORMS,
    Intersections,
    Past,
    box_corners,
    is_hole,
    turn_vector,
)
from glintrack.scene import Mesh

_TRIANGLES_PER_LEAF = 4
_INSTANCES_PER_LEAF = 1
_DEPTH = 64  # of the traversal's stack: one entry a level
_MIN_RAYS = 1024  # of a thread's slice

_MISS = np.inf


class BoxTree(NamedTuple):
    """Bounds of each node; (first child, −1) or (first box, count) of each; order of the boxes in leaves."""

    nodes: Float[Array, "node 6"]
    links: Int[Array, "node 2"]
    order: Int[Array, "box"]


class MeshTrees(NamedTuple):
    """Trees over the triangles (corner, two edges) of meshes, and each triangle's face number and gap."""

    nodes: Float[Array, "node 6"]
    links: Int[Array, "node 2"]
    triangles: Float[Array, "triangle 9"]
    faces: Int[Array, "triangle"]
    gaps: Float[Array, "triangle"]
    node_start: Int[Array, "mesh+1"]
    face_start: Int[Array, "mesh+1"]


class InstanceTree(NamedTuple):
    """Tree over instances: transforms from world to model, mesh and slot of each."""

    nodes: Float[Array, "node 6"]
    links: Int[Array, "node 2"]
    inverses: Float[Array, "instance 3 4"]
    submodels: Int[Array, "instance"]
    slots: Int[Array, "instance"]


class BvhTracer:
    """A `Tracer` in numba; rays are traced one by one, whatever their order."""

    def __init__(
        self,
        static: Mesh,
        models: tuple[Mesh, ...],
        fixed_transforms: Array = NO_TRANSFORMS,
        fixed_models: Array = NO_MODELS,
        gaps: tuple[Float[Array, "_"], ...] | None = None,
    ):
        meshes = (static, *models)
        gaps = gaps or tuple(np.zeros(len(m.faces), np.float32) for m in meshes)
        self._meshes = _mesh_trees(meshes, gaps)
        self._boxes = [box_corners(m.vertices) if len(m.faces) else np.zeros((0, 3)) for m in meshes]
        self._nothing = self._moving = self._instances(NO_TRANSFORMS, NO_MODELS, 0)
        whole = np.concatenate([np.eye(3, 4)[None], np.asarray(fixed_transforms, float)])
        submodels = np.concatenate([[0], np.asarray(fixed_models, int) + 1])
        self._still, self._first_moving = self._instances(whole, submodels, 0), len(submodels)

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances, see `Tracer.update`."""
        submodels = np.asarray(models, int) + 1
        self._moving = self._instances(np.asarray(transforms, float), submodels, self._first_moving)

    def intersect(
        self, origins: Array, directions: Array, coherent: bool = False, past: Past = "all"
    ) -> Intersections:
        """Find the nearest hits of rays, see `Tracer.intersect`."""
        del coherent
        out, moving = Intersections.empty(len(directions)), self._moving if past == "all" else self._nothing
        query = self._meshes, self._still, moving, origins, directions
        over_rows(_intersect, len(directions), *query, out, least=_MIN_RAYS)
        return out

    def transmittance(
        self, origins: Array, directions: Array, wanted: Array, coherent: bool = False, past: Past = "all"
    ) -> Array:
        """Transmittance along each ray, see `Tracer.transmittance`. [1]"""
        del coherent
        out, moving = np.zeros(len(wanted), np.float32), self._moving if past == "all" else self._nothing
        query = self._meshes, self._still, moving, origins, directions
        over_rows(_transmit, len(wanted), *query, wanted, out, least=_MIN_RAYS)
        return out

    def _instances(self, transforms: Array, submodels: Array, first_slot: int) -> InstanceTree:
        chosen = np.array([k for k, m in enumerate(submodels) if len(self._boxes[m])], int)
        boxes = np.array([self._boxes[m] for m in submodels[chosen]]).reshape(-1, 8, 3)
        transforms = transforms[chosen]
        corners = boxes @ transforms[:, :, :3].transpose(0, 2, 1) + transforms[:, None, :, 3]
        # outward by what rounding to float32 may take away
        low = np.nextafter(corners.min(axis=1).astype(np.float32), np.float32(-np.inf))
        high = np.nextafter(corners.max(axis=1).astype(np.float32), np.float32(np.inf))
        tree = BoxTree(*_split(low, high, _INSTANCES_PER_LEAF))
        turned = np.linalg.inv(transforms[tree.order, :, :3])
        shift = -np.einsum("kij,kj->ki", turned, transforms[tree.order, :, 3])
        inverse = np.concatenate([turned, shift[:, :, None]], axis=2)
        chosen = chosen[tree.order]
        return InstanceTree(tree.nodes, tree.links, inverse, submodels[chosen], first_slot + chosen)


def _mesh_trees(meshes: tuple[Mesh, ...], gaps: tuple[Array, ...]) -> MeshTrees:
    corners = [np.asarray(m.vertices, np.float32)[m.faces].reshape(-1, 3, 3) for m in meshes]
    trees = [BoxTree(*_split(c.min(axis=1), c.max(axis=1), _TRIANGLES_PER_LEAF)) for c in corners]
    ordered = [own[tree.order] for own, tree in zip(corners, trees, strict=True)]
    a, b, c = np.concatenate(ordered).transpose(1, 0, 2)
    return MeshTrees(
        nodes=np.concatenate([tree.nodes for tree in trees]),
        links=np.concatenate([tree.links for tree in trees]),
        triangles=np.concatenate([a, b - a, c - a], axis=1),
        faces=np.concatenate([tree.order for tree in trees]).astype(np.int32),
        gaps=np.concatenate([g[tree.order] for g, tree in zip(gaps, trees, strict=True)]).astype(np.float32),
        node_start=np.cumsum([0, *(len(tree.nodes) for tree in trees)]),
        face_start=np.cumsum([0, *(len(tree.order) for tree in trees)]),
    )


@nb.njit(nogil=True, cache=True)
def _split(low, high, per_leaf):
    count = low.shape[0]
    order, pending, used = np.arange(count), [(0, 0, count, 0)], min(count, 1)
    nodes, links = np.empty((2 * count, 6), np.float32), np.empty((2 * count, 2), np.int32)
    while len(pending) > 0 and count > 0:
        node, start, stop, depth = pending.pop()
        for k in range(3):
            nodes[node, k], nodes[node, 3 + k] = np.inf, -np.inf
            for box in order[start:stop]:
                nodes[node, k] = min(nodes[node, k], low[box, k])
                nodes[node, 3 + k] = max(nodes[node, 3 + k], high[box, k])
        if stop - start <= per_leaf:
            links[node, 0], links[node, 1] = start, stop - start
            continue
        middle = (start + stop) // 2
        if depth < _DEPTH // 2:  # past half the stack's depth halve by number, which bounds what is left
            middle = start + _sort_about_cut(low, high, order[start:stop])
        links[node, 0], links[node, 1] = used, -1
        pending.append((used, start, middle, depth + 1))
        pending.append((used + 1, middle, stop, depth + 1))
        used += 2
    return nodes[:used].copy(), links[:used].copy(), order


@nb.njit(cache=True)
def _sort_about_cut(low, high, order):
    """Sort boxes along the axis with the cut of least cost and return the number of boxes before it."""
    boxes, least_cost, before_cut = order.copy(), np.inf, 0
    number = np.arange(1, len(boxes))
    for axis in range(3):
        ranked = boxes[np.argsort(low[boxes, axis] + high[boxes, axis])]
        before = _growing_surfaces(low, high, ranked)[:-1]
        after = _growing_surfaces(low, high, ranked[::-1])[::-1][1:]
        costs = number * before + number[::-1] * after
        cut = np.argmin(costs)
        if costs[cut] < least_cost:
            least_cost, before_cut = costs[cut], int(cut) + 1
            order[:] = ranked
    return before_cut


@nb.njit(cache=True)
def _growing_surfaces(low, high, boxes):
    """Half the surface of the box around the first, the first two, ... of some boxes."""
    out, least, most = np.empty(len(boxes)), low[boxes[0]].copy(), high[boxes[0]].copy()
    for i in range(len(boxes)):
        for k in range(3):
            least[k], most[k] = min(least[k], low[boxes[i], k]), max(most[k], high[boxes[i], k])
        x, y, z = most[0] - least[0], most[1] - least[1], most[2] - least[2]
        out[i] = x * y + y * z + z * x
    return out


@nb.njit(cache=True)
def _enter(nodes, k, ox, oy, oz, ix, iy, iz, far):
    """Distance at which a ray enters box k, `_MISS` if it does not before ``far``."""
    t0, t1 = (nodes[k, 0] - ox) * ix, (nodes[k, 3] - ox) * ix
    near, away = max(0.0, min(t0, t1)), min(far, max(t0, t1))
    t0, t1 = (nodes[k, 1] - oy) * iy, (nodes[k, 4] - oy) * iy
    near, away = max(near, min(t0, t1)), min(away, max(t0, t1))
    t0, t1 = (nodes[k, 2] - oz) * iz, (nodes[k, 5] - oz) * iz
    near, away = max(near, min(t0, t1)), min(away, max(t0, t1))
    # a flat box is as thin as rounding: a little is added so that its own face is not lost
    return near if near <= away * (1 + 1e-12) else _MISS


@nb.njit(cache=True)
def _inverse(d):
    return 1.0 / d if abs(d) > 1e-30 else math.copysign(1e30, d)


@nb.njit(cache=True)
def _meet(triangles, q, ox, oy, oz, dx, dy, dz):
    """Distance and barycentrics at which a ray meets triangle q, distance −1 for not at all."""
    e1x, e1y, e1z = float(triangles[q, 3]), float(triangles[q, 4]), float(triangles[q, 5])
    e2x, e2y, e2z = float(triangles[q, 6]), float(triangles[q, 7]), float(triangles[q, 8])
    px, py, pz = dy * e2z - dz * e2y, dz * e2x - dx * e2z, dx * e2y - dy * e2x
    determinant = e1x * px + e1y * py + e1z * pz
    if determinant == 0.0:
        return -1.0, 0.0, 0.0
    inverse = 1.0 / determinant
    tx, ty, tz = ox - triangles[q, 0], oy - triangles[q, 1], oz - triangles[q, 2]
    u = (tx * px + ty * py + tz * pz) * inverse
    if u < 0 or u > 1:
        return -1.0, 0.0, 0.0
    qx, qy, qz = ty * e1z - tz * e1y, tz * e1x - tx * e1z, tx * e1y - ty * e1x
    v = (dx * qx + dy * qy + dz * qz) * inverse
    if v < 0 or u + v > 1:
        return -1.0, 0.0, 0.0
    return (e2x * qx + e2y * qy + e2z * qz) * inverse, u, v


@nb.njit(cache=True)
def _walk_mesh(meshes, mesh, slot, ox, oy, oz, dx, dy, dz, nearest, stack, light_only):
    """Meet one mesh; ``nearest`` is (distance, u, v, light, face, slot) and is improved.

    With ``light_only`` every face met takes its share of the light and the distance stays.
    """
    nodes, links, gaps, root = meshes.nodes, meshes.links, meshes.gaps, meshes.node_start[mesh]
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    if (
        meshes.node_start[mesh + 1] == root
        or _enter(nodes, root, ox, oy, oz, ix, iy, iz, nearest[0]) == _MISS
    ):
        return
    stack[0], depth = root, 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if links[node, 1] < 0:
            a, b = root + links[node, 0], root + links[node, 0] + 1
            enter_a = _enter(nodes, a, ox, oy, oz, ix, iy, iz, nearest[0])
            enter_b = _enter(nodes, b, ox, oy, oz, ix, iy, iz, nearest[0])
            if enter_a > enter_b:
                a, b, enter_a, enter_b = b, a, enter_b, enter_a
            if enter_b != _MISS:
                stack[depth] = b
                depth += 1
            if enter_a != _MISS:
                stack[depth] = a
                depth += 1
            continue
        first = meshes.face_start[mesh] + links[node, 0]
        for q in range(first, first + links[node, 1]):
            distance, u, v = _meet(meshes.triangles, q, ox, oy, oz, dx, dy, dz)
            if not 0 < distance < nearest[0]:
                continue
            if light_only:
                nearest[3] *= gaps[q]
                if nearest[3] < MIN_LIGHT:
                    nearest[3] = 0.0
                    return
            elif gaps[q] == 0 or not is_hole(meshes.faces[q], u, v, gaps[q]):
                nearest[0], nearest[1], nearest[2] = distance, u, v
                nearest[4], nearest[5] = meshes.faces[q], slot


@nb.njit(cache=True)
def _walk_instances(meshes, instances, ox, oy, oz, dx, dy, dz, nearest, stacks, light_only):
    """Meet all instances of a tree; ``nearest`` as in `_walk_mesh`."""
    nodes, links = instances.nodes, instances.links
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    stacks[0, 0], depth = 0, min(len(nodes), 1)
    while depth > 0 and nearest[3] > 0:
        depth -= 1
        node = stacks[0, depth]
        if _enter(nodes, node, ox, oy, oz, ix, iy, iz, nearest[0]) == _MISS:
            continue
        if links[node, 1] < 0:
            stacks[0, depth], stacks[0, depth + 1] = links[node, 0], links[node, 0] + 1
            depth += 2
            continue
        for k in range(links[node, 0], links[node, 0] + links[node, 1]):
            m = instances.inverses[k]
            px, py, pz = turn_vector(m, ox, oy, oz)
            px, py, pz = px + m[0, 3], py + m[1, 3], pz + m[2, 3]
            tx, ty, tz = turn_vector(m, dx, dy, dz)
            mesh, slot = instances.submodels[k], instances.slots[k]
            _walk_mesh(meshes, mesh, slot, px, py, pz, tx, ty, tz, nearest, stacks[1], light_only)


@nb.njit(cache=True)
def _follow(meshes, still, moving, origins, directions, i, nearest, stacks, light_only):
    """One ray through the fixed and the moving instances."""
    o, d = i if origins.shape[0] > 1 else 0, i if directions.shape[0] > 1 else 0
    ox, oy, oz = float(origins[o, 0]), float(origins[o, 1]), float(origins[o, 2])
    dx, dy, dz = float(directions[d, 0]), float(directions[d, 1]), float(directions[d, 2])
    nearest[0], nearest[3], nearest[4], nearest[5] = np.inf, 1.0, -1.0, -1.0
    _walk_instances(meshes, still, ox, oy, oz, dx, dy, dz, nearest, stacks, light_only)
    _walk_instances(meshes, moving, ox, oy, oz, dx, dy, dz, nearest, stacks, light_only)


@nb.njit(nogil=True, cache=True)
def _intersect(start, stop, meshes, still, moving, origins, directions, out):
    nearest, stacks = np.empty(6), np.empty((2, 2 * _DEPTH), np.int64)
    for i in range(start, stop):
        _follow(meshes, still, moving, origins, directions, i, nearest, stacks, False)
        out.range_m[i] = nearest[0]
        out.face[i] = np.uint32(nearest[4]) if nearest[4] >= 0 else NO_HIT
        out.slot[i] = np.uint32(nearest[5]) if nearest[4] >= 0 else NO_HIT
        out.barycentric[i, 0], out.barycentric[i, 1] = nearest[1], nearest[2]


@nb.njit(nogil=True, cache=True)
def _transmit(start, stop, meshes, still, moving, origins, directions, wanted, light):
    nearest, stacks = np.empty(6), np.empty((2, 2 * _DEPTH), np.int64)
    for i in range(start, stop):
        if wanted[i]:
            _follow(meshes, still, moving, origins, directions, i, nearest, stacks, True)
            light[i] = nearest[3]
