"""A band's absorption as a sum of exponentials of the amount, so that a solver can hold it.

Within a band lines saturate: transmittance T(u) is no exponential of the amount u. With weights a ≥ 0 and
absorption per amount k it is Σ a exp(−k u), and every term is an atmosphere of its own that a solver takes as
it is. The band's light is the sum of theirs (Lacis and Oinas, J. Geophys. Res. 96, 9027 (1991)).
"""

from collections.abc import Callable, Mapping

import numpy as np
from jaxtyping import Float
from scipy.optimize import nnls

from glintrack.atmosphere.gas import gas_depth, gas_profiles, read_gases
from glintrack.atmosphere.profile import slant_weights
from glintrack.core.arrays import Array

LEAST_DEPTH = 0.02  # of the sun's path: gases that take less keep the absorption that is right for it
_MORE_AIR = 3.0  # air masses that scattered light may cross beyond the sun's own path
_LEAST_WEIGHT = 1e-5


def exponential_sum(
    depth_of: Callable[[Float[Array, "amount"]], Float[Array, "amount"]], most_amount: float, most_terms: int
) -> tuple[Float[Array, "term"], Float[Array, "term"]]:
    """Weights, summing to 1, and absorption per amount whose sum is a band's transmittance.

    Parameters
    ----------
    depth_of
        Optical depth of each amount. [1]
    most_amount
        The largest that any path holds.
    most_terms
        How many terms at most.
    """
    amount = most_amount * np.r_[0.0, np.geomspace(1e-4, 1.0, 80)]
    rate = np.r_[0.0, np.geomspace(1e-3, 3e3, 120)] / most_amount
    certain = np.r_[1e3, np.ones(len(amount) - 1)]  # nothing takes nothing: the weights sum to 1
    terms, wanted = np.exp(-np.outer(amount, rate)) * certain[:, None], np.exp(-depth_of(amount)) * certain
    weights, _ = nnls(terms, wanted)
    kept = np.argsort(weights)[::-1][:most_terms]
    weights, _ = nnls(terms[:, kept], wanted)
    return weights / weights.sum(), rate[kept]


def gas_terms(
    amounts: Mapping[str, float],
    height_m: Float[Array, "level"],
    cos_sun_zenith: float,
    wavelength_um: float,
    most_terms: int = 8,
    most_gases: int = 6,
) -> tuple[Float[Array, "term"], Float[Array, "term level"]]:
    """Weights and absorption of the terms of one band, all gases together. [1, m⁻¹]

    Parameters
    ----------
    amounts
        Vertical, of `gas.gas_amounts`.
    height_m, cos_sun_zenith
        Levels; of the sun. [m, 1]
    wavelength_um
        [µm]
    most_terms, most_gases
        Terms of each gas; how many of the strongest gases are made sums of.
    """
    table, profiles, wavelength = read_gases(), gas_profiles(height_m), np.array([wavelength_um])
    slant = slant_weights(cos_sun_zenith, height_m)
    mass = {gas: float(slant @ profile) for gas, profile in profiles.items()}

    def depth_of(gas: str) -> Callable[[Array], Array]:
        return lambda amount: gas_depth(table, gas, amount, wavelength)[..., 0]

    depth = {gas: float(depth_of(gas)(np.array(amounts[gas] * mass[gas]))) for gas in profiles}
    summed = [gas for gas in sorted(depth, key=lambda gas: -depth[gas]) if depth[gas] >= LEAST_DEPTH]
    weights, absorption = np.ones(1), np.zeros((1, height_m.size))
    for gas, profile in profiles.items():
        if gas not in summed[:most_gases]:
            absorption = absorption + profile * depth[gas] / mass[gas]
            continue
        most = amounts[gas] * (mass[gas] + _MORE_AIR)
        share, rate = exponential_sum(depth_of(gas), most, most_terms)
        added = np.outer(amounts[gas] * rate, profile)
        absorption = (absorption[:, None] + added[None]).reshape(-1, height_m.size)
        weights = np.outer(weights, share).ravel()
    kept = weights > _LEAST_WEIGHT
    return weights[kept] / weights[kept].sum(), absorption[kept]
