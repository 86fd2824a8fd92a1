"""A camera over a city: the set-up that every frame shares, made once, and what each frame's rays meet."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property, partial
from typing import Any, Protocol, runtime_checkable

import numpy as np
import xarray as xr

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Radiance
from glintrack.render.bounce import material_classes
from glintrack.render.hits import Hits, among
from glintrack.render.rays.tracer import SceneTracer, build_tracer
from glintrack.render.rays.tracer_protocol import Tracer
from glintrack.render.samples import Samples
from glintrack.render.sampling import FIRST_SIDE, RoughLight, Sampling, further_sides, rough_light
from glintrack.render.shade import FrameSpectra, shade, shade_blocks, shade_with_guests
from glintrack.render.shading.projection import standing_elements
from glintrack.render.sky import Sky
from glintrack.render.surface_model import surface_model
from glintrack.render.trace import trace
from glintrack.render.visibility import build_bare_tracer, visible_fraction
from glintrack.scene import City, Snapshot

SURROUNDINGS = "grass"  # the level ground beyond the city's edge


@dataclass(frozen=True)
class TracedFrame:
    """What a frame's rays met, how much of each moving vehicle they saw, and from where they came.

    Parameters
    ----------
    hits
        From `trace`.
    seen
        From `visible_fraction`, in the order of the snapshot's moving instances. [1]
    camera, pose
        The frame camera and its true pose.
    """

    hits: Hits
    seen: Array
    camera: Camera
    pose: Pose


class FrameCache(Protocol):
    """Where traced frames of one geometry are kept, so that cases which share it trace once."""

    def get(self, time_s: float, observe: Callable[[], TracedFrame]) -> TracedFrame:
        """The frame of that time: a kept one, or what ``observe`` gives."""
        ...


@runtime_checkable
class LightCache(FrameCache, Protocol):
    """One that keeps the light of frames too, for cases that share the sky and the sensor's channels."""

    def light(
        self, time_s: float, observer: "Observer", channels: Array, shade: Callable[[], xr.DataArray]
    ) -> xr.DataArray:
        """Light of the frame of that time in some channels: a kept one, or what ``shade`` gives."""
        ...


@dataclass(frozen=True)
class FrameRadiance:
    """Light of a traced frame on demand: `shade`, bound to what its rays met (a `Radiance`)."""

    hits: Hits
    sky: Sky
    materials: xr.Dataset

    def __call__(self, channels: Array, pixels: Array | None = None) -> xr.DataArray:
        """Stokes radiance of some channels, of the frame or of some of its elements."""
        return shade(self.hits, self.sky, self.materials, channels, pixels, spectra=self._spectra)

    def with_guests(self, channels: Array, guests: Array) -> tuple[xr.DataArray, xr.DataArray]:
        """The whole frame in some channels, and in others that cost little beside them."""
        return shade_with_guests(self.hits, self._spectra, channels, guests)

    def blocks(self, wavelength_um: Array, rows: int) -> Iterator[tuple[int, xr.DataArray]]:
        """First row and light at some wavelengths of blocks of so many rows; see `shade_blocks`."""
        return shade_blocks(self.hits, self.sky, self.materials, wavelength_um=wavelength_um, rows=rows)

    @cached_property
    def _spectra(self) -> FrameSpectra:
        return FrameSpectra(self.hits, self.sky, self.materials)


def keep_frames(
    radiance: Radiance, cache: Callable[..., xr.DataArray] | None = None, guests: Array | None = None
) -> Radiance:
    """The same light, shading whole frames once for all who ask for the same channels.

    ``cache(channels, shade)`` is asked for each first; by default ``shade()`` is called. The light in
    channels that are ``guests`` is found with the first that are asked for.
    """
    frames: dict[bytes, xr.DataArray] = {}

    def whole(channels: Array) -> xr.DataArray:
        if guests is None or frames or not isinstance(radiance, FrameRadiance):
            return radiance(channels)
        light, frames[guests.tobytes()] = radiance.with_guests(channels, guests)
        return light

    def kept(channels: Array, pixels: Array | None = None) -> xr.DataArray:
        if pixels is not None:
            return radiance(channels, pixels)
        key = np.ascontiguousarray(channels).tobytes()
        if key not in frames:
            shade = partial(whole, channels)
            frames[key] = shade() if cache is None else cache(channels, shade)
        return frames[key]

    return kept


@dataclass(frozen=True)
class Observer:
    """A camera over a city under a sky, with intersectors that are built when first needed.

    Parameters
    ----------
    city, sky, camera
        What is looked at, by which light, through what.
    first
        The city at any time: what the intersectors are built from.
    oversampling
        Rays along each side of an element, where ``sampling`` does not say how many.
    sun_samples
        Points of the sun's disc toward which shadow rays go.
    sampling
        The error that elements may have: as many rays as that takes.
    """

    city: City
    sky: Sky
    camera: Camera
    first: Snapshot
    oversampling: int = 1
    sun_samples: int = 1
    sampling: Sampling | None = None

    @cached_property
    def tracer(self) -> SceneTracer:
        """Intersector of all that stands and drives, with the sky views of what stands."""
        return tracer_of(self.city, self.first)

    @cached_property
    def bare_tracer(self) -> Tracer:
        """Intersector of the vehicles alone."""
        return build_bare_tracer(self.first)

    def replace(self, **changes: Any) -> "Observer":
        """An observer of the same scene with another camera or other rays; it shares the intersector."""
        other = replace(self, **changes)
        other.__dict__["tracer"] = self.tracer  # built once for all
        return other

    @cached_property
    def _rough_light(self) -> RoughLight:
        electrons = 0.0 if self.sampling is None else self.sampling.electrons_per_radiance
        return rough_light(self.city.materials, electrons)

    def _further(self, samples: Samples) -> Array:
        """Side of the second grid of each element; see `further_sides`."""
        shape = self.camera.rows, self.camera.columns
        if self.sampling is None:
            return np.zeros(shape[0] * shape[1], np.int64)
        return further_sides(samples, shape, self.sky.sun_direction, self._rough_light, self.sampling)

    def prepare(self) -> None:
        """Build the intersectors now, and begin to read what is kept of the scene's light."""
        sun = np.asarray(self.sky.sun_direction, np.float32)  # as rays go
        self.tracer.probes.toward(sun, self._surroundings).read_ahead()
        _ = self.bare_tracer

    @property
    def _surroundings(self) -> int:
        """Material of the level ground beyond the scene's edge."""
        return self.city.materials["material"].values.tolist().index(SURROUNDINGS)

    def trace(
        self, snapshot: Snapshot, pose: Pose, like: Hits | None = None, elements: Array | None = None
    ) -> Hits:
        """What the rays of one frame meet, from a true pose; see `trace`.

        Parameters
        ----------
        snapshot, pose
            Of the frame.
        like
            Hits of the same pose, whose rays are to be followed: the same places in every element, whatever
            stands there now.
        elements
            Those to trace; the whole frame by default.
        """
        materials = self.city.materials
        side, further = (self.oversampling, None) if self.sampling is None else (FIRST_SIDE, self._further)
        if like is not None:
            side, further = _same_rays(like, side)
        return trace(
            snapshot,
            self.camera,
            pose,
            self.sky.sun_direction,
            roughness=materials["roughness"].values,
            surroundings=self._surroundings,
            oversampling=side,
            tracer=self.tracer,
            sun_samples=self.sun_samples,
            further=further,
            elements=elements,
        )

    def observe(self, snapshot: Snapshot, pose: Pose) -> TracedFrame:
        """One frame's hits, and the part of each vehicle that they show."""
        hits = self.trace(snapshot, pose)
        seen = visible_fraction(snapshot, self.camera, pose, self.tracer, self.bare_tracer)
        return TracedFrame(hits, seen, self.camera, pose)

    def radiance(self, hits: Hits) -> Radiance:
        """Light that reaches the lens from what the rays met."""
        return FrameRadiance(hits, self.sky, self.city.materials)

    def radiance_anew(self, anew: Hits, frame: Hits) -> Radiance:
        """The same of elements alone that were traced anew, of a frame that else met ``frame``."""
        standing = standing_elements(frame.rows * frame.columns)
        return self.radiance(among(anew, frame, standing))

    def surface_model(self, step_m: float) -> xr.Dataset:
        """Heights of roofs and crowns over the city; see `surface_model`."""
        return surface_model(self.tracer, self.first, self.city.extent_m, step_m)

    def white(self, channels: Array) -> Array:
        """Radiance of a level white panel on the ground, in some channels. [W m⁻² sr⁻¹ µm⁻¹]"""
        sky = self.sky
        return channels @ (sky.sun_irradiance * sky.sun_direction[2] + sky.sky_irradiance) / np.pi


def tracer_of(city: City, first: Snapshot) -> SceneTracer:
    """Intersector of a city; ``first`` is the city at any time."""
    materials = city.materials
    shares, gaps = material_classes(materials).shares, materials["gap_fraction"].values
    return build_tracer(first, gaps, shares, city.extent_m, keep_probes=True)


def _same_rays(hits: Hits, side: int) -> tuple[int, Callable[[Samples], Array]]:
    """Sides of the first and second grids that make up the rays of each element."""
    more = np.sqrt(np.maximum(hits.rays.astype(float) - side * side, 0))
    return side, lambda samples: np.rint(more).astype(np.int64)
