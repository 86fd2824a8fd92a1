"""The sensor against closed forms: Malus and Fesenkov, photon transfer, one query a column, spectra."""

import math

import numpy as np
import pytest
import xarray as xr
from pydantic import ValidationError
from scipy.constants import c, h

from glintrack import stokes
from glintrack.camera import Pose, ground_points, look_at
from glintrack.core.records import NONE_SERVED, SpectralQuery
from glintrack.core.spectral import wavelength_grid
from glintrack.sensor import (
    build_sensor,
    expose,
    measure_spectra,
    noise_equivalent_radiance,
    serve,
)
from tests.plain import plain_sensor

GRID = wavelength_grid(0.4, 1.0)
SIGMAS = 5.0  # of the mean over a frame: one false alarm in a million
QUIET = {"integration_time_ms": 0.1, "read_noise_e": 0.0, "bits": 24, "full_well_e": 1e9}
SHARP = {"spot_sigma_um": 0.0, "f_number": 0.5}  # no aberration; a diffraction spot far below an element


def sensor_of(**design):
    return build_sensor(plain_sensor(**{"rows": 64, "columns": 80, **design}), GRID)


def uniform(vector, spectrum=None):
    """A radiance function whose every pixel has the same Stokes vector times a spectrum."""
    spectrum = np.ones(len(GRID)) if spectrum is None else spectrum
    shape = {}

    def radiance(channels, pixels=None):
        light = (channels @ spectrum)[:, None] * np.asarray(vector, float)
        if pixels is not None:
            return xr.DataArray(np.broadcast_to(light, (len(pixels), *light.shape)))
        return xr.DataArray(np.broadcast_to(light, (*shape["array"], *light.shape)))

    def sized(sensor):
        shape["array"] = (sensor.camera.rows, sensor.camera.columns)
        return radiance

    return sized


def frame_of(sensor, vector, seed=0, served=NONE_SERVED):
    return expose(uniform(vector)(sensor), sensor, served, np.random.default_rng(seed))


# --- radiometry ------------------------------------------------------------------------------------


def test_electrons_follow_the_camera_equation():
    """N = L·Δλ · A · π/(4F²+1) · t · τ·QE / (hc/λ), in one narrow band where λ hardly varies."""
    optics = {"quantum_efficiency": 0.5, "optics_transmission": 0.8, "f_number": 4.0}
    sensor = sensor_of(band_um=(0.54, 0.56), integration_time_ms=0.1, **optics)
    power = 0.02 * (17e-6) ** 2 * math.pi / 65
    photons = power * 0.1e-3 / (h * c / 0.55e-6)
    assert sensor.electrons_per_radiance == pytest.approx(0.4 * photons, rel=1e-3)


def test_pan_is_the_photon_weighted_mean():
    sensor = sensor_of()
    spectrum = 2.0 + GRID
    light = uniform((1, 0, 0), spectrum)(sensor)(sensor.pan_weights)[0, 0, 0, 0]
    exact = (0.6**2 / 2 + 0.6 * 0.4) * 2 + (1.0**3 - 0.4**3) / 3  # ∫λ(2+λ)dλ
    assert float(light) == pytest.approx(exact / ((1.0**2 - 0.4**2) / 2), rel=1e-4)


def test_photon_transfer_gives_the_gain():
    """Shot noise alone: variance over mean in radiance is one electron's worth of it."""
    sensor = sensor_of(rows=512, columns=512, **QUIET)
    pan = frame_of(sensor, (80.0, 0, 0))["pan"].values.astype(float)
    two_percent = 0.02  # √(2/65536) = 0.6 % is one sigma of a variance over this many mirrors
    assert pan.var() / pan.mean() * sensor.electrons_per_radiance == pytest.approx(1, abs=two_percent)
    assert pan.mean() == pytest.approx(80, abs=SIGMAS * pan.std() / 256)


def test_dark_noise_is_the_noise_equivalent_radiance():
    sensor = sensor_of(rows=512, columns=512)
    dark = frame_of(sensor, (0.0, 0, 0))["pan"].values.astype(float)
    assert dark.std() == pytest.approx(noise_equivalent_radiance(sensor), rel=0.02)
    assert dark.mean() == pytest.approx(0, abs=SIGMAS * dark.std() / 256)


def test_a_full_well_clips():
    sensor = sensor_of(full_well_e=5000.0, optics={"relative_illumination": "even"})
    full = 5000.0 / sensor.electrons_per_radiance
    pan = frame_of(sensor, (10 * full, 0, 0))["pan"].values
    assert pan.max() <= full
    assert pan.mean() == pytest.approx(full, rel=0.01)  # read noise of 20 e in 5000, cut off above


def test_quantizer_has_its_bits():
    sensor = sensor_of(bits=4, read_noise_e=0.0, full_well_e=1600.0, optics={"relative_illumination": "even"})
    levels = np.unique(frame_of(sensor, (700 / sensor.electrons_per_radiance, 0, 0))["pan"].values)
    steps = levels * sensor.electrons_per_radiance / (1600 / 2**4)
    assert len(levels) >= 3
    np.testing.assert_allclose(steps, np.round(steps), atol=1e-5)  # float32 frames


# --- polarimetry -----------------------------------------------------------------------------------


@pytest.mark.parametrize("q", [0.0, 0.3, -0.5])
@pytest.mark.parametrize("u", [0.0, 0.4, -0.2])
def test_ideal_polarizers_and_fesenkov_recover_a_uniform_field(q, u):
    sensor = sensor_of(rows=256, columns=256)
    vector = 60.0 * np.array([1, q, u])
    measured = frame_of(sensor, vector)["stokes_radiance"].values.reshape(-1, 3)
    error_of_mean = measured.std(axis=0) / math.sqrt(len(measured))
    assert np.all(np.abs(measured.mean(axis=0) - vector) < SIGMAS * error_of_mean)


def test_without_noise_fesenkov_is_exact():
    sensor = sensor_of(
        **{
            **QUIET,
            "integration_time_ms": 1000.0,
            "max_frame_rate_hz": 1.0,
            "full_well_e": 1e12,
            "f_number": 1.0,
        }
    )
    measured = frame_of(sensor, (50.0, 20.0, -10.0))["stokes_radiance"].values
    shot = 5 * math.sqrt(2 * 50 / sensor.electrons_per_radiance)
    assert shot < 0.01
    np.testing.assert_allclose(measured, np.broadcast_to([50, 20, -10], measured.shape), atol=shot)


def test_analysers_are_half_of_an_ideal_polarizers_first_row():
    sensor = sensor_of()
    for (row, column), angle in {(0, 1): 0, (1, 0): 60, (1, 1): 120}.items():
        first_row = stokes.linear_diattenuator(1, 0, math.radians(angle))[0, :3]
        weights = sensor.element_gains[row, column] / sensor.electrons_per_radiance
        np.testing.assert_allclose(weights, first_row, atol=1e-12)
    np.testing.assert_allclose(sensor.element_gains[0, 0], [sensor.electrons_per_radiance, 0, 0])
    assert len(sensor.channels) == 1  # one look at the light is enough for ideal polarizers


def test_each_element_sees_its_own_ray():
    """The mosaic's field-of-view error: what changes within a superpixel passes for polarization."""
    sensor = sensor_of(**QUIET, **SHARP, demosaic="superpixel")
    light = np.zeros((64, 80, 1, 3))
    light[:, 1::2, 0, 0] = 90.0  # odd columns bright: the mirror and the 60° element stand in even ones
    frame = expose(
        lambda channels, pixels=None: xr.DataArray(light), sensor, NONE_SERVED, np.random.default_rng(0)
    )
    far = sensor.kernels[0].far_share * 45.0  # of the mean light, by the lens's wings
    bright = 45.0 * (1 - sensor.kernels[0].far_share) + far / 2
    np.testing.assert_allclose(frame["pan"], far, rtol=0.05)
    wanted = stokes.fesenkov(bright, far / 2, bright)
    measured = frame["stokes_radiance"].values.reshape(-1, 3)
    np.testing.assert_allclose(measured.mean(axis=0), wanted, atol=SIGMAS * measured.std() / math.sqrt(1280))


@pytest.mark.parametrize("axis", [0, 1])
def test_bilinear_demosaicking_removes_the_linear_part_of_that_error(axis):
    """An unpolarized ramp: raw superpixels see false polarization, centred ones none away from the edge."""
    ramp = 50.0 + 0.5 * np.indices((64, 80))[axis]
    light = np.zeros((64, 80, 1, 3))
    light[..., 0, 0] = ramp
    found = {}
    for demosaic in ("superpixel", "bilinear"):
        quiet = {
            **QUIET,
            "integration_time_ms": 1000.0,
            "max_frame_rate_hz": 1.0,
            "full_well_e": 1e12,
            "bits": 24,
        }
        sensor = sensor_of(**{**quiet, **SHARP}, demosaic=demosaic)
        frame = expose(
            lambda channels, pixels=None: xr.DataArray(light), sensor, NONE_SERVED, np.random.default_rng(0)
        )
        found[demosaic] = frame["stokes_radiance"].values[2:-2, 2:-2]
    centre = (ramp[::2, ::2] + ramp[1::2, 1::2])[2:-2, 2:-2] / 2
    shot = SIGMAS * math.sqrt(2 * 90 / sensor.electrons_per_radiance)
    assert np.abs(found["superpixel"][..., 1:]).max() > 10 * shot
    np.testing.assert_allclose(found["bilinear"][..., 1:], 0, atol=shot)
    np.testing.assert_allclose(found["bilinear"][..., 0], centre, atol=shot)


@pytest.mark.parametrize(("demosaic", "offset"), [("superpixel", 1 / 6), ("bilinear", 0.0)])
def test_offsets_say_where_the_mirror_and_the_polarizers_stand(demosaic, offset):
    frame = frame_of(sensor_of(demosaic=demosaic), (50.0, 0, 0))
    assert (frame["y"][0], frame["y"][1], frame["x"][0]) == (0.5, 2.5, 0.5)
    pan, polarized = frame["pan"].attrs, frame["stokes_radiance"].attrs
    assert (pan["row_offset"], pan["column_offset"]) == (-0.5, -0.5)  # element (0, 0) of each superpixel
    np.testing.assert_allclose([polarized["row_offset"], polarized["column_offset"]], offset)
    assert polarized["stokes_frame"] == "detector"


def test_same_generator_same_frame():
    sensor = sensor_of()
    assert frame_of(sensor, (40, 5, 1), seed=3).identical(frame_of(sensor, (40, 5, 1), seed=3))
    assert not frame_of(sensor, (40, 5, 1), seed=3).equals(frame_of(sensor, (40, 5, 1), seed=4))


def test_radiance_of_another_shape_is_refused():
    sensor = sensor_of()
    wrong = xr.DataArray(np.zeros((4, 4, 1, 3)))
    with pytest.raises(
        ValueError, match=r"`radiance` must give a frame of \(64, 80, 1, 3\) .*; got \(4, 4, 1, 3\)"
    ):
        expose(lambda channels, pixels=None: wrong, sensor, NONE_SERVED, np.random.default_rng(0))


# --- spectra on request ----------------------------------------------------------------------------

POSE = look_at(Pose(0.0, -500.0, 1500.0, kind="reported"), (0.0, 0.0, 0.0))


def query_at(sensor, row, column, **fields):
    """A query for the ground point that one superpixel's mirror sees."""
    pixel = 2 * np.array([row, column]) + sensor.mirror_element
    return SpectralQuery(*ground_points(sensor.camera, POSE, pixel).tolist(), **fields)


def test_each_query_gets_the_mirror_that_sees_its_point():
    sensor = sensor_of()
    places = [(0, 0), (31, 39), (12, 7), (5, 20)]
    served = serve(tuple(query_at(sensor, *place) for place in places), sensor, POSE)
    assert list(zip(served.rows, served.columns, strict=True)) == places
    assert served.is_served.all() and served.refusals == ("",) * 4
    points = np.array([q.position for q in served.queries])
    np.testing.assert_array_equal(sensor.superpixel_of(points, POSE)[:, 1], [0, 39, 7, 20])


def test_one_query_a_column_highest_priority_first():
    sensor = sensor_of()
    low, high, other = (
        query_at(sensor, 3, 10, priority=1.0, track_id=1),
        query_at(sensor, 20, 10, priority=2.0, track_id=2),
        query_at(sensor, 20, 11, priority=0.5, track_id=3),
    )
    served = serve((low, high, other), sensor, POSE)
    np.testing.assert_array_equal(served.rows, [-1, 20, 20])
    np.testing.assert_array_equal(served.columns, [-1, 10, 11])
    assert served.refusals == ("column already serves another query", "", "")
    assert served.queries == (low, high, other)


def test_a_query_outside_the_frame_is_refused():
    sensor = sensor_of()
    served = serve((SpectralQuery(5000.0, 0.0), SpectralQuery(0.0, -9000.0, 4000.0)), sensor, POSE)
    assert not served.is_served.any() and served.refusals == ("outside the frame",) * 2
    np.testing.assert_array_equal(sensor.superpixel_of(np.array([[5000.0, 0, 0]]), POSE)[:, 1], [-1])


def test_no_queries_no_mirrors():
    sensor = sensor_of()
    served = serve((), sensor, POSE)
    spectra = measure_spectra(served, uniform((1, 0, 0))(sensor), sensor, np.random.default_rng(0))
    assert len(served.rows) == 0 and spectra.sizes["query"] == 0


def test_mirrors_that_serve_are_dark_in_pan_and_only_they():
    sensor = sensor_of()
    served = serve((query_at(sensor, 3, 10), query_at(sensor, 9, 30), SpectralQuery(9e3, 0.0)), sensor, POSE)
    frame = frame_of(sensor, (50.0, 0, 0), served=served)
    dark = np.argwhere(np.isnan(frame["pan"].values))
    np.testing.assert_array_equal(dark, [[3, 10], [9, 30]])
    assert np.isfinite(frame["stokes_radiance"].values).all()


def test_spectra_of_a_uniform_field_within_their_noise():
    sensor = sensor_of()
    slope = 40.0 + 30.0 * GRID
    served = serve(tuple(query_at(sensor, 5, column) for column in range(40)), sensor, POSE)
    spectra = measure_spectra(served, uniform((1, 0.2, 0), slope)(sensor), sensor, np.random.default_rng(1))
    assert spectra.sizes == {"query": 40, "wavelength": 60}
    wanted = 40.0 + 30.0 * spectra["wavelength"].values  # a narrow band's mean of a straight line
    deviate = (spectra["radiance"].values - wanted) / spectra["noise"].values
    assert np.abs(deviate).max() < SIGMAS
    assert deviate.std() == pytest.approx(1, abs=SIGMAS / math.sqrt(2 * deviate.size))
    assert np.abs(deviate.mean(axis=0)).max() < SIGMAS / math.sqrt(40) * 1.2  # no band is biased


def test_refused_queries_keep_their_row_with_no_data():
    sensor = sensor_of()
    queries = (SpectralQuery(9e3, 1.0, track_id=4), query_at(sensor, 5, 6, track_id=9))
    spectra = measure_spectra(
        serve(queries, sensor, POSE), uniform((50, 0, 0))(sensor), sensor, np.random.default_rng(0)
    )
    np.testing.assert_array_equal(spectra["served"], [0, 1])
    np.testing.assert_array_equal(spectra["track_id"], [4, 9])
    np.testing.assert_allclose(spectra["east_m"], [9e3, queries[1].east_m])
    assert np.isnan(spectra["radiance"][0]).all() and np.isnan(spectra["noise"][0]).all()
    assert np.isfinite(spectra["radiance"][1]).all()


@pytest.mark.parametrize("width", [0.01, 0.025, 0.05, 0.1])
def test_spectrometer_bands_are_means(width):
    sensor = sensor_of(spectrometer_bandwidth_um=width)
    np.testing.assert_allclose(sensor.band_weights.sum(axis=1), 1, atol=1e-12)
    assert len(sensor.band_centre_um) == round(0.6 / width)
    half_a_step = 0.005
    inside = slice(1, -1)  # half of the slit's image of the outermost bands lies outside the range
    np.testing.assert_allclose(
        (sensor.band_weights @ GRID)[inside], sensor.band_centre_um[inside], atol=half_a_step
    )


def test_spectrometer_bands_are_the_mirrors_image_over_the_cells_of_the_grid():
    """Every band, the outermost too: a triangle of 10 nm FWHM, integrated over each wavelength's cell."""
    sensor = sensor_of(spectrometer_bandwidth_um=0.01)
    fine = np.linspace(0.4, 1.0, 600_001)
    cell = np.minimum(np.floor((fine - 0.4) / 0.01 + 0.5).astype(int), 60)
    for k in (0, 1, 30, 59):
        triangle = np.maximum(1 - np.abs(fine - sensor.band_centre_um[k]) / 0.01, 0)
        exact = np.bincount(cell, triangle, 61) * GRID
        np.testing.assert_allclose(sensor.band_weights[k], exact / exact.sum(), atol=2e-3)


# --- designs ---------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("design", "message"),
    [
        ({"rows": 561}, r"`sensor\.rows` must be even"),
        ({"columns": 7}, r"`sensor\.columns` must be even"),
        ({"band_um": (0.9, 0.5)}, "must rise within 0.4 to 2.5"),
        ({"pitch_um": 0.1}, "pitch_um"),
        ({"pitch": 17}, "pitch"),
    ],
)
def test_designs_refuse_what_cannot_be_built(design, message):
    with pytest.raises(ValidationError, match=message):
        plain_sensor(**design)


@pytest.mark.parametrize("key", ["band_um", "spectrometer_um"])
def test_bands_must_lie_within_the_light(key):
    with pytest.raises(ValueError, match=rf"`sensor\.{key}` must lie within .* 0.4 to 1 µm; got 0.4 to 1.1"):
        sensor_of(**{key: (0.4, 1.1)})
