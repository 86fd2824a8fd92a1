"""Lookup of the sky and the path in any direction, also across zenith and nadir.

The `meridian` frame is singular at the poles, so tables are interpolated in a frame of *fixed azimuth*:
the reference axis is the horizontal north–south line, carried to the direction of look along its meridian
from the pole (parallel transport). With the azimuth A clockwise from north of the direction one looks,

- looking **up** (sky) the compass runs counter-clockwise, the meridian axis is A counter-clockwise of
  north, and the fixed axis is reached by turning the reference by **−A**:
  Q' = Q cos 2A − U sin 2A,  U' = U cos 2A + Q sin 2A;
- looking **down** (path) it runs clockwise, and the turn is **+A**:
  Q' = Q cos 2A + U sin 2A,  U' = U cos 2A − Q sin 2A.

Interpolate Q', U', then turn back with the azimuth of the direction wanted. (`stokes.rotate` by ∓A, ±A.)
"""

import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack import stokes
from glintrack.core.arrays import Array


def to_fixed_azimuth_frame(
    stokes_map: Float[Array, "... 3"], azimuth_rad: ArrayLike, looking: str, sign: float = 1.0
) -> Float[Array, "... 3"]:
    """Rotate a map of Stokes vectors from the `meridian` frame to the frame of fixed azimuth.

    Parameters
    ----------
    stokes_map
        I Q U on the last axis, azimuth on the one before.
    azimuth_rad
        Of the direction of look, clockwise from north; broadcasts against the map without its last axis.
        [rad]
    looking
        ``"up"`` for the sky, ``"down"`` for the path.
    sign
        −1 for the inverse, from the frame of fixed azimuth to `meridian`.
    """
    if looking not in ("up", "down"):
        raise ValueError(f"`looking` must be 'up' or 'down'; got {looking!r}.")
    turn = -sign if looking == "up" else sign
    return stokes.rotate(stokes_map, turn * np.asarray(azimuth_rad, dtype=float))


def sky_stokes(
    tables: xr.Dataset, zenith_rad: ArrayLike, azimuth_rad: ArrayLike
) -> Float[Array, "... wavelength 3"]:
    """Radiance of the sky in given directions, `meridian` frame. [W m⁻² sr⁻¹ µm⁻¹]

    Parameters
    ----------
    tables
        Schema ``atmosphere``.
    zenith_rad
        0 straight up to π/2; below the last row of the table (87°) that row is used. [rad]
    azimuth_rad
        Of the direction of look, clockwise from north. [rad]
    """
    zenith, azimuth = np.broadcast_arrays(np.asarray(zenith_rad, float), np.asarray(azimuth_rad, float))
    _require(zenith, "zenith_rad", 0.0, np.pi / 2)
    fixed = interpolate_map(
        tables["sky_map"].values, tables["zenith"].values, tables["azimuth"].values, zenith, azimuth, "up"
    )
    maps = to_fixed_azimuth_frame(fixed, azimuth[..., None], "up", -1.0)
    return np.einsum("...ks,kw->...ws", maps, tables["sky_spectrum"].values)


def path_stokes(
    tables: xr.Dataset, altitude_m: float, view_zenith_rad: ArrayLike, azimuth_rad: ArrayLike
) -> Float[Array, "... wavelength 3"]:
    """Radiance of the air between the ground and a sensor, `meridian` frame. [W m⁻² sr⁻¹ µm⁻¹]

    Parameters
    ----------
    tables
        Schema ``atmosphere``.
    altitude_m
        Of the sensor, within the table's altitudes. [m]
    view_zenith_rad
        Of the direction of look from straight down, within the table. [rad]
    azimuth_rad
        Of the direction of look, clockwise from north. [rad]
    """
    view, azimuth = np.broadcast_arrays(np.asarray(view_zenith_rad, float), np.asarray(azimuth_rad, float))
    altitudes, views = tables["altitude"].values, tables["view_zenith"].values
    _require(view, "view_zenith_rad", 0.0, views[-1])
    _require(np.asarray(altitude_m), "altitude_m", altitudes[0], altitudes[-1])
    maps = np.moveaxis(tables["path_map"].values.astype(float), 1, 0)
    gases = tables["path_gas"].transpose("altitude", "wavelength").values
    at = float(np.interp(altitude_m, altitudes, np.arange(altitudes.size)))
    lower, weight = int(at), at - int(at)
    upper = min(lower + 1, altitudes.size - 1)
    at_altitude = (1 - weight) * maps[lower] + weight * maps[upper]
    gas = (1 - weight) * gases[lower] + weight * gases[upper]
    fixed = interpolate_map(at_altitude, views, tables["azimuth"].values, view, azimuth, "down")
    at = to_fixed_azimuth_frame(fixed, azimuth[..., None], "down", -1.0)
    return np.einsum("...ks,kw->...ws", at, tables["path_spectrum"].values * gas)


def interpolate_map(
    stokes_map: Float[Array, "component zenith azimuth 3"],
    zenith_rad: Float[Array, "zenith"],
    azimuth_rad: Float[Array, "azimuth"],
    at_zenith_rad: Float[Array, "*at"],
    at_azimuth_rad: Float[Array, "*at"],
    looking: str,
) -> Float[Array, "*at component 3"]:
    """Interpolate a `meridian` map, bilinear; the result is **in the frame of fixed azimuth** (see above).

    Parameters
    ----------
    stokes_map
        As ``sky_map`` or one altitude of ``path_map``.
    zenith_rad, azimuth_rad
        The map's grid, even; azimuth is periodic. [rad]
    at_zenith_rad, at_azimuth_rad
        Directions of the result; the last row is used beyond it. [rad]
    looking
        ``"up"`` for the sky, ``"down"`` for the path.
    """
    fixed = np.moveaxis(to_fixed_azimuth_frame(stokes_map, azimuth_rad, looking), 0, 2)
    row = np.clip(at_zenith_rad / (zenith_rad[1] - zenith_rad[0]), 0, zenith_rad.size - 1)
    column = np.mod((at_azimuth_rad - azimuth_rad[0]) / (2 * np.pi), 1.0) * azimuth_rad.size
    above, left = np.minimum(row.astype(int), zenith_rad.size - 2), column.astype(int) % azimuth_rad.size
    down, right = (row - above)[..., None, None], (column - column.astype(int))[..., None, None]
    next_column = (left + 1) % azimuth_rad.size
    upper = (1 - right) * fixed[above, left] + right * fixed[above, next_column]
    lower = (1 - right) * fixed[above + 1, left] + right * fixed[above + 1, next_column]
    return (1 - down) * upper + down * lower


def _require(values: Array, name: str, low: float, high: float) -> None:
    slack = 1e-9  # rounding of degrees to radians
    if values.size and not ((values >= low - slack) & (values <= high + slack)).all():
        raise ValueError(
            f"`{name}` must lie within {low:g} to {high:g}; got {values.min():g} to {values.max():g}."
        )
