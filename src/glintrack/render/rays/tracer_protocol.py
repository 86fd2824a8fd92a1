"""Protocol of an intersector."""

from typing import Literal, Protocol

from glintrack.core.arrays import Array

Past = Literal["all", "still"]


class Tracer(Protocol):
    """An intersector: one static mesh and any number of instances of a few models."""

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances."""
        ...

    def intersect(
        self, origins: Array, directions: Array, coherent: bool = False, past: Past = "all"
    ) -> tuple[Array, Array, Array, Array]:
        """Nearest hits: range, primitive, slot, barycentric; ``coherent`` rays are neighbours."""
        ...

    def transmitted(
        self,
        origins: Array,
        directions: Array,
        wanted: Array,
        coherent: bool = False,
        past: Past = "all",
    ) -> Array:
        """Part of the light that comes along each ray, past everything or a part of it."""
        ...
