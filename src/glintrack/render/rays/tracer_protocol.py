"""What the renderer asks of an intersector."""

from typing import Literal, Protocol

from glintrack.arrays import Array

Past = Literal["all", "still"]
TILE = 4  # a packet of a frame is a square of rays, which part less than a row does


class Tracer(Protocol):
    """An intersector: one static mesh and any number of instances of a few models."""

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances."""
        ...

    def intersect(
        self, origins: Array, directions: Array, width: int = 0
    ) -> tuple[Array, Array, Array, Array]:
        """Nearest hits: range, primitive, slot, barycentric; ``width`` rays make a row of a frame."""
        ...

    def transmitted(
        self,
        origins: Array,
        directions: Array,
        wanted: Array,
        width: int = 0,
        past: Past = "all",
    ) -> Array:
        """Part of the light that comes along each ray, past everything or a part of it."""
        ...
