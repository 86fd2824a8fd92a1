import numpy as np
import pytest

from glintrack.atmosphere.gas import (
    LEVELS_M,
    effective_absorption,
    gas_amounts,
    gas_depth,
    gas_profiles,
    path_transmittance,
    read_gases,
    slant_weights,
)

HEIGHT = np.array(LEVELS_M, dtype=float)


def test_bands_lie_where_spectroscopy_puts_them():
    table = read_gases()
    at = {"h2o": 0.94, "o3": 0.60, "o2": 0.76, "co2": 2.01, "ch4": 2.31, "n2o": 2.28}
    window = np.array([0.55, 0.86, 1.04, 1.24, 1.67, 2.20])
    for gas, um in at.items():
        inside = gas_depth(table, gas, np.array(gas_amounts(2.9)[gas]), np.array([um]))
        # N₂O is the weakest of them: 0.4 % at a vertical path
        assert inside[0] > (0.003 if gas == "n2o" else 0.03), gas
    total = sum(gas_depth(table, g, np.array(u), window) for g, u in gas_amounts(2.9).items())
    assert (total < 0.12).all()


def test_depth_grows_with_amount_but_less_than_in_proportion():
    table, um = read_gases(), np.array([0.94])
    amounts = np.geomspace(0.05, 40, 30)
    depth = gas_depth(table, "h2o", amounts, um)[:, 0]
    assert (np.diff(depth) > 0).all()
    slope = np.diff(np.log(depth)) / np.diff(np.log(amounts))
    assert (slope < 1.0).all() and (slope > 0.3).all()  # between weak lines (1) and strong ones (1/2)
    assert gas_depth(table, "h2o", np.array(0.0), um)[0] == 0


def test_table_is_met_at_its_own_nodes():
    table = read_gases()
    one = table.sel(gas="co2")
    um = table.wavelength.values
    for node in (0, 4, 8):
        amount = one.amount.values[node]
        np.testing.assert_allclose(
            gas_depth(table, "co2", np.array(amount), um),
            one.optical_depth.values[node],
            rtol=1e-5,
            atol=1e-7,
        )


def test_effective_absorption_gives_the_band_transmittance_of_the_suns_path():
    um, cos_sun, amounts = np.array([0.76, 0.94, 2.05]), 0.5, gas_amounts(2.9)
    solved = np.exp(-slant_weights(cos_sun, HEIGHT) @ effective_absorption(amounts, HEIGHT, cos_sun, um))
    table, expected = read_gases(), 1.0
    for gas, profile in gas_profiles(HEIGHT).items():
        slant = amounts[gas] * (slant_weights(cos_sun, HEIGHT) @ profile)
        expected = expected * np.exp(-gas_depth(table, gas, np.asarray(slant), um))
    np.testing.assert_allclose(solved, expected, rtol=1e-12)


def test_longer_and_higher_paths_absorb_more():
    um = np.array([0.94])
    through = path_transmittance(
        gas_amounts(2.9), HEIGHT, np.array([500.0, 3000.0, 20000.0]), np.radians([0.0, 60.0, 85.0]), um
    )[0]
    assert (np.diff(through, axis=0) < 0).all() and (np.diff(through, axis=1) < 0).all()


def test_slant_weights_are_secant_at_small_angles_and_bounded_at_the_horizon():
    profile = gas_profiles(HEIGHT)["o2"]
    assert slant_weights(1.0, HEIGHT) @ profile == pytest.approx(1.0, rel=1e-9)
    assert slant_weights(0.5, HEIGHT) @ profile == pytest.approx(2.0, rel=5e-3)
    # Chapman function of an 8-km atmosphere: sqrt(πR/2H) at the horizon
    horizon = np.sqrt(np.pi * 6371 / (2 * 8))
    assert slant_weights(0.0, HEIGHT) @ profile == pytest.approx(horizon, rel=0.1)
