import datetime

import numpy as np
import pytest

from glintrack.atmosphere import AtmosphereDesign, earth_sun_distance, sun_direction
from glintrack.atmosphere.sun import solar_irradiance
from glintrack.core.designs import validate_design

ONE_ARC_MINUTE = np.radians(1 / 60)


@pytest.mark.parametrize(
    ("keys", "sentence"),
    [
        ({"visibility_km": -3}, "-3"),
        ({"aerosol": "smog"}, "smog"),
        ({"wavelengths_um": (0.3, 0.5)}, "`wavelengths_um` must lie within 0.4 to 2.5 µm; got 0.3"),
        ({"wavelength_stop_um": 3.0}, "got 3"),
        ({"sun_zenith_deg": 95, "sun_azimuth_deg": 0}, "got 95"),
        ({"sun_zenith_deg": 30}, "`sun_zenith_deg` must be given with `sun_azimuth_deg`"),
        ({"visibility_km": 23, "aod_550": 0.2}, "`visibility_km` must not be given together with `aod_550`"),
        ({"altitudes_m": (100.0,)}, "`altitudes_m` must rise within 500 to 20000 m"),
        ({"streams": 15}, "`streams` must be even; got 15"),
        ({"water_cm": -1}, "got -1"),
    ],
)
def test_bad_input_is_one_sentence_with_key_and_range(keys, sentence):
    with pytest.raises(ValueError, match=r"`.+`") as error:
        validate_design(AtmosphereDesign, keys)
    assert sentence in str(error.value)
    assert f"`{next(iter(keys))}`" in str(error.value)


def test_sun_below_the_horizon_names_the_key():
    with pytest.raises(ValueError, match="`local_time_h` must put the sun within 0 to 80"):
        sun_direction(AtmosphereDesign(local_time_h=2))


def test_sun_stands_in_the_south_at_solar_noon_and_in_the_west_in_the_afternoon():
    # Rochester lies 2.6° west of its zone's meridian: solar noon comes 10 min late, and 6 min more in July
    zenith, azimuth = sun_direction(AtmosphereDesign(local_time_h=12 + 16.4 / 60))
    declination = np.radians(21.5)  # 15 July
    assert abs(azimuth - np.pi) < np.radians(0.5)
    assert abs(zenith - (np.radians(43.16) - declination)) < np.radians(0.2)
    azimuths = [sun_direction(AtmosphereDesign(local_time_h=h))[1] for h in (12, 15, 17)]
    assert np.radians(165) < azimuths[0] < azimuths[1] < azimuths[2] < np.radians(290)


def test_given_sun_is_taken_as_it_is():
    zenith, azimuth = sun_direction(AtmosphereDesign(sun_zenith_deg=40, sun_azimuth_deg=-90))
    assert zenith == pytest.approx(np.radians(40))
    assert azimuth == pytest.approx(np.radians(270))


def test_earth_is_farthest_in_july():
    july = earth_sun_distance(AtmosphereDesign(date=datetime.date(2010, 7, 6)))
    january = earth_sun_distance(AtmosphereDesign(date=datetime.date(2010, 1, 3)))
    aphelion, perihelion = 1.01671, 0.98329  # of the mean orbit, eccentricity 0.01671
    assert july == pytest.approx(aphelion, abs=2e-4)
    assert january == pytest.approx(perihelion, abs=2e-4)


def test_solar_irradiance_integrates_to_the_tables_share_of_the_solar_constant():
    um = np.arange(0.405, 2.4951, 0.01)
    # ASTM E-490/G173 put 1208 W/m² of the solar constant between 0.4 and 2.5 µm (88.4 %), ±1 % by table
    assert solar_irradiance(um).sum() * 0.01 == pytest.approx(1208, rel=0.01)


def test_visibility_and_optical_depth_agree_by_koschmieder():
    extinction_per_km = np.log(50) / 23 - 0.01159
    design = AtmosphereDesign(visibility_km=23)
    column_km = 2.0  # scale height; the top at 30 km cuts off 3e-7
    assert design.aerosol_optical_depth_550 == pytest.approx(extinction_per_km * column_km, rel=1e-6)


def test_content_key_follows_the_content():
    assert AtmosphereDesign().content_key() == AtmosphereDesign(local_time_h=15).content_key()
    assert AtmosphereDesign().content_key() != AtmosphereDesign(local_time_h=17).content_key()


def test_content_key_depends_on_the_cloud_only_where_there_is_one():
    assert AtmosphereDesign(cloud_base_m=2000.0).content_key() == AtmosphereDesign().content_key()
    low, high = (AtmosphereDesign(cloud_optical_depth=20.0, cloud_base_m=m) for m in (2000.0, 4000.0))
    assert low.content_key() != high.content_key() != AtmosphereDesign().content_key()


def test_under_a_cloud_the_tables_end_at_its_base():
    """Between a height below and one above it the air would be interpolated into the cloud."""
    assert AtmosphereDesign().sensor_altitudes_m == (500, 1000, 2000, 3000, 5000, 10000)
    assert AtmosphereDesign(cloud_optical_depth=20.0).sensor_altitudes_m == (500, 1000, 2000, 3000, 4000)
    low = AtmosphereDesign(cloud_optical_depth=20.0, cloud_base_m=2000.0)
    assert low.sensor_altitudes_m == (500, 1000, 2000)
