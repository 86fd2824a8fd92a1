"""Hits of a frame's rays: the record between `trace` and `shade`."""

from dataclasses import dataclass, fields, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.arrays import Array
from glintrack.render.probe_lookup import CORNERS, SPACE


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


def take_rows(hits: Hits, rows: slice) -> Hits:
    """Hits of some rows of elements; their arrays are views."""
    first, last, _ = rows.indices(hits.rows)
    elements = slice(first * hits.columns, last * hits.columns)
    begins = hits.first[elements.start : elements.stop + 1]
    samples = slice(begins[0], begins[-1])
    kept = {name: getattr(hits, name)[samples] for name in PER_SAMPLE}
    kept |= {"rays": hits.rays[elements], "look": hits.look[elements], "first": begins - begins[0]}
    return replace(hits, rows=last - first, **kept)


def one_sample_each(hits: Hits) -> Hits:
    """Keep of each element the one sample that stands for most of it: for looking at."""
    samples = np.diff(hits.first)
    counts = np.minimum(samples, 1)
    most = np.maximum.reduceat(hits.weight, hits.first[:-1][counts > 0]) if len(hits.weight) else hits.weight
    heaviest = np.flatnonzero(hits.weight == np.repeat(most, samples[counts > 0]))
    element = hits.element[heaviest]
    kept = take_samples(hits, heaviest[np.diff(element, prepend=-1) > 0], counts)
    return replace(kept, weight=np.ones_like(kept.weight))


def replace_elements(hits: Hits, others: Hits) -> Hits:
    """The same frame with the elements that ``others`` holds taken from there."""
    anew = others.rays > 0
    counts = np.where(anew, np.diff(others.first), np.diff(hits.first))
    start = np.where(anew, others.first[:-1] + len(hits.weight), hits.first[:-1])
    first = np.concatenate([[0], np.cumsum(counts)])
    chosen = np.repeat(start - first[:-1], counts) + np.arange(first[-1])
    others, probes = _probes_after(hits, others, samples_of(others, np.flatnonzero(anew)))
    both = {name: np.concatenate([getattr(hits, name), getattr(others, name)]) for name in PER_SAMPLE}
    joined = replace(hits, rays=np.where(anew, others.rays, hits.rays), **both, **probes)
    return take_samples(joined, chosen, counts)


def _probes_after(hits: Hits, others: Hits, taken: Int[Array, "sample"]) -> tuple[Hits, dict[str, Array]]:
    """Hits whose cells count on from those of a frame, and the probes of both.

    Of the others' probes those come along that some samples need. Cells keep their last three bits.
    """
    cells = np.concatenate([cells_of(others.light_cell[taken]), cells_of(others.mirror_cell[taken])])
    eights = np.unique(cells // CORNERS)
    listed = _in_eights(others.probe_cells)[eights]
    rows = np.unique(listed)
    row_at = np.zeros(len(others.probe_view), np.int32)
    row_at[rows] = len(hits.probe_view) + np.arange(len(rows))
    before = _in_eights(hits.probe_cells)
    shift = np.zeros(-(-len(others.probe_cells) // CORNERS), np.int64)
    shift[eights] = CORNERS * (len(before) + np.arange(len(eights)) - eights)

    def moved(codes: Int[Array, "sample"]) -> Int[Array, "sample"]:
        out = codes.copy()
        facet, space = codes >= 0, codes <= SPACE
        out[facet] += shift[codes[facet] // CORNERS].astype(out.dtype)
        out[space] -= shift[(SPACE - codes[space]) // CORNERS].astype(out.dtype)
        return out

    probes = {name: np.concatenate([getattr(hits, name), getattr(others, name)[rows]]) for name in PROBES[1:]}
    probes["probe_cells"] = np.concatenate([before, row_at[listed]]).reshape(-1, 4)
    return replace(others, light_cell=moved(others.light_cell), mirror_cell=moved(others.mirror_cell)), probes


def cells_of(codes: Int[Array, "sample"]) -> Int[Array, "cell"]:
    """The cells that ``light_cell`` or ``mirror_cell`` point to, those of the whole sky left out."""
    return np.concatenate([codes[codes >= 0], SPACE - codes[codes <= SPACE]])


def _in_eights(cells: Int[Array, "cell 4"]) -> Int[Array, "eight 8 4"]:
    spare = np.zeros((-len(cells) % CORNERS, 4), cells.dtype)
    return np.concatenate([cells, spare]).reshape(-1, CORNERS, 4)
