"""A scene made ready for rays, built once and kept over frames, and its sunlight at one time."""

import importlib.util
import math
import threading
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import lru_cache, partial

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.render.light.heights import solid_heights
from glintrack.render.light.lattice import AS_FACETS, BY_SIDES, IN_SPACE
from glintrack.render.light.probes import SceneProbes
from glintrack.render.light.sky import SUN_RADIUS_RAD
from glintrack.render.rays.bvh import BvhTracer
from glintrack.render.rays.embree import EmbreeTracer
from glintrack.render.rays.surfaces import FaceTable, Past, SurfaceHits, Tracer, resolve
from glintrack.scene import Mesh, Snapshot

_VEHICLE_M = (19.0, 4.0, 5.0)  # no vehicle is larger, in its own axes
_EDGE_M = 1e-2
_STEEP = 0.9  # upward component of normals
_REACH = 4.0  # heights of what rises, as far as its shade on the sky is followed
_RISES_M = 0.5  # over the ground at the scene's edge: what is lower shades nothing


@dataclass(frozen=True)
class SceneTracer:
    """A scene made ready for rays.

    Parameters
    ----------
    rays
        The intersector.
    faces
        All meshes, in the intersector's order.
    probes
        Light that what stands still gets from sky and surroundings.
    sheets
        Materials of leaf cards: those with a gap fraction.
    role, boxes
        How the instances of each model find their probes (`probes`), and its lower and upper corner. [m]
    fixed
        How many instances stand still, `Snapshot.fixed`.
    busy
        Held by the thread whose snapshot is placed.
    """

    rays: Tracer
    faces: FaceTable
    probes: SceneProbes
    sheets: Bool[Array, "material"]
    role: Int[Array, "model"]
    boxes: Float[Array, "model 2 3"]
    fixed: int
    busy: threading.RLock = field(default_factory=threading.RLock, repr=False, compare=False)

    @contextmanager
    def placed(self, snapshot: Snapshot) -> Iterator[None]:
        """Move what moves to where it is in the snapshot, and let no other thread move it meanwhile."""
        with self.busy:
            self.place(snapshot)
            yield

    def place(self, snapshot: Snapshot) -> None:
        """Move what moves to where it is in the snapshot.

        Raises
        ------
        ValueError
            If the snapshot has another number of fixed instances than the one this was built from.
        """
        if snapshot.fixed != self.fixed:
            raise ValueError(
                f"`snapshot.fixed` must be {self.fixed}, as when the tracer was built, got {snapshot.fixed}"
            )
        self.rays.update(snapshot.transforms[self.fixed :], snapshot.model[self.fixed :])


def intersector() -> type[EmbreeTracer] | type[BvhTracer]:
    """Embree where its wheel is installed, else, with a warning, the several times slower tree in numba."""
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
    """Acceleration structure of a scene's static mesh, models and fixed instances, to be kept over frames.

    Parameters
    ----------
    snapshot
        The scene at any time.
    gap_fraction
        Part of a face of each material that is holes (leaf cards); none by default. [1]
    shares
        `gather.MaterialClasses.shares`; without them light from surfaces is the frame's mean.
    window
        West, south, east, north of where the lattice of probes is finest; everywhere by default. [m]

    Raises
    ------
    ValueError
        If there is nothing in the scene.
    """
    if len(snapshot.static.faces) + sum(len(m.faces) for m in snapshot.models) == 0:
        raise ValueError("`snapshot` must hold at least one triangle, got an empty scene")
    fixed = slice(0, snapshot.fixed)
    gapped = [_closed_first(*mesh_and_paints, gap_fraction) for mesh_and_paints in _meshes(snapshot)]
    meshes, gaps = tuple(mesh for mesh, _ in gapped), tuple(gap for _, gap in gapped)
    rays = intersector()(meshes[0], meshes[1:], snapshot.transforms[fixed], snapshot.model[fixed], gaps)
    sheets = np.zeros(0, np.bool_) if gap_fraction is None else np.asarray(gap_fraction) > 0
    role, boxes = _roles(snapshot, sheets)
    box = standing_box(snapshot)
    west_south, east_north = (corner[:2] for corner in box)
    heights = partial(solid_heights, snapshot, sheets, window or (*west_south, *east_north))
    probes = SceneProbes(box, window, shares, heights)
    return SceneTracer(
        rays=rays,
        faces=FaceTable.of(meshes),
        probes=probes,
        sheets=sheets,
        role=role,
        boxes=boxes,
        fixed=snapshot.fixed,
    )


def _roles(snapshot: Snapshot, sheets: Array) -> tuple[Int[Array, "model"], Float[Array, "model 2 3"]]:
    """What has leaf cards is lit in space, what is as small as a vehicle by its sides, all else by facets."""
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
    """Corners of the box beyond which nothing that stands shades the sky. [m]"""
    vertices = np.asarray(snapshot.static.vertices, float).reshape(-1, 3)
    faces = np.asarray(snapshot.static.faces).reshape(-1, 3)
    level = vertices[faces, 2].min() if len(faces) else 0.0
    rising = np.zeros(len(vertices), np.bool_)
    rising[faces[_rises(vertices, faces)]] = True
    corners = [vertices[rising]]
    for k, mesh in enumerate(snapshot.models):
        transforms = np.asarray(snapshot.transforms)[: snapshot.fixed][snapshot.model[: snapshot.fixed] == k]
        if len(transforms) and len(mesh.vertices):
            ends = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            box = np.stack(np.meshgrid(*np.stack(ends, axis=1), indexing="ij"), -1).reshape(-1, 3)
            placed = np.einsum("kij,cj->kci", transforms[:, :, :3], box) + transforms[:, None, :, 3]
            corners.append(placed.reshape(-1, 3))
    every = np.concatenate(corners)
    if len(every) == 0:
        return np.full(3, np.inf), np.full(3, -np.inf)
    low, high = every.min(axis=0), every.max(axis=0)
    reach = _REACH * (high[2] - min(low[2], level))
    return low - [reach, reach, 0.0], high + [reach, reach, 0.0]


def _rises(vertices: Float[Array, "vertex 3"], faces: Int[Array, "face 3"]) -> Bool[Array, "face"]:
    """Which faces are steep or rise over the ground at the scene's edge."""
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


def _meshes(snapshot: Snapshot) -> list[tuple[Mesh, Array]]:
    """Each mesh, static first, with the paints of its fixed instances."""
    model, paint = snapshot.model[: snapshot.fixed], snapshot.paint[: snapshot.fixed]
    nothing = np.zeros(0, np.int16)
    return [(snapshot.static, nothing), *((m, paint[model == k]) for k, m in enumerate(snapshot.models))]


def _closed_first(mesh: Mesh, paints: Array, gap_fraction: Array | None) -> tuple[Mesh, Float[Array, "face"]]:
    """The mesh with its faces without holes first, and the gap of each face.

    The instances of a model share its holes: painted faces get the mean gap of the paints they come in.
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


_FEW = 0.5  # of surfaces that the sun may light: those alone are gathered into packets


@dataclass(frozen=True)
class Lit:
    """A scene at one time under its sun, with its instances placed; rays go past all of it or a part."""

    tracer: SceneTracer
    snapshot: Snapshot
    surroundings: int
    sun: Array
    past: Past = "all"

    def meet(self, origins: Array, starts: Array, directions: Array, coherent: bool = False) -> SurfaceHits:
        """SurfaceHits that rays meet; ``starts`` are their origins in single precision."""
        met = self.tracer.rays.intersect(starts, directions, coherent, self.past)
        known = self.tracer.faces, self.snapshot, self.surroundings, self.sun, self.tracer.sheets
        return resolve(origins, directions, met, *known)

    def sunlight(self, seen: SurfaceHits, samples: int = 1, coherent: bool = False) -> Float[Array, "ray"]:
        """Part of the sun's light that arrives at each surface, by rays to points of its disc."""
        wanted = seen.sun_cosine != 0
        light = np.zeros(len(wanted), np.float32)
        some, start = slice(None), seen.lifted
        # packets that are full of rays are traced faster
        if not coherent and np.count_nonzero(wanted) < _FEW * len(wanted):
            some = np.flatnonzero(wanted)
            wanted, start = wanted[some], start[some]
        for direction in _sun_disc(self.sun.tobytes(), self.sun.dtype.str, samples):
            light[some] += self.tracer.rays.transmittance(start, direction[None], wanted, coherent, self.past)
        return light / np.float32(samples)


@lru_cache(maxsize=8)  # asked for by every lot of rays
def _sun_disc(toward: bytes, kind: str, samples: int) -> Float[Array, "sample 3"]:
    """Directions toward points spread evenly over the sun's disc; its centre if there is one. [1]"""
    sun = np.frombuffer(toward, kind)
    k = np.arange(samples)
    across = 0.0 if samples == 1 else np.tan(SUN_RADIUS_RAD) * np.sqrt((k + 0.5) / samples)
    turn = math.pi * (3 - math.sqrt(5)) * k  # the golden angle: a sunflower's seeds
    level = np.array([-sun[1], sun[0], 0.0]) if abs(sun[2]) < 0.9 else np.array([0.0, -sun[2], sun[1]])
    level /= np.linalg.norm(level)
    offset = (across * np.cos(turn))[:, None] * level + (across * np.sin(turn))[:, None] * np.cross(
        sun, level
    )
    directions = sun + offset
    return (directions / np.linalg.norm(directions, axis=1, keepdims=True)).astype(np.float32)


_ABOVE_M = 10.0
_ROWS_AT_A_TIME = 256


def surface_model(
    tracer: SceneTracer,
    snapshot: Snapshot,
    area_m: tuple[float, float, float, float],
    step_m: float,
) -> xr.Dataset:
    """Surface model of all that stands still.

    Parameters
    ----------
    tracer
        Of the scene; what moves is taken out of it until the next `SceneTracer.place`.
    snapshot
        The scene at any time.
    area_m
        West, south, east, north, ENU. [m]
    step_m
        Between the rays, one a cell. [m]

    Returns
    -------
    Schema ``terrain``, heights of what a ray from above meets first: of ground, roof, or leaf where none of a
    crown's holes lets it through. 0 where there is nothing, as beyond the scene's edge. [m]

    Raises
    ------
    ValueError
        If the area does not hold two cells a side.
    """
    west, south, east, north = area_m
    columns, rows = int((east - west) / step_m), int((north - south) / step_m)
    if min(columns, rows) < 2:
        raise ValueError(f"`area_m` must hold two cells of {step_m:g} m a side at least, got {area_m}")
    x = west + step_m * (np.arange(columns) + 0.5)
    y = north - step_m * (np.arange(rows) + 0.5)
    with tracer.busy:
        tracer.rays.update(snapshot.transforms[:0], snapshot.model[:0])
        top = float(standing_box(snapshot)[1][2]) + _ABOVE_M
        height = np.empty((rows, columns))
        for start in range(0, rows, _ROWS_AT_A_TIME):
            block = y[start : start + _ROWS_AT_A_TIME]
            origins = np.empty((len(block), columns, 3), np.float32)
            origins[..., 0], origins[..., 1], origins[..., 2] = x[None], block[:, None], top
            down = np.zeros((origins[..., 0].size, 3), np.float32)
            down[:, 2] = -1
            reach = tracer.rays.intersect(origins.reshape(-1, 3), down).range_m.reshape(origins.shape[:2])
            height[start : start + len(block)] = np.where(np.isfinite(reach), top - reach, 0.0)
    metres = {"units": "m"}
    return xr.Dataset(
        {"height": (("y", "x"), height, metres)}, coords={"y": ("y", y, metres), "x": ("x", x, metres)}
    )
