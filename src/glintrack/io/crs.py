"""Places on the map: a CRS in metres of the ground, and longitude and latitude of what lies in it."""

import warnings
from typing import Any

import numpy as np
import pyproj
import pyproj.exceptions
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.io.untrusted import plain

_STEP_M = 100.0
_OFF_MAP_DEG = 1.0  # beyond the area for which a CRS is made
_TRUE = 0.05  # of a metre: conic projections of a continent keep lengths that well, Pseudo-Mercator does not


def metric_crs(crs: Any) -> pyproj.CRS:
    """A projected CRS in metres, or a refusal."""
    try:
        found = pyproj.CRS.from_user_input(crs)
    except pyproj.exceptions.CRSError as error:
        raise ValueError(
            f"`crs` must be a coordinate reference system such as EPSG:32618, got {crs!r}"
        ) from error
    if not found.is_projected or any(axis.unit_name != "metre" for axis in found.axis_info[:2]):
        raise ValueError(f"`crs` must be projected and in metres, as EPSG:32618 is, got {found.name}")
    return found


def change_crs(source: Any, target: Any) -> pyproj.Transformer:
    """PROJ's way from one CRS to another, x or longitude first.

    Raises
    ------
    ValueError
        If there is none, as between a CRS that a damaged file holds and any.
    """
    try:
        return pyproj.Transformer.from_crs(source, target, always_xy=True)
    except pyproj.exceptions.ProjError as error:
        both = f"{plain(source, 60)!r} and {plain(target, 60)!r}"
        raise ValueError(f"`crs` must be one that PROJ can change into another, got {both}") from error


def longitude_latitude(
    crs: Any, east_m: Float[Array, "place"], north_m: Float[Array, "place"]
) -> tuple[Float[Array, "place"], Float[Array, "place"]]:
    """Longitude and latitude (WGS 84) of places in a projected CRS. [°]

    Parameters
    ----------
    crs
        Whatever PROJ takes for one.
    east_m, north_m
        Easting and northing. [m]

    Raises
    ------
    ValueError
        If the CRS is not in metres, if a place of it lies nowhere on earth, or if its metre is not one of the
        ground there within 5 %: speeds and gates would be wrong by as much.
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
            f"`crs` must be one in which the places lie, got {x[k]:.9g} m east, {y[k]:.9g} m north, which is "
            f"nowhere in {found.name}{_if_exchanged(found, *middle_m)}"
        )
    here = longitude[-3:-2].repeat(2), latitude[-3:-2].repeat(2)
    _, _, along_m = pyproj.Geod(ellps="WGS84").inv(here[0], here[1], longitude[-2:], latitude[-2:])
    lengths = np.asarray(along_m) / _STEP_M
    if np.abs(lengths - 1).max() > _TRUE:
        zone = f"{longitude[-3]:.2f}°, {latitude[-3]:.2f}°"
        raise ValueError(
            f"`crs` must count metres of the ground where the places lie, got {lengths[0]:.3f} m of ground a "
            f"metre east and {lengths[1]:.3f} m a metre north in {found.name}"
            + (_if_exchanged(found, *middle_m) or f" (take the UTM zone of {zone})")
        )
    return longitude[:-3], latitude[:-3]


def warn_off_map(crs: pyproj.CRS, east_m: float, north_m: float) -> None:
    """Say where a place is far from what its CRS is made for, as degrees taken for metres are."""
    (longitude_deg,), (latitude_deg,) = longitude_latitude(crs, np.array([east_m]), np.array([north_m]))
    if not _is_on_map(crs, longitude_deg, latitude_deg):
        asked = _if_exchanged(crs, east_m, north_m) or " (are easting and northing metres of that CRS?)"
        warnings.warn(
            f"the place is at {longitude_deg:.2f}°, {latitude_deg:.2f}°, outside what {crs.name} is "
            f"made for{asked}",
            stacklevel=2,
        )


def _is_on_map(crs: pyproj.CRS, longitude_deg: float, latitude_deg: float) -> bool:
    """Whether a CRS is made for a place; one that does not say is for any."""
    made_for = crs.area_of_use
    if made_for is None:
        return True
    west, south, east, north = made_for.bounds
    beyond_deg = (longitude_deg - (west + east) / 2 + 180) % 360 - 180
    wide_deg = ((east - west) % 360) / 2 + _OFF_MAP_DEG
    return abs(beyond_deg) <= wide_deg and south - _OFF_MAP_DEG <= latitude_deg <= north + _OFF_MAP_DEG


def _if_exchanged(crs: pyproj.CRS, east_m: float, north_m: float) -> str:
    """A remedy for a place that is off the map, but would be on it with east and north exchanged."""
    longitude, latitude = change_crs(crs, "EPSG:4326").transform(north_m, east_m)
    if crs.area_of_use is None or not (abs(longitude) <= 180 and _is_on_map(crs, longitude, latitude)):
        return ""
    return f" (exchanged they lie at {longitude:.2f}°, {latitude:.2f}°: are east and north exchanged?)"
