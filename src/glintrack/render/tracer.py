"""Acceleration structures of a scene, built once for all frames, and its sunlight at one time."""

import importlib.util
import math
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.render.light.heights import solid_heights
from glintrack.render.light.lattice import AS_FACETS, BY_SIDES, IN_SPACE
from glintrack.render.light.probes import SceneProbes
from glintrack.render.light.sky import SUN_RADIUS_RAD
from glintrack.render.rays import surfaces
from glintrack.render.rays.bvh import BvhTracer
from glintrack.render.rays.embree import EmbreeTracer
from glintrack.scene import Mesh, Snapshot

_VEHICLE_M = (19.0, 4.0, 5.0)  # largest vehicle, along its own axes
_EDGE_M = 1e-2
_STEEP = 0.9  # upward component of normals
_REACH = 4.0  # heights of what rises, as far as its shade on the sky is followed
_ABOVE_M = 10.0  # start of rays over the highest object
_RISES_M = 0.5  # over the ground at the scene's edge: what is lower shades nothing


@dataclass(frozen=True)
class SceneTracer:
    """Intersector, faces and probes of a scene.

    Parameters
    ----------
    rays
        The intersector.
    faces
        All meshes, in the intersector's order.
    probes
        Light of sky and surroundings on the fixed parts of the scene.
    sheets
        Materials of leaf cards: those with a gap fraction.
    role, boxes
        How the instances of each model find their probes (`lattice`), and its lower and upper corner. [m]
    fixed
        Number of instances that never move, `Snapshot.fixed`.
    busy
        Lock of the thread with the placed snapshot.
    """

    rays: surfaces.Tracer
    faces: surfaces.FaceTable
    probes: SceneProbes
    sheets: Bool[Array, "material"]
    role: Int[Array, "model"]
    boxes: Float[Array, "model 2 3"]
    fixed: int
    busy: threading.RLock = field(default_factory=threading.RLock, repr=False, compare=False)

    @contextmanager
    def hold(self, snapshot: Snapshot) -> Iterator[None]:
        """Place the moving instances of a snapshot and keep other threads from moving them.

        Raises
        ------
        ValueError
            If the snapshot has another number of fixed instances than the one this was built from.
        """
        if snapshot.fixed != self.fixed:
            raise ValueError(
                f"`snapshot.fixed` must be {self.fixed}, as when the tracer was built; got {snapshot.fixed}."
            )
        with self.busy:
            self.rays.update(snapshot.transforms[self.fixed :], snapshot.model[self.fixed :])
            yield


def intersector() -> type[EmbreeTracer] | type[BvhTracer]:
    """Return Embree where its wheel is installed, else, with a warning, the slower tree in numba."""
    if importlib.util.find_spec("embreex"):
        return EmbreeTracer
    warnings.warn(
        "`embreex` is not installed: rays are traced by numba, several times slower (pip install embreex; "
        "it has wheels for Linux, Windows and macOS on x86-64, and for macOS 13 on Apple silicon)",
        stacklevel=2,
    )
    return BvhTracer


def build_tracer(
    snapshot: Snapshot,
    gap_fraction: Float[Array, "material"] | None = None,
    shares: Float[Array, "row class"] | None = None,
    window: tuple[float, float, float, float] | None = None,
) -> SceneTracer:
    """Build the acceleration structure of a scene's static mesh, models and fixed instances, for all frames.

    Parameters
    ----------
    snapshot
        The scene at any time.
    gap_fraction
        Gap fraction of each material (leaf cards); 0 by default. [1]
    shares
        `gather.MaterialClasses.shares`; by default light from surfaces is the frame's mean.
    window
        West, south, east, north of the finest lattice of probes; everywhere by default. [m]

    Raises
    ------
    ValueError
        If the scene has no triangle.
    """
    if len(snapshot.static.faces) + sum(len(m.faces) for m in snapshot.models) == 0:
        raise ValueError("`snapshot` must hold at least one triangle; got an empty scene.")
    fixed = slice(0, snapshot.fixed)
    model, paint = snapshot.model[fixed], snapshot.paint[fixed]
    painted = [(snapshot.static, paint[:0]), *((m, paint[model == k]) for k, m in enumerate(snapshot.models))]
    sorted_meshes = [_sort_by_gap(mesh, paints, gap_fraction) for mesh, paints in painted]
    meshes, gaps = tuple(mesh for mesh, _ in sorted_meshes), tuple(gap for _, gap in sorted_meshes)
    sheets = np.zeros(0, np.bool_) if gap_fraction is None else np.asarray(gap_fraction) > 0
    role, boxes = _roles(snapshot, sheets)
    box = standing_box(snapshot)
    west_south, east_north = (corner[:2] for corner in box)
    heights = partial(solid_heights, snapshot, sheets, window or (*west_south, *east_north))
    return SceneTracer(
        rays=intersector()(meshes[0], meshes[1:], snapshot.transforms[fixed], model, gaps),
        faces=surfaces.FaceTable.of(meshes),
        probes=SceneProbes(box, window, shares, heights),
        sheets=sheets,
        role=role,
        boxes=boxes,
        fixed=snapshot.fixed,
    )


def _roles(snapshot: Snapshot, sheets: Array) -> tuple[Int[Array, "model"], Float[Array, "model 2 3"]]:
    """Role of each model (in space: with leaf cards; by its sides: as small as a vehicle) and its box."""
    models, model, paint = snapshot.models, np.asarray(snapshot.model), np.asarray(snapshot.paint)
    role, boxes = np.full(len(models), AS_FACETS, np.int8), np.zeros((len(models), 2, 3))
    leaves = np.flatnonzero(sheets)
    for k, mesh in enumerate(models):
        if len(mesh.vertices) == 0:
            continue
        boxes[k] = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
        own = np.union1d(mesh.material, paint[model == k])  # a tree's species is its instance's paint
        if np.isin(own, leaves).any():
            role[k] = IN_SPACE
        elif (boxes[k, 1] - boxes[k, 0] < _VEHICLE_M).all():
            role[k] = BY_SIDES
    return role, boxes


def standing_box(snapshot: Snapshot) -> tuple[Array, Array]:
    """Corners of the box beyond which the fixed scene shades no sky. [m]"""
    vertices = np.asarray(snapshot.static.vertices, float).reshape(-1, 3)
    faces = np.asarray(snapshot.static.faces).reshape(-1, 3)
    level = vertices[faces, 2].min() if len(faces) else 0.0
    rising = np.zeros(len(vertices), np.bool_)
    rising[faces[_rises(vertices, faces)]] = True
    corners = [vertices[rising]]
    for k, mesh in enumerate(snapshot.models):
        transforms = np.asarray(snapshot.transforms)[: snapshot.fixed][snapshot.model[: snapshot.fixed] == k]
        if len(transforms) and len(mesh.vertices):
            box = surfaces.box_corners(mesh.vertices) @ transforms[:, :, :3].swapaxes(1, 2)
            corners.append((box + transforms[:, None, :, 3]).reshape(-1, 3))
    every = np.concatenate(corners)
    if len(every) == 0:
        return np.full(3, np.inf), np.full(3, -np.inf)
    low, high = every.min(axis=0), every.max(axis=0)
    reach = _REACH * (high[2] - min(low[2], level))
    return low - [reach, reach, 0.0], high + [reach, reach, 0.0]


def _rises(vertices: Float[Array, "vertex 3"], faces: Int[Array, "face 3"]) -> Bool[Array, "face"]:
    """Mask of the faces that are steep or rise over the ground at the scene's edge."""
    if len(faces) == 0:
        return np.zeros(0, np.bool_)
    x, y, z = (np.ascontiguousarray(axis)[faces] for axis in vertices.T)
    edge = np.zeros(x.shape, np.bool_)
    for across in (x, y):
        edge |= (across <= across.min() + _EDGE_M) | (across >= across.max() - _EDGE_M)
    level = z[edge].min() + _RISES_M
    (ax, ay, az), (bx, by, bz) = ([axis[:, k] - axis[:, 0] for axis in (x, y, z)] for k in (1, 2))
    nx, ny, nz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    steep = np.abs(nz) < _STEEP * np.sqrt(nx * nx + ny * ny + nz * nz)
    around = (edge & (z <= level)).any(axis=1)
    return steep | (~around & (z.max(axis=1) > level))


def _sort_by_gap(mesh: Mesh, paints: Array, gap_fraction: Array | None) -> tuple[Mesh, Float[Array, "face"]]:
    """Sort faces without holes first, and return the gap of each face.

    The instances of a model share its holes: painted faces get the mean gap of the instances' paints.
    """
    gap = np.zeros(len(mesh.faces), np.float32)
    if gap_fraction is None or len(mesh.faces) == 0:
        return mesh, gap
    gap_fraction, own = np.asarray(gap_fraction, dtype=np.float32), mesh.material >= 0
    gap[own] = gap_fraction[mesh.material[own]]
    if len(paints):
        gap[~own] = gap_fraction[paints].mean()
    order = np.argsort(gap > 0, kind="stable")
    return Mesh(mesh.vertices, mesh.faces[order], mesh.material[order]), gap[order]


@dataclass(frozen=True)
class SunlitScene:
    """A scene with its instances placed, under its sun; rays meet all of it or the fixed part."""

    tracer: SceneTracer
    snapshot: Snapshot
    surroundings: int
    sun: Array
    past: surfaces.Past = "all"

    def meet(
        self, origins: Array, starts: Array, directions: Array, coherent: bool = False
    ) -> surfaces.SurfaceHits:
        """Find the surfaces that rays meet; ``starts`` are their origins in single precision."""
        met = self.tracer.rays.intersect(starts, directions, coherent, self.past)
        known = self.tracer.faces, self.snapshot, self.surroundings, self.sun, self.tracer.sheets
        return surfaces.resolve(origins, directions, met, *known)

    def sunlight(
        self, seen: surfaces.SurfaceHits, samples: int = 1, coherent: bool = False
    ) -> Float[Array, "ray"]:
        """Transmittance of the sun's light to each surface, by rays to points of its disc. [1]"""
        light = np.zeros(len(seen.sun_cosine), np.float32)
        # full packets are traced faster
        some = slice(None) if coherent else np.flatnonzero(seen.sun_cosine)
        start, wanted = seen.lifted[some], seen.sun_cosine[some] != 0
        for direction in _sun_disc(self.sun, samples):
            light[some] += self.tracer.rays.transmittance(start, direction[None], wanted, coherent, self.past)
        return light / np.float32(samples)


def _sun_disc(sun: Float[Array, "3"], samples: int) -> Float[Array, "sample 3"]:
    """Directions toward points spread evenly over the sun's disc; its centre for a single one. [1]"""
    k = np.arange(samples)
    across = 0.0 if samples == 1 else np.tan(SUN_RADIUS_RAD) * np.sqrt((k + 0.5) / samples)
    turn = math.pi * (3 - math.sqrt(5)) * k  # the golden angle: a sunflower's seeds
    level = np.array([-sun[1], sun[0], 0.0]) if abs(sun[2]) < 0.9 else np.array([0.0, -sun[2], sun[1]])
    level /= np.linalg.norm(level)
    upright = np.cross(sun, level)
    directions = sun + (across * np.cos(turn))[:, None] * level + (across * np.sin(turn))[:, None] * upright
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


def surface_model(
    tracer: SceneTracer, snapshot: Snapshot, area_m: tuple[float, float, float, float], step_m: float
) -> xr.Dataset:
    """Surface model of the fixed scene.

    Parameters
    ----------
    tracer
        Tracer of the scene. Its moving instances are removed until the next `SceneTracer.hold`.
    snapshot
        The scene at any time.
    area_m
        West, south, east, north, ENU. [m]
    step_m
        Spacing of the rays, one a cell. [m]

    Returns
    -------
    Schema ``terrain``: height of the first ground, roof or leaf that a ray from above meets. Rays pass
    through the holes of crowns. 0 beyond the scene's edge. [m]

    Raises
    ------
    ValueError
        If the area is less than two cells wide or high.
    """
    west, south, east, north = area_m
    columns, rows = int((east - west) / step_m), int((north - south) / step_m)
    if min(columns, rows) < 2:
        raise ValueError(f"`area_m` must hold two cells of {step_m:g} m a side at least; got {area_m}.")
    x = west + step_m * (np.arange(columns) + 0.5)
    y = north - step_m * (np.arange(rows) + 0.5)
    height, down = np.empty((rows, columns)), np.tile(np.array([0, 0, -1], np.float32), (columns, 1))
    top = float(standing_box(snapshot)[1][2]) + _ABOVE_M
    with tracer.busy:
        tracer.rays.update(surfaces.NO_TRANSFORMS, surfaces.NO_MODELS)
        for row, y_m in enumerate(y):
            origins = np.stack([x, np.full(columns, y_m), np.full(columns, top)], axis=1).astype(np.float32)
            reach = tracer.rays.intersect(origins, down).range_m
            height[row] = np.where(np.isfinite(reach), top - reach, 0.0)
    unit = {"units": "m"}
    return xr.Dataset(
        {"height": (("y", "x"), height, unit)}, coords={"y": ("y", y, unit), "x": ("x", x, unit)}
    )
