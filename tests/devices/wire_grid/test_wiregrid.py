"""Designs, sweeps, caching and what a table says; the solver itself is tested in ``test_fem``."""

import json

import numpy as np
import pytest
from pydantic import ValidationError

from glintrack import stokes
from glintrack.devices import PAPER_GRIDS, FemDesign, MetalDesign, WireGridDesign, wire_grid
from glintrack.devices.wire_grid import table

COARSE = WireGridDesign(
    wires=3, aperture_um=1.5, port_um=3, depth_um=2, fem=FemDesign(order=2, air_element_um=0.5)
)
ROW = {
    **{name: 0.1 for name in wire_grid.SOLVED},
    "pass_transmittance": 0.6,
    "field_ratio_real": 0.0,
    "field_ratio_imag": 2.0,
    "elements": 10,
    "ngsolve": "none",
}


@pytest.mark.parametrize(
    ("values", "complaint"),
    [
        ({"wire_width_nm": 500}, "narrower than the period of 500 nm; got 500 nm"),
        ({"wires": 21}, "hold the 21 wires, which need at least 10.1 µm; got 10 µm"),
        ({"wire_height_nm": -1}, "greater than 0"),
        ({"wall_angle_deg": 40, "wire_width_nm": 50}, "leave the wires a top"),
        ({"port_um": 10}, "wider than the aperture of 10 µm"),
        ({"wire_height_nm": 1500, "depth_um": 5}, "four times the wires' height"),
        ({"substrate_index": 0.5}, "greater than or equal to 1"),
    ],
)
def test_designs_that_cannot_be(values, complaint):
    with pytest.raises(ValidationError, match=complaint):
        WireGridDesign(**values)


def test_wavelengths_outside_the_data_are_refused(tmp_path):
    path = tmp_path / "metal.csv"
    path.write_text("wavelength_um,n,k\n0.5,1,5\n0.7,1,5\n")
    design = WireGridDesign(metal=MetalDesign(model="table", table=path))
    with pytest.raises(ValueError, match=r"0.5 to 0.7 µm, where metal.csv holds; got 0.8"):
        wire_grid.solve(design, [0.6, 0.8])
    with pytest.raises(ValueError, match=r"0.4 to 2.5 µm"):
        wire_grid.solve(design, [3.0])


def fake_solver(monkeypatch, fail_at=None):
    """Answers in place of NGSolve, so that sweeping and caching can be tested without it."""
    asked = []

    def solve_all(design, tasks, workers, keep):
        for i, (um, _) in tasks.items():
            if um == fail_at:
                raise KeyboardInterrupt
            asked.append(um)
            keep(i, ROW)

    monkeypatch.setattr(table, "_solve_all", solve_all)
    monkeypatch.setattr(table, "find_spec", lambda name: object())
    return asked


def test_an_interrupted_sweep_goes_on(monkeypatch, tmp_path):
    fake_solver(monkeypatch, fail_at=0.6)
    with pytest.raises(KeyboardInterrupt):
        wire_grid.solve(COARSE, [0.5, 0.6, 0.7], cache=tmp_path)
    asked = fake_solver(monkeypatch)
    seen = []
    wire_grid.solve(COARSE, [0.5, 0.6, 0.7], cache=tmp_path, progress=seen.append)
    assert asked == [0.6, 0.7] and seen[-1] == 1.0
    asked = fake_solver(monkeypatch)
    wire_grid.solve(COARSE.model_copy(update={"period_nm": 499.0}), [0.5], cache=tmp_path)
    assert asked == [0.5]  # another geometry is another file


def test_a_damaged_cache_file_is_solved_again(monkeypatch, tmp_path):
    fake_solver(monkeypatch)
    wire_grid.solve(COARSE, [0.5], cache=tmp_path)
    (file,) = tmp_path.rglob("*.json")
    file.write_text("{}")
    asked = fake_solver(monkeypatch)
    wire_grid.solve(COARSE, [0.5], cache=tmp_path)
    assert asked == [0.5]


def test_without_the_extra_the_cache_still_serves(monkeypatch, tmp_path):
    fake_solver(monkeypatch)
    first = wire_grid.solve(COARSE, [0.5], cache=tmp_path)
    monkeypatch.setattr(table, "find_spec", lambda name: None)
    assert wire_grid.solve(COARSE, [0.5], cache=tmp_path).equals(first)
    with pytest.raises(ValueError, match=r"extra `em`.*pip install .*\[em\]"):
        wire_grid.solve(COARSE, [0.5, 0.6], cache=tmp_path)


def test_what_follows_from_the_solved_fields(monkeypatch, tmp_path):
    fake_solver(monkeypatch)
    table = wire_grid.solve(COARSE, [0.5], cache=tmp_path).isel(wavelength=0)
    assert float(table["extinction_ratio"]) == pytest.approx(6)
    ratio = float(table["extinction_ratio"])
    assert float(table["diattenuation"]) == pytest.approx((ratio - 1) / (ratio + 1))
    assert float(table["retardance"]) == pytest.approx(np.pi / 2)
    assert float(table["pass_transmittance_per_aperture"]) == pytest.approx(0.6 * 3 / 1.5)
    psi = table["polarization_angle"].values
    light = np.stack([np.ones(10), np.cos(2 * psi), np.sin(2 * psi), np.zeros(10)])
    behind = table["mueller"].values @ light
    assert behind[0] == pytest.approx(table["transmittance"].values)  # detected irradiance is T(ψ)
    assert (behind[0] ** 2 >= (behind[1:] ** 2).sum(axis=0) - 1e-15).all()
    expected = stokes.linear_diattenuator(0.6, 0.1, 0.0, np.pi / 2)
    assert table["mueller"].values == pytest.approx(expected)


def test_a_small_pixel_may_pass_more_than_the_removed_run(monkeypatch, tmp_path):
    """Its removed run loses most light through the sides: T > 1 is no error, and Mueller matrices follow."""
    monkeypatch.setitem(ROW, "pass_transmittance", 1.2)
    fake_solver(monkeypatch)
    table = wire_grid.solve(COARSE, [0.5], cache=tmp_path).isel(wavelength=0)
    assert table["mueller"].values[0, :2] == pytest.approx([(1.2 + 0.1) / 2, (1.2 - 0.1) / 2])


def test_provenance_is_stored(monkeypatch, tmp_path):
    fake_solver(monkeypatch)
    attrs = wire_grid.solve(COARSE, [0.5], cache=tmp_path).attrs
    assert WireGridDesign.model_validate_json(attrs["design"]) == COARSE
    assert "glintrack" in json.loads(attrs["versions"]) and "35.6" in attrs["source"].replace(
        "3.56e+07", "35.6"
    )


def test_a_worker_that_dies_says_why(tmp_path):
    pytest.importorskip("ngsolve", reason="the extra em is not installed")
    with pytest.raises(RuntimeError, match=r"solving 0.5 µm failed: .*"):
        table._sweep(COARSE, [0.5], [float("nan") * 1j], folder=tmp_path)


def test_live_solves_agree_with_the_solver_in_process(tmp_path):
    pytest.importorskip("ngsolve", reason="the extra em is not installed")
    from glintrack.devices import permittivity
    from glintrack.devices.wire_grid.fem import Pixel, measure

    table = wire_grid.solve(COARSE, [0.9, 1.5], workers=2, cache=tmp_path)
    for um in (0.9, 1.5):
        row = measure(Pixel.of(COARSE, um), um, complex(permittivity(COARSE.metal, um)))
        for name in wire_grid.SOLVED:
            assert float(table[name].sel(wavelength=um)) == pytest.approx(row[name], rel=1e-9, abs=1e-12)


def test_names_of_shipped_grids():
    with pytest.raises(ValueError, match="grid_a, grid_b, grid_a_physical, grid_b_physical; got 'grid_c'"):
        wire_grid.load("grid_c")
    assert PAPER_GRIDS["grid_b"].wires == 125
