"""What `trace` keeps from frame to frame: the intersector with its meshes, built once for a scene."""

import importlib.util
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from jaxtyping import Float

from ..scene import Mesh, Snapshot
from .bvh import BvhTracer
from .embree import EmbreeTracer
from .resolve import FaceTable

Array = np.ndarray


class Tracer(Protocol):
    """An intersector: one static mesh and any number of instances of a few models."""

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances."""
        ...

    def intersect(self, origins: Array, directions: Array) -> tuple[Array, Array, Array, Array]:
        """Nearest hits: range, primitive, slot, barycentric."""
        ...

    def transmitted(self, origins: Array, directions: Array, wanted: Array) -> Array:
        """Part of the light that comes along each ray."""
        ...


@dataclass(frozen=True)
class SceneTracer:
    """A scene made ready for rays.

    Parameters
    ----------
    rays
        The intersector.
    faces
        All meshes, in the intersector's order.
    fixed
        How many instances stand still, `Snapshot.fixed`.
    """

    rays: Tracer
    faces: FaceTable
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
    """Embree where its wheel is installed, else the tree in numba, which is several times slower."""
    return EmbreeTracer if importlib.util.find_spec("embreex") else BvhTracer


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
    sorted_meshes = [_closed_first(mesh, gap_fraction) for mesh in (snapshot.static, *snapshot.models)]
    meshes, gaps = tuple(m for m, _ in sorted_meshes), tuple(g for _, g in sorted_meshes)
    rays = intersector()(meshes[0], meshes[1:], snapshot.transforms[fixed], snapshot.model[fixed], gaps)
    return SceneTracer(rays, FaceTable.of(meshes), snapshot.fixed)


def _closed_first(mesh: Mesh, gap_fraction: Array | None) -> tuple[Mesh, Float[Array, "face"]]:
    """The mesh with its faces without holes first, and the gap of each face."""
    gap = np.zeros(len(mesh.faces), np.float32)
    if gap_fraction is None or len(mesh.faces) == 0:
        return mesh, gap
    own = mesh.material >= 0  # a vehicle's paint has no holes
    gap[own] = np.asarray(gap_fraction, dtype=np.float32)[mesh.material[own]]
    order = np.argsort(gap > 0, kind="stable")
    return Mesh(mesh.vertices, mesh.faces[order], mesh.material[order]), gap[order]
