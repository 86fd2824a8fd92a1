"""A place of the sun that is not the city's: left out, or latitude and longitude exchanged."""

from types import SimpleNamespace

import pytest

from glintrack.case.build import check_place
from glintrack.case.design import Case
from glintrack.core.designs import validate_design

BRAUNSCHWEIG = SimpleNamespace(latitude_deg=52.27, longitude_deg=10.53)


def place(latitude_deg, longitude_deg, **keys):
    keys |= {"latitude_deg": latitude_deg, "longitude_deg": longitude_deg}
    return validate_design(Case, {"atmosphere": keys}).atmosphere


def test_a_place_that_is_the_citys_exchanged_is_refused():
    check_place(place(52.0, 10.0), BRAUNSCHWEIG)
    check_place(place(43.16, -77.61), BRAUNSCHWEIG)  # another place is the user's own
    check_place(place(10.5, 52.3, sun_zenith_deg=30.0, sun_azimuth_deg=0.0), BRAUNSCHWEIG)
    with pytest.raises(ValueError, match=r"of the city, 52\.27° and 10\.53°; got 10\.5° and 52\.3"):
        check_place(place(10.5, 52.3), BRAUNSCHWEIG)


def test_a_city_at_another_place_needs_its_own_sun():
    rochester = SimpleNamespace(latitude_deg=43.1, longitude_deg=-77.7)
    check_place(validate_design(Case, {}).atmosphere, rochester)
    angles = {"sun_zenith_deg": 30.0, "sun_azimuth_deg": 0.0}
    check_place(validate_design(Case, {"atmosphere": angles}).atmosphere, BRAUNSCHWEIG)
    with pytest.raises(ValueError, match=r"got none\. This city lies at 52\.2700° and 10\.5300°"):
        check_place(validate_design(Case, {}).atmosphere, BRAUNSCHWEIG)


def test_a_latitude_that_can_only_be_a_longitude_is_named():
    with pytest.raises(ValueError, match=r"`atmosphere.latitude_deg` must lie within ±90°; got 121\.5"):
        place(121.5, 31.2)
