"""The tunable etalon: against tmm, Airy and itself; order filter, cone, drive; and what is refused."""

import numpy as np
import pytest
from pydantic import ValidationError

from glintrack.core.spectral import wavelength_grid
from glintrack.devices.etalon import (
    EtalonDesign,
    OrderFilterDesign,
    drive_voltage,
    find_peaks,
    responses,
)
from glintrack.devices.optical_constants import permittivity

DESIGN = EtalonDesign()


def peer(tmm, design, gap_um, wavelength_um, angle, polarization):
    """The same stack through the tmm package."""
    n = np.sqrt(complex(permittivity(design.metal, wavelength_um)))
    film = design.metal_thickness_nm * 1e-3
    stack, d = [1.0, n, 1.0, n, design.window_index], [np.inf, film, gap_um, film, np.inf]
    return tmm.coh_tmm(polarization, stack, d, angle, wavelength_um)["T"]


@pytest.mark.parametrize("incidence_deg", [0.0, 35.0, 70.0])
@pytest.mark.parametrize("polarization", ["s", "p"])
def test_equals_the_tmm_package(polarization, incidence_deg):
    tmm = pytest.importorskip("tmm")
    design = EtalonDesign(incidence_deg=incidence_deg, polarization=polarization)
    gaps, wavelength = np.array([0.1, 0.162, 0.443, 1.2]), np.array([0.4, 0.55, 1.0, 2.5])
    ours = responses(design, gaps, wavelength)["transmittance"].values
    angle = np.radians(incidence_deg)
    theirs = [[peer(tmm, design, g, w, angle, polarization) for w in wavelength] for g in gaps]
    np.testing.assert_allclose(ours, theirs, atol=1e-12)


def test_unpolarized_is_the_mean_of_both():
    s, p, mean = (
        responses(EtalonDesign(incidence_deg=40, polarization=name))["transmittance"].values
        for name in ("s", "p", "unpolarized")
    )
    np.testing.assert_allclose(mean, (s + p) / 2, atol=1e-15)


def test_without_metal_it_is_a_bare_window():
    found = responses(EtalonDesign(metal_thickness_nm=0))["transmittance"]
    np.testing.assert_allclose(found, 1 - (0.45 / 2.45) ** 2, atol=1e-14)


def test_metal_closes_it_and_no_power_is_gained():
    through = [
        responses(EtalonDesign(metal_thickness_nm=t))["transmittance"].values for t in (10.0, 30.0, 90.0)
    ]
    assert all(t.min() >= 0 and t.max() <= 1 for t in through)
    assert through[0].mean() > through[1].mean() > through[2].mean()


def test_the_peak_moves_to_shorter_waves_when_tilted():
    wavelength = wavelength_grid(0.5, 0.75, 0.001)
    level, tilted = (
        wavelength[
            responses(EtalonDesign(incidence_deg=a), [0.266], wavelength)["transmittance"].values.argmax()
        ]
        for a in (0, 30)
    )
    assert 0.02 < level - tilted < level * (1 - np.cos(np.radians(30)))  # less than a gap without phase


def test_a_narrow_cone_is_parallel_light_and_a_wide_one_blurs():
    parallel = responses(DESIGN)["transmittance"].values
    narrow = responses(EtalonDesign(f_number=100))["transmittance"].values
    np.testing.assert_allclose(narrow, parallel, atol=2e-4)  # (1/200)²/2 of the phase, times the slope
    wide = responses(EtalonDesign(f_number=1.0))["transmittance"].values
    assert wide.max() < parallel.max()


def test_a_cone_off_axis_tends_to_its_chief_ray():
    slow = responses(EtalonDesign(incidence_deg=20, f_number=200))["transmittance"].values
    chief = responses(EtalonDesign(incidence_deg=20))["transmittance"].values
    np.testing.assert_allclose(slow, chief, atol=1e-3)
    oblique = EtalonDesign(incidence_deg=80, f_number=1.0)
    with pytest.raises(ValueError, match="leave the whole cone above the horizon"):
        responses(oblique)


def test_order_filter_blocks_the_second_order_only_where_it_is_in():
    plain = responses(DESIGN)
    sorted_ = responses(EtalonDesign(order_filter=OrderFilterDesign()))
    out = sorted_["filter_in"].values == 0
    np.testing.assert_array_equal(sorted_["transmittance"][out], plain["transmittance"][out])
    last = {"gap": -1, "wavelength": plain["wavelength"].values < 0.55}
    assert plain["transmittance"][last].max() > 0.3  # order 2 at 450 nm
    assert sorted_["transmittance"][last].max() < 0.01
    red = {"gap": -1, "wavelength": plain["wavelength"].values > 0.62}
    np.testing.assert_allclose(sorted_["transmittance"][red], 0.95 * plain["transmittance"][red], rtol=1e-3)


def test_second_order_needs_half_a_wave_more():
    first, second = (find_peaks(DESIGN, [0.55], order) for order in (1, 2))
    assert (second["gap"] - first["gap"]).item() == pytest.approx(0.275, abs=1e-4)
    assert second["fwhm"] < first["fwhm"]


def test_travel_and_voltage():
    volts = drive_voltage(DESIGN, [0.46, 0.443, 0.162])
    assert volts[0] == 0 and np.all(np.diff(volts) > 0)
    assert volts[-1] < 33.6  # pull-in of that spring, area and electrode gap
    small = EtalonDesign(actuator={"electrode_gap_um": 0.6})  # pyright: ignore[reportArgumentType]
    with pytest.raises(ValueError, match="a third of the electrode gap of 600 nm; got 298 nm"):
        drive_voltage(small, [0.162])
    with pytest.raises(ValueError, match=r"`travel` must lie within 0 to 500 nm.*got -40 nm"):
        drive_voltage(DESIGN, [0.5])


@pytest.mark.parametrize(
    ("table", "sentence"),
    [
        ({"metal_thickness_nm": -1}, "greater than or equal to 0"),
        ({"gap_start_nm": 500}, "`gap_stop_nm` must exceed gap_start_nm = 500; got 450"),
        ({"polarization": "s", "f_number": 4}, "must be 'unpolarized' with an f_number; got 's'"),
        ({"wavelength_stop_um": 0.4}, "range must rise within 0.4 to 2.5"),
    ],
)
def test_designs_refuse_what_cannot_be(table, sentence):
    with pytest.raises(ValidationError, match=sentence):
        EtalonDesign.model_validate(table)


def test_sweeps_refuse_what_is_outside(tmp_path):
    with pytest.raises(ValueError, match=r"`gaps_um` must be 0 or more; got -0.1"):
        responses(DESIGN, [-0.1])
    with pytest.raises(ValueError, match=r"must lie within 0.4 to 2.5 µm; got 3"):
        responses(DESIGN, [0.2], [3.0])
    table = tmp_path / "metal.csv"
    table.write_text("wavelength_um,n,k\n0.5,0.1,3\n0.7,0.1,4\n", encoding="utf-8")
    design = EtalonDesign.model_validate({"metal": {"model": "table", "table": str(table)}})
    with pytest.raises(ValueError, match=r"must lie within 0.5 to 0.7 µm"):
        responses(design)
