"""What stands between a point and the sun, read from lists of the faces over each small square of sunlight.

The sun does not move within a flight, so rays toward it are parallel: seen from the sun the scene is a plane
picture, cut into blocks and these into cells, each with the faces that reach over it. A point asks the faces
of its own cell, in the plane: no tree is walked. Blocks are made when a surface in them is first looked at;
what moves is left out, and `light` says which points lie under it.

References
----------
Haines and Greenberg, "The Light Buffer: A Shadow-Testing Accelerator", IEEE CG&A 6(9), 1986.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.arrays import Array
from glintrack.parallel import over_rows
from glintrack.render.rays.light_cells import (
    BLOCK_CELLS,
    RECORD_WORDS,
    UNKNOWN,
    WANTED,
    bound_faces,
    count_cells,
    fill_cells,
    find_light,
    list_boxes,
)
from glintrack.render.rays.resolve import FaceTable

_BLOCK_M = 32.0  # larger where a scene would need more than `_MOST_BLOCKS`
_MOST_BLOCKS = 250_000
_BESIDE_M = 0.01  # boxes of what moves are taken wider than they are by this
_LEAST_RISE = 0.1
_ROW = 1024  # of points that are in no order


@dataclass(frozen=True)
class StandingFaces:
    """All faces that stand still.

    Parameters
    ----------
    faces
        All meshes; the static one first.
    gaps
        Part of each face that is holes. [1]
    transforms, mesh
        Instances that stand still: model to world, and their mesh in ``faces``. [m]
    """

    faces: FaceTable
    gaps: Float[Array, "face"]
    transforms: Float[Array, "instance 3 4"]
    mesh: Int[Array, "instance"]


@dataclass
class _Blocks:
    """Cells of all blocks made so far, in arrays with room to grow; ``used`` of each are filled."""

    heads: Array = field(default_factory=lambda: np.zeros(1024, np.int32))
    tops: Array = field(default_factory=lambda: np.zeros((1024, 3), np.float32))
    entries: Array = field(default_factory=lambda: np.zeros(1024, np.int32))
    records: Array = field(default_factory=lambda: np.zeros((1024, RECORD_WORDS), np.float32))
    first_head: Array = field(default_factory=lambda: np.zeros(64, np.int64))
    used: tuple[int, ...] = (0, 0, 0, 0, 0)

    def grow(self, more: tuple[int, ...]) -> None:
        """Make room for so many more of each."""
        for name, used, extra in zip(
            ("heads", "tops", "entries", "records", "first_head"), self.used, more, strict=True
        ):
            array = getattr(self, name)
            if used + extra > len(array):
                larger = np.empty((max(2 * len(array), used + extra), *array.shape[1:]), array.dtype)
                larger[:used] = array[:used]
                setattr(self, name, larger)


class KeptLightBuffer:
    """The light buffer of a scene for the sun that was asked for last.

    Parameters
    ----------
    standing
        What stands still.
    """

    def __init__(self, standing: StandingFaces):
        self._standing = standing
        self._buffer: LightBuffer | None = None

    def toward(self, sun_direction: Float[Array, "3"]) -> "LightBuffer":
        """The buffer for a sun; made anew if another sun was asked for before."""
        sun = np.asarray(sun_direction, np.float32)
        if self._buffer is None or not np.array_equal(self._buffer.sun, sun):
            self._buffer = LightBuffer(self._standing, sun)
        return self._buffer


class LightBuffer:
    """Light from one direction past what stands still.

    Parameters
    ----------
    standing
        What stands still.
    sun_direction
        Unit vector toward the sun, ENU. [1]
    """

    def __init__(self, standing: StandingFaces, sun_direction: Float[Array, "3"]):
        self.sun = np.array(sun_direction, np.float32)  # the caller may change his own
        self._standing = standing
        self._axes = _sun_axes(self.sun.astype(float))
        self._boxes = _mesh_boxes(standing.faces)
        low, high = np.empty((standing.faces.start[1], 3)), np.empty((standing.faces.start[1], 3))
        bound_faces(standing.faces.vertices, standing.faces.corners, self._axes, low, high)
        instance_low, instance_high = self._bounds(standing.transforms, standing.mesh)
        nothing = np.zeros((1, 3))  # so that an empty scene has a box
        ends = np.concatenate([nothing, low, instance_low]), np.concatenate([nothing, high, instance_high])
        self._origin = ends[0].min(axis=0)[:2] - 1.0
        extent = ends[1].max(axis=0)[:2] + 1.0 - self._origin
        self._block_m = max(_BLOCK_M, float(np.sqrt(np.prod(extent) / _MOST_BLOCKS)))
        across, along = np.ceil(extent / self._block_m).astype(int)
        self._index = np.full((int(across), int(along)), UNKNOWN, np.int32)
        self._instances = self._bin(instance_low, instance_high)
        self._static = self._bin(low, high)
        self._blocks = _Blocks()
        self._moving = self._bin(np.zeros((0, 3)), np.zeros((0, 3)))
        self._moving_boxes = np.zeros((0, 5))

    def place(self, transforms: Float[Array, "instance 3 4"], mesh: Int[Array, "instance"]) -> None:
        """Say where what moves is; ``mesh`` as in `StandingFaces`. [m]"""
        low, high = self._bounds(np.asarray(transforms, float), np.asarray(mesh, np.int64))
        low, high = low - _BESIDE_M, high + _BESIDE_M
        self._moving = self._bin(low, high)
        self._moving_boxes = np.column_stack(
            [low[:, :2] - self._origin, high[:, :2] - self._origin, high[:, 2]]
        )

    def light(
        self, points: Float[Array, "ray 3"], wanted: Bool[Array, "ray"], width: int = 0
    ) -> tuple[Float[Array, "ray"], Bool[Array, "ray"], bool]:
        """Part of the sun's light that arrives at each ``wanted`` point; the others come back 0.

        ``width`` points make a row of a frame, if they do.

        Returns
        -------
        light (n,) float32 [1]; whether something that moves may stand before it (n,); whether blocks are
        missing: then call `fill` and ask again.
        """
        light, below = np.empty(len(points), np.float32), np.empty(len(points), np.bool_)
        missing, blocks = np.zeros(1, np.int8), self._blocks
        lists = blocks.first_head, blocks.heads, blocks.tops, blocks.entries, blocks.records
        frame = self._axes, self._origin, self._block_m, self._index
        moving = (*self._moving, self._moving_boxes)
        width = width or _ROW
        rows, rays = -(-len(points) // width), (points, wanted, width)
        least = max(_ROW // width, 16)
        over_rows(find_light, rows, *rays, frame, lists, moving, light, below, missing, least=least)
        return light, below, bool(missing[0])

    def fill(self) -> None:
        """Make the blocks that were found missing."""
        wanted = np.argwhere(self._index == WANTED)
        lists = self._static, self._instances
        scene = (
            self._standing.faces.vertices,
            self._standing.faces.corners,
            self._standing.gaps,
            self._standing.faces.start,
            self._standing.transforms,
            self._standing.mesh,
        )
        frame = self._axes, self._origin, self._block_m, self._index.shape[1]
        counts = np.zeros((len(wanted), BLOCK_CELLS**2), np.int32)
        records = np.zeros(len(wanted), np.int64)
        over_rows(count_cells, len(wanted), wanted, frame, scene, lists, counts, records)
        cells = BLOCK_CELLS**2 + 1
        blocks, totals = self._blocks, counts.sum(axis=1, dtype=np.int64)
        heads_used, _, entries_used, records_used, blocks_used = blocks.used
        more = len(wanted) * cells, len(wanted) * cells, int(totals.sum()), int(records.sum()), len(wanted)
        blocks.grow(more)
        starts = (
            heads_used + cells * np.arange(len(wanted)),
            entries_used + np.cumsum(totals) - totals,
            records_used + np.cumsum(records) - records,
        )
        lists_out = blocks.heads, blocks.tops, blocks.entries, blocks.records
        over_rows(fill_cells, len(wanted), wanted, frame, scene, lists, counts, *starts, lists_out)
        blocks.first_head[blocks_used : blocks_used + len(wanted)] = starts[0]
        blocks.used = tuple(a + b for a, b in zip(blocks.used, more, strict=True))
        self._index[wanted[:, 0], wanted[:, 1]] = blocks_used + np.arange(len(wanted))

    def _bounds(self, transforms: Array, mesh: Array) -> tuple[Array, Array]:
        """Boxes of instances along the sun's axes."""
        if len(mesh) == 0:
            return np.zeros((0, 3)), np.zeros((0, 3))
        placed = (
            np.einsum("kij,kcj->kci", transforms[:, :, :3], self._boxes[mesh]) + transforms[:, None, :, 3]
        )
        seen = placed @ self._axes.T
        return seen.min(axis=1), seen.max(axis=1)

    def _bin(self, low: Array, high: Array) -> tuple[Array, Array]:
        """For each block where its list starts, and the lists: which boxes reach over it."""
        last = np.array(self._index.shape) - 1
        first = np.clip(((low[:, :2] - self._origin) / self._block_m).astype(np.int64), 0, last)
        end = np.clip(((high[:, :2] - self._origin) / self._block_m).astype(np.int64), 0, last)
        return list_boxes(first, end, self._index.shape)


def _sun_axes(sun: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Two axes across the sun's direction, and one along which places on a ray to the sun are compared.

    That is up, unless the sun stands low: a level face then reaches over its cells at one height.
    """
    side = np.array([0.0, 0.0, 1.0]) if abs(sun[2]) < 0.9 else np.array([1.0, 0.0, 0.0])
    sun = sun / np.linalg.norm(sun)
    first = np.cross(side, sun)
    first /= np.linalg.norm(first)
    up = np.array([0.0, 0.0, 1.0]) if sun[2] > _LEAST_RISE else sun
    return np.stack([first, np.cross(sun, first), up])


def _mesh_boxes(faces: FaceTable) -> Float[Array, "mesh 8 3"]:
    """Corners of each mesh's box; zeros if it has no faces."""
    boxes = np.zeros((len(faces.start) - 1, 8, 3))
    for k, (start, stop) in enumerate(zip(faces.start, faces.start[1:], strict=False)):
        if stop > start:
            used = faces.vertices[faces.corners[start:stop].ravel()].astype(float)
            ends = np.stack([used.min(axis=0), used.max(axis=0)], axis=1)
            boxes[k] = np.stack(np.meshgrid(*ends, indexing="ij"), -1).reshape(8, 3)
    return boxes
