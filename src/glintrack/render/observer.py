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
from glintrack.render.light.gather import material_classes
from glintrack.render.light.sky import Sky
from glintrack.render.rays.surfaces import Tracer
from glintrack.render.shade import FrameSpectra, shade, shade_blocks
from glintrack.render.shading.hits import Hits, among, nothing_of
from glintrack.render.shading.materials import MIRROR_ROUGHNESS
from glintrack.render.shading.projection import standing_elements
from glintrack.render.trace import trace
from glintrack.render.tracer import SceneTracer, build_tracer, surface_model
from glintrack.render.vehicles import build_vehicle_tracer, elements_near_traffic, visible_fraction
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

    def blocks(self, wavelength_um: Array, rows: int) -> Iterator[tuple[int, xr.DataArray]]:
        """First row and light at some wavelengths of blocks of so many rows; see `shade_blocks`."""
        return shade_blocks(self.hits, self.sky, self.materials, wavelength_um=wavelength_um, rows=rows)

    @cached_property
    def _spectra(self) -> FrameSpectra:
        return FrameSpectra(self.hits, self.sky, self.materials)


def keep_frames(radiance: Radiance, cache: Callable[..., xr.DataArray] | None = None) -> Radiance:
    """The same light, shading whole frames once for all who ask for the same channels.

    ``cache(channels, shade)`` is asked for each first; by default ``shade()`` is called.
    """
    frames: dict[bytes, xr.DataArray] = {}

    def kept(channels: Array, pixels: Array | None = None) -> xr.DataArray:
        if pixels is not None:
            return radiance(channels, pixels)
        key = np.ascontiguousarray(channels).tobytes()
        if key not in frames:
            shade = partial(radiance, channels)
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
        Rays along each side of an element.
    sun_samples
        Points of the sun's disc toward which shadow rays go.
    """

    city: City
    sky: Sky
    camera: Camera
    first: Snapshot
    oversampling: int = 1
    sun_samples: int = 1

    @cached_property
    def tracer(self) -> SceneTracer:
        """Intersector of all that stands and drives, with the sky views of what stands."""
        return tracer_of(self.city, self.first)

    @cached_property
    def vehicle_tracer(self) -> Tracer:
        """Intersector of the vehicles alone."""
        return build_vehicle_tracer(self.first)

    def replace(self, **changes: Any) -> "Observer":
        """An observer of the same scene with another camera or other rays; it shares the intersector."""
        other = replace(self, **changes)
        other.__dict__["tracer"] = self.tracer  # built once for all
        return other

    def prepare(self) -> None:
        """Build the intersectors now."""
        _ = self.tracer, self.vehicle_tracer

    @property
    def _surroundings(self) -> int:
        """Material of the level ground beyond the scene's edge."""
        return self.city.materials["material"].values.tolist().index(SURROUNDINGS)

    def trace(self, snapshot: Snapshot, pose: Pose, elements: Array | None = None) -> Hits:
        """What the rays of one frame, or of some of its elements, meet from a true pose; see `trace`."""
        return trace(
            snapshot,
            self.camera,
            pose,
            self.sky.sun_direction,
            roughness=self.city.materials["roughness"].values,
            surroundings=self._surroundings,
            oversampling=self.oversampling,
            tracer=self.tracer,
            sun_samples=self.sun_samples,
            elements=elements,
        )

    def observe(self, snapshot: Snapshot, pose: Pose) -> TracedFrame:
        """One frame's hits, and the part of each vehicle that they show."""
        hits = self.trace(snapshot, pose)
        seen = visible_fraction(snapshot, self.camera, pose, self.tracer, self.vehicle_tracer)
        return TracedFrame(hits, seen, self.camera, pose)

    def trace_without_traffic(self, snapshot: Snapshot, pose: Pose, hits: Hits) -> Hits:
        """Hits of a frame without its traffic, of the elements alone that traffic may change.

        Those are elements whose rays may meet a vehicle or its shadow (`elements_near_traffic`), those with a
        smooth surface, which may mirror one or the other, and those where vehicles take light of the sky.
        ``hits`` are those of the frame with its traffic.
        """
        lowest_m = float(self.city.terrain["height"].min()) - 0.1
        sun = np.asarray(self.sky.sun_direction, float)
        may = elements_near_traffic(snapshot, self.camera, pose, sun, lowest_m)
        smooth = self.city.materials["roughness"].values < MIRROR_ROUGHNESS
        mirrors = (hits.material >= 0) & smooth[hits.material]
        may[hits.element[mirrors | (hits.sky_left < 255)]] = True
        elements = np.flatnonzero(may)
        if not elements.size:  # no vehicle near what is seen
            return nothing_of(hits)
        return self.trace(snapshot.without_traffic(), pose, elements)

    def radiance(self, hits: Hits) -> Radiance:
        """Light that reaches the lens from what the rays met."""
        return FrameRadiance(hits, self.sky, self.city.materials)

    def partial_radiance(self, anew: Hits, frame: Hits) -> Radiance:
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
    return build_tracer(first, gaps, shares, city.extent_m)
