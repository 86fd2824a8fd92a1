"""The lens's point spread as a few separable kernels and wide wings, and its convolution with a frame.

A kernel tap is the point spread integrated over one cell of the light's grid. Over the field the kernels of
some nodes are expanded in common ones (a singular value decomposition), with strengths that are bilinear
between the nodes; each common kernel is a sum of products of a column and a row.

The kernels end a few elements away. Light diffracted at the pupil's edges falls with the third power of
distance, and 1 to 2 % of it is beyond that; without it the modulation transfer is too high by as much. Light
scattered at surfaces falls more slowly still. Both are smooth there and are computed on a coarse grid.
"""

import math
from dataclasses import dataclass

import numba as nb
import numpy as np
from jaxtyping import Float
from scipy.signal import fftconvolve
from scipy.special import ndtr

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.wavefront import diffraction_pattern, pupil, wavefront_um

SCATTER_SLOPE = 1.5  # g of ABg: the wings of scatter fall as angle to this power, as of polished glass
SCATTER_SHOULDER_MRAD = 2.0  # of ABg: B to the power 1/g
WING_CELL = 4  # elements: the grid of the wings
_DIFFRACTION_REACH = 64  # elements: less than a tenth of the diffraction wings is beyond
_PARTS = 6  # samples along a cell
ENERGY_SHARE = 0.995  # of the light within reach that a kernel includes
MAX_HALF_WIDTH = 16  # cells, where diffraction alone reaches farther: the wings include the rest
MAX_BLUR = 64  # elements to each side
RANK_ERROR = 2.5e-3  # of a kernel's Frobenius norm: half a thousandth of the light in a tap
SPECTRAL_NODES = 5
FIELD_NODES = 5  # along each side, if the lens changes over the field
SAMPLES_PER_LAMBDA_N = 2.2  # the point spread has no finer detail than two per λN
MIN_CELL_PARTS = 7  # samples along a cell where no spot smooths them


@dataclass(frozen=True)
class LensKernels:
    """Separable kernels of one channel.

    Parameters
    ----------
    down, across
        (term, tap): each term is the outer product of its column and its row. [1]
    strength
        (node row, node column, term): of each term, at nodes spread evenly over the frame, corner to corner.
    far_share, half_side_um
        Share of the light beyond the kernels, and their half side: see `with_wings`. The kernels sum to
        1 − ``far_share``. [1, µm]
    """

    down: Float[Array, "term tap"]
    across: Float[Array, "term tap"]
    strength: Float[Array, "node_row node_column term"]
    far_share: float
    half_side_um: float

    @property
    def half_width(self) -> int:
        """Cells to either side of the middle one."""
        return self.down.shape[1] // 2

    def at(self, row: int, column: int) -> Float[Array, "tap tap"]:
        """Kernel at one node. [1]"""
        return np.einsum("t,ti,tj->ij", self.strength[row, column], self.down, self.across)


def lens_kernels(
    design: SensorDesign,
    wavelength_um: Float[Array, "wavelength"],
    channels: Float[Array, "channel wavelength"],
    oversampling: int = 1,
) -> tuple[LensKernels, ...]:
    """Kernels of each channel on a grid of ``oversampling`` cells along an element's side.

    Parameters
    ----------
    wavelength_um, channels
        Grid and weights of the channels. [µm, 1]
    oversampling
        Cells of the light along an element.
    """
    weight = np.abs(channels)
    used = np.flatnonzero(weight.sum(axis=0) > 0)
    first, last = float(wavelength_um[used[0]]), float(wavelength_um[used[-1]])
    nodes = np.linspace(first, last, SPECTRAL_NODES) if last > first else np.array([first])
    share = np.stack([np.interp(wavelength_um, nodes, row) for row in np.eye(len(nodes))])  # hats
    mix = np.stack([share @ row / row.sum() for row in weight])
    stacks = _cell_kernels(design, nodes, oversampling)  # node, field row, field column, tap, tap
    out = []
    for row in mix:
        kernels = np.tensordot(row, stacks, axes=1)
        middle, total = kernels.shape[-1] // 2, kernels.sum(axis=(-2, -1))
        for half in range(middle + 1):  # the smallest half width with `ENERGY_SHARE` of the light
            core = slice(middle - half, middle + half + 1)
            if np.all(kernels[..., core, core].sum(axis=(-2, -1)) >= ENERGY_SHARE * total):
                break
        kernels = kernels[..., core, core]
        kernels = kernels / kernels.sum(axis=(-2, -1), keepdims=True)
        half_side_um = kernels.shape[-1] / 2 * design.pitch_um / oversampling
        share = diffraction_share(design, float(row @ nodes), half_side_um)
        out.append(LensKernels(*_separate((1 - share) * kernels), share, half_side_um))
    return tuple(out)


def through_lens(
    planes: Float[Array, "plane y x"], kernels: tuple[LensKernels, ...], stride: int, window: Array
) -> Float[Array, "plane row column"]:
    """Planes of light through the lens and onto the elements.

    Parameters
    ----------
    planes
        Light on a grid of ``stride`` cells along an element's side. [radiance]
    kernels
        One for each plane.
    stride, window
        Cells along an element, and the weights in its light of these or of more cells about their middle.

    Returns
    -------
    Mean over each element's aperture of what the kernels carry; `with_wings` adds the rest. [radiance]
    """
    count, height, width = planes.shape
    out = np.zeros((count, height // stride, width // stride), np.float32)
    for plane, kernel in enumerate(kernels):
        source = np.ascontiguousarray(planes[plane], dtype=np.float32)
        # kernel and aperture in one, reversed: the weight of each cell in an element's light
        down, across = (
            np.stack([np.convolve(row[::-1], window) for row in taps]).astype(np.float32)
            for taps in (kernel.down, kernel.across)
        )
        before = kernel.half_width + (len(window) - stride) // 2
        job = source, down, across, before, stride, kernel.strength, out[plane]
        over_rows(_convolve, out.shape[1], *job, least=8)
    return out


def aperture_weights(rays: int, fill_factor: float, cells: int = 1) -> Float[Array, "weight"]:
    """Weights of the cells in an element's light, for `through_lens`.

    Parameters
    ----------
    rays
        Rays along an element's side, whose mean is the light on its one cell.
    fill_factor
        Share of an element's area that its square aperture covers. [1]
    cells
        Cells along an element. Several have light of their own, and the weights are the aperture's.

    Notes
    -----
    Of a wave of f cycles per element the mean of n rays passes sin(πf)/(n sin(πf/n)), a kernel's integral
    over a cell sinc f, and an aperture of side a sinc af. With one cell, the weights are the five that pass
    closest to sinc af over the product of the other two, up to half a cycle per element: within 3 % of it for
    whole apertures, 7 % for tiny ones. More weights would be closer and ring about glints. Finer detail is
    aliased, as by the rays.
    """
    side = math.sqrt(fill_factor)
    if rays == 1 and fill_factor == 1 and cells == 1:
        return np.ones(1)
    if cells > 1:
        edges = np.linspace(-0.5, 0.5, cells + 1)
        covered = np.maximum(np.minimum(edges[1:], side / 2) - np.maximum(edges[:-1], -side / 2), 0)
        return covered / covered.sum()
    f = (np.arange(512) + 0.5) / 1024
    passed = np.sinc(f) * np.sin(np.pi * f) / (rays * np.sin(np.pi * f / rays))
    beside = 2 * (np.cos(2 * np.pi * np.outer(f, [1, 2])) - 1)  # so that the weights sum to 1
    first, second = np.linalg.lstsq(beside, np.sinc(side * f) / passed - 1, rcond=None)[0]
    return np.array([second, first, 1 - 2 * (first + second), first, second])


def _cell_kernels(design: SensorDesign, nodes_um: Array, oversampling: int) -> Array:
    """Point spread over cells: (node, field row, field column, tap, tap), not yet normalised."""
    cell_um = design.pitch_um / oversampling
    optics = design.optics
    terms = [optics.zernike_rms_nm, *(node for row in optics.field_zernikes_rms_nm for node in row)]
    rms_um = [1e-3 * sum(map(abs, term.values())) for term in terms]
    # the wavefront's slope times the focal length; twenty times RMS over diameter bounds low orders well
    aberration_um = 20 * (rms_um[0] + max(rms_um[1:], default=0.0)) * design.f_number
    aberration_um += abs(optics.defocus_um) / design.f_number
    blur_um = aberration_um + 4 * design.spot_sigma_um
    if (blur := blur_um / design.pitch_um) > MAX_BLUR:
        raise ValueError(
            f"`sensor.spot_sigma_um` and sensor.optics must spread a point over at most {MAX_BLUR} elements "
            f"to each side; got about {blur:.0f}. Reduce the spot, the defocus or the aberrations."
        )
    reach_um = 15 * float(nodes_um[-1]) * design.f_number + aberration_um
    half = math.ceil((reach_um + 4 * design.spot_sigma_um) / cell_um)
    half = min(half, max(MAX_HALF_WIDTH, math.ceil(blur_um / cell_um)))
    taps = 2 * max(half, 1) + 1
    edges_um = (np.arange(taps + 1) - taps / 2) * cell_um
    places = np.linspace(-1, 1, FIELD_NODES) if optics.field_zernikes_rms_nm else np.zeros(1)
    diagonal = math.hypot(design.rows, design.columns)
    out = np.empty((len(nodes_um), len(places), len(places), taps, taps))
    for i, down in enumerate(places):
        for j, right in enumerate(places):
            field = (float(right * design.columns / diagonal), float(-down * design.rows / diagonal))
            error_um = wavefront_um(design, field)
            for k, wavelength in enumerate(nodes_um):
                step_um = float(wavelength) * design.f_number / SAMPLES_PER_LAMBDA_N
                if design.spot_sigma_um < step_um:
                    step_um = min(step_um, cell_um / MIN_CELL_PARTS)
                samples = 2 * math.ceil(min(reach_um, edges_um[-1]) / step_um) + 1
                passing = pupil(design, float(wavelength), error_um=error_um)
                _check_sampling(error_um, passing, float(wavelength))
                spread = diffraction_pattern(design, passing, float(wavelength), step_um, samples)
                to_cells = _share_of_cells(samples, step_um, edges_um, design.spot_sigma_um)
                out[k, i, j] = to_cells @ (spread * step_um**2) @ to_cells.T
    return out


def _check_sampling(error_um: Array, passing: Array, wavelength_um: float) -> None:
    """Refuse a wavefront so steep that the samples of the pupil alias it."""
    inside = np.where(np.abs(passing) > 0, error_um, np.nan)
    steepest_um = max(float(np.nanmax(np.abs(np.diff(inside, axis=axis)))) for axis in (0, 1))
    if steepest_um > wavelength_um / 2:
        raise ValueError(
            "`sensor.optics` must have a wavefront that changes by at most half a wavelength between the "
            f"{len(error_um)} samples across the pupil; got {steepest_um / wavelength_um:.2g} wavelengths. "
            "Reduce the defocus or the aberrations."
        )


def _share_of_cells(samples: int, step_um: float, edges_um: Array, spot_um: float) -> Array:
    """(cell, sample): share of each sample's light on each cell, spread by the Gaussian spot."""
    centre = (np.arange(samples) - samples // 2) * step_um
    if spot_um < step_um:  # a sample is a box as wide as its step
        below = np.clip((edges_um[:, None] - centre[None]) / step_um + 0.5, 0, 1)
    else:
        below = ndtr((edges_um[:, None] - centre[None]) / spot_um)
    return np.diff(below, axis=0)


def _separate(kernels: Array) -> tuple[Array, Array, Array]:
    """Approximate the nodes' kernels by a few separable terms; each node's sum stays the same.

    The first term is the product of the kernel's sums along rows and along columns, so that the modulation
    transfer along both axes is exact for any number of terms.
    """
    nodes, taps = kernels.shape[:2], kernels.shape[-1]
    flat = kernels.reshape(-1, taps * taps)
    left, size, common = np.linalg.svd(flat, full_matrices=False)
    first = common[0].reshape(taps, taps)
    down, across = first.sum(axis=1), first.sum(axis=0) / first.sum()
    terms = [(math.inf, size[0] * down, across, left[:, 0])]
    for k in range(len(size)):
        rest = common[k].reshape(taps, taps) - (np.outer(down, across) if k == 0 else 0.0)
        u, s, v = np.linalg.svd(rest)
        terms += [(size[k] * s[t], size[k] * s[t] * u[:, t], v[t], left[:, k]) for t in range(taps)]
    terms.sort(key=lambda term: -term[0])
    left_out = np.cumsum([term[0] ** 2 for term in terms[:0:-1]])[::-1]  # after so many terms
    kept = terms[: 1 + int(np.count_nonzero(left_out > RANK_ERROR**2 * (size**2).sum()))]
    downs, acrosses, strengths = (np.stack([term[k] for term in kept]) for k in (1, 2, 3))
    energy = kernels.sum(axis=(-2, -1)).ravel()
    strengths = strengths.T * (energy / (strengths.T @ (downs.sum(axis=1) * acrosses.sum(axis=1))))[:, None]
    strengths = strengths.reshape(*nodes, -1)
    return downs.astype(np.float32), acrosses.astype(np.float32), strengths.astype(np.float32)


@nb.njit(nogil=True, cache=True, fastmath=True)
def _convolve(start, stop, source, down, across, before, stride, strength, out):
    """Add Σ_terms strength·(down ⊗ across) * source to rows ``start``–``stop`` of ``out``; edges repeat."""
    height, width = source.shape
    columns = out.shape[1]
    terms, taps = down.shape
    node_rows, node_columns, _ = strength.shape
    first = start * stride - before
    length = (stop - 1 - start) * stride + taps
    padded = np.empty(width + 2 * taps, np.float32)
    middle = padded[taps : taps + width]
    smeared = np.empty((length, columns), np.float32)
    total = np.empty(columns, np.float32)
    even = node_rows * node_columns == 1
    for term in range(terms):
        for i in range(length):
            row = source[min(max(first + i, 0), height - 1)]
            for j in range(taps):
                padded[j] = row[0]
                padded[width + taps + j] = row[width - 1]
            for j in range(width):
                middle[j] = row[j]
            line = smeared[i]
            line[:] = 0.0
            for tap in range(taps):
                weight = across[term, tap]
                shift = taps - before + tap
                if stride == 1:
                    for j in range(columns):
                        line[j] += weight * padded[shift + j]
                else:
                    for j in range(columns):
                        line[j] += weight * padded[shift + j * stride]
        for row_out in range(start, stop):
            total[:] = 0.0
            offset = (row_out - start) * stride
            for tap in range(taps):
                weight = down[term, tap]
                line = smeared[offset + tap]
                for j in range(columns):
                    total[j] += weight * line[j]
            if even:
                weight = strength[0, 0, term]
                for j in range(columns):
                    out[row_out, j] += weight * total[j]
                continue
            y = row_out * (node_rows - 1.0) / max(out.shape[0] - 1, 1)
            i0 = min(int(y), node_rows - 2)
            fy = np.float32(y - i0)
            for j in range(columns):
                x = j * (node_columns - 1.0) / max(columns - 1, 1)
                j0 = min(int(x), node_columns - 2)
                fx = np.float32(x - j0)
                upper = (1 - fx) * strength[i0, j0, term] + fx * strength[i0, j0 + 1, term]
                lower = (1 - fx) * strength[i0 + 1, j0, term] + fx * strength[i0 + 1, j0 + 1, term]
                out[row_out, j] += ((1 - fy) * upper + fy * lower) * total[j]


def diffraction_share(design: SensorDesign, wavelength_um: float, half_side_um: float) -> float:
    """Light that the pupil's edges diffract out of a square about the image point. [1]

    Parameters
    ----------
    design, wavelength_um
        The sensor, and the light's wavelength. [µm]
    half_side_um
        Half the square's side, several λN. [µm]

    Notes
    -----
    The mean of the Airy pattern's rings is λN/(π³r³); an obscuration ε makes the edge longer by 1 + ε and the
    open area smaller by 1 − ε². The square's outside holds 4√2 λN/(π³a) of it, as
    ∫∫ r⁻³ dA = 4 ∫_{−π/4}^{π/4} (cos θ/a) dθ. Aberrations move light inside the square and leave the edges.
    """
    edge = design.f_number * wavelength_um / (1 - design.optics.obscuration)
    return min(4 * math.sqrt(2) * edge / (math.pi**3 * half_side_um), 0.5)


def with_wings(
    light: Float[Array, "row column"], design: SensorDesign, far_share: float, half_side_um: float
) -> Float[Array, "row column"]:
    """Add the wings to the light on the elements.

    Parameters
    ----------
    light
        Light by the kernels: 1 − ``far_share`` of all. [radiance]
    far_share, half_side_um
        The rest, and half the side of the square outside which it falls: `diffraction_share`. [1, µm]

    Returns
    -------
    All of it, the frame repeated at its edges. [radiance]

    References
    ----------
    Pfisterer, "Approximated scatter models for stray light analysis", OPN 22(10), 16 (2011): BSDF =
    A/(B + |β − β₀|^g); here normalised to the design's ``scatter_fraction``.
    """
    optics = design.optics
    rows, columns = light.shape
    shape = -(-rows // WING_CELL), -(-columns // WING_CELL)
    margin = (0, shape[0] * WING_CELL - rows), (0, shape[1] * WING_CELL - columns)
    coarse = np.pad(light, margin, mode="edge").reshape(shape[0], WING_CELL, shape[1], WING_CELL)
    coarse = coarse.mean(axis=(1, 3)) / (1 - far_share)
    reach = max(shape) if optics.scatter_fraction else min(_DIFFRACTION_REACH // WING_CELL, max(shape))
    place = (np.arange((2 * reach + 1) * _PARTS) + 0.5) / _PARTS - 0.5 - reach  # samples over cells [cell]
    y, x = np.abs(place[:, None]), np.abs(place[None])
    # wings ∝ r⁻³ outside the square
    outside = np.maximum(y, x) * WING_CELL > half_side_um / design.pitch_um
    diffraction = np.where(outside, WING_CELL * np.hypot(y, x), np.inf) ** -3.0
    kernel = (1 - optics.scatter_fraction) * (far_share * _per_cell(diffraction, reach))
    if optics.scatter_fraction:
        step = WING_CELL * design.pitch_um / design.focal_length_mm / SCATTER_SHOULDER_MRAD
        scatter = 1 / (1 + (step * np.hypot(y, x)) ** SCATTER_SLOPE)
        kernel = kernel + optics.scatter_fraction * _per_cell(scatter, reach)
    wide = fftconvolve(np.pad(coarse, reach, mode="edge"), kernel, mode="valid")
    wings = _between(_between(wide.astype(np.float32).T, columns).T, rows)
    return np.float32(1 - optics.scatter_fraction) * light + wings


def _between(cells: Array, elements: int) -> Array:
    """Values of cells at the elements down them, linear between the middles of cells."""
    at = np.clip((np.arange(elements) + 0.5) / WING_CELL - 0.5, 0, len(cells) - 1)
    low = np.minimum(at.astype(int), max(len(cells) - 2, 0))
    part = (at - low).astype(np.float32)[:, None]
    return cells[low] * (1 - part) + cells[np.minimum(low + 1, len(cells) - 1)] * part


def _per_cell(wings: Array, reach: int) -> Array:
    """Sum samples over cells, and normalise to 1."""
    cells = 2 * reach + 1
    sums = wings.reshape(cells, _PARTS, cells, _PARTS).sum(axis=(1, 3))
    return sums / sums.sum()
