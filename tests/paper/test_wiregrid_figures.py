"""Figures 6 to 10 of the paper and the statements beside them, from the shipped tables.

Tolerances are those of the table that states what finite elements reach: the paper gives its own figures to
one or two digits.
"""

from importlib import resources

import numpy as np
import pytest

from glintrack.devices import PAPER_GRIDS, WireGridDesign, wire_grid

FIVE_UM = [0.4, 0.49, 0.8, 1.5, 2.5]


@pytest.fixture(scope="module")
def tables():
    return Tables()


class Tables:
    """Shipped tables by name, each loaded once."""

    def __init__(self):
        self.loaded = {}

    def __getitem__(self, name):
        if name not in self.loaded:
            if not (resources.files("glintrack") / "data" / "devices" / f"{name}.nc").is_file():
                pytest.skip(f"{name} is not solved yet: python tools/make_wiregrid_tables.py {name}")
            self.loaded[name] = wire_grid.load(name)
        return self.loaded[name]


@pytest.mark.parametrize(
    ("name", "variable", "expected", "tolerance"),
    [
        ("grid_a", "block_transmittance", 0.0708, 0.0005),  # the paper: 6.9 %
        ("grid_a", "pass_transmittance", 0.6805, 0.002),  # about 0.7
        ("grid_b", "block_transmittance", 0.00174, 0.00005),  # 0.2 %
        ("grid_b", "pass_transmittance", 0.6932, 0.002),  # about 0.7
        ("grid_a_physical", "block_transmittance", 0.141, 0.001),  # not in the paper: measured aluminium
        ("grid_b_physical", "block_transmittance", 0.108, 0.001),
        ("grid_b_physical", "diattenuation", 0.73, 0.005),
    ],
)
def test_leakage_at_1_5_um(tables, name, variable, expected, tolerance):
    assert float(tables[name][variable].sel(wavelength=1.5)) == pytest.approx(expected, abs=tolerance)


def test_fine_grid_polarizes_everywhere(tables):
    """Figure 8(b): D > 0.95 over 0.4 to 2.5 µm, least at the short end."""
    d = tables["grid_b"]["diattenuation"]
    assert float(d.min()) > 0.95
    assert float(d.min()) == pytest.approx(0.956, abs=0.001)
    assert float(d["wavelength"][int(np.argmin(d.values))]) == pytest.approx(0.4)


def test_coarse_grid_converges_near_half_a_micrometre(tables):
    """Figure 6(a): T(0°) = T(90°) near 0.5 µm."""
    d = tables["grid_a"]["diattenuation"]
    assert abs(float(d.sel(wavelength=0.49))) < 0.02
    assert float(d.sel(wavelength=2.5)) > 0.9


def test_transmission_across_is_about_0_7(tables):
    """Figure 6: both grids' T(λ, 0°) at most wavelengths."""
    a = tables["grid_a"]["pass_transmittance"]
    a = a.where(a["wavelength"] >= 0.52 - 1e-9, drop=True)
    assert 0.63 <= float(a.min()) and float(a.max()) <= 0.74
    assert float(tables["grid_b"]["pass_transmittance"].min()) > 0.63


@pytest.mark.parametrize("name", list(PAPER_GRIDS))
def test_tables_are_physical_and_whole(tables, name):
    table = tables[name]
    assert table.sizes["wavelength"] == 211
    for polarization in ("pass", "block"):
        through = table[f"{polarization}_transmittance"].values * table["free_transmittance"].values
        back, lost = (table[f"{polarization}_{q}"].values for q in ("reflectance", "absorptance"))
        assert (through > 0).all() and (back > 0).all() and (lost > 0).all()
        assert (through + back + lost <= 1).all()
        assert (table[f"{polarization}_transmittance"].values + back <= 1).all()
    coherence = np.hypot(table["coherence_real"], table["coherence_imag"])
    bound = np.sqrt(table["pass_transmittance"] * table["block_transmittance"])
    assert (coherence <= bound * 1.001).all()  # Schwarz, but for what near field is left 5 µm behind
    assert WireGridDesign.model_validate_json(table.attrs["design"]) == PAPER_GRIDS[name]
    assert {"source", "licence", "versions", "made_by"} <= set(table.attrs)


@pytest.mark.parametrize("name", list(PAPER_GRIDS))
def test_per_aperture_response_takes_the_aperture_out(tables, name):
    """Most of the paper's 0.7 is the aperture's 10/15 of the port."""
    table = tables[name]
    for polarization in ("pass", "block"):
        whole = table[f"{polarization}_transmittance"].values
        assert table[f"{polarization}_transmittance_per_aperture"].values == pytest.approx(whole * 1.5)


def test_retardance_is_that_of_an_inductive_grid(tables):
    """Along the wires a thin grid is a shunt inductance Z = −iωL: t = 1/(1 + iZ₀/2ωL) lags by up to π/2.

    So the pass wave, whose grid is a small capacitance, leads: the retardance lies between 0 and a little
    over π/2 where λ ≫ d.
    """
    retardance = tables["grid_b"]["retardance"].sel(wavelength=slice(1.0, 2.5)).values
    assert (0 < retardance).all() and (retardance < np.pi / 2 + 0.1).all()
    at_long_waves = float(tables["grid_a"]["retardance"].sel(wavelength=2.5))
    assert at_long_waves == pytest.approx(np.pi / 2, abs=0.2)


@pytest.mark.slow
def test_shipped_rows_are_what_the_solver_gives(tables, tmp_path):
    """Five wavelengths, solved now, with another number of processes and no cache."""
    pytest.importorskip("ngsolve", reason="the extra em is not installed")
    solved = wire_grid.solve(PAPER_GRIDS["grid_a"], FIVE_UM, workers=2, cache=tmp_path)
    shipped = tables["grid_a"].sel(wavelength=FIVE_UM, method="nearest")
    for name in wire_grid.SOLVED:
        # meshes of another NGSolve may differ: what refinement may move
        assert solved[name].values == pytest.approx(shipped[name].values, abs=1e-3), name


def test_one_live_solve(tables, tmp_path):
    pytest.importorskip("ngsolve", reason="the extra em is not installed")
    solved = wire_grid.solve(PAPER_GRIDS["grid_a"], [1.5], workers=1, cache=tmp_path)
    for name in ("pass_transmittance", "block_transmittance"):
        shipped = float(tables["grid_a"][name].sel(wavelength=1.5))
        assert float(solved[name][0]) == pytest.approx(shipped, abs=1e-3)
