"""Projected CRS in metres on the ground, and longitude and latitude of positions in them."""

import warnings
from typing import Any

import numpy as np
import pyproj
import pyproj.exceptions
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.io.untrusted import plain

_STEP_M = 100.0
_OFF_MAP_DEG = 1.0  # outside the area of use of a CRS
_MAX_SCALE_ERROR = 0.05  # conic projections of a continent have less, Pseudo-Mercator has more


def any_crs(crs: Any) -> pyproj.CRS:
    """Return a CRS in any form that PROJ accepts, or raise ValueError."""
    try:
        return pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise ValueError(
            f"`crs` must be a coordinate reference system such as EPSG:32618; got {plain(crs, 60)!r}."
        ) from error


def metric_crs(crs: Any) -> pyproj.CRS:
    """Return a projected CRS in metres that counts eastward and northward, or raise ValueError."""
    found = any_crs(crs)
    if not found.is_projected or any(axis.unit_name != "metre" for axis in found.axis_info[:2]):
        raise ValueError(f"`crs` must be projected and in metres, as EPSG:32618 is; got {found.name}.")
    directions = [axis.direction for axis in found.axis_info[:2]]
    if {"west", "south"} & set(directions):
        raise ValueError(
            f"`crs` must count eastward and northward; got axes {' and '.join(directions)} of {found.name}. "
            "Take one with easting and northing, such as UTM."
        )
    return found


def change_crs(source: Any, target: Any) -> pyproj.Transformer:
    """Return PROJ's transformer from one CRS to another, x or longitude first.

    Raises
    ------
    ValueError
        If there is none, for example from the CRS of a damaged file.
    """
    try:
        return pyproj.Transformer.from_crs(source, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        both = f"{plain(source, 60)!r} and {plain(target, 60)!r}"
        raise ValueError(f"`crs` must be one that PROJ can change into another; got {both}.") from error


def longitude_latitude(
    crs: Any, east_m: Float[Array, "place"], north_m: Float[Array, "place"]
) -> tuple[Float[Array, "place"], Float[Array, "place"]]:
    """Longitude and latitude (WGS 84) of positions in a projected CRS. [°]

    Parameters
    ----------
    crs
        CRS in any form that PROJ accepts.
    east_m, north_m
        Easting and northing. [m]

    Raises
    ------
    ValueError
        If the CRS is not in metres, if a position is nowhere on earth, or if a metre of the CRS differs from
        one on the ground there by more than 5 %: speeds and gates would be wrong by as much.
    """
    found = metric_crs(crs)
    if not len(east_m):
        return np.empty(0), np.empty(0)
    middle_m = float(np.median(east_m)), float(np.median(north_m))
    x = np.r_[east_m, middle_m[0], middle_m[0] + _STEP_M, middle_m[0]]
    y = np.r_[north_m, middle_m[1], middle_m[1], middle_m[1] + _STEP_M]
    longitude, latitude = change_crs(found, "EPSG:4326").transform(x, y)
    nowhere = ~((np.abs(longitude) <= 180) & (np.abs(latitude) <= 90))
    if nowhere.any():
        k = np.flatnonzero(nowhere)[0]
        raise ValueError(
            f"`crs` must be one in which the places lie; got {x[k]:.9g} m east, {y[k]:.9g} m north, which is "
            f"nowhere in {found.name}.{_exchange_question(found, *middle_m)}"
        )
    here = longitude[-3:-2].repeat(2), latitude[-3:-2].repeat(2)
    _, _, along_m = pyproj.Geod(ellps="WGS84").inv(here[0], here[1], longitude[-2:], latitude[-2:])
    lengths = np.asarray(along_m) / _STEP_M
    if np.abs(lengths - 1).max() > _MAX_SCALE_ERROR:
        zone = f"{longitude[-3]:.2f}°, {latitude[-3]:.2f}°"
        raise ValueError(
            f"`crs` must count metres of the ground where the places lie; got {lengths[0]:.3f} m of ground a "
            f"metre east and {lengths[1]:.3f} m a metre north in {found.name}."
            + (_exchange_question(found, *middle_m) or f" Take the UTM zone of {zone}.")
        )
    return longitude[:-3], latitude[:-3]


def warn_off_map(crs: pyproj.CRS, east_m: float, north_m: float) -> None:
    """Warn if a position is outside the area of use of its CRS, as degrees instead of metres are."""
    (longitude_deg,), (latitude_deg,) = longitude_latitude(crs, np.array([east_m]), np.array([north_m]))
    if not _is_on_map(crs, longitude_deg, latitude_deg):
        question = _exchange_question(crs, east_m, north_m) or " (are they metres of that CRS?)"
        warnings.warn(
            f"the place is at {longitude_deg:.2f}°, {latitude_deg:.2f}°, outside what {crs.name} is "
            f"made for{question}",
            stacklevel=2,
        )


def check_not_exchanged(crs: Any, longitude_deg: float, latitude_deg: float, name: str) -> None:
    """Refuse a place off the map of a CRS that is on it with longitude and latitude exchanged."""
    found = pyproj.CRS.from_user_input(crs)
    if not _is_on_map(found, longitude_deg, latitude_deg) and _is_on_map(found, latitude_deg, longitude_deg):
        raise ValueError(
            f"`{name}` must lie where {found.name} is made for; got longitude {longitude_deg:.4f}° and "
            f"latitude {latitude_deg:.4f}°. They are probably exchanged."
        )


def _is_on_map(crs: pyproj.CRS, longitude_deg: float, latitude_deg: float) -> bool:
    """Return True if a position is in the area of use of a CRS, or that is unknown."""
    if crs.area_of_use is None:
        return True
    west, south, east, north = crs.area_of_use.bounds
    beyond_deg = (longitude_deg - (west + east) / 2 + 180) % 360 - 180
    wide_deg = ((east - west) % 360) / 2 + _OFF_MAP_DEG
    return abs(beyond_deg) <= wide_deg and south - _OFF_MAP_DEG <= latitude_deg <= north + _OFF_MAP_DEG


def _exchange_question(crs: pyproj.CRS, east_m: float, north_m: float) -> str:
    """Remedy for a position that would be on the map with east and north exchanged; may be empty."""
    longitude, latitude = change_crs(crs, "EPSG:4326").transform(north_m, east_m)
    if crs.area_of_use is None or not (abs(longitude) <= 180 and _is_on_map(crs, longitude, latitude)):
        return ""
    return f" Are east and north exchanged? The places would then lie at {longitude:.2f}°, {latitude:.2f}°."
