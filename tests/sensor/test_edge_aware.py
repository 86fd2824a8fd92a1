"""Residual interpolation along edges: exact where it must be, local where readings are missing, symmetric."""

import numpy as np
import pytest
from scipy.ndimage import convolve1d, uniform_filter, uniform_filter1d

from glintrack.core.designs import validate_design
from glintrack.sensor import RawDesign, SensorDesign, demosaic, demosaicking, measure_polarization
from glintrack.sensor.demosaicking import inconsistency, tentative_values
from glintrack.sensor.layouts import LAYOUTS, analyser_matrix, places, superpixel
from tests.sensor.light import texture

POLARSENS, PAPER = LAYOUTS["0-45-90-135"], LAYOUTS["mirror-0-60-120"]
THREE = (("open", 0.0, "open"), (60.0, "mirror", 120.0), ("open", "open", "open"))


def readings_of(stokes, layout):
    """What the elements read of Stokes vectors (row, column, 3)."""
    out = stokes[..., 0].copy()
    for (i, j), row in zip(places(layout, "polarizer"), analyser_matrix(layout, 1.0), strict=True):
        out[i::2, j::2] = stokes[i::2, j::2] @ row
    return out


@pytest.mark.parametrize("layout", [POLARSENS, PAPER, ((0.0, 30.0), ("open", 110.0))])
def test_no_stokes_vector_is_inconsistent(layout):
    n = inconsistency(superpixel(layout))
    for vector in np.random.default_rng(0).standard_normal((20, 3)):
        even = readings_of(np.broadcast_to(vector, (2, 2, 3)).copy(), layout)
        assert abs((n * even).sum()) < 1e-12
    assert np.abs(n).mean() == pytest.approx(1)
    if layout is POLARSENS:  # |r0 + r90 − r45 − r135|
        np.testing.assert_allclose(n * np.sign(n[0, 0]), [[1, -1], [-1, 1]], atol=1e-12)


def guide_of(readings, layout):
    """Guide of a whole frame."""
    return demosaicking._guide(np.asarray(readings, np.float64), inconsistency(layout))


def guide_by_filters(readings, layout):
    """S0 along edges by SciPy's filters over the whole frame."""
    wide = np.pad(readings, 8, mode="reflect")
    unlike = wide * np.tile(inconsistency(layout), tuple(n // 2 for n in wide.shape))
    least, total, weights = 1e-6 * readings.mean(), 0.0, 0.0
    for along in (0, 1):

        def pairs(values, along=along):
            smooth = convolve1d(values, [0.25, 0.5, 0.25], axis=1 - along)
            return 0.5 * (smooth + np.roll(smooth, 1, axis=along))

        spread = uniform_filter1d(np.abs(pairs(unlike)), 5, axis=1 - along)
        spread = uniform_filter1d(spread, 3, axis=along)
        for pair, middle in ((0, -1), (1, 2)):
            weight = 1 / (np.roll(spread, -middle, axis=along) + least)
            total += weight * np.roll(pairs(wide), -pair, axis=along)
            weights += weight
    return (total / weights)[8:-8, 8:-8]


@pytest.mark.parametrize("layout", [POLARSENS, PAPER])
def test_the_kernel_is_what_filters_of_the_whole_frame_give(layout):
    """Over slices of rows, their halos and the frame's edges."""
    light = 40 + 20 * texture()
    readings = np.tile(light, (8, 1))[: 2 * 150].astype(np.float32).astype(float)
    guide = guide_by_filters(readings, layout)
    rounding = 1e-9
    np.testing.assert_allclose(guide_of(readings, layout), guide, rtol=rounding)
    residual, found = tentative_values(readings, layout)

    def mean(of):
        return uniform_filter(of, 5, mode="nearest")

    small = readings[:2, :4]  # less than the guide looks
    np.testing.assert_allclose(guide_of(small, layout), guide_by_filters(small, layout), rtol=rounding)
    centre = guide.reshape(guide.shape[0] // 2, 2, -1, 2).mean(axis=(1, 3))
    for k, (i, j) in enumerate(places(layout, "polarizer")):
        g, v = guide[i::2, j::2], readings[i::2, j::2]
        slope = (mean(g * v) - mean(g) * mean(v)) / (mean(g * g) - mean(g) ** 2 + (1e-3 * mean(g)) ** 2)
        a, b = mean(slope), mean(mean(v) - slope * mean(g))
        of_single_precision = 1e-6 * readings.max()
        np.testing.assert_allclose(found[..., k], a * centre + b, atol=of_single_precision)
        np.testing.assert_allclose(residual[i::2, j::2], v - (a * g + b), atol=of_single_precision)


@pytest.mark.parametrize("layout", [POLARSENS, PAPER])
def test_a_ramp_of_any_polarization_comes_to_the_centre(layout):
    y, x = np.mgrid[:32, :40].astype(float)
    s0 = 50 + 0.4 * y - 0.3 * x
    light = np.stack([s0, 0.2 * s0, -0.1 * s0], axis=-1)
    found = demosaic(readings_of(light, layout), layout, "eari")
    centre = light.reshape(16, 2, 20, 2, 3).mean(axis=(1, 3)) @ analyser_matrix(layout, 1.0).T
    a_thousandth_of_a_superpixels_step = 1e-3 * 2 * 0.7
    inner = np.s_[6:-6, 6:-6]
    np.testing.assert_allclose(found[inner], centre[inner], atol=a_thousandth_of_a_superpixels_step)


def test_the_guide_does_not_look_across_an_edge():
    """Beside a corner S0 is that of its own side, where the mean of all kinds has both."""
    light = np.full((32, 32), 20.0)
    light[16:, 16:] = 80.0
    guide = guide_of(light, PAPER)
    assert abs(guide[15, 10] - 20) < 1 and abs(guide[10, 15] - 20) < 1 and abs(guide[17, 17] - 80) < 5
    mean_of_all_kinds = 20 + 60 * 0.75 * 0.25
    assert abs(guide[16, 24] - 80) < abs(mean_of_all_kinds - 80)


@pytest.mark.parametrize("layout", [POLARSENS, PAPER])
def test_what_turns_with_the_light_turns_the_result(layout):
    """Upside down, or twice as bright: the same, upside down or twice as bright."""
    measured = texture()
    plain = demosaic(measured, layout, "eari")
    np.testing.assert_allclose(demosaic(2 * measured, layout, "eari"), 2 * plain, rtol=1e-5, atol=1e-5)
    turned = tuple(reversed(layout))
    kinds = [layout[i][j] for i, j in places(layout, "polarizer")]
    order = [[turned[i][j] for i, j in places(turned, "polarizer")].index(kind) for kind in kinds]
    upside_down = demosaic(measured[::-1].copy(), turned, "eari")[::-1][..., order]
    np.testing.assert_allclose(upside_down, plain, atol=1e-4)


def test_an_unknown_reading_stays_where_it_is_used():
    """The superpixels that are NaN are those of bilinear demosaicking; the others hardly change."""
    measured = texture()
    holed = measured.copy()
    holed[20, 30] = np.nan
    found, whole = demosaic(holed, POLARSENS, "eari"), demosaic(measured, POLARSENS, "eari")
    lost = np.isnan(found)
    np.testing.assert_array_equal(lost, np.isnan(demosaic(holed, POLARSENS, "bilinear")))
    assert 0 < lost.sum() < 8
    far = np.ones(found.shape[:2], bool)
    far[1:20, 6:25] = False
    np.testing.assert_array_equal(found[far], whole[far])
    assert np.nanmax(np.abs(found - whole)) < 0.2 * measured.std()


def test_superpixels_of_another_side_are_refused():
    message = "must be superpixel, bilinear or ppid for superpixels of 3 × 3; got 'eari'"
    with pytest.raises(ValueError, match=f"`demosaic` {message}"):
        measure_polarization(np.ones((12, 12), np.uint16), RawDesign(layout=THREE, demosaic="eari"))
    with pytest.raises(ValueError, match=f"`sensor.demosaic` {message}"):
        validate_design(SensorDesign, {"layout": THREE, "demosaic": "eari", "rows": 12, "columns": 12})
    validate_design(SensorDesign, {"layout": "pan", "demosaic": "eari"})  # nothing to demosaick
