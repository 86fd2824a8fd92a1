"""``glintrack sensor``: what it prints, what it writes, what it says of bad input."""

import sys

import numpy as np
import pytest
import xarray as xr

from glintrack.case import build as scenario
from glintrack.case.design import Case
from glintrack.cli import app
from glintrack.core.distortion import Distortion
from glintrack.core.schema import check
from glintrack.io.photographs import read_camera, read_pose
from glintrack.ortho.rectify import GridCells, rectify_frame
from glintrack.scene import load_materials
from glintrack.sensor import design_names
from tests.conftest import ThreeCars

CASE = """
[sensor]
rows = 80
columns = 120
pitch_um = 80.0
polarizer = "grid_a"
oversampling = 1
demosaic = "bilinear"
[sensor.optics.distortion]
k1 = -0.4
[flight]
altitude_m = 3000.0
off_nadir_deg = 0.0
frames = 3
"""


@pytest.fixture
def glintrack(monkeypatch, capsys):
    def run(*arguments):
        monkeypatch.setattr(sys, "argv", ["glintrack", *map(str, arguments)])
        with pytest.raises(SystemExit) as stop:
            app.main()
        out, err = capsys.readouterr()
        return stop.value.code or 0, " ".join(out.split()), " ".join(err.split())

    return run


def test_the_list_names_every_ready_design(glintrack):
    code, out, _ = glintrack("sensor", "list")
    assert code == 0 and all(name in out for name in design_names())


def test_lens_pictures_appear_together_or_not_at_all(glintrack, tmp_path):
    """The second has a name as long as a file's may be, or one longer."""
    pytest.importorskip("optiland", reason="needs the extra optics")
    spots, long = tmp_path / "spots.png", tmp_path / f"{'a' * 251}.png"
    code, _, err = glintrack("sensor", "lens", "relay", "--spots", spots, "--layout", long)
    assert code == 0 and long.read_bytes()[:4] == b"\x89PNG" and spots.exists(), err
    spots.unlink()
    code, _, err = glintrack(
        "sensor", "lens", "relay", "--spots", spots, "--layout", long.with_name(f"a{long.name}")
    )
    assert code == 2 and "File name too long" in err
    assert list(tmp_path.iterdir()) == [long]


def test_show_says_what_follows_and_draws_the_transfer(glintrack, tmp_path):
    code, out, _ = glintrack("sensor", "show", "imx250mzr", "--mtf", tmp_path / "mtf.png")
    assert code == 0 and "MTF at Nyquist" in out and "condition number" in out
    assert "DoLP lost by the ideal formula" in out
    assert (tmp_path / "mtf.png").read_bytes().startswith(b"\x89PNG")


def test_show_takes_a_detector_of_the_catalogue_with_its_sources(glintrack):
    code, out, _ = glintrack("sensor", "show", "imx249")
    assert code == 0 and "lens 68 mm F/5.6" in out
    assert (
        "catalogue: sensor.pitch_um = 5.86: MATRIX VISION" in out
        and "quantum_efficiency = silicon: assumed" in out
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("show", "nikon"), "`sensor` must be a packaged sensor or case, or a TOML file; got nikon"),
        (("show", "quikstart"), "Did you mean `quickstart`?"),
        (("show", "pan", "--mtf", "plot.pdf"), "`--mtf` must end in .png"),
        (("ghosts", "relay", "--pitch-um", "1e308"), "`--pitch-um` must be less than or equal to 1000000 µm"),
        (("ghosts", "relay", "--window-mm", "nan"), "`window` must fit into the 320.027 mm before the image"),
        (("expose", "quickstart", "-o", "frame.tif"), "`--output` must end in .nc"),
        (("expose", "quickstart", "--frame", "40"), "`--frame` must lie in the flight's 0 to 39; got 40"),
    ],
)
def test_bad_input_is_one_sentence(glintrack, tmp_path, monkeypatch, arguments, message):
    monkeypatch.chdir(tmp_path)
    code, _, err = glintrack("sensor", *arguments)
    assert code == 2 and message in err and "Traceback" not in err
    assert list(tmp_path.iterdir()) == []


@pytest.fixture
def small(monkeypatch):
    """Three cars in place of a city, under a coarse sky."""
    solved = scenario.solve_tables(Case().atmosphere).isel(wavelength=slice(None, None, 2))
    monkeypatch.setattr(scenario, "build_scene", lambda design: ThreeCars(load_materials()))
    monkeypatch.setattr(scenario, "solve_tables", lambda design: solved)


def test_a_frame_is_exposed_and_rectified_with_its_camera_and_pose(glintrack, small, tmp_path):
    (tmp_path / "case.toml").write_text(CASE)
    target, picture = tmp_path / "frame.nc", tmp_path / "f.png"
    code, out, err = glintrack(
        "sensor", "expose", tmp_path / "case.toml", "-o", target, "--frame", "1", "--picture", picture
    )
    assert code == 0, err
    assert "wrote" in out and picture.stat().st_size > 10_000
    frame = check(xr.load_dataset(target), "frame")
    assert frame["pan"].shape == (40, 60) and np.isfinite(frame["pan"]).all()
    camera = read_camera(tmp_path / "frame.camera.toml")
    assert (camera.rows, camera.columns) == (80, 120) and camera.distortion == Distortion(k1=-0.4)
    placed = read_pose(tmp_path / "frame.pose.toml", "frame.nc")
    assert placed.pose.up_m == 3000

    # the files it wrote are what `glintrack ortho` reads
    options = "--camera", tmp_path / "frame.camera.toml", "--pose", tmp_path / "frame.pose.toml"
    result = tmp_path / "ortho.nc"
    code, _, err = glintrack("ortho", target, *options, "--height", "0", "--gsd", "8", "-o", result)
    assert code == 0, err
    image = xr.load_dataset(result)
    east, north = np.meshgrid(image["x"] - placed.origin_m[0], image["y"] - placed.origin_m[1])
    cells = GridCells.of(east, north, np.zeros_like(east))
    pan, stokes, _ = rectify_frame(frame, camera, placed.pose, cells, "bilinear")
    assert np.isfinite(pan).mean() > 0.5
    np.testing.assert_allclose(image["pan"].values, pan, rtol=1e-5)
    np.testing.assert_allclose(image["Q"].values, stokes[..., 1], rtol=1e-4, atol=1e-4)


def test_a_frame_of_a_flight_over_waypoints_is_exposed_from_where_they_lead(glintrack, small, tmp_path):
    (tmp_path / "way.csv").write_text("time_s,east_m,north_m,up_m\n0,0,0,1000\n10,100,50,1200\n")
    flight = 'kind = "waypoints"\nwaypoint_file = "way.csv"\nrate_hz = 0.2\n'
    (tmp_path / "case.toml").write_text(CASE.replace("altitude_m = 3000.0\n", flight))
    assert glintrack("case", "check", tmp_path / "case.toml")[0] == 1  # valid, and bad at 0.2 Hz
    target = tmp_path / "frame.nc"
    code, _, err = glintrack("sensor", "expose", tmp_path / "case.toml", "-o", target, "--frame", "1")
    assert code == 0, err
    pose = read_pose(tmp_path / "frame.pose.toml", "frame.nc").pose
    assert pose.up_m == pytest.approx(1100)  # half way after 5 s


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ('kind = "waypoints"\nwaypoint_file = "none.csv"\n', "`waypoint_file` must be a readable file; got"),
        ('kind = "waypoints"\nwaypoint_file = "one.csv"\n', "must hold two waypoints or more; got 1"),
        ("[sensor]\nlayout = [[0, 0], [0, 'mirror']]\n", "got a condition number of inf"),
    ],
)
def test_a_check_looks_at_waypoints_and_polarizers(glintrack, tmp_path, change, message):
    (tmp_path / "one.csv").write_text("east_m,north_m,up_m\n0,0,1000\n")
    (tmp_path / "case.toml").write_text(change if "[" in change else f"[flight]\n{change}")
    code, _, err = glintrack("case", "check", tmp_path / "case.toml")
    assert code == 2 and message in err


def test_ghosts_are_listed(glintrack):
    pytest.importorskip("optiland")
    code, out, err = glintrack("sensor", "ghosts", "relay", "--window-mm", "1", "--coating", "0.01")
    assert code == 0, err
    assert "surface 5 surface 4 0.0001" in out and "0.007 of the light is ghosts" in out
    code, _, err = glintrack("sensor", "ghosts", "relay", "--field", "9")
    assert code == 2 and "`--field` must be 0 to 5; got 9" in err
