"""Presets see the same light through the same lens, and none of them more of it than there is."""

import numpy as np
import pytest
import xarray as xr

from glintrack.core.records import NONE_SERVED
from glintrack.core.spectral import wavelength_grid
from glintrack.sensor import (
    Sensor,
    SensorDesign,
    build_preset,
    build_sensor,
    expose,
    read_arrays,
    read_presets,
)
from glintrack.sensor.layouts import superpixel
from glintrack.sensor.presets import element_curves
from glintrack.sensor.response import element_response

GRID_UM = wavelength_grid(0.4, 1.0)
DESIGN = SensorDesign(rows=16, columns=24, polarizer="ideal", read_noise_e=0.0, prnu=0.0)
# electrons in white light over those of all pan elements; None: what filters of the table leave
SHARES = {"pan": 1.0, "superpixel": 0.625, "depolarized": 0.625, "polarimeter": 0.75}


def electrons(arrays):
    """Mean electrons of a place of the field per unit of white light, in all arrays together."""
    return sum(sensor.stokes_gains[..., 0].mean() for sensor in arrays)


@pytest.fixture(scope="module")
def presets() -> dict[str, tuple[Sensor, ...]]:
    return {name: build_preset(preset, DESIGN, GRID_UM) for name, preset in read_presets().items()}


def uniform(i, q=0.0, u=0.0, spectrum=None):
    """Light that is the same everywhere."""
    shape = np.ones(len(GRID_UM)) if spectrum is None else spectrum

    def radiance(channels, pixels=None):
        values = (channels @ shape)[:, None] * np.array([i, q, u])
        values = np.broadcast_to(values, (DESIGN.rows, DESIGN.columns, *values.shape))
        return xr.DataArray(values, dims=("y", "x", "channel", "stokes"))

    return radiance


@pytest.mark.parametrize("name", read_presets())
def test_optics_and_electronics_are_those_of_the_design(name, presets):
    own = build_sensor(DESIGN, GRID_UM)
    for sensor in presets[name]:
        assert sensor.camera == own.camera
        kept = sensor.design.model_dump(exclude={"layout", "demosaic", "optics"})
        assert kept == DESIGN.model_dump(exclude={"layout", "demosaic", "optics"}) | {
            "spectrometer_um": kept["spectrometer_um"]
        }
        assert sensor.design.optics.replace({"depolarizer": False}) == DESIGN.optics


@pytest.mark.parametrize("name", read_presets())
def test_no_preset_takes_more_light_than_there_is(name):
    preset = read_presets()[name]
    taken = 0.0
    for one in preset["arrays"]:
        kinds = [what for row in superpixel(one["elements"]) for what in row]
        taken += one["light"] * np.mean([element_curves(e, DESIGN, GRID_UM)[0] for e in kinds], axis=0)
    assert np.all(taken <= element_response(DESIGN, GRID_UM) * (1 + 1e-9))


def test_polarizers_absorb_half_and_filters_all_but_their_band(presets):
    whole = electrons(presets["pan"])
    np.testing.assert_allclose(whole, build_sensor(DESIGN, GRID_UM).electrons_per_radiance)
    for name, share in SHARES.items():
        np.testing.assert_allclose(electrons(presets[name]) / whole, share, rtol=1e-9)
    for name, filters in (("rgb", [1 / 6, 1 / 6, 1 / 6]), ("four-bands", [7 / 60, 8 / 60, 6 / 60, 14 / 60])):
        assert 0.5 < electrons(presets[name]) / whole / np.mean(filters) < 1.1  # photons are more in the red


def test_the_superpixel_is_the_papers(presets):
    """Electrons of each element are those of the packaged sensor with its own layout."""
    own = build_sensor(DESIGN, GRID_UM)
    np.testing.assert_allclose(presets["superpixel"][0].stokes_gains, own.stokes_gains, atol=1e-9)


@pytest.mark.parametrize("layout", ["rgb", "four-bands"])
def test_a_mosaic_of_filters_of_a_case_is_the_presets(layout, presets):
    own = {"layout": layout, "integration_time_ms": DESIGN.integration_time_ms}  # else it is longer
    own = build_sensor(DESIGN.replace(own), GRID_UM)
    np.testing.assert_allclose(presets[layout][0].stokes_gains, own.stokes_gains, atol=1e-9)


def test_pan_of_filters_is_the_mean_of_their_bands():
    """Spectrum L = λ: the mean of a filter's photon-weighted means, ∫ λ² dλ / ∫ λ dλ."""
    sensor = build_sensor(DESIGN.replace({"layout": "four-bands"}), GRID_UM)
    frame = expose(uniform(40.0, spectrum=GRID_UM), sensor, NONE_SERVED, np.random.default_rng(1))
    bands = np.array([(0.45, 0.52), (0.52, 0.60), (0.63, 0.69), (0.76, 0.90)]).T
    expected = 40.0 * np.mean(2 / 3 * np.diff(bands**3, axis=0) / np.diff(bands**2, axis=0))
    assert float(frame["pan"].mean()) == pytest.approx(expected, rel=0.01)
    assert frame["pan"].shape == (DESIGN.rows // 2, DESIGN.columns // 2)
    np.testing.assert_array_equal(frame["stokes_radiance"][..., 0], frame["pan"])
    assert np.isnan(frame["stokes_radiance"][..., 1:]).all()


def test_white_light_reads_the_same_in_all_elements_and_polarization_in_polarizers_alone(presets):
    rng = np.random.default_rng(1)
    for name, arrays in presets.items():
        plain = [r.mean() for r in read_arrays(arrays, uniform(40.0), rng)]
        np.testing.assert_allclose(plain, 40.0, rtol=0.01)
        polarized = read_arrays(arrays, uniform(40.0, q=10.0, u=4.0), rng)
        angles = {"superpixel": {(0, 1): 0.0, (1, 0): 60.0, (1, 1): 120.0}}.get(name, {})
        for place, angle in angles.items():
            turn = 2 * np.radians(angle)
            expected = 40 + 10 * np.cos(turn) + 4 * np.sin(turn)
            np.testing.assert_allclose(polarized[0][place[0] :: 2, place[1] :: 2].mean(), expected, rtol=0.02)
        if name == "polarimeter":
            s0 = np.mean([r.mean() for r in polarized[1:]])
            np.testing.assert_allclose([s0, polarized[1].mean()], [40.0, 50.0], rtol=0.02)
        if name not in ("superpixel", "polarimeter"):
            np.testing.assert_allclose([r.mean() for r in polarized], 40.0, rtol=0.01)


def test_a_filter_reads_its_own_band(presets):
    red = ((GRID_UM >= 0.63) & (GRID_UM <= 0.69)).astype(float)
    (read,) = read_arrays(presets["four-bands"], uniform(40.0, spectrum=red), np.random.default_rng(1))
    means = [read[i::2, j::2].mean() for i in (0, 1) for j in (0, 1)]
    np.testing.assert_allclose(means, [0.0, 0.0, 40.0, 0.0], atol=0.5)


def test_a_band_without_a_filter_is_refused():
    narrow = DESIGN.replace({"band_um": (0.4, 0.6)})
    with pytest.raises(ValueError, match="must overlap the filter"):
        build_preset(read_presets()["four-bands"], narrow, GRID_UM)
