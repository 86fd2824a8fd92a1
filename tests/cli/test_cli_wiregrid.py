"""``glintrack device wiregrid``: what it writes and what it says."""

import pytest
import xarray as xr
from matplotlib.image import imread
from typer.testing import CliRunner

from glintrack.cli.app import app
from glintrack.devices import wire_grid
from glintrack.devices.wire_grid import table

run = CliRunner().invoke


def test_a_paper_grid_comes_from_its_table(tmp_path, monkeypatch):
    monkeypatch.setattr(table, "find_spec", lambda name: None)  # as without the extra
    path = tmp_path / "a.nc"
    done = run(app, ["device", "wiregrid", "grid_a", "-o", str(path), "--plot"])
    assert done.exit_code == 0, done.output
    with xr.open_dataset(path, engine="h5netcdf") as written:
        assert written.sizes["wavelength"] == 211
        assert written["pass_transmittance"].equals(wire_grid.load("grid_a")["pass_transmittance"])
    assert imread(tmp_path / "a.png").std() > 0.05
    assert "wrote" in done.output and "no field maps: the extra `em` must be installed" in done.output


@pytest.mark.parametrize(
    ("text", "arguments", "sentence"),
    [
        ("wire_width_nm = 600", [], "narrower than the period of 500 nm; got 600 nm"),
        ("aperture_um = 5", [], "hold the 20 wires, which need at least 9.6 µm; got 5 µm"),
        ("wire_height_nm = -5", [], "`wire_height_nm` must be greater than 0 nm; got -5 nm"),
        ("perid_nm = 5", [], "Did you mean `period_nm`?"),
        (
            'metal = { model = "table", table = "gone.csv" }',
            [],
            "`metal.table` must be a readable file; got gone.csv",
        ),
        ("", ["--start-um", "0.2"], "must rise within 0.4 to 2.5 µm; got 0.2"),
        ("", ["--field-um", "nan"], "`field_um` must lie within 0.4 to 2.5 µm; got nan"),
        ("", ["--step-um", "1e308"], "`step_um` must divide 0.4 to 2.5 µm into whole steps; got 1e+308"),
        ("", ["-o", "gone/x.nc"], "must be a file in an existing folder"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, monkeypatch, text, arguments, sentence):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.toml").write_text(text)
    done = run(app, ["device", "wiregrid", "grid.toml", "-o", "x.nc", *arguments])
    assert isinstance(done.exception, ValueError) and sentence in str(done.exception)
    assert "\n" not in str(done.exception)
    assert [p.name for p in tmp_path.iterdir()] == ["grid.toml"]


def test_a_designs_table_lies_beside_it(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "designs").mkdir()
    (tmp_path / "designs" / "metal.csv").write_text("wavelength_um,n,k\n0.5,1,5\n0.6,1,5\n")
    (tmp_path / "designs" / "grid.toml").write_text('[metal]\nmodel = "table"\ntable = "metal.csv"\n')
    done = run(app, ["device", "wiregrid", "designs/grid.toml", "-o", "x.nc"])
    assert "0.5 to 0.6 µm, where metal.csv holds; got 0.4" in str(done.exception)
