"""What `trace` keeps from frame to frame: the intersector with its meshes, built once for a scene."""

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from ..scene import Snapshot
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

    def occluded(self, origins: Array, directions: Array, wanted: Array) -> Array:
        """Whether anything lies ahead."""
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


def build_tracer(snapshot: Snapshot) -> SceneTracer:
    """Acceleration structure of a scene's static mesh, models and fixed instances, to be kept over frames.

    Raises
    ------
    ValueError
        If there is nothing in the scene.
    """
    if len(snapshot.static.faces) + sum(len(m.faces) for m in snapshot.models) == 0:
        raise ValueError("`snapshot` must hold at least one triangle, got an empty scene")
    fixed = slice(0, snapshot.fixed)
    rays = EmbreeTracer(snapshot.static, snapshot.models, snapshot.transforms[fixed], snapshot.model[fixed])
    return SceneTracer(rays, FaceTable.of((snapshot.static, *snapshot.models)), snapshot.fixed)
