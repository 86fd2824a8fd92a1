"""Derived quantities of cases against values computed by hand, and light against the solved atmospheres."""

import math

import numpy as np
import pytest

from glintrack.atmosphere import solve_tables
from glintrack.case.design import Case
from glintrack.case.quantities import (
    AIRLIGHT,
    MIN_HEADWAY_S,
    fastest_speed_m_s,
    ground_irradiance,
    haze_transmittance,
    light_quantities,
    motion_quantities,
    optics_quantities,
    view_quantities,
)
from glintrack.core.designs import validate_design
from glintrack.core.spectral import channel_weights
from tests.conftest import ThreeCars


def camera(pixels, pitch_um, focal_length_mm, **flight):
    """A case of a plain camera without aberrations."""
    columns, rows = pixels
    sensor = {
        "layout": "pan", "columns": columns, "rows": rows, "pitch_um": pitch_um, "spot_sigma_um": 0.0,
        "focal_length_mm": focal_length_mm, "max_frame_rate_hz": 60.0, "integration_time_ms": 0.5,
    }  # fmt: skip
    values = {"sensor": sensor, "flight": flight, "channels": ["pan"]}
    return validate_design(Case, values | {"atmosphere": {"altitudes_m": [500.0, 20000.0]}})


DATA_SHEET = camera((2048, 2048), 3.45, 100.0, altitude_m=2000.0, off_nadir_deg=30.0, rate_hz=5.0)
VIDEO = camera((1920, 1080), 7.0, 200.0, altitude_m=20000.0, off_nadir_deg=0.0, rate_hz=1.0)
DRONE = camera((3840, 2160), 2.4, 35.0, altitude_m=300.0, off_nadir_deg=0.0, rate_hz=30.0)


@pytest.mark.parametrize(
    ("case", "across_m", "along_m", "footprint_m", "on_car"),
    [
        (DATA_SHEET, 0.079674, 0.092000, (163.173, 188.416), 1105.0),  # 2309.40 m of slant range
        (VIDEO, 0.7, 0.7, (1344.0, 756.0), 16.53),
        (DRONE, 0.020571, 0.020571, (78.994, 44.434), 19140.5),
    ],
)
def test_sampling_and_footprint(case, across_m, along_m, footprint_m, on_car):
    found = view_quantities(case)
    expected = [across_m, along_m, *footprint_m, on_car]
    names = ("gsd_across_m", "gsd_along_m", "footprint_across_m", "footprint_along_m", "elements_on_car")
    np.testing.assert_allclose([found[name] for name in names], expected, rtol=1e-4)


def test_the_papers_frame():
    """Table 1: 68 mm, 17 µm, 3000 m slant range at 50° off nadir make 0.75 m elements across the view."""
    found = view_quantities(validate_design(Case, {"sensor": {"focal_length_mm": 68.0, "pitch_um": 17.0}}))
    assert found["gsd_across_m"] == pytest.approx(0.75, rel=1e-3)
    assert found["gsd_along_m"] == pytest.approx(0.75 / 0.6428, rel=1e-3)
    assert found["footprint_share"] == 1 and found["beyond_window"] == 0


def test_the_footprint_is_compared_with_the_scored_area():
    """Half the sides of the paper's array, 440 × 280 elements, see 330 m × 327 m of 660 m × 420 m."""
    half = Case().replace({"sensor.rows": 280, "sensor.columns": 440})
    square = [[-100.0, -100.0], [100.0, -100.0], [100.0, 100.0], [-100.0, 100.0]]
    wide = [[3 * x for x in corner] for corner in square]
    for area, share in (("window", 0.389), (square, 1.0), (wide, 0.299)):
        case = half.replace({"scene.area": area})
        assert view_quantities(case)["footprint_share"] == pytest.approx(share, rel=1e-2), area
    for footprint in (half, half.replace({"scene.area": "footprint"})):
        assert "footprint_share" not in view_quantities(footprint)


def test_diffraction_and_transfer_of_a_perfect_lens():
    """F/5.6 at 0.7 µm: cut-off 255.1 mm⁻¹, of which Nyquist at 3.45 µm is 0.5681; MTF 0.3177 × 2/π."""
    found = optics_quantities(DATA_SHEET)
    assert found["airy_elements"] == pytest.approx(2.44 * 0.7 * 5.6 / 3.45)
    assert found["mtf_nyquist"] == pytest.approx(0.3177 * 2 / math.pi, rel=0.01)


def test_a_gaussian_spot_has_its_own_width():
    """Where the spot dwarfs pitch and diffraction, the blur is 2.355 σ."""
    found = optics_quantities(DATA_SHEET.replace({"sensor.spot_sigma_um": 30.0}))
    assert found["blur_elements"] == pytest.approx(2.3548 * 30 / 3.45, rel=0.03)


@pytest.mark.parametrize(
    ("case", "step"), [(DATA_SHEET, 2.78 / 14.23), (VIDEO, 13.9 / 14.23), (DRONE, 0.0326)]
)
def test_steps_of_city_traffic(case, step):
    """Displacement a frame over a spacing of 13.9 m/s × 0.7 s + 4.5 m = 14.23 m."""
    found = motion_quantities(case)
    assert MIN_HEADWAY_S == 0.7 and found["displacement_share"] == pytest.approx(step, rel=2e-3)
    assert found["vehicle_blur_m"] == pytest.approx(13.9 * 0.5e-3)
    shortest_m = min(view_quantities(case)[f"footprint_{name}_m"] for name in ("across", "along"))
    assert found["vehicle_dwell_s"] == pytest.approx(shortest_m / 13.9)
    assert found["overlap"] == pytest.approx(1) and found["platform_blur_elements"] < 0.01


def test_a_fixed_gimbal_blurs_by_speed_times_exposure():
    """At nadir 80 m/s in 5 ms are 0.4 m, and 40 m from frame to frame of 420 m × 266 m."""
    passing = {
        "flight.kind": "straight", "flight.gimbal": "fixed", "flight.off_nadir_deg": 0.0,
        "flight.altitude_m": 1900.0, "flight.course_deg": 0.0, "sensor.integration_time_ms": 5.0,
    }  # fmt: skip
    found, gsd_m = motion_quantities(Case().replace(passing)), 17e-6 / 68e-3 * 1900
    assert found["platform_blur_elements"] == pytest.approx(0.4 / gsd_m, rel=1e-3)
    assert found["overlap"] == pytest.approx(1 - 40 / (560 * gsd_m), rel=1e-3)
    assert found["ground_dwell_s"] == pytest.approx(560 * gsd_m / 80, rel=1e-3)
    assert found["vehicle_dwell_s"] == pytest.approx(found["ground_dwell_s"])


def test_signal_to_noise_is_shot_noise_where_light_is_plenty():
    """Without haze, read and dark noise the ratio is the root of the road's electrons."""
    case = Case().replace({"atmosphere.aerosol": "none", "sensor.read_noise_e": 0.0, "sensor.bits": 24})
    found = light_quantities(case)
    road_e = found["well_fill"] * case.sensor.full_well_e * 0.22 / 0.8
    assert found["road_snr"] == pytest.approx(math.sqrt(road_e), rel=0.05)  # with the air's own light
    contrast = found["road_snr"] * 0.5 * math.sqrt(view_quantities(case)["elements_on_car"])
    assert found["car_contrast"] == pytest.approx(contrast)
    hazy = light_quantities(Case().replace({"atmosphere.aerosol": "urban"}))
    assert hazy["car_contrast"] < 0.8 * light_quantities(Case())["car_contrast"]


def test_light_on_the_ground_and_haze_agree_with_the_solved_atmosphere():
    """Global irradiance in the band within 3 %; transmittance within 10 %; path radiance within a quarter."""
    case = Case()
    tables = solve_tables(case.atmosphere)
    um = tables["wavelength"].values
    mean = channel_weights(um, (um * np.ones(len(um)))[None])[0]
    cosine = math.cos(tables.attrs["sun_zenith_rad"])
    solved = tables["sun_irradiance"].values * cosine + tables["sky_irradiance"].values
    assert mean @ ground_irradiance(case, um) == pytest.approx(mean @ solved, rel=0.03)
    at_lens = {"altitude": case.flight.altitude_m, "view_zenith": math.radians(case.flight.off_nadir_deg)}
    passed = haze_transmittance(case)
    assert passed == pytest.approx(mean @ tables["transmittance"].interp(at_lens).values, rel=0.1)
    path = tables["path_radiance"].isel(stokes=0).interp(at_lens).mean("azimuth").values
    airlight = AIRLIGHT * (1 - passed) * (mean @ solved) / math.pi
    assert airlight == pytest.approx(mean @ path, rel=0.25)


def test_the_fastest_vehicles_are_those_of_the_city():
    city = ThreeCars(None)
    speeds = np.hypot(city.truth(0.0)["east_speed_m_s"], city.truth(0.0)["north_speed_m_s"])
    assert fastest_speed_m_s(city, Case().flight) == pytest.approx(float(speeds.max()), rel=0.2)
