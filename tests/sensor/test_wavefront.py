"""Point spread and modulation transfer against closed forms."""

import math

import numpy as np
import pytest
from scipy.special import j1

from glintrack.sensor import modulation_transfer
from glintrack.sensor.lens_kernels import WING_CELL, diffraction_share, lens_kernels, through_lens, with_wings
from glintrack.sensor.wavefront import (
    diffraction_pattern,
    noll_indices,
    pupil,
    relative_illumination,
    wavefront_um,
    zernike,
)
from tests.plain import plain_sensor

GRID = np.round(np.arange(0.4, 1.0001, 0.01), 9)
FLAT = np.ones((1, len(GRID)))
LAMBDA_UM = 0.55


def design_of(**keys):
    return plain_sensor(**{"spot_sigma_um": 0.0, "rows": 64, "columns": 80, **keys})


def airy(radius_um, f_number, obscuration=0.0):
    """Irradiance of the (annular) Airy pattern, integral 1. [µm⁻²]"""

    def disc(part):
        v = np.maximum(math.pi * part * radius_um / (LAMBDA_UM * f_number), 1e-9)
        return part**2 * 2 * j1(v) / v

    amplitude = disc(1.0) - (disc(obscuration) if obscuration else 0.0)
    return math.pi / 4 * amplitude**2 / (LAMBDA_UM * f_number) ** 2 / (1 - obscuration**2)


def point_spread(design, wavelength_um, step_um, samples, field=(0.0, 0.0)):
    passing = pupil(design, wavelength_um, field)
    return diffraction_pattern(design, passing, wavelength_um, step_um, samples)


@pytest.mark.parametrize("f_number", [2.8, 5.6])
@pytest.mark.parametrize("obscuration", [0.0, 0.35])
def test_point_spread_is_the_airy_pattern(f_number, obscuration):
    step, samples = 0.1 * f_number * LAMBDA_UM, 81
    design = design_of(f_number=f_number, optics={"obscuration": obscuration})
    spread = point_spread(design, LAMBDA_UM, step, samples)
    place = (np.arange(samples) - 40) * step
    wanted = airy(np.hypot(place[:, None], place[None]), f_number, obscuration)
    of_the_peak = 0.002  # a pupil of 128 samples with softened edges
    np.testing.assert_allclose(spread, wanted, atol=of_the_peak * wanted.max())
    first_ring = np.abs(place - 1.22 * LAMBDA_UM * f_number).argmin()
    if not obscuration:
        assert spread[40, first_ring] < 1e-3 * spread[40, 40]


def test_transfer_of_a_clear_pupil():
    """MTF of a circular pupil: (2/π)(arccos ν − ν√(1−ν²)), Goodman §6.3."""
    design = design_of(f_number=4.0)
    part = np.linspace(0, 1.2, 25)
    found = modulation_transfer(design, LAMBDA_UM, part * 1e3 / (LAMBDA_UM * 4.0), element=False)
    inside = np.minimum(part, 1)
    np.testing.assert_allclose(
        found, 2 / math.pi * (np.arccos(inside) - inside * np.sqrt(1 - inside**2)), atol=0.004
    )


def test_transfer_of_an_element_and_of_a_spot():
    design = design_of(f_number=0.5, pitch_um=10.0, fill_factor=0.25)  # no diffraction worth naming
    frequency = np.array([0.0, 20.0, 50.0])
    clear = modulation_transfer(design, LAMBDA_UM, frequency, element=False)
    with_element = modulation_transfer(design, LAMBDA_UM, frequency)
    np.testing.assert_allclose(with_element / clear, np.sinc(5e-3 * frequency), rtol=1e-12)
    blurred = modulation_transfer(
        design_of(f_number=0.5, spot_sigma_um=4.0), LAMBDA_UM, frequency, element=False
    )
    np.testing.assert_allclose(blurred / clear, np.exp(-2 * (math.pi * 4e-3 * frequency) ** 2), rtol=1e-12)


def test_noll_indices_are_those_of_his_table():
    """Noll, J. Opt. Soc. Am. 66, 207 (1976), Table I; odd indices are sines, written as negative m."""
    table = {
        1: (0, 0), 2: (1, 1), 3: (1, -1), 4: (2, 0), 5: (2, -2), 6: (2, 2), 7: (3, -1), 8: (3, 1),
        9: (3, -3), 10: (3, 3), 11: (4, 0), 12: (4, 2), 13: (4, -2), 14: (4, 4), 15: (4, -4), 16: (5, 1),
        17: (5, -1), 18: (5, 3), 19: (5, -3), 20: (5, 5), 21: (5, -5), 22: (6, 0), 37: (8, 0),
    }  # fmt: skip
    assert {index: noll_indices(index) for index in table} == table


def test_zernike_polynomials_are_noll_s():
    """Rows of Noll's Table I, written out."""
    r, t = np.meshgrid(np.linspace(0, 1, 7), np.linspace(0, 2 * math.pi, 9))
    written = {
        4: math.sqrt(3) * (2 * r**2 - 1),
        5: math.sqrt(6) * r**2 * np.sin(2 * t),
        8: math.sqrt(8) * (3 * r**3 - 2 * r) * np.cos(t),
        11: math.sqrt(5) * (6 * r**4 - 6 * r**2 + 1),
        12: math.sqrt(10) * (4 * r**4 - 3 * r**2) * np.cos(2 * t),
    }
    for index, values in written.items():
        np.testing.assert_allclose(zernike(index, r, t), values, atol=1e-12)


def test_zernike_polynomials_are_orthonormal_over_the_disc():
    """Gauss quadrature in r² and equal steps of azimuth: exact for polynomials of this degree."""
    node, weight = np.polynomial.legendre.leggauss(12)
    r, t = np.meshgrid(np.sqrt((node + 1) / 2), 2 * math.pi * np.arange(32) / 32)
    values = np.stack([zernike(index, r, t) for index in range(1, 38)])
    products = np.einsum("iar,jar,r->ij", values, values, weight / 2) / 32
    np.testing.assert_allclose(products, np.eye(37), atol=1e-12)


def test_defocus_is_the_geometric_path_error():
    """A detector δ behind focus: the path error falls as ρ² to −δ/(8N²) at the pupil's edge.

    A ray of the pupil's radius ρ has crossed the axis and lands at −δρ/(2N), which is 2N ∂W/∂ρ.
    """
    design = design_of(f_number=4.0, optics={"defocus_um": 50.0})
    error = wavefront_um(design, samples=101)
    edge, middle = error[50, 100], error[50, 50]
    assert edge - middle == pytest.approx(-50.0 / (8 * 16), rel=1e-6)
    slope = (error[50, 100] - error[50, 98]) / 0.04  # at ρ = 0.98
    assert 2 * 4.0 * slope == pytest.approx(-50.0 * 0.98 / (2 * 4.0), rel=1e-6)


def test_small_aberrations_lower_the_peak_as_marechal_says():
    rms_um = LAMBDA_UM / 20
    design = design_of(optics={"zernike_rms_nm": {6: 1e3 * rms_um}})
    perfect, aberrated = (point_spread(d, LAMBDA_UM, 0.5, 3)[1, 1] for d in (design_of(), design))
    assert aberrated / perfect == pytest.approx(math.exp(-((2 * math.pi / 20) ** 2)), rel=0.01)


def test_coma_points_along_the_field_and_grows_with_it():
    def corner(up, right):  # coma of 50 nm toward the corners, growing as the field height
        return {8: 50.0 * right / math.sqrt(2), 7: 50.0 * up / math.sqrt(2)}

    nodes = [[corner(-down, right) for right in (-1, 0, 1)] for down in (-1, 0, 1)]
    design = design_of(optics={"field_zernikes_rms_nm": nodes}, rows=80)
    centre = point_spread(design, LAMBDA_UM, 1.0, 81)
    np.testing.assert_allclose(centre, centre[::-1, ::-1], atol=1e-9)

    def shift(field):
        spread = point_spread(design, LAMBDA_UM, 1.0, 81, field)
        place = np.arange(81) - 40
        inner = np.hypot(place[:, None], place[None]) < 30
        total = (spread * inner).sum()
        return (
            np.array([-(spread * inner).sum(1) @ place, (spread * inner).sum(0) @ place]) / total
        )  # up, right

    edge = 1 / math.sqrt(2)  # of a square array, over the distance to its corner
    right, up, half = shift((edge, 0.0)), shift((0.0, edge)), shift((edge / 2, 0.0))
    assert abs(right[0]) < 0.02 * abs(right[1]) and abs(up[1]) < 0.02 * abs(up[0])
    assert up[0] == pytest.approx(right[1], rel=0.01)  # the same, turned by 90°
    assert half[1] / right[1] == pytest.approx(0.5, abs=0.05)


def test_a_closed_pupil_is_refused():
    with pytest.raises(
        ValueError, match=r"`sensor.optics.obscuration` must leave part of the pupil open; got 1"
    ):
        design_of(optics={"obscuration": 1.0})
    shut = design_of().model_copy(
        update={"optics": design_of().optics.model_copy(update={"obscuration": 1.5})}
    )
    with pytest.raises(ValueError, match="`pupil` must pass light"):
        pupil(shut, LAMBDA_UM)


# --- kernels ---------------------------------------------------------------------------------------


def test_kernels_carry_all_light_and_have_the_spots_width():
    kernels = lens_kernels(design_of(spot_sigma_um=17.0, f_number=1.0), GRID, FLAT)[0]
    kernel = kernels.at(0, 0)
    assert kernel.sum() + kernels.far_share == pytest.approx(1, abs=1e-6)
    kernel /= kernel.sum()
    place = np.arange(len(kernel)) - len(kernel) // 2
    variance = kernel.sum(0) @ place**2
    # the Gaussian of one element, and the cell it is summed over; 0.5 % of the light is beyond the kernel
    assert variance == pytest.approx(1 + 1 / 12, rel=0.06)


@pytest.mark.parametrize("oversampling", [1, 3, 5])
def test_wide_blurs_are_whole_on_any_grid(oversampling):
    """A disc of diameter δ/N has an RMS of δ/(4N) along an axis, a spot its own; in elements of 17 µm."""
    for keys, sigma in (
        ({"f_number": 4.0, "optics": {"defocus_um": 400.0}}, 400 / 4 / 4 / 17),
        ({"f_number": 1.0, "spot_sigma_um": 34.0}, 2.0),
    ):
        kernel = lens_kernels(design_of(**keys), GRID, FLAT, oversampling)[0].at(0, 0)
        place = (np.arange(len(kernel)) - len(kernel) // 2) / oversampling
        light = kernel.sum(axis=0) * (np.abs(place) <= 6.5)  # without diffraction's wings
        variance = light @ place**2 / light.sum()
        assert variance == pytest.approx(sigma**2 + 1 / 12 / oversampling**2, rel=0.08)


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"spot_sigma_um": 200.0, "pitch_um": 3.45}, r"must spread a point .* got about 232\."),
        ({"optics": {"defocus_um": 2500.0}}, r"must have a wavefront that changes .* Reduce the defocus"),
    ],
)
def test_blurs_that_cannot_be_computed_are_refused(keys, sentence):
    with pytest.raises(ValueError, match=sentence):
        lens_kernels(design_of(**keys), GRID, FLAT)


def test_a_perfect_small_lens_leaves_light_where_it_falls():
    kernel = lens_kernels(design_of(f_number=0.5), GRID, FLAT)[0].at(0, 0)
    assert kernel.max() > 0.98


def test_passage_is_a_convolution_with_the_kernel():
    """A coma'd point goes where the point spread says: separable terms against the kernel itself."""
    design = design_of(optics={"zernike_rms_nm": {8: 600.0}})
    kernels = lens_kernels(design, GRID, FLAT)
    point = np.zeros((1, 64, 80), np.float32)
    point[0, 30, 40] = 1000
    image = through_lens(point, kernels, 1, np.ones(1))[0]
    taps, half = kernels[0].at(0, 0), kernels[0].half_width
    np.testing.assert_allclose(image[30 - half : 31 + half, 40 - half : 41 + half], 1000 * taps, atol=0.01)
    assert abs(taps - taps[:, ::-1]).max() > 0.01  # and it is lopsided


def test_finer_light_gives_the_same_picture():
    """A smooth scene on 3 × 3 cells of each element and on the elements themselves."""
    design = design_of(spot_sigma_um=12.0)
    y, x = np.mgrid[:192, :240] / 3
    fine = (100 + 40 * np.sin(x / 6) * np.cos(y / 5))[None].astype(np.float32)
    coarse = fine.reshape(1, 64, 3, 80, 3).mean(axis=(2, 4))
    third = np.full(3, 1 / 3)
    from_fine = through_lens(fine, lens_kernels(design, GRID, FLAT, 3), 3, third)
    from_coarse = through_lens(coarse, lens_kernels(design, GRID, FLAT), 1, np.ones(1))
    np.testing.assert_allclose(from_fine[0, 8:-8, 8:-8], from_coarse[0, 8:-8, 8:-8], atol=0.15)  # of 40


def test_kernels_over_the_field_follow_the_lens():
    place = np.linspace(-1, 1, 5)
    nodes = [[{4: 350.0 * (y * y + x * x)} for x in place] for y in place]
    design = design_of(optics={"field_zernikes_rms_nm": nodes})
    kernel = lens_kernels(design, np.array([0.5, 0.6]), np.ones((1, 2)))[0]
    peaks = np.array([[kernel.at(i, j).max() for j in range(5)] for i in range(5)])
    assert peaks[2, 2] > peaks[2, 4] > peaks[4, 4] and peaks[0, 0] == pytest.approx(peaks[4, 4], rel=0.01)
    even = through_lens(np.full((1, 64, 80), 50, np.float32), (kernel,), 1, np.ones(1))[0]
    np.testing.assert_allclose(even, 50 * (1 - kernel.far_share), rtol=1e-4)
    all_of_it = with_wings(even, design, kernel.far_share, kernel.half_side_um)
    np.testing.assert_allclose(all_of_it, 50, rtol=1e-4)


def test_scatter_keeps_the_light_and_reaches_far():
    design = design_of(optics={"scatter_fraction": 0.1}, rows=160, columns=240)
    np.testing.assert_allclose(with_wings(np.full((160, 240), 7.0), design, 0.0, 50.0), 7.0, rtol=1e-5)
    point = np.zeros((160, 240))
    point[80 : 80 + WING_CELL, 120 : 120 + WING_CELL] = 100
    wings = with_wings(point, design, 0.0, 50.0) - 0.9 * point
    assert wings[84, 124] > wings[84, 160] > wings[84, 200] > 0
    assert wings.sum() < 0.1 * point.sum()


@pytest.mark.parametrize("obscuration", [0.0, 0.35])
def test_what_lies_beyond_a_square_is_what_edges_diffract(obscuration):
    """The point spread summed over squares of 12 and 24 λN, against the law of the wings."""
    design = design_of(f_number=5.6, optics={"obscuration": obscuration})
    step_um = LAMBDA_UM * 5.6 / 4
    spread = point_spread(design, LAMBDA_UM, step_um, 97) * step_um**2
    for half in (24, 48):
        inside = spread[48 - half : 49 + half, 48 - half : 49 + half].sum()
        beyond = diffraction_share(design, LAMBDA_UM, (half + 0.5) * step_um)
        assert 1 - inside == pytest.approx(beyond, rel=0.1)


def transfer(design, cells, cycles):
    """Modulation of gratings of so many cycles an element, through kernels, apertures and wings, along x."""
    kernel = lens_kernels(design, GRID, FLAT, cells)[0]
    place = (np.arange(design.columns * cells) + 0.5) / cells
    middle = np.arange(design.columns) + 0.5
    used = slice(design.columns // 4, 3 * design.columns // 4)
    found = []
    for f in cycles:
        waves = []
        for grating in (np.cos(2 * np.pi * f * place), np.sin(2 * np.pi * f * place)):
            light = np.broadcast_to(grating, (1, 48 * cells, len(place))).astype(np.float32)
            near = through_lens(light, (kernel,), cells, np.full(cells, 1 / cells))[0]
            waves.append(with_wings(near, design, kernel.far_share, kernel.half_side_um)[24])
        wave = (waves[0] + 1j * waves[1]) * np.exp(-2j * np.pi * f * middle)
        found.append(abs(wave[used].mean()))
    return np.array(found)


def closed_form(design, cycles):
    """Circular pupil over the band × Gaussian spot × square element, at so many cycles an element."""
    per_um = np.abs(cycles) / design.pitch_um
    shift = np.minimum(per_um[:, None] * np.linspace(0.4, 1.0, 601) * design.f_number, 1)
    diffraction = (2 / math.pi * (np.arccos(shift) - shift * np.sqrt(1 - shift**2))).mean(axis=1)
    spot = np.exp(-2 * (math.pi * design.spot_sigma_um * per_um) ** 2)
    return diffraction * spot * np.sinc(cycles)


@pytest.mark.parametrize("keys", [{}, {"f_number": 2.8}, {"spot_sigma_um": 6.0}, {"pitch_um": 30.0}])
def test_modulation_on_three_cells_an_element_is_the_closed_form(keys):
    design = design_of(**{"spot_sigma_um": 12.0, "columns": 400, **keys})
    cycles = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4])
    np.testing.assert_allclose(transfer(design, 3, cycles), closed_form(design, cycles), rtol=0.01)


@pytest.mark.parametrize("keys", [{"spot_sigma_um": 12.0}, {"f_number": 2.8}, {"f_number": 11.0}])
def test_modulation_on_whole_elements_is_the_closed_form_and_its_aliases(keys):
    """Light sampled once an element shows f + k as f: their transfers add."""
    design = design_of(**{"columns": 400, **keys})
    cycles = np.array([0.01, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4])
    wanted = sum(closed_form(design, cycles + k) for k in range(-6, 7))
    np.testing.assert_allclose(transfer(design, 1, cycles), wanted, rtol=0.01)


def test_light_falls_off_as_cos4():
    design = design_of(rows=560, columns=880, focal_length_mm=10.0)
    light = relative_illumination(design, np.array([279.5, 0.0]), np.array([439.5, 879.0]))
    angle = math.atan(17e-3 * 439.5 / 10)
    assert light[0, 0] == 1 and light[0, 1] == pytest.approx(math.cos(angle) ** 4)
