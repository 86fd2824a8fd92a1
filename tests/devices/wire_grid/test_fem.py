"""Finite elements against grating theory, conservation, refinement, a joint solve; needs the extra ``em``."""

import numpy as np
import pytest

ng = pytest.importorskip("ngsolve", reason="the extra em is not installed")

from glintrack.devices import PAPER_GRIDS, FemDesign, WireGridDesign, permittivity  # noqa: E402
from glintrack.devices.wire_grid import fem  # noqa: E402
from glintrack.devices.wire_grid.fem import Pixel, measure  # noqa: E402
from tests.oracles.rcwa_1d import rcwa  # noqa: E402

FINE = FemDesign(air_element_um=0.1, wire_element_nm=7, order=6)
ENERGY = 1e-5  # of the finite elements on the fine mesh, relative to the incident power
# a small pixel on few elements, for what must hold whatever the accuracy
SMALL = WireGridDesign(
    wires=3, aperture_um=1.5, port_um=3, depth_um=2, fem=FemDesign(order=3, wire_element_nm=50)
)


def cell_powers(design, um, eps):
    """(zero-order T, T, R, absorbed) of the infinite grid, block then pass."""
    space = fem.unit_cell(design, um)
    out = []
    for polarization in ("block", "pass"):
        solved = fem.solve(space, um, polarization, eps, design.fem.order_at(um))
        wave = np.exp(2j * np.pi / um * fem.PAST_SOURCE_UM) * np.ones(len(solved.input.weight))
        reflected = solved.input - fem.PortField(wave, wave, solved.input.weight)
        powers = solved.output.power(), -reflected.power(), solved.absorbed_um
        straight = abs(solved.output.mean_electric()) ** 2
        out.append((straight, *(p / space.half_port_um for p in powers)))
    return out


@pytest.mark.parametrize(
    ("name", "um"), [("grid_a_physical", 0.65), ("grid_a_physical", 1.5), ("grid_b_physical", 0.5)]
)
def test_unit_cell_is_the_infinite_grating(name, um):
    design = PAPER_GRIDS[name].model_copy(update={"fem": FINE})
    eps = complex(permittivity(design.metal, um))
    shape = [x * 1e-3 for x in (design.period_nm, design.wire_width_nm, design.wire_height_nm)]
    block, across = cell_powers(design, um, eps)
    # RCWA itself converges to 1e-5 (TE, 80 harmonics) and 2e-4 (TM, 150)
    assert block[:3] == pytest.approx(rcwa(um, *shape, eps, 80, "TE"), abs=1e-4)
    assert across[:3] == pytest.approx(rcwa(um, *shape, eps, 150, "TM"), abs=5e-4)
    for straight, through, back, absorbed in (block, across):
        assert through + back + absorbed == pytest.approx(1, abs=ENERGY)
        assert through == pytest.approx(straight, abs=ENERGY)  # d < λ: no other order leaves


def test_without_wires_the_substrate_reflects_as_fresnel_says():
    n = 1.5
    design = WireGridDesign(substrate_index=n, fem=FINE)
    for polarization, powers in zip(("block", "pass"), cell_powers(design, 1.0, 1.0), strict=True):
        # the wires' layer is filled with air (ε = 1), so the interface lies behind it
        assert powers[1] == pytest.approx(4 * n / (1 + n) ** 2, abs=ENERGY), polarization
        assert powers[2] == pytest.approx(((n - 1) / (n + 1)) ** 2, abs=ENERGY), polarization


def test_sloping_walls_approach_upright_ones():
    upright = WireGridDesign(fem=FINE)
    eps = complex(permittivity(upright.metal, 1.0))
    by_angle = {}
    for angle in (90.0, 89.9, 75.0):
        design = upright.model_copy(update={"wall_angle_deg": angle})
        by_angle[angle] = np.array(cell_powers(design, 1.0, eps))[:, 1]
    assert by_angle[89.9] == pytest.approx(by_angle[90.0], abs=5e-4)  # 0.2 nm of 100 nm
    assert abs(by_angle[75.0] - by_angle[90.0]).max() > 5e-3


def test_polarizations_superpose():
    """T(ψ) = T₀ cos²ψ + T₉₀ sin²ψ against one system for both unknowns with both sources."""
    um, order, psi = 1.5, 3, np.radians(35)
    space, k = fem.grid_space(SMALL, um), 2 * np.pi / um
    eps = complex(permittivity(SMALL.metal, um))
    alone = [fem.solve(space, um, p, eps, order).output.power() for p in ("pass", "block")]
    both = ng.H1(space.mesh, order=order, complex=True, dirichlet="outer") * ng.H1(
        space.mesh, order=order, complex=True, dirichlet="plate|outer"
    )
    (h, e), (v, w) = both.TnT()
    system = ng.BilinearForm(both, symmetric=True)
    system += fem.wave_operator(space, h, v, k, "pass", eps)
    system += fem.wave_operator(space, e, w, k, "block", eps)
    source = ng.LinearForm(both)
    source += -2j * k * (np.cos(psi) * v + np.sin(psi) * w) * ng.ds("input")
    system.Assemble()
    source.Assemble()
    field = ng.GridFunction(both)
    field.vec.data = system.mat.Inverse(both.FreeDofs(), inverse="sparsecholesky") * source.vec
    joint = sum(
        fem.port_field(space, part, k, p, space.output_um - 1e-6, 1.0).power()
        for part, p in zip(field.components, ("pass", "block"), strict=True)
    )
    assert joint == pytest.approx(alone[0] * np.cos(psi) ** 2 + alone[1] * np.sin(psi) ** 2, rel=1e-10)


def test_power_is_conserved_in_the_small_pixel():
    um = 1.5
    design = SMALL.model_copy(update={"metal": PAPER_GRIDS["grid_a_physical"].metal})
    row = measure(Pixel.of(design, um), um, complex(permittivity(design.metal, um)))
    for name in ("pass", "block"):
        through = row[f"{name}_transmittance"] * row["free_transmittance"]
        back, lost = row[f"{name}_reflectance"], row[f"{name}_absorptance"]
        assert lost > 0 and back > 0 and through > 0
        assert through + back + lost <= 1
    coherence = row["coherence_real"] + 1j * row["coherence_imag"]
    # Schwarz; a port 1 µm behind the grid still holds a little of fields that carry no power
    near_field = 1e-3
    assert abs(coherence) ** 2 <= row["pass_transmittance"] * row["block_transmittance"] * (1 + near_field)


def test_narrow_gaps_in_a_near_perfect_conductor():
    """E along the wires is cut off and reflected but for 4 Re(1/n) ≈ 9e-4 absorbed; E across is guided."""
    design = WireGridDesign(period_nm=80, wire_width_nm=60, wire_height_nm=100, fem=FINE)
    block, across = cell_powers(design, 2.0, 1 + 1e7j)
    assert block[1] < 1e-6 and block[2] > 0.998
    assert across[1] > 0.1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "um", "finer"),
    [
        ("grid_a", 0.49, FemDesign(order=7)),  # two orders more than by default
        ("grid_b", 1.5, FemDesign(air_element_um=0.15, wire_element_nm=7)),  # half of the default's
    ],
)
def test_refinement_does_not_move_the_result(name, um, finer):
    design = PAPER_GRIDS[name]
    eps = complex(permittivity(design.metal, um))
    usual = measure(Pixel.of(design, um), um, eps)
    refined = measure(Pixel.of(design.model_copy(update={"fem": finer}), um), um, eps)
    for quantity in ("pass_transmittance", "block_transmittance"):
        assert refined[quantity] == pytest.approx(usual[quantity], abs=1e-3)
