"""Wavelength grids, integration, bands and colour matching."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from glintrack.core.spectral import (
    band_response,
    channel_weights,
    check_band,
    check_wavelengths,
    cie_xyz,
    quadrature_weights,
    resample,
    wavelength_grid,
)

ROUNDING = 1e-12


@st.composite
def grids(draw):
    """Rising, uneven wavelengths within 0.4 to 2.5 µm."""
    thousandths = draw(st.lists(st.integers(400, 2500), min_size=2, max_size=40, unique=True))
    return np.sort(np.array(thousandths)) * 1e-3


# --- grid and quadrature ---------------------------------------------------------------------------


def test_the_standard_grid_is_the_papers_211_bands():
    grid = wavelength_grid()
    assert len(grid) == 211 and grid[0] == 0.4 and grid[-1] == 2.5
    np.testing.assert_allclose(np.diff(grid), 0.01, atol=1e-9)


@pytest.mark.parametrize(("step_um", "count"), [(0.01, 61), (0.025, 25), (0.05, 13), (0.1, 7)])
def test_table_1s_bandwidths_divide_the_visible(step_um, count):
    assert len(wavelength_grid(0.4, 1.0, step_um)) == count


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.3, 1.0), "`wavelength` range must rise within 0.4 to 2.5 µm; got 0.3 to 1.0"),
        ((0.4, 2.6), "got 0.4 to 2.6"),
        ((1.0, 1.0), "got 1.0 to 1.0"),
        ((0.4, 1.0, 1e-300), "`step_um` must be at least 1e-05 µm; got 1e-300"),
        ((0.4, 1.0, 0.07), "`step_um` must divide 0.4 to 1.0 µm into whole steps; got 0.07"),
        ((0.4, 1.0, np.inf), "`step_um` must divide 0.4 to 1.0 µm into whole steps; got inf"),
        ((0.4, 1.0, 0.0), "got 0.0"),
        ((0.4, 1.0, -0.1), "got -0.1"),
    ],
)
def test_a_wrong_grid_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        wavelength_grid(*arguments)


@given(grids(), st.floats(-5, 5), st.floats(-5, 5))
def test_weights_integrate_straight_lines_exactly(grid, slope, offset):
    exact = slope / 2 * (grid[-1] ** 2 - grid[0] ** 2) + offset * (grid[-1] - grid[0])
    assert quadrature_weights(grid) @ (slope * grid + offset) == pytest.approx(exact, abs=100 * ROUNDING)


@pytest.mark.parametrize("degree", [2, 3, 4])
def test_weights_integrate_polynomials_to_the_trapezoid_rules_bound(degree):
    grid = wavelength_grid()
    exact = (2.5 ** (degree + 1) - 0.4 ** (degree + 1)) / (degree + 1)
    bound = 0.01**2 / 12 * degree * (2.5 ** (degree - 1) - 0.4 ** (degree - 1))  # h²/12 [f'(b) − f'(a)]
    error = quadrature_weights(grid) @ grid**degree - exact
    assert error == pytest.approx(bound, rel=1e-3)  # the next term is h²/60 smaller or less


def test_one_wavelength_alone_weighs_one_micrometre():
    np.testing.assert_array_equal(quadrature_weights(np.array([0.55])), [1.0])


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ([], "must name at least one wavelength; got none"),
        ([0.5, 2.6], "must lie within 0.4 to 2.5 µm; got 2.6"),
        ([0.3, 0.5], "got 0.3"),
        ([0.5, float("nan")], "got nan"),
        ([0.6, 0.5], r"must rise; got \[0.6, 0.5\]"),
        ([0.5, 0.5], "must rise"),
    ],
)
def test_wrong_wavelengths_are_named_with_their_key(wrong, message):
    with pytest.raises(ValueError, match=message) as caught:
        check_wavelengths(wrong, "sensor.band_um")
    assert str(caught.value).startswith("`sensor.band_um` must ")


# --- tables ----------------------------------------------------------------------------------------


@given(grids())
def test_resample_is_exact_at_nodes_and_on_straight_lines(grid):
    table = np.stack([2 - 0.5 * grid, grid])
    middle = 0.5 * (grid[:-1] + grid[1:])
    np.testing.assert_array_equal(resample(grid, grid, table), table)
    np.testing.assert_allclose(resample(middle, grid, table), [2 - 0.5 * middle, middle], atol=ROUNDING)


def test_resample_keeps_leading_axes():
    table = np.arange(24.0).reshape(2, 3, 4)
    got = resample(np.array([0.45, 0.5]), np.array([0.4, 0.5, 0.6, 0.7]), table)
    assert got.shape == (2, 3, 2)
    np.testing.assert_allclose(got[1, 2], [20.5, 21.0])
    assert resample(np.array([0.45]), np.array([0.4, 0.5]), np.array([1.0, 2.0])) == pytest.approx([1.5])


@pytest.mark.parametrize("outside", [[0.39, 0.5], [0.5, 0.71]])
def test_resample_does_not_extrapolate(outside):
    with pytest.raises(ValueError, match=r"`grass` must cover .* got data from 0.4 to 0.7 µm"):
        resample(np.array(outside), np.array([0.4, 0.7]), np.ones(2), "grass")


# --- bands and channels ----------------------------------------------------------------------------


@given(grids().filter(lambda grid: len(grid) > 1), st.floats(0.4, 2.5), st.floats(0.4, 2.5))
def test_a_flat_band_has_its_width_on_any_grid(grid, first, last):
    """Within the grid, and wherever its edges lie between the wavelengths."""
    start, stop = sorted((first, last))
    if stop - start < 1e-6:
        return
    response = band_response(start, stop, grid)
    width = max(0.0, min(stop, grid[-1]) - max(start, grid[0]))
    assert quadrature_weights(grid) @ response == pytest.approx(width, abs=1e-8 * len(grid))
    assert (response >= 0).all() and (response <= 1).all()


def test_bands_side_by_side_share_the_wavelength_between_them():
    grid = wavelength_grid(0.4, 1.0)
    parts = [band_response(*band, grid) for band in ((0.4, 0.52), (0.52, 0.6), (0.6, 1.0))]
    np.testing.assert_allclose(np.sum(parts, axis=0), 1.0, atol=1e-9)
    assert parts[1][grid == 0.52] == parts[1][grid == 0.6] == 0.5
    single = [band_response(0.5, 0.6, np.array([um]))[0] for um in (0.49, 0.5, 0.55, 0.6, 0.61)]
    assert single == [0, 1, 1, 1, 0]


@pytest.mark.parametrize("edges", [(0.9, 0.8), (0.9, 2.6)])
def test_a_wrong_band_is_named(edges):
    with pytest.raises(ValueError, match=f"`nir` must rise .* got {edges[0]} to {edges[1]}"):
        check_band("nir", *edges)


@given(grids(), st.floats(0.1, 100))
def test_channel_weights_give_means(grid, level):
    responses = np.stack([np.ones_like(grid), np.exp(-grid), grid - 0.39])
    weights = channel_weights(grid, responses)
    np.testing.assert_allclose(weights @ np.full(len(grid), level), level, rtol=ROUNDING)
    np.testing.assert_allclose(channel_weights(grid, 7 * responses), weights, rtol=ROUNDING)
    low, high = grid[0] - ROUNDING, grid[-1] + ROUNDING
    assert np.all((weights @ grid >= low) & (weights @ grid <= high))


def test_a_flat_channel_of_a_straight_line_is_its_middle():
    grid = wavelength_grid(0.4, 1.0)
    weights = channel_weights(grid, band_response(0.4, 1.0, grid)[None])
    assert (weights @ grid)[0] == pytest.approx(0.7, abs=ROUNDING)


def test_a_channel_without_response_is_named():
    grid = wavelength_grid(0.4, 1.0)
    responses = np.stack([np.ones(61), band_response(1.5, 1.7, grid)])
    with pytest.raises(ValueError, match=r"`responses` must be positive .* got channel 1 with none"):
        channel_weights(grid, responses)


# --- colour ----------------------------------------------------------------------------------------

# CIE 1931 2° observer, CIE 018:2019 tables at 5 nm: x̄, ȳ, z̄
CIE_1931 = {
    0.450: (0.3362, 0.0380, 1.7721),
    0.500: (0.0049, 0.3230, 0.2720),
    0.555: (0.5121, 1.0000, 0.0057),
    0.600: (1.0622, 0.6310, 0.0008),
    0.650: (0.2835, 0.1070, 0.0000),
    0.700: (0.0114, 0.0041, 0.0000),
}
FIT_ERROR = 0.02  # of the fit's peak: about the largest departure Wyman et al. show for their multi-lobe fit


@pytest.mark.parametrize("wavelength_um", CIE_1931)
def test_colour_matching_functions_are_the_cies(wavelength_um):
    got = cie_xyz(np.array([wavelength_um]))[:, 0]
    np.testing.assert_allclose(got, CIE_1931[wavelength_um], atol=FIT_ERROR * 1.78)


def test_equal_energy_light_is_white():
    """The CIE normalized x̄, ȳ, z̄ to equal integrals."""
    grid = wavelength_grid(0.4, 0.8, 0.005)
    x, y, z = cie_xyz(grid) @ quadrature_weights(grid)
    assert x == pytest.approx(y, rel=FIT_ERROR) and z == pytest.approx(y, rel=FIT_ERROR)
    assert y == pytest.approx(0.10686, rel=FIT_ERROR)  # Σȳ Δλ of the CIE table [µm]


def test_infrared_has_no_colour():
    assert np.all(np.abs(cie_xyz(np.array([0.9, 1.5, 2.5]))) < 1e-3)
