"""A camera over a city: the set-up that all frames share, and the hits and light of each frame."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol

import numpy as np
import xarray as xr

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Radiance
from glintrack.render.light.gather import material_classes
from glintrack.render.light.sky import Sky
from glintrack.render.rays.surfaces import Tracer
from glintrack.render.shade import FrameSpectra, shade, shade_blocks
from glintrack.render.shading.hits import Hits, merge_frames
from glintrack.render.shading.materials import MIRROR_ROUGHNESS
from glintrack.render.shading.projection import standing_elements
from glintrack.render.trace import trace
from glintrack.render.tracer import SceneTracer, build_tracer, surface_model
from glintrack.render.vehicles import build_vehicle_tracer, elements_near_traffic, visible_fraction
from glintrack.scene import City, Snapshot

SURROUNDINGS = "grass"  # the level ground beyond the city's edge


@dataclass(frozen=True)
class TracedFrame:
    """Hits of a frame and the visible fraction of its moving vehicles.

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
    """Cache of the traced frames of one geometry, for cases that share it."""

    def get(self, time_s: float, observe: Callable[[], TracedFrame]) -> TracedFrame:
        """Return the cached frame of a time, or the result of ``observe``."""
        ...


@dataclass(frozen=True)
class FrameRadiance:
    """Light of a traced frame on demand: `shade`, bound to the frame's hits (a `Radiance`)."""

    hits: Hits
    sky: Sky
    materials: xr.Dataset

    def __call__(self, channels: Array, pixels: Array | None = None) -> xr.DataArray:
        """Stokes radiance of some channels, of the frame or of some of its elements."""
        return shade(self.hits, self.sky, self.materials, channels, pixels, spectra=self._spectra)

    def blocks(self, wavelength_um: Array, rows: int) -> Iterator[tuple[int, xr.DataArray]]:
        """Light at some wavelengths of blocks of rows, with the first row of each; see `shade_blocks`."""
        return shade_blocks(self.hits, self.sky, self.materials, wavelength_um=wavelength_um, rows=rows)

    @cached_property
    def _spectra(self) -> FrameSpectra:
        return FrameSpectra(self.hits, self.sky, self.materials)


def keep_frames(radiance: Radiance) -> Radiance:
    """Shade whole frames once for all calls with the same channels."""
    frames: dict[bytes, xr.DataArray] = {}

    def look_up(channels: Array, pixels: Array | None = None) -> xr.DataArray:
        if pixels is not None:
            return radiance(channels, pixels)
        key = np.ascontiguousarray(channels).tobytes()
        if key not in frames:
            frames[key] = radiance(channels)
        return frames[key]

    return look_up


@dataclass(frozen=True)
class Observer:
    """A camera over a city under a sky, with intersectors that are built at first use.

    Parameters
    ----------
    city, sky, camera
        The scene, its light, and the frame camera.
    first
        The city at any time, from which the intersectors are built.
    oversampling
        Rays along each side of an element.
    sun_samples
        Number of shadow rays, toward points of the sun's disc.
    """

    city: City
    sky: Sky
    camera: Camera
    first: Snapshot
    oversampling: int = 1
    sun_samples: int = 1

    @cached_property
    def tracer(self) -> SceneTracer:
        """Intersector of the scene, with the probes of its fixed part."""
        materials = self.city.materials
        shares, gaps = material_classes(materials).shares, materials["gap_fraction"].values
        return build_tracer(self.first, gaps, shares, self.city.extent_m)

    @cached_property
    def vehicle_tracer(self) -> Tracer:
        """Intersector of the vehicles alone."""
        return build_vehicle_tracer(self.first)

    def replace(self, **changes: Any) -> "Observer":
        """Copy the observer with another camera or other rays; the copy shares the intersector."""
        other = replace(self, **changes)
        other.__dict__["tracer"] = self.tracer  # built once for all
        return other

    def prepare(self) -> None:
        """Build the intersectors now."""
        _ = self.tracer, self.vehicle_tracer

    def trace(self, snapshot: Snapshot, pose: Pose, elements: Array | None = None) -> Hits:
        """Trace the rays of a frame, or of some of its elements, from a true pose; see `trace`."""
        materials = self.city.materials
        surroundings = materials["material"].values.tolist().index(SURROUNDINGS)
        lit = self.sky.sun_direction, materials["roughness"].values, surroundings
        rays = self.oversampling, self.tracer, self.sun_samples
        return trace(snapshot, self.camera, pose, *lit, *rays, elements)

    def observe(self, snapshot: Snapshot, pose: Pose) -> TracedFrame:
        """Trace a frame and find the visible fraction of each moving vehicle."""
        hits = self.trace(snapshot, pose)
        seen = visible_fraction(snapshot, self.camera, pose, self.tracer, self.vehicle_tracer)
        return TracedFrame(hits, seen, self.camera, pose)

    def trace_without_traffic(self, snapshot: Snapshot, pose: Pose, hits: Hits) -> Hits:
        """Trace a frame without its traffic, only the elements that traffic may change.

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
        return self.trace(snapshot.without_traffic(), pose, np.flatnonzero(may))

    def radiance(self, hits: Hits) -> Radiance:
        """Light that reaches the lens from the hits of a frame."""
        return FrameRadiance(hits, self.sky, self.city.materials)

    def partial_radiance(self, some: Hits, frame: Hits) -> Radiance:
        """Light from the hits of some elements, in a frame with ``frame`` at all others."""
        return self.radiance(merge_frames(some, frame, standing_elements(frame.rows * frame.columns)))

    def surface_model(self, step_m: float) -> xr.Dataset:
        """Heights of roofs and crowns over the city; see `surface_model`."""
        return surface_model(self.tracer, self.first, self.city.extent_m, step_m)

    def white(self, channels: Array) -> Array:
        """Radiance of a level white panel on the ground, in some channels. [W m⁻² sr⁻¹ µm⁻¹]"""
        sky = self.sky
        return channels @ (sky.sun_irradiance * sky.sun_direction[2] + sky.sky_irradiance) / np.pi
