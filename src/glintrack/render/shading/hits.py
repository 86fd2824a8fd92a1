"""Hits of a frame's rays: the record between `trace` and `shade`."""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array


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
    sky_here
        ``sky_view``, but for vehicles that move, over what the probes of ``light_cell`` see between them. [1]
    sky_left
        Of 255 parts of the light from sky and surroundings how many vehicles that move leave beside and
        under them. [1/255]
    light_cell
        Where the surface gets its light from sky and surroundings: a cell of ``probe_cells``; −1 for the
        whole sky, −2 − cell for a point in space or on a vehicle, whose other side has the cell with its last
        three bits inverted.
    light_part
        Place in that cell, along its two sides. [1/255]
    mirror_material
        Material that the mirror-reflected ray of a smooth surface, or of any of a vehicle, meets; −1 where it
        meets the sky, or was not followed because the surface is rough.
    mirror_sun
        Cosine of the sun's incidence on what that ray meets, times the part of the sun's light that arrives
        there; 0 in shadow and where ``mirror_material`` is −1. [1]
    mirror_sky
        Cosine-weighted part of the hemisphere over what that ray meets that is sky, (1 + n_z)/2 · V; 0 where
        ``mirror_material`` is −1. [1]
    mirror_here, mirror_left, mirror_cell, mirror_part
        ``sky_here``, ``sky_left``, ``light_cell`` and ``light_part`` of what that ray meets.
    probe_cells, probe_facing, probe_patches, probe_bounced, probe_view
        The probes that cells point to, `probes.ProbeTable`.
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
        """Which element each sample is of."""
        return np.repeat(np.arange(self.rows * self.columns), np.diff(self.first))

    @property
    def direction(self) -> Float[Array, "sample 3"]:
        """Unit direction of look of each sample's element. [1]"""
        return self.look[self.element]


PROBES = tuple(f.name for f in fields(Hits) if f.name.startswith("probe_"))
PER_FRAME = ("rows", "columns", "detector_axis", *PROBES)
PER_ELEMENT = ("rays", "first", "look")
PER_SAMPLE = tuple(f.name for f in fields(Hits) if f.name not in PER_FRAME + PER_ELEMENT)


def samples_of(hits: Hits, elements: Int[Array, "element"]) -> Int[Array, "sample"]:
    """All samples of some elements, one element's after the other's."""
    begin = hits.first[elements]
    counts = hits.first[np.asarray(elements) + 1] - begin
    return np.repeat(begin - np.cumsum(counts) + counts, counts) + np.arange(counts.sum())


def take_samples(hits: Hits, chosen: Int[Array, "sample"], counts: Int[Array, "element"]) -> Hits:
    """Some samples, in order of their elements, so many of each."""
    kept = {name: getattr(hits, name)[chosen] for name in PER_SAMPLE}
    return replace(hits, first=np.concatenate([[0], np.cumsum(counts)]), **kept)


def one_sample_each(hits: Hits) -> Hits:
    """Keep of each element the one sample that stands for most of it: for looking at."""
    samples = np.diff(hits.first)
    counts = np.minimum(samples, 1)
    most = np.maximum.reduceat(hits.weight, hits.first[:-1][counts > 0]) if len(hits.weight) else hits.weight
    heaviest = np.flatnonzero(hits.weight == np.repeat(most, samples[counts > 0]))
    element = hits.element[heaviest]
    kept = take_samples(hits, heaviest[np.diff(element, prepend=-1) > 0], counts)
    return replace(kept, weight=np.ones_like(kept.weight))


def nothing_of(frame: Hits) -> Hits:
    """Hits of a frame of which no element was traced."""
    rays = np.zeros_like(frame.rays)
    return replace(take_samples(frame, np.zeros(0, np.int64), np.zeros(len(rays), np.int64)), rays=rays)


def among(some: Hits, frame: Hits, standing: Int[Array, "element"]) -> Hits:
    """Elements that were traced anew, and of the others of their frame those that stand for it.

    Parameters
    ----------
    some
        Of a few elements alone.
    frame
        Of all of them.
    standing
        From `projection.standing_elements`. What comes from ``frame`` has no cell: it tells spectra what a
        frame is of, and is not to be shaded.
    """
    others = standing[some.rays[standing] == 0]
    taken = samples_of(frame, others)
    counts = np.diff(some.first)
    counts[others] = np.diff(frame.first)[others]
    first = np.concatenate([[0], np.cumsum(counts)])
    start = some.first[:-1].copy()
    start[others] = len(some.weight) + np.cumsum(counts[others]) - counts[others]
    chosen = np.repeat(start - first[:-1], counts) + np.arange(first[-1])
    both = {n: np.concatenate([getattr(some, n), getattr(frame, n)[taken]])[chosen] for n in PER_SAMPLE}
    of_frame = chosen >= len(some.weight)
    for name in ("light_cell", "mirror_cell"):
        both[name][of_frame] = -1  # the whole sky
    return replace(some, first=first, **both)
