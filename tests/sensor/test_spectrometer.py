"""Spectra on request: accuracy, the slit's smear, the etalon, refusals, and pan where mirrors are away."""

import numpy as np
import pytest
import xarray as xr

from glintrack.camera import Pose, ground_points, look_at
from glintrack.core.records import NONE_SERVED, SpectralQuery
from glintrack.sensor import expose, fill_dark_mirrors, measure_spectra, serve
from tests.sensor.light import GRID, picture, sensor_of, uniform

POSE = look_at(Pose(0.0, -500.0, 1500.0, kind="reported"), (0.0, 0.0, 0.0))
PANEL = 30 + 50 * np.exp(-(((GRID - 0.68) / 0.12) ** 2)) + 20 * np.sin(4 * GRID)  # smooth, as paint is
BRIGHT = {"spectrometer_integration_time_ms": 50.0}


def query_at(sensor, row, column, **fields):
    pixel = sensor.side * np.array([row, column]) + sensor.mirror_element
    return SpectralQuery(*ground_points(sensor.camera, POSE, pixel).tolist(), **fields)


def spectra_of(sensor, queries, radiance, seed=0):
    served = serve(queries, sensor, POSE)
    return served, measure_spectra(served, radiance, sensor, np.random.default_rng(seed))


@pytest.mark.parametrize("width_um", [0.01, 0.05])
def test_spectrum_of_a_panel_within_a_percent_at_high_signal(width_um):
    time_ms = 0.5 / width_um  # as many electrons in bands of each width
    sensor = sensor_of(spectrometer_bandwidth_um=width_um, spectrometer_integration_time_ms=time_ms)
    queries = tuple(query_at(sensor, 5, column) for column in range(30))
    _, spectra = spectra_of(sensor, queries, uniform(sensor, (1, 0, 0), PANEL))
    centre = spectra["wavelength"].values
    # the mean over a band, by photons, of the panel's spectrum drawn finely
    fine = np.linspace(0.4, 1.0, 6001)
    panel = np.interp(fine, GRID, PANEL)
    # a band a pixel wide smeared by a slit as wide: a triangle
    share = np.clip(1 - np.abs(fine[None] - centre[:, None]) / width_um, 0, None)
    truth = (share * fine * panel).sum(1) / (share * fine).sum(1)
    one_percent = 0.01
    np.testing.assert_allclose(spectra["radiance"].mean("query"), truth, rtol=one_percent)
    assert (spectra["noise"] / spectra["radiance"]).max() < one_percent


def test_the_slit_smears_a_line_over_its_neighbours():
    """A narrow line falls on the two bands beside it, by a relay and by etalons alike."""
    line = np.zeros(len(GRID))
    line[30] = 100.0  # 0.70 µm, the edge of two bands of 0.01 µm
    seen = {kind: sensor_of(spectrometer=kind).band_weights @ line for kind in ("relay", "etalon")}
    assert all((values > 0.01 * values.max()).sum() == 2 for values in seen.values())
    assert seen["relay"].sum() == pytest.approx(seen["etalon"].sum(), rel=0.01)


def test_bright_spectra_keep_their_shape_and_dark_current_is_noise():
    """Reads are added up, however many electrons there are."""
    slope = np.linspace(20, 200, len(GRID))
    found = {}
    for dark_e_per_s in (0.0, 1e9):
        sensor = sensor_of(spectrometer_integration_time_ms=90.0, dark_current_e_per_s=dark_e_per_s)
        queries = tuple(query_at(sensor, 5, column) for column in range(30))
        _, spectra = spectra_of(sensor, queries, uniform(sensor, (1, 0, 0), slope))
        found[dark_e_per_s] = spectra
        expected = np.interp(spectra["wavelength"].values, GRID, slope)
        np.testing.assert_allclose(spectra["radiance"].mean("query")[2:-2], expected[2:-2], rtol=0.02)
    assert (found[1e9]["noise"] > 1.2 * found[0.0]["noise"]).all()
    spread = found[1e9]["radiance"].std("query") / found[1e9]["noise"].mean("query")
    assert 0.8 < float(spread.mean()) < 1.2


def test_a_narrow_pan_band_between_two_bands_is_filled_from_the_spectrum():
    sensor = sensor_of(
        band_um=(0.56, 0.64), spectrometer_bandwidth_um=0.1, fill_dark_mirrors="spectrum", **BRIGHT
    )
    queries = (query_at(sensor, 5, 9),)
    light = uniform(sensor, (50.0, 0, 0))
    served, spectra = spectra_of(sensor, queries, light)
    frame = expose(light, sensor, served, np.random.default_rng(1))
    filled = fill_dark_mirrors(frame, served, spectra, sensor)["pan"].values
    assert filled[5, 9] == pytest.approx(np.nanmean(frame["pan"].values), rel=0.02)


def test_etalons_serve_a_column_twice_and_find_a_smooth_spectrum():
    keys = {"spectrometer": "etalon", "spectrometer_integration_time_ms": 50.0}
    sensor = sensor_of(**keys)
    queries = tuple(query_at(sensor, row, 10) for row in range(12))
    served, spectra = spectra_of(sensor, queries, uniform(sensor, (1, 0, 0), PANEL))
    assert served.is_served.all()
    centre = spectra["wavelength"].values
    error = spectra["radiance"].mean("query").values / np.interp(centre, GRID, PANEL) - 1
    assert np.sqrt(np.mean(error[3:-3] ** 2)) < 0.03  # regularised: smooth spectra, a few per cent
    relay = sensor_of(**BRIGHT)
    assert serve(queries, relay, POSE).is_served.sum() == 1


def test_a_layout_without_mirrors_refuses_every_query():
    for layout in ("pan", "0-45-90-135"):
        sensor = sensor_of(layout=layout)
        served, spectra = spectra_of(
            sensor, (query_at(sensor, 3, 3), query_at(sensor, 4, 9)), uniform(sensor, (50.0, 0, 0))
        )
        assert served.refusals == ("the superpixel has no mirror",) * 2
        assert not spectra["served"].any() and np.isnan(spectra["radiance"]).all()


def test_a_detector_blind_in_the_spectrometers_range_is_refused(tmp_path):
    curve = tmp_path / "qe.csv"
    curve.write_text("wavelength_um,efficiency\n0.4,0.8\n0.9,0.8\n0.91,0\n2.5,0\n")
    with pytest.raises(ValueError, match=r"`sensor.spectrometer_um` must lie where .* no response at 0.9\d"):
        sensor_of(quantum_efficiency=str(curve))


# --- mirrors that are away -------------------------------------------------------------------------


def scene(sensor, seed=0):
    """Grey squares on a grey ground, unpolarized."""
    rng = np.random.default_rng(seed)
    light = np.full((sensor.camera.rows, sensor.camera.columns), 40.0)
    for _ in range(60):
        y, x = rng.integers(0, light.shape[0] - 8), rng.integers(0, light.shape[1] - 8)
        light[y : y + rng.integers(2, 8), x : x + rng.integers(2, 8)] = rng.uniform(10, 90)
    return np.stack([light, 0 * light, 0 * light], axis=-1)


def grey(sensor, light):
    """The same for frames and for single pixels."""
    whole = picture(sensor, light)

    def radiance(channels, pixels=None):
        if pixels is None:
            return whole(channels)
        at = light[pixels[:, 0], pixels[:, 1]]
        return xr.DataArray((channels.sum(axis=1))[None, :, None] * at[:, None, :])

    return radiance


@pytest.mark.parametrize("way", ["none", "spectrum", "interpolate", "polarizers"])
def test_dark_mirrors_are_filled_as_asked(way):
    """On edges the spectrum knows pan itself; neighbours and polarizers only what lies beside it."""
    sensor = sensor_of(rows=128, columns=160, fill_dark_mirrors=way, read_noise_e=2.0, **BRIGHT)
    radiance = grey(sensor, scene(sensor))
    # every third column has its mirror away, in rows that differ
    columns = np.arange(1, 79, 3)
    rows = (7 * columns) % 60 + 2
    queries = tuple(query_at(sensor, int(r), int(c)) for r, c in zip(rows, columns, strict=True))
    served = serve(queries, sensor, POSE)
    assert served.is_served.all()
    truth = expose(radiance, sensor, NONE_SERVED, np.random.default_rng(3))["pan"].values
    frame = expose(radiance, sensor, served, np.random.default_rng(3))
    spectra = measure_spectra(served, radiance, sensor, np.random.default_rng(4))
    filled = fill_dark_mirrors(frame, served, spectra, sensor)
    at = served.rows, served.columns
    if way == "none":
        assert filled is frame and np.isnan(filled["pan"].values[at]).all()
        return
    error = filled["pan"].values[at] - truth[at]
    rms = float(np.sqrt(np.mean(error**2)))
    assert np.isfinite(filled["pan"]).all()
    assert np.isnan(frame["pan"].values[at]).all()  # the frame itself is left alone
    if way == "spectrum":
        assert rms < 1.5
    else:
        assert rms < 15
    untouched = np.ones_like(truth, bool)
    untouched[at] = False
    np.testing.assert_array_equal(filled["pan"].values[untouched], truth[untouched])


def test_filling_by_a_spectrum_that_misses_part_of_the_band_is_refused():
    with pytest.raises(ValueError, match=r"`sensor.fill_dark_mirrors` must not be 'spectrum'"):
        sensor_of(fill_dark_mirrors="spectrum", spectrometer_um=(0.5, 1.0))
    with pytest.raises(ValueError, match=r"must not be 'polarizers' without polarizers"):
        sensor_of(fill_dark_mirrors="polarizers", layout="mirror")
