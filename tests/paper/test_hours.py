"""Position of the sun at Table 1's hours in Rochester, in standard and daylight time."""

import numpy as np
import pytest

from glintrack.atmosphere import AtmosphereDesign
from glintrack.atmosphere.sun import sun_direction

STANDARD_H, DAYLIGHT_H = -5.0, -4.0


@pytest.mark.parametrize(
    ("hour", "offset_h", "from_zenith_deg", "azimuth_deg"),
    [
        (12, STANDARD_H, 22.0, 170),
        (15, STANDARD_H, 40.2, 251),
        (17, STANDARD_H, 61.8, 274),
        (12, DAYLIGHT_H, 26.9, 138),
        (15, DAYLIGHT_H, 30.6, 233),
        (17, DAYLIGHT_H, 50.9, 263),
    ],
)
def test_the_suns_place_at_table_1s_hours(hour, offset_h, from_zenith_deg, azimuth_deg):
    zenith, azimuth = np.degrees(sun_direction(AtmosphereDesign(local_time_h=hour, utc_offset_h=offset_h)))
    assert zenith == pytest.approx(from_zenith_deg, abs=0.05)
    assert azimuth == pytest.approx(azimuth_deg, abs=0.5)


def test_hours_are_standard_time_by_default():
    """Longitude −77.61° lies in the zone five hours behind UTC, also in July."""
    named = AtmosphereDesign(local_time_h=15, utc_offset_h=STANDARD_H)
    assert sun_direction(AtmosphereDesign(local_time_h=15)) == sun_direction(named)
