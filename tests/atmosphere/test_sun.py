"""Where the sun stands: as all of pvlib says, of which one module is loaded."""

import datetime

import numpy as np
import pandas as pd
import pvlib
import pytest

from glintrack.atmosphere.design import AtmosphereDesign
from glintrack.atmosphere.sun import earth_sun_distance, sun_direction


@pytest.mark.parametrize(("latitude_deg", "longitude_deg"), [(43.16, -77.61), (-33.9, 151.2), (52.27, 10.52)])
@pytest.mark.parametrize("day", [datetime.date(2010, 7, 15), datetime.date(1999, 9, 23)])
@pytest.mark.parametrize("hour", [9.25, 12.0, 15.0])
def test_the_sun_stands_where_pvlib_has_it(latitude_deg, longitude_deg, day, hour):
    place = {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
    design = AtmosphereDesign(**place, date=day, local_time_h=hour, utc_offset_h=0.0)
    noon_h = 12.0 - longitude_deg / 15.0  # so that the hour is one of the sun's there
    design = design.replace({"local_time_h": (hour + noon_h - 12.0) % 24.0})
    time = pd.Timestamp(day, tz="UTC") + pd.Timedelta(hours=design.local_time_h)
    said = pvlib.solarposition.get_solarposition(pd.DatetimeIndex([time]), latitude_deg, longitude_deg)
    np.testing.assert_allclose(
        np.degrees(sun_direction(design)), said[["zenith", "azimuth"]].values[0], rtol=0, atol=1e-7
    )


def test_the_earth_is_nearest_the_sun_in_january():
    """Perihelion 0.9833 au, aphelion 1.0167 au."""
    january, july = (AtmosphereDesign(date=datetime.date(2010, *day)) for day in ((1, 3), (7, 6)))
    np.testing.assert_allclose([earth_sun_distance(d) for d in (january, july)], [0.9833, 1.0167], atol=1e-4)
