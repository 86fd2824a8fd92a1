"""State of `trace` from frame to frame: the intersector with its meshes, built once for a scene."""

import importlib.util
import warnings
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float

from glintrack.arrays import Array
from glintrack.render.rays.bvh import BvhTracer
from glintrack.render.rays.embree import EmbreeTracer
from glintrack.render.rays.resolve import FaceTable
from glintrack.render.rays.tracer_protocol import Tracer
from glintrack.render.sky_view import SkyProbes
from glintrack.scene import Mesh, Snapshot


@dataclass(frozen=True)
class SceneTracer:
    """A scene made ready for rays.

    Parameters
    ----------
    rays
        The intersector.
    faces
        All meshes, in the intersector's order.
    sky
        Sky view of what stands still.
    sheets
        Materials of leaf cards: those with a gap fraction.
    fixed
        How many instances stand still, `Snapshot.fixed`.
    """

    rays: Tracer
    faces: FaceTable
    sky: SkyProbes
    sheets: Bool[Array, "material"]
    fixed: int

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


def build_tracer(snapshot: Snapshot, gap_fraction: Float[Array, "material"] | None = None) -> SceneTracer:
    """Acceleration structure of a scene's static mesh, models and fixed instances, to be kept over frames.

    Parameters
    ----------
    snapshot
        The scene at any time.
    gap_fraction
        Part of a face of each material that is holes (leaf cards); none by default. [1]

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
    sky = SkyProbes(rays, *standing_box(snapshot))
    sheets = np.zeros(0, np.bool_) if gap_fraction is None else np.asarray(gap_fraction) > 0
    return SceneTracer(rays, FaceTable.of(meshes), sky, sheets, snapshot.fixed)


def standing_box(snapshot: Snapshot) -> tuple[Array, Array]:
    """Corners of the box that holds all that stands still. [m]"""
    low, high = [np.zeros(3)], [np.zeros(3)]
    if len(snapshot.static.vertices):
        low, high = [snapshot.static.vertices.min(axis=0)], [snapshot.static.vertices.max(axis=0)]
    for k, mesh in enumerate(snapshot.models):
        transforms = np.asarray(snapshot.transforms)[: snapshot.fixed][snapshot.model[: snapshot.fixed] == k]
        if len(transforms) and len(mesh.vertices):
            ends = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
            corners = np.stack(np.meshgrid(*np.stack(ends, axis=1), indexing="ij"), -1).reshape(-1, 3)
            placed = np.einsum("kij,cj->kci", transforms[:, :, :3], corners) + transforms[:, None, :, 3]
            low.append(placed.min(axis=(0, 1)))
            high.append(placed.max(axis=(0, 1)))
    return np.min(low, axis=0), np.max(high, axis=0)


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
