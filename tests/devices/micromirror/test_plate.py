"""The coupled plate against the rigid one, Stoney, balances of heat and current, and its own limits."""

import numpy as np
import pytest
from pydantic import ValidationError

from glintrack.devices.micromirror.equilibrium import MicromirrorDesign, equilibrium
from tests.devices.micromirror.test_sheet import stoney_curvature

pytest.importorskip("skfem")

from glintrack.devices.micromirror.plate import bend_plate

CELLS = 16


def design(**tables):
    return MicromirrorDesign.model_validate(tables)


STIFF = {"youngs_modulus_gpa": 2000, "thickness_nm": 1500}


def test_a_stiff_plate_under_even_voltage_is_the_rigid_one():
    found = bend_plate(design(plate=STIFF), (25.0, 25.0, 25.0), CELLS)
    assert found.attrs["piston_m"] == pytest.approx(equilibrium(design(), (25.0,) * 3).piston_m, rel=1e-4)
    assert abs(found.attrs["tilt_rad"]) < 1e-9 and found.attrs["bow_rms_m"] < 1e-13


def test_a_stiff_plate_tilts_as_the_rigid_one_but_for_the_electrodes_extent():
    found = bend_plate(design(plate=STIFF), (28.0, 20.0, 20.0), CELLS)
    rigid = equilibrium(design(), (28.0, 20.0, 20.0))
    assert found.attrs["piston_m"] == pytest.approx(rigid.piston_m, rel=0.01)
    # over an electrode 6.2 µm wide the tilted gap pulls harder than at its middle: 3 %
    assert 1.0 < found.attrs["tilt_rad"] / rigid.tilt_rad < 1.05
    narrow = design(plate=STIFF, actuator={"electrode_area_um2": 3.0, "leg_radius_um": 1.0})
    small = bend_plate(narrow, tuple(np.sqrt(10) * np.array([28.0, 20.0, 20.0])), 32)
    assert small.attrs["tilt_rad"] == pytest.approx(rigid.tilt_rad, rel=0.02)


def test_film_stress_bows_by_stoney_and_a_soft_plate_bows_under_voltage():
    stressed = design(plate={"film_stress_mpa": 50, "film_thickness_nm": 2}, drive={"irradiance_w_m2": 0})
    found = bend_plate(stressed, (0, 0, 0), CELLS)
    assert found.attrs["curvature_per_m"] == pytest.approx(stoney_curvature(stressed.plate), rel=0.02)
    assert found.attrs["piston_m"] == pytest.approx(0, abs=1e-9)  # a nanometre
    soft = bend_plate(design(plate={"thickness_nm": 100}), (25.0, 25.0, 25.0), CELLS)
    assert soft.attrs["bow_rms_m"] > 20 * bend_plate(design(), (25.0,) * 3, CELLS).attrs["bow_rms_m"]


def test_heat_balances():
    lit = design(drive={"irradiance_w_m2": 1e6, "air_conductivity_w_m_k": 0, "leg_conductance_uw_k": 2})
    found = bend_plate(lit, (0, 0, 0), CELLS)
    # all heat leaves through three legs of 2 µW/K; aluminium is even to a few per cent
    assert found.attrs["absorbed_w"] == pytest.approx(0.04 * 1e6 * 256e-12)
    mean = float(found["temperature_rise"].mean())
    assert mean == pytest.approx(found.attrs["absorbed_w"] / 6e-6, rel=0.03)
    gas = design(drive={"irradiance_w_m2": 1e6, "leg_conductance_uw_k": 1e-6})
    assert float(bend_plate(gas, (0, 0, 0), CELLS)["temperature_rise"].mean()) == pytest.approx(
        0.04 * 1e6 * 1.5e-6 / 0.026, rel=1e-3
    )


def test_current_heats_by_its_square_and_more_as_it_warms():
    def joule(current_ma, growth):
        one = design(
            plate={"resistivity_growth_per_k": growth},
            drive={"current_ma": current_ma, "irradiance_w_m2": 0, "voltages_v": (0, 0, 0)},
        )
        return bend_plate(one, cells=CELLS).attrs["joule_w"]

    assert joule(20, 0.0) == pytest.approx(4 * joule(10, 0.0), rel=1e-6)
    assert joule(100, 0.0039) > 1.05 * joule(100, 0.0)


def test_warm_film_and_plate_bow_toward_the_one_that_grows_less():
    warm = bend_plate(design(drive={"irradiance_w_m2": 1e7}), (0, 0, 0), CELLS)
    assert warm.attrs["temperature_rise_max_k"] > 5
    assert warm.attrs["curvature_per_m"] < 0  # silver grows less than aluminium: the mirror turns hollow


def test_mesh_refinement_moves_little():
    coarse, fine = (bend_plate(design(), (28.0, 20.0, 20.0), cells).attrs for cells in (16, 32))
    assert coarse["tilt_rad"] == pytest.approx(fine["tilt_rad"], rel=2e-3)
    assert coarse["piston_m"] == pytest.approx(fine["piston_m"], rel=1e-4)


def test_what_cannot_be_is_refused():
    with pytest.raises(ValueError, match=r"must stay below pull-in, near \[36.3, 36.3, 36.3\] V"):
        bend_plate(design(), (38.0, 38.0, 38.0), CELLS)
    hot = {"current_ma": 1000}
    bare = {"resistivity_nohm_m": 5000, "film_thickness_nm": 0}
    with pytest.raises(ValueError, match="runs away"):
        bend_plate(design(drive=hot, plate=bare), (0, 0, 0), CELLS)
    with pytest.raises(ValueError, match="`plate` must bow less than the electrode gap of 1500 nm"):
        bend_plate(design(drive=hot, plate={"resistivity_nohm_m": 5000}), (0, 0, 0), CELLS)
    with pytest.raises(ValidationError, match=r"`actuator.electrode_radius_um` must be at most 4.91 µm"):
        design(actuator={"electrode_radius_um": 6})
