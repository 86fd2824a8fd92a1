"""Designs: ready ones, curves and tables from files, and what cannot be built."""

import numpy as np
import pytest
import xarray as xr
from pydantic import ValidationError

from glintrack.core.records import NONE_SERVED
from glintrack.core.spectral import wavelength_grid
from glintrack.devices import wire_grid
from glintrack.sensor import SensorDesign, build_sensor, design_keys, design_names, expose
from tests.plain import plain_sensor
from tests.sensor.light import GRID, sensor_of, uniform


def test_ready_designs_are_designs():
    assert set(design_names()) >= {"paper", "imx250mzr", "pan", "mos"}
    for name in design_names():
        design = SensorDesign(ready=name)
        for key, value in design_keys(name).items():
            assert getattr(design, key) == (tuple(value) if isinstance(value, list) else value), key


def test_a_case_changes_what_it_likes_of_a_ready_design():
    design = SensorDesign(ready="imx250mzr", f_number=4.0, optics={"defocus_um": 5.0})
    assert design.f_number == 4.0 and design.pitch_um == 3.45 and design.optics.defocus_um == 5.0
    with pytest.raises(ValidationError, match=r"`sensor.ready` must be one of imx250mzr, mos, pan, paper"):
        SensorDesign(ready="kodak")


@pytest.mark.parametrize("name", ["imx250mzr", "pan", "mos", "paper"])
def test_ready_designs_expose(name):
    design = SensorDesign(ready=name, rows=32, columns=48)
    sensor = build_sensor(design, GRID)
    frame = expose(uniform(sensor, (40.0, 8.0, 0.0)), sensor, NONE_SERVED, np.random.default_rng(0))
    assert float(frame["pan"].mean()) == pytest.approx(40, rel=0.01)
    if design.has_stokes:
        assert float(frame["stokes_radiance"][..., 1].mean()) == pytest.approx(8, abs=0.5)
    else:
        assert np.isnan(frame["stokes_radiance"][..., 1:]).all()


def test_the_papers_grids_come_per_aperture():
    """Eq. (7) counts the 15 µm port; the element's own aperture passes 15/10 of it."""
    sensor = sensor_of(polarizer="grid_a", quantum_efficiency=1.0, optics_transmission=1.0)
    table = wire_grid.load("grid_a").sel(wavelength=slice(0.399, 1.001))
    both = 0.5 * (table["pass_transmittance"] + table["block_transmittance"]).values * 1.5
    weight = GRID * np.r_[0.5, np.ones(len(GRID) - 2), 0.5]
    wanted = (weight @ both) / weight.sum()
    assert sensor.electrons_per_reading[0, 1] / sensor.electrons_per_radiance == pytest.approx(
        wanted, rel=1e-6
    )
    half = sensor_of(
        polarizer="grid_a",
        quantum_efficiency=1.0,
        optics_transmission=1.0,
        fill_factor=0.5,
        integration_time_ms=sensor.design.integration_time_ms,
    )
    # once, on every element alike
    np.testing.assert_allclose(half.electrons_per_reading / sensor.electrons_per_reading, 0.5)


def test_quantum_efficiency_from_a_file_weighs_the_band(tmp_path):
    (tmp_path / "qe.csv").write_text("# source: made up\nwavelength_um,efficiency\n0.4,0\n1.0,0.6\n")
    design = plain_sensor(quantum_efficiency="qe.csv", rows=8, columns=8).resolve_files(tmp_path)
    sensor = build_sensor(design, GRID)
    mean_um = sensor.pan_weights[0] @ GRID
    weight = GRID * (GRID - 0.4) * np.r_[0.5, np.ones(len(GRID) - 2), 0.5]
    assert mean_um == pytest.approx(weight @ GRID / weight.sum(), rel=1e-9)


@pytest.mark.parametrize(
    ("keys", "message"),
    [
        ({"integration_time_ms": 200.0}, r"`sensor.integration_time_ms` must end within a frame's 100 ms"),
        ({"rows": 562, "layout": (("open",) * 3,) * 3}, r"`sensor.rows` must be a multiple of 3"),
        ({"optics": {"zernike_rms_nm": {1: 5.0}}}, "must have keys 2 to 37; got 1"),
        ({"optics": {"obscuration": 1.0}}, "must leave part of the pupil open"),
        ({"quantum_efficiency": 0.0}, "must be above 0 and at most 1; got 0"),
    ],
)
def test_designs_that_contradict_themselves_are_refused(keys, message):
    with pytest.raises(ValidationError, match=message):
        SensorDesign(**keys)


def write(path, text):
    path.write_text(text)
    return str(path)


@pytest.mark.parametrize(
    ("key", "text", "message"),
    [
        ("quantum_efficiency", "wavelength_um,efficiency\n0.4,0.5\n0.9,0.5\n", "must cover 0.4 to 1 µm"),
        (
            "quantum_efficiency",
            "wavelength_um,qe\n0.4,0.5\n",
            "must have columns wavelength_um and efficiency; got no efficiency among wavelength_um, qe",
        ),
        ("quantum_efficiency", "wavelength_um,efficiency\n0.4,x\n1,1\n", "must hold numbers; got .*'x'"),
        ("quantum_efficiency", "wavelength_um,efficiency\n0.4,1\n", "at least 2 rows; got 1"),
        (
            "quantum_efficiency",
            "wavelength_um,efficiency\n0.4,0.5\n1,1.5\n",
            "must have efficiency within 0 to 1; got 1.5 at 1 µm",
        ),
        (
            "response",
            "wavelength_um,response\n1,0.5\n0.4,0.5\n0.5,0.5\n",
            "rising or falling wavelengths; got 0.5 beside 0.4",
        ),
        ("reference_spectrum", "wavelength_um,radiance\n0.4,0\n1,0\n", "must have light in the pan band"),
    ],
)
def test_curves_that_are_none_are_refused(tmp_path, key, text, message):
    with pytest.raises(ValueError, match=message):
        sensor_of(**{key: write(tmp_path / "curve.csv", text)})


def test_polarizer_files_that_are_none_are_refused(tmp_path):
    with pytest.raises(ValueError, match=r"`sensor.polarizer` must be ideal, constant, grid_a"):
        sensor_of(polarizer=str(tmp_path / "missing.nc"))
    with pytest.raises(ValueError, match=r"`sensor.polarizer` must be a readable NetCDF-4 file"):
        sensor_of(polarizer=write(tmp_path / "text.nc", "no netcdf"))
    other = tmp_path / "other.nc"
    xr.Dataset({"pass_transmittance": ("wavelength", np.ones(3))}).to_netcdf(other, engine="h5netcdf")
    with pytest.raises(ValueError, match=r"`sensor.polarizer` must have a coordinate wavelength of numbers"):
        sensor_of(polarizer=str(other))
    short = tmp_path / "short.nc"
    xr.Dataset(
        {"pass_transmittance": ("wavelength", [0.6, 0.6]), "block_transmittance": ("wavelength", [0.1, 0.1])},
        coords={"wavelength": [0.5, 0.9]},
    ).to_netcdf(short, engine="h5netcdf")
    with pytest.raises(ValueError, match=r"`sensor.polarizer` must cover 0.4 to 1 µm; got data from 0.5"):
        sensor_of(polarizer=str(short))


def test_polarizers_too_weak_to_invert_are_refused_with_their_number():
    with pytest.raises(ValueError, match=r"got a condition number of \d+.* polarizers that diattenuate"):
        sensor_of(polarizer="constant", polarizer_extinction_ratio=1.02)


def test_bands_to_the_short_wave_infrared():
    grid = wavelength_grid(0.4, 2.5)
    design = plain_sensor(
        band_um=(0.4, 2.5), spectrometer_um=(0.4, 2.5), rows=8, columns=8, polarizer="grid_a"
    )
    sensor = build_sensor(design, grid)
    assert len(sensor.band_centre_um) == 210 and sensor.diattenuation > 0.5


def test_a_mirror_must_settle_and_expose_within_a_frame():
    assert plain_sensor(max_frame_rate_hz=10.0, mirror_settling_ms=90.0).mirror_settling_ms == 90.0
    with pytest.raises(ValueError, match=r"`sensor.mirror_settling_ms` must leave the 10 ms of exposure"):
        plain_sensor(max_frame_rate_hz=10.0, mirror_settling_ms=91.0)
    assert plain_sensor(layout="pan", mirror_settling_ms=500.0).has_mirror is False


def test_light_lost_at_a_mirror_is_lost_to_the_spectrometer_alone():
    grid = np.arange(0.4, 1.001, 0.01)
    whole, half = (build_sensor(plain_sensor(mirror_throughput=share), grid) for share in (1.0, 0.5))
    np.testing.assert_allclose(half.band_electrons_per_radiance, 0.5 * whole.band_electrons_per_radiance)
    assert half.electrons_per_radiance == whole.electrons_per_radiance


def test_a_stated_exposure_stays_though_it_is_the_ready_designs():
    derived = SensorDesign(ready="imx249", f_number=11).integration_time_ms
    own = SensorDesign(ready="imx249").integration_time_ms
    stated = SensorDesign(ready="imx249", f_number=11, integration_time_ms=own)
    assert derived != own
    assert stated.replace({"prnu": 0.01}).integration_time_ms == own
