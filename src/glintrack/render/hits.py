"""Hits of a frame's rays: the record between `trace` and `shade`."""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.arrays import Array


@dataclass(frozen=True)
class Hits:
    """What the rays of a frame met, as samples: those of element e are ``first[e]`` to ``first[e + 1]``.

    Rays of an element that met the same plane of the same thing, and are not mirrored, are one sample, their
    mean: light is linear in all that differs between them but the mottle, whose patches are larger. Elements
    run row by row over the array.

    Parameters
    ----------
    rows, columns
        Elements of the array.
    detector_axis
        The detector's +x in ENU, the reference axis of the ``detector`` Stokes frame. [1]
    rays
        How many rays each element was sampled with; 0 for one that was not traced.
    first
        Where each element's samples begin, and the last one's end.
    weight
        Part of its element's rays that a sample stands for; they sum to 1 in each element. [1]
    look
        Unit direction of each element's middle. [1]
    point
        Hit point in ENU. [m]
    normal
        Facet normal, turned toward the camera. [1]
    range_m
        Distance from the lens; infinite for sky. [m]
    material
        Index into the materials; −1 for sky.
    vehicle_id
        The vehicle hit, −1 for none.
    sun_visible
        Part of the sun's light that arrives, 0 to 1; 0 where the sun stands behind the facet, unless that is
        a leaf card (a material with a gap fraction): then what arrives at its back. [1]
    sky_view
        Sky irradiance of the facet over that of the same facet in the open, both under an even sky:
        V = ∫ v cos θ dω / ∫ cos θ dω over the directions above the horizon and in front of the facet, v
        being 1 where sky is seen and 0 elsewhere. An open facet of any tilt has V = 1, and (1 + n_z)/2 · V
        of its cosine-weighted hemisphere is sky. 0 to 1. [1]
    sky_behind
        The same of the other side of a leaf card, whose normal is −n; 0 for all else. [1]
    mirror_material
        Material that the mirror-reflected ray of a smooth surface meets; −1 where it meets the sky, or was
        not followed because the surface is rough.
    mirror_sun
        Cosine of the sun's incidence on what that ray meets, times the part of the sun's light that arrives
        there; 0 in shadow and where ``mirror_material`` is −1. [1]
    mirror_sky
        Cosine-weighted part of the hemisphere over what that ray meets that is sky, (1 + n_z)/2 · V; 0 where
        ``mirror_material`` is −1. [1]
    """

    rows: int
    columns: int
    detector_axis: Float[Array, "3"]
    rays: Int[Array, "element"]
    first: Int[Array, "element+1"]
    weight: Float[Array, "sample"]
    look: Float[Array, "element 3"]
    point: Float[Array, "sample 3"]
    normal: Float[Array, "sample 3"]
    range_m: Float[Array, "sample"]
    material: Int[Array, "sample"]
    vehicle_id: Int[Array, "sample"]
    sun_visible: Float[Array, "sample"]
    sky_view: Float[Array, "sample"]
    sky_behind: Float[Array, "sample"]
    mirror_material: Int[Array, "sample"]
    mirror_sun: Float[Array, "sample"]
    mirror_sky: Float[Array, "sample"]

    @property
    def element(self) -> Int[Array, "sample"]:
        """Which element each sample is of."""
        return np.repeat(np.arange(self.rows * self.columns), np.diff(self.first))

    @property
    def direction(self) -> Float[Array, "sample 3"]:
        """Unit direction of look of each sample's element. [1]"""
        return self.look[self.element]


PER_FRAME = ("rows", "columns", "detector_axis")
PER_ELEMENT = ("rays", "first", "look")
PER_SAMPLE = tuple(f.name for f in fields(Hits) if f.name not in PER_FRAME + PER_ELEMENT)


def take_samples(hits: Hits, chosen: Int[Array, "sample"], counts: Int[Array, "element"]) -> Hits:
    """Some samples, in order of their elements, so many of each."""
    kept = {name: getattr(hits, name)[chosen] for name in PER_SAMPLE}
    return replace(hits, first=np.concatenate([[0], np.cumsum(counts)]), **kept)


def one_sample_each(hits: Hits) -> Hits:
    """Keep of each element the one sample that stands for most of it: for looking at."""
    order = np.lexsort((-hits.weight, hits.element))
    counts = np.minimum(np.diff(hits.first), 1)
    kept = take_samples(hits, order[hits.first[:-1][counts > 0]], counts)
    return replace(kept, weight=np.ones_like(kept.weight))


def replace_elements(hits: Hits, others: Hits) -> Hits:
    """The same frame with the elements that ``others`` holds taken from there."""
    anew = others.rays > 0
    counts = np.where(anew, np.diff(others.first), np.diff(hits.first))
    start = np.where(anew, others.first[:-1] + len(hits.weight), hits.first[:-1])
    first = np.concatenate([[0], np.cumsum(counts)])
    chosen = np.repeat(start - first[:-1], counts) + np.arange(first[-1])
    both = {name: np.concatenate([getattr(hits, name), getattr(others, name)]) for name in PER_SAMPLE}
    joined = replace(hits, rays=np.where(anew, others.rays, hits.rays), **both)
    return take_samples(joined, chosen, counts)
