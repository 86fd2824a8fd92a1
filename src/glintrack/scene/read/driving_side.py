"""Side of the road that traffic keeps to, by the country of a place."""

from functools import cache
from importlib import resources

import shapely
from shapely.geometry.base import BaseGeometry


def keeps_left(longitude_deg: float, latitude_deg: float) -> bool:
    """Return True if traffic keeps left at a place, by the country it lies in. [deg]"""
    return bool(shapely.contains_xy(_left_hand_area(), longitude_deg, latitude_deg))


@cache
def _left_hand_area() -> BaseGeometry:
    """Area of left-hand traffic in degrees, of Natural Earth's countries; good to about 3 km."""
    path = resources.files("glintrack") / "data" / "traffic" / "left_hand.geojson"
    area = shapely.from_geojson(path.read_text(encoding="utf-8"))
    shapely.prepare(area)
    return area
