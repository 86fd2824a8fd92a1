"""Finite elements of the sheet against closed forms of plates and of conduction."""

import numpy as np
import pytest

from glintrack.devices.micromirror.equilibrium import PlateDesign

pytest.importorskip("skfem")

from glintrack.devices.micromirror.plate import Sheet, laminate

SIDE, RIGIDITY, NU = 10e-6, 8e-10, 0.35
ONE_PERCENT = 0.01


def free_curvature(layers, temperature_rise_k=0.0):
    """Curvature of the free sheet, positive where the film's side is convex. [1/m]"""
    strain = layers.misfit_strain + layers.misfit_per_k * temperature_rise_k
    return layers.moment_per_strain_n * strain / (layers.rigidity_nm * (1 + layers.poisson_ratio))


def stoney_curvature(plate):
    """6σt(1−ν)/(Eh²), Stoney, Proc. R. Soc. A 82, 172 (1909), with the biaxial modulus. [1/m]"""
    h, t = plate.thickness_nm * 1e-9, plate.film_thickness_nm * 1e-9
    biaxial = plate.youngs_modulus_gpa * 1e9 / (1 - plate.poisson_ratio)
    return -6 * plate.film_stress_mpa * 1e6 * t / (biaxial * h**2)


def test_clamped_plate_is_timoshenkos():
    sheet = Sheet(SIDE, 32)
    found = sheet.bend(RIGIDITY, NU, np.full_like(sheet.area, 1e3), edge="clamped")
    expected = 0.00126 * 1e3 * SIDE**4 / RIGIDITY
    assert found.at_nodes.max() == pytest.approx(expected, rel=ONE_PERCENT)


def test_clamped_plate_converges():
    errors = []
    for cells in (8, 16, 32):
        sheet = Sheet(SIDE, cells)
        found = sheet.bend(RIGIDITY, NU, np.full_like(sheet.area, 1e3), edge="clamped").at_nodes.max()
        errors.append(abs(found / (1e3 * SIDE**4 / RIGIDITY) - 0.00126532))  # Taylor and Govindjee (2004)
    assert errors[0] > 3 * errors[1] > 9 * errors[2]  # second order


@pytest.mark.parametrize("foundation", [1e6, 1e9])  # the mirror's springs: 4e9 Pa/m
def test_a_free_plate_takes_its_curvature_everywhere(foundation):
    sheet, curvature = Sheet(SIDE, 8), 250.0
    found = sheet.bend(RIGIDITY, NU, 0 * sheet.area, RIGIDITY * (1 + NU) * curvature, foundation)
    line = np.linspace(-SIDE / 2, SIDE / 2, 9)
    bowl = curvature / 2 * (line[:, None] ** 2 + line**2)
    shape = sheet.on_grid(found.at_nodes)
    np.testing.assert_allclose(shape - shape[4, 4], bowl, atol=0.02 * bowl.max())


def test_pressure_on_a_foundation_sinks_level():
    sheet = Sheet(SIDE, 8)
    found = sheet.bend(RIGIDITY, NU, np.full_like(sheet.area, 30.0), foundation_pa_m=1e9)
    np.testing.assert_allclose(found.at_nodes, 30e-9, rtol=1e-6)


def test_one_dimensional_conduction_is_the_parabola():
    sheet, conductance, heat = Sheet(SIDE, 16), 2e-4, 1e5
    found = sheet.conduct(conductance, heat, held=lambda x, y: np.abs(x) > SIDE / 2 * (1 - 1e-9))
    line = np.linspace(-SIDE / 2, SIDE / 2, 17)
    parabola = heat / (2 * conductance) * ((SIDE / 2) ** 2 - line**2)
    # linear elements are exact at the nodes here
    np.testing.assert_allclose(
        sheet.on_grid(found.at_nodes), np.tile(parabola, (17, 1)), atol=1e-6 * parabola.max()
    )


def test_a_cooling_fin_is_the_hyperbolic_cosine():
    sheet, conductance, heat, loss = Sheet(SIDE, 32), 2e-4, 1e5, 5e7
    found = sheet.conduct(conductance, heat, loss, held=lambda x, y: np.abs(x) > SIDE / 2 * (1 - 1e-9))
    line, m = np.linspace(-SIDE / 2, SIDE / 2, 33), np.sqrt(loss / conductance)
    profile = heat / loss * (1 - np.cosh(m * line) / np.cosh(m * SIDE / 2))
    np.testing.assert_allclose(sheet.on_grid(found.at_nodes)[16], profile, atol=2e-3 * profile.max())


def test_gas_alone_cools_evenly():
    sheet = Sheet(SIDE, 8)
    found = sheet.conduct(2e-4, 1e5, 2e4)
    np.testing.assert_allclose(found.at_nodes, 5.0, rtol=1e-9)


def test_spots_weigh_one_and_lie_where_they_should():
    sheet = Sheet(SIDE, 32)
    for soft in (True, False):
        spot = sheet.spot(1e-6, -2e-6, 1.5e-6, soft)
        assert np.sum(spot * sheet.area) == pytest.approx(1)
        assert np.sum(spot * sheet.area * sheet.points[1]) == pytest.approx(-2e-6, abs=0.02e-6)
    with pytest.raises(ValueError, match="must reach a point of the mesh"):
        sheet.spot(40e-6, 0, 1e-6)


def test_a_thin_film_bends_by_stoney():
    plate = PlateDesign(film_thickness_nm=0.5, film_stress_mpa=200)
    assert free_curvature(laminate(plate)) == pytest.approx(stoney_curvature(plate), rel=5e-3)  # 4 t/h
    assert stoney_curvature(plate) < 0  # tension: the film's side is hollow


def test_equal_layers_bend_by_timoshenko():
    same = PlateDesign(
        thickness_nm=250,
        film_thickness_nm=250,
        film_youngs_modulus_gpa=70,
        film_poisson_ratio=0.35,
        film_expansion_per_mk=33.1,
    )
    # two equal strips, total height h: 3/2 Δα ΔT / h
    assert free_curvature(laminate(same), 50.0) == pytest.approx(1.5 * 10e-6 * 50 / 500e-9, rel=1e-9)


def test_a_bare_plate_has_the_textbook_rigidity():
    bare = laminate(PlateDesign(film_thickness_nm=0))
    assert bare.rigidity_nm == pytest.approx(70e9 * 500e-9**3 / 12 / (1 - 0.35**2))
    assert free_curvature(bare, 100.0) == 0
