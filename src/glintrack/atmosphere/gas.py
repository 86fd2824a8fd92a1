"""Absorption by H₂O, O₃, O₂, CO₂, CH₄ and N₂O in 10-nm bands, by amount along the path.

Within a band lines saturate, so that transmittance is not exponential in the amount: the packaged table
(``tools/make_gas_tables.py``, from 6S) holds optical depth against amount, and what the solver gets is the
*effective* absorption that gives the right transmittance of the sun's slant path.
"""

import math
from collections.abc import Mapping
from importlib.resources import as_file, files

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.atmosphere.profile import column_weights, exponential_profile, slant_weights
from glintrack.core.arrays import Array
from glintrack.core.spectral import resample

WATER_SCALE_HEIGHT_M = 2000.0
"""Of water vapour in the mean (e.g. Reitan, J. Appl. Meteor. 2, 776 (1963)). [m]"""
AIR_SCALE_HEIGHT_M = 8000.0
OZONE_HEIGHT_M, OZONE_WIDTH_M = 20_000.0, 5_000.0
"""Green's ozone layer as in Lacis and Hansen, J. Atmos. Sci. 31, 118 (1974), b and c. [m]"""
DOBSON_PER_CM_ATM = 1000.0


def read_gases() -> xr.Dataset:
    """Packaged optical depth by gas, amount and wavelength (µm)."""
    resource = files("glintrack") / "data" / "atmosphere" / "gas_transmittance.nc"
    with as_file(resource) as path:
        return xr.load_dataset(path, engine="h5netcdf")


def gas_amounts(water_cm: float, ozone_du: float) -> dict[str, float]:
    """Vertical amount of each gas in the table's units: cm, cm-atm, air masses."""
    mixed = dict.fromkeys(("o2", "co2", "ch4", "n2o"), 1.0)
    return {"h2o": water_cm, "o3": ozone_du / DOBSON_PER_CM_ATM, **mixed}


def gas_profiles(height_m: Float[Array, "level"]) -> dict[str, Float[Array, "level"]]:
    """Vertical distribution of each gas, unit column. [m⁻¹]"""
    lifted = np.exp((height_m - OZONE_HEIGHT_M) / OZONE_WIDTH_M)
    shapes = {"h2o": exponential_profile(height_m, WATER_SCALE_HEIGHT_M), "o3": lifted / (1 + lifted) ** 2}
    air = exponential_profile(height_m, AIR_SCALE_HEIGHT_M)
    shapes |= dict.fromkeys(("o2", "co2", "ch4", "n2o"), air)
    return {gas: column_weights(shape, height_m) for gas, shape in shapes.items()}


def gas_depth(
    table: xr.Dataset, gas: str, amount: Float[Array, "..."], wavelength_um: Float[Array, "wavelength"]
) -> Float[Array, "... wavelength"]:
    """Optical depth of an amount of one gas, 10-nm mean. [1]

    Parameters
    ----------
    table
        Of `read_gases`.
    gas
        One of its gases.
    amount
        Along the path, in the table's unit for that gas.
    wavelength_um
        [µm]

    Notes
    -----
    Depth per amount is interpolated in the logarithm of the amount; below the table's least amount it is
    constant (weak lines), above its largest too.
    """
    one = table.sel(gas=gas)
    nodes, depth = one["amount"].values, one["optical_depth"].values.astype(float)
    per_amount = resample(wavelength_um, table["wavelength"].values, depth / nodes[:, None], f"gas.{gas}")
    amount = np.asarray(amount, dtype=float)
    at = np.log(np.clip(amount, nodes[0], nodes[-1]))
    upper = np.clip(np.searchsorted(np.log(nodes), at), 1, nodes.size - 1)
    span = np.log(nodes[upper]) - np.log(nodes[upper - 1])
    weight = ((at - np.log(nodes[upper - 1])) / span)[..., None]
    return amount[..., None] * ((1 - weight) * per_amount[upper - 1] + weight * per_amount[upper])


def effective_absorption(
    amounts: Mapping[str, float],
    height_m: Float[Array, "level"],
    cos_sun_zenith: float,
    wavelength_um: Float[Array, "wavelength"],
) -> Float[Array, "level wavelength"]:
    """Absorption that gives the band transmittance of the sun's path to the ground. [m⁻¹]

    Parameters
    ----------
    amounts
        Vertical, of `gas_amounts`.
    height_m
        Levels. [m]
    cos_sun_zenith
        Of the sun. [1]
    wavelength_um
        [µm]
    """
    table, slant = read_gases(), slant_weights(cos_sun_zenith, height_m)
    total = np.zeros((height_m.size, np.size(wavelength_um)))
    for gas, profile in gas_profiles(height_m).items():
        air_mass = slant @ profile
        depth = gas_depth(table, gas, np.asarray(amounts[gas] * air_mass), wavelength_um)
        total += np.outer(profile, depth / air_mass)
    return total


def path_transmittance(
    amounts: Mapping[str, float],
    height_m: Float[Array, "level"],
    altitude_m: Float[Array, "altitude"],
    view_zenith: Float[Array, "view_zenith"],
    wavelength_um: Float[Array, "wavelength"],
) -> Float[Array, "wavelength altitude view_zenith"]:
    """Transmittance of all gases from the ground to a sensor. [1]

    Parameters
    ----------
    amounts
        Vertical, through the whole atmosphere, of `gas_amounts`.
    height_m
        Levels. [m]
    altitude_m
        Of the sensor. [m]
    view_zenith
        Angle of the path from the vertical, at the ground. [rad]
    wavelength_um
        [µm]
    """
    table, profiles = read_gases(), gas_profiles(height_m)
    slant = np.array([[slant_weights(math.cos(v), height_m, a) for v in view_zenith] for a in altitude_m])
    depth = sum(
        gas_depth(table, gas, amounts[gas] * (slant @ profile), wavelength_um)
        for gas, profile in profiles.items()
    )
    return np.moveaxis(np.exp(-np.asarray(depth)), -1, 0)
