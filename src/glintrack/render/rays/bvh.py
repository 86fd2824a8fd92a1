"""A two-level tree of bounding boxes in numba: the intersector where no Embree wheel exists.

Each mesh has a tree over its triangles, built once; above them are two trees over instances, one of what
stands still and one of what moves. Trees are split by the surface-area heuristic in bins (Wald, "On fast
Construction of SAH-based Bounding Volume Hierarchies", 2007), triangles are met by Möller and Trumbore's
test (1997), in double precision because a ray is 3 km long.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.rays.surfaces import LEAST_LIGHT, NO_HIT, Intersections, Past, is_hole
from glintrack.scene import Mesh

_BINS = 16
_TRIANGLES_PER_LEAF = 4
_INSTANCES_PER_LEAF = 1
_DEPTH = 64  # of the traversal's stack: one entry a level
_LEAST_RAYS = 1024  # of a thread's slice

_MISS = np.inf


class BvhTracer:
    """A `Tracer` in numba; rays are traced one by one, whatever their order."""

    def __init__(
        self,
        static: Mesh,
        models: tuple[Mesh, ...],
        fixed_transforms: Array | None = None,
        fixed_models: Array | None = None,
        gaps: tuple[Float[Array, "_"], ...] | None = None,
    ):
        meshes = (static, *models)
        gaps = gaps or tuple(np.zeros(len(m.faces), np.float32) for m in meshes)
        trees = [_mesh_tree(mesh, gap) for mesh, gap in zip(meshes, gaps, strict=True)]
        node_start = np.cumsum([0, *(len(t[0]) for t in trees)])
        face_start = np.cumsum([0, *(len(t[2]) for t in trees)])
        self._meshes = (
            np.concatenate([t[0] for t in trees]),
            np.concatenate([t[1] for t in trees]),
            np.concatenate([t[2] for t in trees]),
            np.concatenate([t[3] for t in trees]),
            np.concatenate([t[4] for t in trees]),
            node_start,
            face_start,
        )
        self._boxes = [_corners(mesh) for mesh in meshes]
        if fixed_transforms is None or fixed_models is None:
            fixed_transforms, fixed_models = np.zeros((0, 3, 4)), np.zeros(0, int)
        whole = np.concatenate([np.eye(3, 4)[None], np.asarray(fixed_transforms, float).reshape(-1, 3, 4)])
        submodels = np.concatenate([[0], np.asarray(fixed_models, int) + 1])
        self._still = self._instances(whole, submodels, 0)
        self._first_moving = len(submodels)
        self.update(np.zeros((0, 3, 4)), np.zeros(0, int))

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances, see `Tracer.update`."""
        submodels = np.asarray(models, int) + 1
        self._moving = self._instances(np.asarray(transforms, float), submodels, self._first_moving)

    def intersect(
        self, origins: Array, directions: Array, coherent: bool = False, past: Past = "all"
    ) -> Intersections:
        """Nearest hits of rays, see `Tracer.intersect`."""
        del coherent
        out = Intersections.empty(len(directions))
        query = (*self._scene(past), origins, directions)
        over_rows(_intersect, len(directions), *query, out, least=_LEAST_RAYS)
        return out

    def transmittance(
        self, origins: Array, directions: Array, wanted: Array, coherent: bool = False, past: Past = "all"
    ) -> Array:
        """Part of the light that comes along each ray, see `Tracer.transmittance`."""
        del coherent
        out = np.zeros(len(wanted), np.float32)
        query = (*self._scene(past), origins, directions, wanted)
        over_rows(_transmit, len(wanted), *query, out, least=_LEAST_RAYS)
        return out

    def _scene(self, past: Past):
        """Meshes, and trees over the instances that stand still and that move."""
        nothing = self._instances(np.zeros((0, 3, 4)), np.zeros(0, int), 0)
        return self._meshes, self._still, self._moving if past == "all" else nothing

    def _instances(self, transforms: Array, submodels: Array, first_slot: int):
        """Tree over instances: nodes, links, world to model, submodels, slots."""
        kept = [k for k, m in enumerate(submodels) if len(self._boxes[m])]
        low, high = np.empty((len(kept), 3), np.float32), np.empty((len(kept), 3), np.float32)
        for row, k in enumerate(kept):
            corners = self._boxes[submodels[k]] @ transforms[k, :, :3].T + transforms[k, :, 3]
            # outward by what rounding to float32 may take away
            low[row] = np.nextafter(corners.min(axis=0).astype(np.float32), np.float32(-np.inf))
            high[row] = np.nextafter(corners.max(axis=0).astype(np.float32), np.float32(np.inf))
        nodes, links, order = _build(low, high, _INSTANCES_PER_LEAF)
        chosen = np.array(kept, int)[order]
        turned = np.linalg.inv(transforms[chosen, :, :3])
        shift = -np.einsum("kij,kj->ki", turned, transforms[chosen, :, 3])
        inverse = np.ascontiguousarray(np.concatenate([turned, shift[:, :, None]], axis=2))
        return nodes, links, inverse, np.asarray(submodels, np.int64)[chosen], first_slot + chosen


def _corners(mesh: Mesh) -> Float[Array, "_ 3"]:
    """The eight corners of a mesh's bounding box; none if the mesh is empty."""
    if len(mesh.faces) == 0:
        return np.zeros((0, 3))
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    return np.stack(np.meshgrid(*np.stack([low, high], axis=1).astype(float), indexing="ij"), -1).reshape(
        -1, 3
    )


def _mesh_tree(mesh: Mesh, gap: Float[Array, "face"]) -> tuple[Array, Array, Array, Array, Array]:
    """Nodes, links, triangles (corner, two edges), the face each is, and its gaps, in the tree's order."""
    corners = np.asarray(mesh.vertices, dtype=np.float32)[mesh.faces].reshape(-1, 3, 3)
    low, high = corners.min(axis=1), corners.max(axis=1)
    nodes, links, order = _build(low, high, _TRIANGLES_PER_LEAF)
    a, b, c = corners[order, 0], corners[order, 1], corners[order, 2]
    triangles = np.ascontiguousarray(np.concatenate([a, b - a, c - a], axis=1))
    return nodes, links, triangles, order.astype(np.int32), np.asarray(gap, dtype=np.float32)[order]


def _build(
    low: Float[Array, "box 3"], high: Float[Array, "box 3"], per_leaf: int
) -> tuple[Float[Array, "node 6"], Int[Array, "node 2"], Int[Array, "box"]]:
    """Tree over boxes: bounds of each node; (first child, −1) or (first box, count); order of the boxes."""
    if len(low) == 0:
        return np.zeros((0, 6), np.float32), np.zeros((0, 2), np.int32), np.zeros(0, np.int64)
    return _split(np.ascontiguousarray(low), np.ascontiguousarray(high), per_leaf)


@nb.njit(nogil=True, cache=True)
def _split(low, high, per_leaf):
    count = low.shape[0]
    order = np.arange(count)
    nodes = np.empty((2 * count, 6), np.float32)
    links = np.empty((2 * count, 2), np.int32)
    pending = np.empty((2 * _DEPTH + 2, 4), np.int64)
    pending[0, 0], pending[0, 1], pending[0, 2], pending[0, 3] = 0, 0, count, 0
    waiting, used = 1, 1
    while waiting > 0:
        waiting -= 1
        node, start, stop, depth = pending[waiting]
        for k in range(3):
            nodes[node, k], nodes[node, 3 + k] = np.inf, -np.inf
        for q in range(start, stop):
            for k in range(3):
                nodes[node, k] = min(nodes[node, k], low[order[q], k])
                nodes[node, 3 + k] = max(nodes[node, 3 + k], high[order[q], k])
        if stop - start <= per_leaf:
            links[node, 0], links[node, 1] = start, stop - start
            continue
        # past half the stack's depth halve by number, which bounds what is left
        middle = _best_cut(low, high, order, start, stop) if depth < _DEPTH // 2 else (start + stop) // 2
        links[node, 0], links[node, 1] = used, -1
        for side in range(2):
            pending[waiting, 0] = used + side
            pending[waiting, 1] = start if side == 0 else middle
            pending[waiting, 2] = middle if side == 0 else stop
            pending[waiting, 3] = depth + 1
            waiting += 1
        used += 2
    return nodes[:used].copy(), links[:used].copy(), order


@nb.njit(cache=True)
def _best_cut(low, high, order, start, stop):
    """Sort ``order[start:stop]`` about the plane of least cost and return where the second part begins."""
    best_cost, best_axis, best_bin, best_low, best_scale = np.inf, -1, 0, 0.0, 0.0
    counts = np.empty(_BINS, np.int64)
    bounds = np.empty((_BINS, 6))
    right_cost = np.empty(_BINS)
    running = np.empty(6)
    for axis in range(3):
        least, most = np.inf, -np.inf
        for q in range(start, stop):
            centre = 0.5 * (float(low[order[q], axis]) + high[order[q], axis])
            least, most = min(least, centre), max(most, centre)
        if most - least < 1e-9:
            continue
        scale = _BINS / (most - least)
        counts[:] = 0
        bounds[:, :3], bounds[:, 3:] = np.inf, -np.inf
        for q in range(start, stop):
            i = order[q]
            b = min(int((0.5 * (float(low[i, axis]) + high[i, axis]) - least) * scale), _BINS - 1)
            counts[b] += 1
            for k in range(3):
                bounds[b, k] = min(bounds[b, k], low[i, k])
                bounds[b, 3 + k] = max(bounds[b, 3 + k], high[i, k])
        running[:3], running[3:], total = np.inf, -np.inf, 0
        for b in range(_BINS - 1, 0, -1):
            total += counts[b]
            right_cost[b] = total * _grow(running, bounds[b])
        running[:3], running[3:], total = np.inf, -np.inf, 0
        for b in range(_BINS - 1):
            total += counts[b]
            area = _grow(running, bounds[b])
            if 0 < total < stop - start and total * area + right_cost[b + 1] < best_cost:
                best_cost = total * area + right_cost[b + 1]
                best_axis, best_bin, best_low, best_scale = axis, b, least, scale
    if best_axis < 0:
        return (start + stop) // 2
    i, j = start, stop - 1
    while i <= j:
        centre = 0.5 * (float(low[order[i], best_axis]) + high[order[i], best_axis])
        if min(int((centre - best_low) * best_scale), _BINS - 1) <= best_bin:
            i += 1
        else:
            order[i], order[j] = order[j], order[i]
            j -= 1
    return i


@nb.njit(cache=True)
def _grow(running, box):
    """Enlarge a box by another; returns half its surface, 0 while it is empty."""
    for k in range(3):
        running[k], running[3 + k] = min(running[k], box[k]), max(running[3 + k], box[3 + k])
    x, y, z = running[3] - running[0], running[4] - running[1], running[5] - running[2]
    return x * y + y * z + z * x if x >= 0 else 0.0


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
def _walk_mesh(meshes, mesh, ox, oy, oz, dx, dy, dz, far, light, stack, light_only):
    """Meet one mesh nearer than ``far``: distance, u, v, light left, and the face met, −1 for none.

    With ``light_only`` every face met takes its share of the light and the distance stays.
    """
    nodes, links, triangles, faces, gaps, node_start, face_start = meshes
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    root, base, found, at_u, at_v = node_start[mesh], face_start[mesh], -1, 0.0, 0.0
    if node_start[mesh + 1] == root or _enter(nodes, root, ox, oy, oz, ix, iy, iz, far) == _MISS:
        return far, at_u, at_v, light, found
    stack[0], depth = root, 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if links[node, 1] < 0:
            a, b = root + links[node, 0], root + links[node, 0] + 1
            enter_a = _enter(nodes, a, ox, oy, oz, ix, iy, iz, far)
            enter_b = _enter(nodes, b, ox, oy, oz, ix, iy, iz, far)
            if enter_a > enter_b:
                a, b, enter_a, enter_b = b, a, enter_b, enter_a
            if enter_b != _MISS:
                stack[depth] = b
                depth += 1
            if enter_a != _MISS:
                stack[depth] = a
                depth += 1
            continue
        for q in range(base + links[node, 0], base + links[node, 0] + links[node, 1]):
            distance, u, v = _meet(triangles, q, ox, oy, oz, dx, dy, dz)
            if not 0 < distance < far:
                continue
            if light_only:
                light *= gaps[q]
                if light < LEAST_LIGHT:
                    return far, u, v, 0.0, faces[q]
            elif gaps[q] == 0 or not is_hole(faces[q], u, v, gaps[q]):
                far, at_u, at_v, found = distance, u, v, faces[q]
    return far, at_u, at_v, light, found


@nb.njit(cache=True)
def _walk_instances(meshes, instances, ox, oy, oz, dx, dy, dz, nearest, stacks, light_only):
    """Meet all instances of a tree; ``nearest`` is (distance, u, v, light, face, slot) and is improved."""
    nodes, links, inverses, submodels, slots = instances
    if nodes.shape[0] == 0:
        return
    ix, iy, iz = _inverse(dx), _inverse(dy), _inverse(dz)
    stacks[0, 0], depth = 0, 1
    while depth > 0:
        depth -= 1
        node = stacks[0, depth]
        if _enter(nodes, node, ox, oy, oz, ix, iy, iz, nearest[0]) == _MISS:
            continue
        if links[node, 1] < 0:
            stacks[0, depth], stacks[0, depth + 1] = links[node, 0], links[node, 0] + 1
            depth += 2
            continue
        for k in range(links[node, 0], links[node, 0] + links[node, 1]):
            far, u, v, light, face = _walk_mesh(
                meshes,
                submodels[k],
                inverses[k, 0, 0] * ox + inverses[k, 0, 1] * oy + inverses[k, 0, 2] * oz + inverses[k, 0, 3],
                inverses[k, 1, 0] * ox + inverses[k, 1, 1] * oy + inverses[k, 1, 2] * oz + inverses[k, 1, 3],
                inverses[k, 2, 0] * ox + inverses[k, 2, 1] * oy + inverses[k, 2, 2] * oz + inverses[k, 2, 3],
                inverses[k, 0, 0] * dx + inverses[k, 0, 1] * dy + inverses[k, 0, 2] * dz,
                inverses[k, 1, 0] * dx + inverses[k, 1, 1] * dy + inverses[k, 1, 2] * dz,
                inverses[k, 2, 0] * dx + inverses[k, 2, 1] * dy + inverses[k, 2, 2] * dz,
                nearest[0],
                nearest[3],
                stacks[1],
                light_only,
            )
            nearest[3] = light
            if face >= 0:
                nearest[0], nearest[1], nearest[2], nearest[4], nearest[5] = far, u, v, face, slots[k]
            if light == 0.0:
                return


@nb.njit(cache=True)
def _follow(meshes, still, moving, origins, directions, i, nearest, stacks, light_only):
    """One ray through what stands still and what moves."""
    o, d = i if origins.shape[0] > 1 else 0, i if directions.shape[0] > 1 else 0
    ox, oy, oz = float(origins[o, 0]), float(origins[o, 1]), float(origins[o, 2])
    dx, dy, dz = float(directions[d, 0]), float(directions[d, 1]), float(directions[d, 2])
    nearest[0], nearest[3], nearest[4], nearest[5] = np.inf, 1.0, -1.0, -1.0
    _walk_instances(meshes, still, ox, oy, oz, dx, dy, dz, nearest, stacks, light_only)
    if nearest[3] > 0:
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
