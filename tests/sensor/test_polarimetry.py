"""Stokes vectors from mosaics: exactness, bias, field-of-view error, demosaicking, noise."""

import math

import numpy as np
import pytest
import xarray as xr

from glintrack import stokes
from glintrack.core.records import NONE_SERVED
from glintrack.sensor import boost, demosaic, expose, noiseless_frame
from glintrack.sensor.layouts import LAYOUTS, analyser_matrix, invert, superpixel
from tests.sensor.light import GRID, NOISELESS, picture, sensor_of, texture, uniform

VECTORS = [(50.0, 20.0, -10.0), (50.0, 0.0, 0.0), (50.0, -30.0, 40.0)]


def frame_of(sensor, radiance, seed=0):
    return expose(radiance, sensor, NONE_SERVED, np.random.default_rng(seed))


def table(tmp_path, along, across):
    """A polarizer table in the paper's normalisation, from per-aperture transmittances over the grid."""
    path = tmp_path / "table.nc"
    xr.Dataset(
        {
            "pass_transmittance": ("wavelength", along * 10 / 15),
            "block_transmittance": ("wavelength", across * 10 / 15),
        },
        coords={"wavelength": GRID},
    ).to_netcdf(path, engine="h5netcdf")
    return str(path)


@pytest.mark.parametrize("vector", VECTORS)
@pytest.mark.parametrize("layout", ["mirror-0-60-120", "0-45-90-135"])
@pytest.mark.parametrize("way", ["fesenkov", "measured"])
def test_ideal_polarizers_recover_any_vector(vector, layout, way):
    sensor = sensor_of(layout=layout, stokes=way, **NOISELESS)
    found = frame_of(sensor, uniform(sensor, vector))["stokes_radiance"].values
    one_in_a_million = 1e-6 * 50
    assert np.abs(found.mean(axis=(0, 1)) - vector).max() < one_in_a_million
    np.testing.assert_allclose(found, np.broadcast_to(vector, found.shape), atol=10 * one_in_a_million)


@pytest.mark.parametrize("vector", VECTORS)
def test_leaky_polarizers_are_inverted_and_the_ideal_formulas_bias_is_the_analytic_one(tmp_path, vector):
    """A table that varies over the band, with light of the calibration's spectrum."""
    name = table(tmp_path, 0.9 + 0.1 * GRID, 0.3 - 0.2 * GRID)
    found = {}
    for way in ("measured", "fesenkov"):
        sensor = sensor_of(polarizer=name, stokes=way, **NOISELESS)
        frame = frame_of(sensor, uniform(sensor, vector))
        found[way] = frame["stokes_radiance"].values.mean(axis=(0, 1))
        np.testing.assert_allclose(frame["pan"], vector[0], rtol=1e-5)
    weight = sensor.pan_weights[0]
    both, difference = 1.2 - 0.1 * GRID, 0.6 + 0.3 * GRID
    diattenuation = (weight @ difference) / (weight @ both)
    assert sensor.diattenuation == pytest.approx(diattenuation)
    np.testing.assert_allclose(found["measured"], vector, atol=5e-4)
    np.testing.assert_allclose(found["fesenkov"], np.array(vector) * [1, *2 * [diattenuation]], atol=5e-4)
    bias = stokes.dolp(found["fesenkov"]) - stokes.dolp(np.array(vector))
    assert bias == pytest.approx((diattenuation - 1) * stokes.dolp(np.array(vector)), abs=1e-5)


def test_grid_b_is_inverted_within_its_noise():
    """The finer grid at the default exposure: the ideal formula is off by D, the inverse by nothing."""
    vector = np.array([60.0, 15.0, -9.0])
    for way in ("measured", "fesenkov"):
        sensor = sensor_of(rows=256, columns=256, polarizer="grid_b", stokes=way)
        found = frame_of(sensor, uniform(sensor, vector))["stokes_radiance"].values.reshape(-1, 3)
        error_of_mean = found.std(axis=0) / math.sqrt(len(found))
        share = sensor.diattenuation if way == "fesenkov" else 1.0
        assert np.all(np.abs(found.mean(axis=0) - vector * [1, share, share]) < 5 * error_of_mean)
    assert 0.9 < sensor.diattenuation < 0.999


def test_a_scene_of_another_spectrum_leaves_the_residual_that_follows_from_it(tmp_path):
    """Red light on polarizers calibrated in flat light: S1 is off by the ratio of diattenuations."""
    along, across = np.full(len(GRID), 0.9), np.interp(GRID, [0.4, 1.0], [0.0, 0.6])
    sensor = sensor_of(polarizer=table(tmp_path, along, across), **NOISELESS)
    red = np.exp(4 * GRID)
    red /= sensor.pan_weights[0] @ red
    found = frame_of(sensor, uniform(sensor, (50.0, 20.0, 0.0), red))["stokes_radiance"].values.mean((0, 1))
    w = sensor.pan_weights[0]
    sums, differences = w * (along + across), w * (along - across)
    s0 = 50 * (sums @ red) / sums.sum()
    s1 = 20 * (differences @ red) / differences.sum()
    np.testing.assert_allclose(found, [s0, s1, 0], atol=1e-3)
    assert s1 < 18 and s0 > 51  # a tenth: worth reporting
    right = sensor_of(polarizer=sensor.design.polarizer, reference_spectrum="am15g", **NOISELESS)
    assert right.diattenuation != pytest.approx(sensor.diattenuation, abs=1e-4)


def test_agrees_with_polanalyser():
    """polanalyser's least squares on the same three and four irradiances."""
    polanalyser = pytest.importorskip("polanalyser", reason="the dev extra's oracle of polarization images")
    rng = np.random.default_rng(2)
    for name in ("mirror-0-60-120", "0-45-90-135"):
        layout = superpixel(name)
        measured = rng.uniform(10, 20, size=(6, 8))
        angles = [w for row in layout for w in row if not isinstance(w, str)]
        readings = demosaic(measured, layout, "superpixel")
        images = [readings[..., k].astype(float) / 2 for k in range(len(angles))]
        theirs = polanalyser.calcLinearStokes(images, np.radians(angles))
        ours = readings @ invert(analyser_matrix(layout, 1.0)).T
        np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_field_of_view_error_on_an_edge_has_the_right_sign():
    """Unpolarized, bright right of an edge that splits superpixels: 0° and 120° see it, 60° does not."""
    light = np.zeros((64, 80, 3))
    light[:, 41:, 0] = 80.0
    sensor = sensor_of(demosaic="superpixel", **NOISELESS)
    found = frame_of(sensor, picture(sensor, light))["stokes_radiance"].values[10, 20]
    np.testing.assert_allclose(found, stokes.fesenkov(40.0, 0.0, 40.0), atol=1.0)  # less a little diffraction
    assert found[1] > 20 and found[2] < -20
    elsewhere = frame_of(sensor, picture(sensor, light))["stokes_radiance"].values[10, 30]
    np.testing.assert_allclose(elsewhere, [80, 0, 0], atol=0.1)


@pytest.mark.parametrize("layout", ["mirror-0-60-120", "0-45-90-135"])
def test_better_demosaicking_sees_less_false_polarization(layout):
    light = np.zeros((64, 80, 3))
    light[..., 0] = texture()
    error = {}
    for method in ("superpixel", "bilinear", "ppid", "eari"):
        keys = {**NOISELESS, "spot_sigma_um": 70.0}
        sensor = sensor_of(layout=layout, demosaic=method, **keys)
        found = frame_of(sensor, picture(sensor, light))["stokes_radiance"].values
        error[method] = float(np.sqrt(np.mean(stokes.dolp(found) ** 2)))
    assert error["ppid"] < 0.8 * error["bilinear"] < 0.8 * error["superpixel"]
    assert error["eari"] < 0.95 * error["ppid"]


@pytest.mark.parametrize("method", ["superpixel", "bilinear", "ppid", "eari"])
def test_demosaicking_leaves_an_even_field_alone(method):
    sensor = sensor_of(demosaic=method, **NOISELESS)
    found = frame_of(sensor, uniform(sensor, (50.0, 20.0, -10.0)))["stokes_radiance"].values
    np.testing.assert_allclose(found, np.broadcast_to([50, 20, -10], found.shape), atol=1e-3)


def test_ppid_counts_texture_once():
    """Stripes that all kinds see alike: S0 comes out as the superpixels' means, not half as strong again."""
    x = np.mgrid[:24, :48][1].astype(float)
    measured = 50 + 10 * np.cos(2 * np.pi * x / 6)
    s0 = demosaic(measured, LAYOUTS["0-45-90-135"], "ppid").mean(axis=2)[3:-3, 3:-3]
    wanted = measured.reshape(12, 2, 24, 2).mean(axis=(1, 3))[3:-3, 3:-3]
    assert np.sqrt(np.mean((s0 - wanted) ** 2)) < 0.2 * wanted.std()


@pytest.mark.parametrize("method", ["ppid", "eari"])
def test_a_dark_mirror_does_not_spoil_what_looks_at_all_kinds(method):
    layout = LAYOUTS["mirror-0-60-120"]
    measured = np.full((8, 8), 40.0)
    measured[2, 4] = 0.0  # the mirror of superpixel (1, 2) was away
    dark = np.zeros((4, 4), bool)
    dark[1, 2] = True
    np.testing.assert_allclose(demosaic(measured, layout, method, dark), 40, atol=1e-5)
    spread = np.ptp(demosaic(measured, layout, method))
    assert spread > 1 if method == "ppid" else spread < 1e-5  # a guide says nothing of an even field


def test_three_by_three_superpixels_come_to_their_centre():
    layout = superpixel((("open", 0.0, "open"), (60.0, "mirror", 120.0), ("open", "open", "open")))
    y, x = np.mgrid[:24, :30].astype(float)
    readings = demosaic(50 + 2 * y - 3 * x, layout, "bilinear")
    centre = (50 + 2 * y - 3 * x)[1::3, 1::3]
    np.testing.assert_allclose(readings[1:-1, 1:-1], centre[1:-1, 1:-1, None].repeat(3, axis=2), atol=1e-3)


# --- DoLP, AoP, boost ------------------------------------------------------------------------------


def test_boost_multiplies_and_cuts_off():
    np.testing.assert_allclose(boost(np.array([0.01, 0.15, 0.3])), [0.05, 0.75, 1.0])
    with pytest.raises(ValueError, match="`factor` must be positive; got 0"):
        boost(np.zeros(2), 0)


@pytest.mark.parametrize("polarizer", ["ideal", "grid_b"])
def test_behind_a_depolarizer_polarized_light_reads_as_unpolarized(polarizer):
    """M = diag(1, 0, 0), in a mosaic and in the frame without noise."""
    keys = {"polarizer": polarizer, "rows": 32, "columns": 40}
    plain, blind = sensor_of(**keys), sensor_of(**keys, optics={"depolarizer": True})
    grey = expose(uniform(plain, (50.0, 0.0, 0.0)), plain, NONE_SERVED, np.random.default_rng(3))
    seen = expose(uniform(blind, (50.0, 20.0, -10.0)), blind, NONE_SERVED, np.random.default_rng(3))
    xr.testing.assert_identical(seen, grey)
    assert not noiseless_frame(uniform(blind, (50.0, 20.0, -10.0)), blind)["stokes_radiance"][..., 1:].any()
