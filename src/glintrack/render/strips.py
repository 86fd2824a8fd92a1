"""Light of a frame too large to be traced at once: strip by strip of its rows, none kept.

What a whole frame decides (the mean light of what is in view, the nodes of the directions of look) is found
first, from the elements that stand for it, so that light is that of the frame traced whole but for rounding
(`tests/render/test_strips.py`). Only where that would want more probes than there is room for
(`probes.MOST_PROBES`) do strips differ: they keep the fine lattice.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.render.hits import Hits, take_rows
from glintrack.render.observer import FrameRadiance, Observer
from glintrack.render.shade import FrameSpectra, shade, shade_blocks
from glintrack.render.shading.projection import standing_elements
from glintrack.scene import Snapshot

AT_ONCE_BYTES = 1_000_000_000  # of a frame's hits and what is made of them on the way, beside the scene
_STRIP_PART = 0.3  # of that, for a strip
_RAY_BYTES = 350  # at one ray an element (measured)
_ADAPTED_SIDE = 3  # of as many rays as elements get where their error decides
_TILE = 4  # rows that are traced together


@dataclass(frozen=True)
class StripRadiance:
    """Light of a frame on demand, traced anew in strips for each call (a `Radiance`).

    Parameters
    ----------
    observer, snapshot, pose
        Of the frame.
    rows
        Of a strip.
    """

    observer: Observer
    snapshot: Snapshot
    pose: Pose
    rows: int

    def __call__(
        self, channels: Float[Array, "channel wavelength"], pixels: Int[Array, "pixel 2"] | None = None
    ) -> xr.DataArray:
        """Stokes radiance of some channels, of the frame or of some of its elements."""
        if pixels is not None:
            return self._of_pixels(channels, pixels)
        camera, light = self.observer.camera, None
        for row, block in self.blocks(channels):
            if light is None:
                shape = camera.rows, *block.shape[1:]
                light = xr.DataArray(
                    np.empty(shape, block.dtype), block.coords, block.dims, attrs=block.attrs
                )
            light.values[row : row + len(block)] = block.values
        assert light is not None  # a camera has rows
        return light

    def blocks(
        self,
        channels: Float[Array, "channel wavelength"] | None = None,
        wavelength_um: Float[Array, "channel"] | None = None,
        rows: int | None = None,
    ) -> Iterator[tuple[int, xr.DataArray]]:
        """First row and light of blocks of so many rows, those of a strip by default; see `shade_blocks`."""
        observer = self.observer
        for first, hits in self._strips():
            spectra = self._spectra.of_rows(slice(first, first + hits.rows))
            asked = channels, wavelength_um, rows or hits.rows
            for row, light in shade_blocks(hits, observer.sky, observer.city.materials, *asked, spectra):
                yield first + row, light

    @property
    def hits(self) -> Hits:
        """What the rays of the whole frame meet, whatever memory that takes."""
        return self.observer.trace(self.snapshot, self.pose)

    def _of_pixels(self, channels: Array, pixels: Array) -> xr.DataArray:
        shape = self.observer.camera.rows, self.observer.camera.columns
        index = np.ravel_multi_index(tuple(np.asarray(pixels, int).reshape(-1, 2).T), shape)
        hits, materials = self._of_elements(np.unique(index)), self.observer.city.materials
        return shade(hits, self.observer.sky, materials, channels, pixels, spectra=self._spectra)

    def _of_elements(self, elements: Int[Array, "element"]) -> Hits:
        """Hits of some elements, with as many rays as they get in the whole frame."""
        camera = self.observer.camera
        if self.observer.sampling is not None:  # which asks what lies beside
            row, column = np.divmod(elements, camera.columns)
            beside = [elements]
            for down, right in ((-1, 0), (1, 0), (0, -1), (0, 1)):
                r, c = row + down, column + right
                inside = (r >= 0) & (r < camera.rows) & (c >= 0) & (c < camera.columns)
                beside.append((r * camera.columns + c)[inside])
            elements = np.unique(np.concatenate(beside))
        return self.observer.trace(self.snapshot, self.pose, elements=elements)

    @cached_property
    def _spectra(self) -> FrameSpectra:
        camera = self.observer.camera
        some = self._of_elements(standing_elements(camera.rows * camera.columns))
        return FrameSpectra(some, self.observer.sky, self.observer.city.materials)

    def _strips(self) -> Iterator[tuple[int, Hits]]:
        """First row and hits of each strip."""
        camera, margin = self.observer.camera, 0 if self.observer.sampling is None else 1
        _ = self._spectra  # of elements that lie far apart: before the first strip's probes
        for first in range(0, camera.rows, self.rows):
            last = min(first + self.rows, camera.rows)
            low, high = max(first - margin, 0), min(last + margin, camera.rows)
            self.observer.tracer.probes.make_room()
            observer = self.observer.replace(camera=_of_rows(camera, low, high))
            yield first, take_rows(observer.trace(self.snapshot, self.pose), slice(first - low, last - low))


def frame_light(observer: Observer, snapshot: Snapshot, pose: Pose) -> FrameRadiance | StripRadiance:
    """Light of one frame, traced at once if that takes no more than `AT_ONCE_BYTES`, else in strips."""
    whole, rows = whole_bytes(observer), observer.camera.rows
    if whole <= AT_ONCE_BYTES:
        return FrameRadiance(observer.trace(snapshot, pose), observer.sky, observer.city.materials)
    strip = int(_STRIP_PART * AT_ONCE_BYTES * rows / whole)
    return StripRadiance(observer, snapshot, pose, max(strip - strip % _TILE, _TILE))


def whole_bytes(observer: Observer) -> int:
    """What a frame takes that is traced at once, beside the scene, about."""
    camera = observer.camera
    side = _ADAPTED_SIDE if observer.sampling is not None else observer.oversampling
    return _RAY_BYTES * side * camera.rows * camera.columns  # rays that meet the same share a sample


def _of_rows(camera: Camera, first: int, last: int) -> Camera:
    """The camera with some of its rows alone."""
    row = camera.principal_point[0] - first
    return replace(camera, rows=last - first, principal_row=row)
