"""Hits of a frame's rays: the record between `trace` and `shade`."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array


class Hits(NamedTuple):
    """Surfaces that the rays of a frame met; samples of element e are ``first[e]`` to ``first[e + 1]``.

    Rays of an element that met the same plane of the same thing, and are not mirrored, are one sample, their
    mean: light is linear in their differences but for the mottle, with larger patches. Elements run row by
    row over the array.

    Parameters
    ----------
    rows, columns
        Elements of the array.
    detector_axis
        The detector's +x in ENU, the reference axis of the ``detector`` Stokes frame. [1]
    rays
        Number of rays of each element; 0 for an element that was not traced.
    first
        First sample of each element, and the end of the last one's.
    weight
        A sample's share of its element's rays; they sum to 1 in each element. [1]
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
        The moving vehicle hit; −1 for none, below −1 for parked vehicles.
    sun_visible
        Transmittance of the sun's light to the facet, 0 to 1; 0 with the sun behind the facet, unless that is
        a leaf card (a material with a gap fraction): then to its back. [1]
    sky_view
        Sky irradiance of the facet over that of the same facet in the open, both under an even sky:
        V = ∫ v cos θ dω / ∫ cos θ dω over the directions above the horizon and in front of the facet, v
        being 1 where sky is seen and 0 elsewhere. An open facet of any tilt has V = 1, and (1 + n_z)/2 · V
        of its cosine-weighted hemisphere is sky. 0 to 1. [1]
    sky_here
        ``sky_view`` without moving vehicles, over the mean sky view of the probes of ``light_cell``. [1]
    sky_left
        Part of the light from sky and surroundings that moving vehicles do not block. [1/255]
    light_cell
        Cell of ``probe_cells`` that lights the surface; −1 for the whole sky, −2 − cell for a point in space
        or on a vehicle. The other side of that has the cell with its last three bits inverted.
    light_part
        Place in that cell, along its two sides. [1/255]
    mirror_material
        Material that the mirrored ray of a smooth surface, or of any of a vehicle, meets; −1 for the sky, and
        for rough surfaces, which have no mirrored ray.
    mirror_sun
        Cosine of the sun's incidence on the mirrored surface, times the transmittance of the sun's light to
        it; 0 in shadow and where ``mirror_material`` is −1. [1]
    mirror_sky
        Cosine-weighted part of sky in the hemisphere over the mirrored surface, (1 + n_z)/2 · V; 0 where
        ``mirror_material`` is −1. [1]
    mirror_here, mirror_left, mirror_cell, mirror_part
        ``sky_here``, ``sky_left``, ``light_cell`` and ``light_part`` of the mirrored surface.
    probe_cells, probe_facing, probe_patches, probe_bounced, probe_view
        Probes of the cells, `probes.ProbeTable`.
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
    sky_here: Float[Array, "sample"]
    sky_left: Int[Array, "sample"]
    light_cell: Int[Array, "sample"]
    light_part: Int[Array, "sample 2"]
    mirror_material: Int[Array, "sample"]
    mirror_sun: Float[Array, "sample"]
    mirror_sky: Float[Array, "sample"]
    mirror_here: Float[Array, "sample"]
    mirror_left: Int[Array, "sample"]
    mirror_cell: Int[Array, "sample"]
    mirror_part: Int[Array, "sample 2"]
    probe_cells: Int[Array, "cell 4"]
    probe_facing: Int[Array, "probe"]
    probe_patches: Int[Array, "probe patch"]
    probe_bounced: Int[Array, "probe bounce"]
    probe_view: Float[Array, "probe"]

    @property
    def element(self) -> Int[Array, "sample"]:
        """Element of each sample."""
        return np.repeat(np.arange(self.rows * self.columns), np.diff(self.first))

    @property
    def direction(self) -> Float[Array, "sample 3"]:
        """Unit direction of look of each sample's element. [1]"""
        return self.look[self.element]


PROBES = tuple(name for name in Hits._fields if name.startswith("probe_"))
PER_FRAME = ("rows", "columns", "detector_axis", *PROBES)
PER_ELEMENT = ("rays", "first", "look")
PER_SAMPLE = tuple(name for name in Hits._fields if name not in PER_FRAME + PER_ELEMENT)


def samples_of(hits: Hits, elements: Int[Array, "element"]) -> Int[Array, "sample"]:
    """All samples of some elements, one element's after the other's."""
    begin = hits.first[elements]
    counts = hits.first[np.asarray(elements) + 1] - begin
    return np.repeat(begin - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def take_samples(hits: Hits, chosen: Int[Array, "sample"], counts: Int[Array, "element"]) -> Hits:
    """Take some samples, in order of their elements, and their number in each element."""
    own = {name: getattr(hits, name)[chosen] for name in PER_SAMPLE}
    return hits._replace(first=np.concatenate([[0], np.cumsum(counts)]), **own)


def one_sample_each(hits: Hits) -> Hits:
    """Take the sample of the largest weight of each element: for looking at."""
    samples = np.diff(hits.first)
    order = np.lexsort((-hits.weight, hits.element))  # stable: the first of equal weights
    heaviest = order[hits.first[:-1][samples > 0]]
    own = take_samples(hits, heaviest, np.minimum(samples, 1))
    return own._replace(weight=np.ones_like(own.weight))


def merge_frames(some: Hits, frame: Hits, standing: Int[Array, "element"]) -> Hits:
    """Merge a few elements of a frame with others that represent the rest of it in mean values.

    Parameters
    ----------
    some
        Hits of a few elements.
    frame
        Hits of all elements.
    standing
        From `projection.standing_elements`. Samples from ``frame`` have no cell: they are not to be shaded.
    """
    taken = samples_of(frame, standing[some.rays[standing] == 0])
    element = np.concatenate([some.element, frame.element[taken]])
    order = np.argsort(element, kind="stable")
    both = {n: np.concatenate([getattr(some, n), getattr(frame, n)[taken]])[order] for n in PER_SAMPLE}
    for name in ("light_cell", "mirror_cell"):
        both[name][order >= len(some.weight)] = -1  # the whole sky
    counts = np.bincount(element, minlength=len(frame.rays))
    return some._replace(first=np.concatenate([[0], np.cumsum(counts)]), **both)
