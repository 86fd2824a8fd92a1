"""Levels, slant paths, and absorption by H₂O, O₃, O₂, CO₂, CH₄ and N₂O in 10-nm bands.

Within a band lines saturate, so that transmittance is not exponential in the amount. The packaged table
(``tools/make_gas_tables.py``, from 6S) contains optical depth over amount. The solver gets the *effective*
absorption that gives the right transmittance of the sun's slant path, or a sum of exponentials of the amount:
with weights a ≥ 0 and absorption per amount k, T(u) = Σ a exp(−k u), every term is an atmosphere of its own,
and the band's light is the sum of theirs (Lacis and Oinas, J. Geophys. Res. 96, 9027 (1991)).
"""

import math
from collections.abc import Callable, Mapping

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.optimize import nnls

from glintrack.core.arrays import Array
from glintrack.core.installation import data_file
from glintrack.core.schema import EARTH_RADIUS_M
from glintrack.core.spectral import resample

LEVELS_M: tuple[float, ...] = (
    *range(0, 3001, 250),
    3500,
    *range(4000, 10001, 1000),
    *range(12000, 30001, 3000),
    40000,
    50000,
    70000,
    100000,
)
"""Levels of the atmosphere; fine at the heights of the aerosol and the aircraft. [m]"""
WATER_SCALE_HEIGHT_M = 2000.0
"""Of water vapour in the mean (e.g. Reitan, J. Appl. Meteor. 2, 776 (1963)). [m]"""
AIR_SCALE_HEIGHT_M = 8000.0
OZONE_HEIGHT_M, OZONE_WIDTH_M = 20_000.0, 5_000.0
"""Green's ozone layer as in Lacis and Hansen, J. Atmos. Sci. 31, 118 (1974), b and c. [m]"""
OZONE_DU = 320.0
"""Vertical column of ozone, the mean of northern mid-latitudes. [Dobson units]"""
DOBSON_PER_CM_ATM = 1000.0
MIN_DEPTH = 0.02  # of the sun's path: weaker gases are given their effective absorption of that path
_MORE_AIR = 3.0  # air masses that scattered light may cross beyond the sun's own path
_MIN_WEIGHT = 1e-5


def column_weights(profile: Float[Array, "level"], height_m: Float[Array, "level"]) -> Float[Array, "level"]:
    """Scale a profile to unit column (trapezoid, as in the solver). [m⁻¹]"""
    return profile / np.trapezoid(profile, height_m)


def exponential_profile(
    height_m: Float[Array, "level"], scale_height_m: float, top_m: float = np.inf
) -> Float[Array, "level"]:
    """exp(−z/H) below a top, zero above. [1]"""
    return np.where(height_m <= top_m, np.exp(-height_m / scale_height_m), 0.0)


def slant_weights(
    cos_zenith: float, height_m: Float[Array, "level"], up_to_m: float = np.inf
) -> Float[Array, "level"]:
    """Weights from an extinction profile to the optical depth along a slant path. [m]

    Parameters
    ----------
    cos_zenith
        Cosine of the path's zenith angle at the ground.
    height_m
        Levels, from 0 upward; extinction is linear between them. [m]
    up_to_m
        Where the path ends; at the top by default. [m]

    Returns
    -------
    Weight of each level, straight rays through spherical shells.
    """
    edges = np.unique(np.r_[height_m[height_m < up_to_m], min(up_to_m, height_m[-1])])
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    half = np.diff(edges) / 2
    at = (edges[:-1] + half)[:, None] + half[:, None] * nodes
    radius = 1 + at / EARTH_RADIUS_M
    per_height = radius / np.sqrt(radius**2 - (1 - cos_zenith**2))  # ds/dz of a straight ray, Chapman
    quadrature = (half[:, None] * node_weights * per_height).ravel()
    at = at.ravel()
    upper = np.clip(np.searchsorted(height_m, at, side="right"), 1, height_m.size - 1)
    fraction = (at - height_m[upper - 1]) / (height_m[upper] - height_m[upper - 1])
    weights = np.zeros(height_m.size)
    np.add.at(weights, upper - 1, quadrature * (1 - fraction))
    np.add.at(weights, upper, quadrature * fraction)
    return weights


def read_gases() -> xr.Dataset:
    """Read the packaged optical depth by gas, amount and wavelength (µm)."""
    return xr.load_dataset(data_file("atmosphere", "gas_transmittance.nc"), engine="h5netcdf")


def gas_amounts(water_cm: float) -> dict[str, float]:
    """Vertical amount of each gas in the table's units: cm, cm-atm, air masses."""
    mixed = dict.fromkeys(("o2", "co2", "ch4", "n2o"), 1.0)
    return {"h2o": water_cm, "o3": OZONE_DU / DOBSON_PER_CM_ATM, **mixed}


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
    table, gas
        From `read_gases`, and one of its gases.
    amount
        Amount along the path, in the table's unit for that gas.

    Notes
    -----
    Depth per amount is interpolated in the logarithm of the amount; below the table's least amount it is
    constant (weak lines), above its largest too.
    """
    one = table.sel(gas=gas)
    nodes, depth = one["amount"].values, one["optical_depth"].values.astype(float)
    per_amount = resample(wavelength_um, table["wavelength"].values, depth / nodes[:, None], f"gas.{gas}")
    amount, log_nodes = np.asarray(amount, dtype=float), np.log(nodes)
    at = np.log(np.clip(amount, nodes[0], nodes[-1]))
    upper = np.clip(np.searchsorted(log_nodes, at), 1, nodes.size - 1)
    weight = ((at - log_nodes[upper - 1]) / (log_nodes[upper] - log_nodes[upper - 1]))[..., None]
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
    cos_sun_zenith: float | None = None,
) -> Float[Array, "wavelength altitude view_zenith"]:
    """Transmittance of all gases from the ground to a sensor. [1]

    Sunlight reaches the ground without the centres of the absorption lines. On the way up it loses less than
    white light: its transmittance is T(down and up) / T(down).

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
    cos_sun_zenith
        Of the sun's zenith angle, for reflected sunlight; white light by default. [1]
    """
    table, profiles = read_gases(), gas_profiles(height_m)
    slant = np.array([[slant_weights(math.cos(v), height_m, a) for v in view_zenith] for a in altitude_m])
    before = np.zeros(height_m.size) if cos_sun_zenith is None else slant_weights(cos_sun_zenith, height_m)
    depth = np.zeros((*slant.shape[:2], np.size(wavelength_um)))
    for gas, profile in profiles.items():
        down, up = np.asarray(amounts[gas] * (before @ profile)), amounts[gas] * (slant @ profile)
        both, first = (gas_depth(table, gas, amount, wavelength_um) for amount in (down + up, down))
        depth += both - first
    return np.moveaxis(np.exp(-depth), -1, 0)


def exponential_sum(
    depth_of: Callable[[Float[Array, "amount"]], Float[Array, "amount"]], max_amount: float, max_terms: int
) -> tuple[Float[Array, "term"], Float[Array, "term"]]:
    """Exponential sum of a band's transmittance: weights, summing to 1, and absorption per amount.

    Parameters
    ----------
    depth_of
        Optical depth of each amount. [1]
    max_amount, max_terms
        Largest amount of any path; largest number of terms.
    """
    amount = max_amount * np.r_[0.0, np.geomspace(1e-4, 1.0, 80)]
    rate = np.r_[0.0, np.geomspace(1e-3, 3e3, 120)] / max_amount
    certain = np.r_[1e3, np.ones(len(amount) - 1)]  # nothing takes nothing: the weights sum to 1
    terms, target = np.exp(-np.outer(amount, rate)) * certain[:, None], np.exp(-depth_of(amount)) * certain
    weights, _ = nnls(terms, target)
    chosen = np.argsort(weights)[::-1][:max_terms]
    weights, _ = nnls(terms[:, chosen], target)
    return weights / weights.sum(), rate[chosen]


def gas_terms(
    amounts: Mapping[str, float],
    height_m: Float[Array, "level"],
    cos_sun_zenith: float,
    wavelength_um: float,
    max_terms: int = 8,
    max_gases: int = 6,
) -> tuple[Float[Array, "term"], Float[Array, "term level"]]:
    """Weights and absorption of the terms of one band, all gases together. [1, m⁻¹]

    Parameters
    ----------
    amounts
        Vertical, of `gas.gas_amounts`.
    height_m, cos_sun_zenith
        Levels; of the sun. [m, 1]
    max_terms, max_gases
        Terms of each gas; number of the strongest gases that are expanded in sums.
    """
    table, profiles, wavelength = read_gases(), gas_profiles(height_m), np.array([wavelength_um])
    slant = slant_weights(cos_sun_zenith, height_m)
    mass = {gas: float(slant @ profile) for gas, profile in profiles.items()}

    def depth_of(gas: str) -> Callable[[Array], Array]:
        return lambda amount: gas_depth(table, gas, amount, wavelength)[..., 0]

    depth = {gas: float(depth_of(gas)(np.array(amounts[gas] * mass[gas]))) for gas in profiles}
    summed = [gas for gas in sorted(depth, key=lambda gas: -depth[gas]) if depth[gas] >= MIN_DEPTH]
    weights, absorption = np.ones(1), np.zeros((1, height_m.size))
    for gas, profile in profiles.items():
        if gas not in summed[:max_gases]:
            absorption = absorption + profile * depth[gas] / mass[gas]
            continue
        most = amounts[gas] * (mass[gas] + _MORE_AIR)
        share, rate = exponential_sum(depth_of(gas), most, max_terms)
        added = np.outer(amounts[gas] * rate, profile)
        absorption = (absorption[:, None] + added[None]).reshape(-1, height_m.size)
        weights = np.outer(weights, share).ravel()
    chosen = weights > _MIN_WEIGHT
    return weights[chosen] / weights[chosen].sum(), absorption[chosen]
