"""Probes on disk: what those of a frame gathered, for the next flight that asks for the same ones.

A file is addressed by all that it depends on: the scene that stands still, the sun, the level ground beyond
the edge, the program, and which probes were asked for in which order. What is read is to the last bit what
would have been gathered, so that a result does not depend on what was flown before.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.io import cache
from glintrack.io.digest import content_hash
from glintrack.scene import Snapshot

WORTH_KEEPING = 20_000  # probes: fewer are gathered in half a second
MOST_BYTES = 300_000_000  # of all files: some ten first frames of a city
_SUFFIX = ".probes"


@dataclass(frozen=True)
class KeptProbes:
    """Where the probes of a scene are kept.

    Parameters
    ----------
    scene
        From `scene_content`.
    folder
        `cache_folder` by default.
    """

    scene: str
    folder: Path | None = None

    def fill(self, arrays: tuple[Array, ...], asked: tuple[Array, ...], gather: Callable[[], None]) -> None:
        """Fill arrays, a row a probe, with what was kept; else let ``gather`` fill them, and keep that.

        Parameters
        ----------
        arrays
            Written to.
        asked
            What they depend on beside the scene.
        gather
            Fills them.
        """
        if len(arrays[0]) < WORTH_KEEPING:
            gather()
            return
        folder = cache.cache_folder("probes") if self.folder is None else self.folder
        shapes = "".join(f"{one.dtype.str}{one.shape}" for one in arrays)
        stem = cache.content_stem(content_hash([self.scene, shapes, *map(_bytes, asked)]))
        data = cache.read(stem, _SUFFIX, folder)
        if data is None or len(data) != sum(one.nbytes for one in arrays):
            gather()
            if cache.keep(stem, _SUFFIX, folder, b"".join(map(_bytes, arrays))) is not None:
                cache.trim(_SUFFIX, folder, MOST_BYTES)
            return
        start = 0
        for one in arrays:
            part = data[start : start + one.nbytes]
            one[...] = np.frombuffer(part, one.dtype).reshape(one.shape)
            start += one.nbytes


def scene_content(
    snapshot: Snapshot,
    gap_fraction: Float[Array, "material"] | None,
    shares: Float[Array, "row class"] | None,
    window: tuple[float, float, float, float] | None,
) -> str:
    """Hash of all that stands still in a scene, and of the programs that follow rays in it."""
    fixed = slice(0, snapshot.fixed)
    meshes = (snapshot.static, *snapshot.models)
    arrays = [part for mesh in meshes for part in (mesh.vertices, mesh.faces, mesh.material)]
    arrays += [snapshot.transforms[fixed], snapshot.model[fixed], snapshot.paint[fixed]]
    arrays += [np.zeros(0) if part is None else np.asarray(part) for part in (gap_fraction, shares, window)]
    described = [f"{one.dtype.str}{one.shape}" for one in arrays]
    return content_hash([_programs(), *described, *map(_bytes, arrays)])


@lru_cache(maxsize=1)
def _programs() -> str:
    """Hash of this folder's source, and the version of the library that traces."""
    try:
        tracer = version("embreex")
    except PackageNotFoundError:
        tracer = "none"
    sources = sorted(Path(__file__).parent.rglob("*.py"))
    return content_hash([tracer, *(source.read_bytes() for source in sources)])


def _bytes(array: Array) -> bytes:
    return np.ascontiguousarray(array).tobytes()
