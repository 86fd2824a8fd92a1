"""The etalon's and the micromirror's commands: what they write, and how they refuse."""

import sys

import numpy as np
import pytest
import xarray as xr

from glintrack.cli.app import main
from glintrack.results.figures import devices as plot_devices


def run(monkeypatch, *arguments):
    """Run the program; its exit code."""
    monkeypatch.setattr(sys, "argv", ["glintrack", "device", *map(str, arguments)])
    with pytest.raises(SystemExit) as stop:
        main()
    return stop.value.code or 0


@pytest.fixture
def design(tmp_path):
    def write(text):
        path = tmp_path / "design.toml"
        path.write_text(text, encoding="utf-8")
        return path

    return write


def test_etalon_writes_table_and_picture(design, tmp_path, monkeypatch):
    path = design("gap_count = 12\nwavelength_step_um = 0.05\n[order_filter]\ncut_on_um = 0.6\n")
    assert run(monkeypatch, "etalon", path, "-o", tmp_path / "etalon.nc", "--plot") == 0
    with xr.open_dataset(tmp_path / "etalon.nc", engine="h5netcdf") as table:
        assert table["transmittance"].shape == (12, 13)
        assert {"voltage", "filter_in", "peak_transmittance", "fwhm", "peak_gap"} <= set(table)
        assert "lorentz-drude" in table.attrs["design"]
    assert (tmp_path / "etalon.png").stat().st_size > 20_000


def test_micromirror_writes_table_pictures_and_model(design, tmp_path, monkeypatch):
    pytest.importorskip("skfem")
    grid = xr.Dataset({"pass_transmittance": ("wavelength", [0.6])}, coords={"wavelength": [1.5]})
    grid.to_netcdf(tmp_path / "grid.nc", engine="h5netcdf")
    out, glb = tmp_path / "mirror.nc", tmp_path / "mirror.glb"
    path = design("[drive]\nvoltages_v = [28, 20, 20]\n")
    arguments = ("-o", out, "--plot", "--glb", glb, "--polarizer", tmp_path / "grid.nc")
    assert run(monkeypatch, "micromirror", path, *arguments) == 0
    with xr.open_dataset(out, engine="h5netcdf") as table:
        assert table.attrs["rigid_tilt_deg"] == pytest.approx(0.887, abs=1e-3)
        assert table.attrs["settles_within_frame"] == 1
        assert table["deflection"].dims == ("y", "x")
        assert np.all(table["scattered_beyond_stop"] < table["scattered"])
    for picture in ("mirror.png", "mirror-rays.png"):
        assert (tmp_path / picture).stat().st_size > 20_000
    assert glb.read_bytes()[:4] == b"glTF"


def test_without_scikit_fem_the_rest_is_written(design, tmp_path, monkeypatch, capsys):
    monkeypatch.setattr("glintrack.devices.micromirror.dynamics.find_spec", lambda name: None)
    assert run(monkeypatch, "micromirror", design(""), "-o", tmp_path / "m.nc", "--plot") == 0
    assert "left out: the extra `em` must be installed to bend plates; got no" in capsys.readouterr().out
    with xr.open_dataset(tmp_path / "m.nc", engine="h5netcdf") as table:
        assert "deflection" not in table and "piston" in table


@pytest.mark.parametrize(
    ("kind", "text", "sentence"),
    [
        ("etalon", "metal_thickness_nm = -3", "`metal_thickness_nm` must be greater than or equal to 0"),
        (
            "etalon",
            "gap_stop_nm = 460\n[actuator]\nelectrode_gap_um = 0.6",
            "`travel` must lie within 0 to 200 nm",
        ),
        ("etalon", "wavelength_stop_um = 3.0", "`wavelength_stop_um` must be less than or equal to 2.5"),
        ("etalon", "gap_contu = 3", "`gap_contu` must be a known key"),
        (
            "micromirror",
            "[drive]\nvoltages_v = [40, 40, 40]",
            "must stay below pull-in at [36.3, 36.3, 36.3] V",
        ),
        ("micromirror", "[plate]\nthickness_nm = -1", "`plate.thickness_nm` must be greater than 1"),
    ],
)
def test_bad_input_is_one_sentence_and_exit_code_2(
    kind, text, sentence, design, tmp_path, monkeypatch, capsys
):
    out = tmp_path / "x.nc"
    assert run(monkeypatch, kind, design(text), "-o", out) == 2
    assert sentence in capsys.readouterr().err
    assert not out.exists()


def test_a_polarizer_that_is_none_leaves_nothing(design, tmp_path, monkeypatch, capsys):
    xr.Dataset({"other": ("wavelength", [1.0])}).to_netcdf(tmp_path / "p.nc", engine="h5netcdf")
    out = tmp_path / "x.nc"
    arguments = "-o", out, "--plot", "--polarizer", tmp_path / "p.nc"
    assert run(monkeypatch, "micromirror", design(""), *arguments) == 2
    assert "`polarizer` must be an output of" in capsys.readouterr().err
    assert not list(tmp_path.glob("x*"))


@pytest.mark.parametrize("option", ["--exaggeration", "--f-number"])
def test_infinite_numbers_reach_no_model(option, design, tmp_path, monkeypatch):
    out = tmp_path / "x.nc"
    assert run(monkeypatch, "micromirror", design(""), "-o", out, option, "inf") == 2
    assert not out.exists()


def test_a_mirror_turns_light_by_twice_its_tilt():
    down = np.array([0.0, -1.0])
    away = plot_devices.reflect(down, 0.05)
    assert np.arctan2(-away[0], away[1]) == pytest.approx(0.1)
    np.testing.assert_allclose(plot_devices.reflect(down, 0.0), [0, 1], atol=1e-15)
