"""`glintrack render`: what each product's file holds, read back by others, and what wrong input is told."""

import importlib
import math
import os
import tracemalloc

import numpy as np
import pyproj
import pytest
import rasterio
import xarray as xr
from matplotlib.image import imread

from glintrack.atmosphere import sun_direction
from glintrack.case import build as scenario
from glintrack.case.design import Case
from glintrack.io import raster
from glintrack.render import frame as frame_products
from glintrack.scene import load_materials
from tests.cli.test_cli import program
from tests.conftest import ThreeCars, box, snapshot

CASE = f"""
[flight]
off_nadir_deg = 30.0
altitude_m = 3000.0
frames = 3
[sensor]
rows = 60
columns = 80
focal_length_mm = 20.0
oversampling = 1
polarizer = "ideal"
demosaic = "bilinear"
[atmosphere]
wavelengths_um = {[round(0.4 + 0.02 * k, 2) for k in range(31)]}
"""
SHAPE, BANDS = (60, 80), 31


@pytest.fixture
def cars(monkeypatch):
    monkeypatch.setattr(scenario, "build_scene", lambda design: ThreeCars(load_materials()))


@pytest.fixture(scope="module")
def tables():
    """One solved atmosphere, thinned out, for all cases here."""
    solved = scenario.solve_tables(Case().atmosphere)
    return solved.isel(wavelength=slice(None, None, 2))


@pytest.fixture
def case_file(tmp_path, cars, tables, monkeypatch):
    monkeypatch.setattr(scenario, "solve_tables", lambda design: tables)
    path = tmp_path / "case.toml"
    path.write_text(CASE, encoding="utf-8")
    return path


@pytest.fixture
def view(case_file):
    return scenario.trace_frame(Case.from_toml(case_file), 1)


@pytest.mark.parametrize("product", [[], ["--rgb"], ["--dolp"], ["--aop"], ["--band", "0.6:0.7"]])
@pytest.mark.parametrize("ortho", [[], ["--ortho"]])
def test_pictures(monkeypatch, case_file, tmp_path, product, ortho):
    path = tmp_path / "picture.png"
    assert program(monkeypatch, "render", case_file, "--frame", 1, *product, *ortho, "-o", path) == 0
    picture = imread(path)
    assert picture.shape[2] in (3, 4) and picture[..., :3].std() > 0.02
    assert sorted(p.name for p in tmp_path.iterdir()) == ["case.toml", "picture.png"]


def test_radiance_in_every_format_is_the_same(monkeypatch, case_file, tmp_path, view):
    _, expected = frame_products.render_product(view, "radiance", ((0.5, 0.6), (0.8, 0.9)))
    asked = ["--frame", 1, "--band", "0.5:0.6", "--band", "0.8:0.9"]
    for name in ("r.tif", "r.hdr", "r.nc", "r.zarr"):
        assert program(monkeypatch, "render", case_file, *asked, "-o", tmp_path / name) == 0
    flat = np.moveaxis(expected, (3, 2), (0, 1)).reshape(6, *SHAPE)  # component by component
    for name in ("r.tif", "r.img"):
        with rasterio.open(tmp_path / name) as file:
            np.testing.assert_array_equal(file.read(), flat)
            assert file.descriptions[0].startswith("I 0.5-0.6 um")
    for name, engine in (("r.nc", "h5netcdf"), ("r.zarr", "zarr")):
        with xr.open_dataset(tmp_path / name, engine=engine) as dataset:
            radiance = dataset["radiance"].transpose("y", "x", "band", "stokes")
            np.testing.assert_array_equal(radiance.values, expected)
            assert radiance.attrs["units"] == "W m-2 sr-1 um-1"
            assert radiance.attrs["stokes_frame"] == "detector"
            assert list(dataset["stokes"].values) == ["I", "Q", "U"]


@pytest.mark.parametrize(("name", "engine"), [("p.nc", "h5netcdf"), ("p.zarr", "zarr")])
def test_natural_colour_in_labelled_files(monkeypatch, case_file, tmp_path, view, name, engine):
    assert program(monkeypatch, "render", case_file, "--frame", 1, "-o", tmp_path / name) == 0
    _, expected = frame_products.render_product(view, "rgb")
    with xr.open_dataset(tmp_path / name, engine=engine) as dataset:
        np.testing.assert_array_equal(dataset["rgb"].transpose("y", "x", "colour").values, expected[:, :, 0])
        assert list(dataset["colour"].values) == ["red", "green", "blue"]


@pytest.mark.parametrize("ortho", [[], ["--ortho", "--gsd", "4"]])
@pytest.mark.parametrize("name", ["cube.hdr", "cube.nc", "cube.zarr"])
def test_cube_in_blocks_equals_the_frame(monkeypatch, case_file, tmp_path, name, ortho):
    monkeypatch.setattr(frame_products, "BLOCK_BYTES", 100_000)
    monkeypatch.setattr(frame_products, "ORTHO_BLOCK_BYTES", 600_000)
    path = tmp_path / name
    assert program(monkeypatch, "render", case_file, "--frame", 1, "--cube", *ortho, "-o", path) == 0
    view = scenario.trace_frame(Case.from_toml(case_file), 1, bool(ortho), 4.0 if ortho else None)
    whole = frame_products._stokes(view, np.eye(BANDS))
    if name == "cube.hdr":
        with rasterio.open(tmp_path / "cube.img") as file:
            values = file.read(masked=True).filled(np.nan)
        values = np.moveaxis(values.reshape(3, BANDS, *whole.shape[:2]), (0, 1), (3, 2))
    else:
        with xr.open_dataset(path, engine="zarr" if name.endswith("zarr") else "h5netcdf") as dataset:
            values = dataset["radiance"].transpose("y", "x", "wavelength", "stokes").values
            np.testing.assert_allclose(dataset["wavelength"], view.sky.wavelength_um)
            np.testing.assert_allclose(dataset["fwhm"], 0.01)
    float32_and_transmittance_nodes = 2e-4
    np.testing.assert_allclose(values, whole, rtol=float32_and_transmittance_nodes, atol=1e-3)
    assert np.isfinite(values).any()


def test_rectified_files_carry_their_place(monkeypatch, case_file, tmp_path, cars):
    city = ThreeCars(load_materials())
    west, south, east, north = city.extent_m
    for name, opened in (
        ("d.tif", "{}"),
        ("d.hdr", "{}"),
        ("d.nc", 'NETCDF:"{}":dolp'),
        ("d.zarr", 'ZARR:"{}":/dolp'),
    ):
        path = tmp_path / name
        assert program(monkeypatch, "render", case_file, "--dolp", "--ortho", "--gsd", "3", "-o", path) == 0
        real = path.with_suffix(".img") if name.endswith("hdr") else path
        with rasterio.open(opened.format(real)) as file:
            assert pyproj.CRS(file.crs.to_wkt()).to_authority(min_confidence=50) == ("EPSG", "32618")
            assert file.transform.a == 3 and file.transform.e == -3
            assert file.transform.c == pytest.approx(west + city.origin_easting_m)
            assert file.transform.f == pytest.approx(north + city.origin_northing_m)
            assert file.shape == (round((north - south) / 3), round((east - west) / 3))
            values = file.read(1, masked=True)
            assert 0 <= values.min() and values.max() <= 1


def test_envi_header_by_spectral_python(monkeypatch, case_file, tmp_path, view):
    spectral = pytest.importorskip("spectral", reason="needs the dev extra")
    monkeypatch.setattr(frame_products, "BLOCK_BYTES", 100_000)
    asked = ["--frame", 1, "--cube", "-o", tmp_path / "c.hdr"]
    assert program(monkeypatch, "render", case_file, *asked) == 0
    image = spectral.open_image(str(tmp_path / "c.hdr"))
    assert image.shape == (*SHAPE, 3 * BANDS)
    np.testing.assert_allclose(image.bands.centers[:BANDS], view.sky.wavelength_um, atol=1e-6)
    assert image.bands.bandwidths[0] == 0.01 and image.bands.band_unit.lower() == "micrometers"
    header = image.metadata
    assert header["byte order"] == "0" and header["data ignore value"] == "-9999"
    assert header["band names"][BANDS] == "Q 0.400 um" and header["stokes frame"] == "detector"
    assert header["description"] == "glintrack radiance [W m-2 sr-1 um-1]"
    pixels = np.array([[0, 0], [30, 41], [59, 79]])
    light = view.radiance(np.eye(BANDS), pixels).values  # (pixel, channel, stokes)
    for (row, column), spectrum in zip(pixels, light, strict=True):
        np.testing.assert_allclose(image[row, column].ravel(), spectrum.T.ravel(), rtol=2e-4, atol=1e-3)


@pytest.mark.parametrize("name", ["cube.hdr", "cube.nc", "cube.zarr"])
def test_a_cube_is_never_in_memory_whole(monkeypatch, case_file, tmp_path, name):
    case_file.write_text(CASE.replace("rows = 60", "rows = 160").replace("columns = 80", "columns = 240"))
    monkeypatch.setattr(frame_products, "BLOCK_BYTES", 250_000)
    view = scenario.trace_frame(Case.from_toml(case_file), 0)
    layout = frame_products.cube_layout(view)
    whole_bytes = 4 * layout.count * layout.rows * layout.columns
    next(frame_products.cube_blocks(view, layout))  # compiled
    tracemalloc.start()
    try:
        next(frame_products.cube_blocks(view, layout))
        one_block = tracemalloc.get_traced_memory()[1]
        tracemalloc.reset_peak()
        with raster.raster_writer(tmp_path / name, layout) as write:
            for block in frame_products.cube_blocks(view, layout):
                write(*block)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    # all blocks need what one does, with its transposed copy and what the format keeps
    assert peak - one_block < 8 * frame_products.BLOCK_BYTES < 0.2 * whole_bytes


def test_an_interrupt_leaves_nothing(monkeypatch, case_file, tmp_path, capsys):
    def interrupted(*arguments):
        yield 0, 0, np.zeros((1, SHAPE[1], BANDS, 3), np.float32)
        raise KeyboardInterrupt

    module = importlib.import_module("glintrack.cli.render")
    monkeypatch.setattr(module, "cube_blocks", interrupted)
    for name in ("c.hdr", "c.nc", "c.zarr"):
        assert program(monkeypatch, "render", case_file, "--cube", "-o", tmp_path / name) == 130
        assert "interrupted, nothing written" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["case.toml"]


@pytest.mark.parametrize(
    ("arguments", "sentence"),
    [
        (["--frame", "3"], "`--frame` must lie in the flight's 0 to 2; got 3"),
        (["--frame", "-1"], "`--frame` must lie in the flight's 0 to 2; got -1"),
        (["--band", "0.7:0.6"], "`--band` must be two rising wavelengths in µm; got '0.7:0.6'"),
        (["--band", "red"], "`--band` must be two wavelengths in µm, as 0.6:0.7; got 'red'"),
        (["--band", "0.9:1.2"], "`--band` must rise within the atmosphere's 0.4 to 1 µm; got 0.9:1.2"),
        (["--band", "0.505:0.515"], "`--band` must hold at least one of the atmosphere's wavelengths"),
        (["--dolp", "--aop"], "`render` must get one product; got --dolp and --aop"),
        (["--rgb", "--band", "0.5:0.6"], "`--rgb` must be given without --band"),
        (["--gsd", "2"], "`--gsd` must be given with --ortho; got 2 without it"),
        (["--ortho", "--gsd", "900"], "must hold at least one cell of 900"),
        (["--cube"], "`output` must end in .hdr, .nc or .zarr for a cube; got 'out.png'"),
        (["-o", "out.jp2"], "`output` must end in one of .png, .jpg"),
        (["-o", "gone/out.png"], "`output` must lie in an existing folder; got gone/out.png"),
        (["--dolp", "-o", "gone/out.nc"], "`output` must lie in an existing folder; got gone/out.nc"),
        (["--cube", "-o", "there.zarr"], "`output` must be a new folder; got there.zarr, which exists"),
        (["-o", "there.png"], "`output` must be writable; got there.png"),
        (["--cube", "--band", "0.4:0.5", "--band", "0.6:0.7", "-o", "c.nc"], "at most one --band"),
    ],
)
def test_bad_input_is_one_sentence_and_leaves_nothing(
    monkeypatch, case_file, tmp_path, capsys, arguments, sentence
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "there.zarr").mkdir()
    (tmp_path / "there.png").mkdir()
    output = [] if "-o" in arguments else ["-o", "out.png"]
    assert program(monkeypatch, "render", case_file, *arguments, *output) == 2
    said = capsys.readouterr().err.strip()
    assert sentence in said and "\n" not in said
    assert sorted(p.name for p in tmp_path.iterdir()) == ["case.toml", "there.png", "there.zarr"]


@pytest.mark.parametrize(
    ("material", "samples", "half_shade"), [("panel_80", 1, False), ("panel_80", 8, True), ("leaf", 1, True)]
)
def test_shadows_are_as_soft_as_the_case_and_the_leaves_say(
    monkeypatch, case_file, material, samples, half_shade
):
    """The shadow of a slab 200 m up: its edge has a metre of penumbra; light falls through leaves."""
    zenith, azimuth = sun_direction(Case().atmosphere)
    away = 200 * math.tan(zenith)
    east, north = away * math.sin(azimuth) + 30, away * math.cos(azimuth)  # the frame's middle is at an edge

    class Roofed(ThreeCars):
        def at(self, t):
            ground, index = super().at(t).static, self.materials.get_index("material").get_loc(material)
            slab = box(60.0, 60.0, 1.0, index)
            raised = [[[1, 0, 0, east], [0, 1, 0, north], [0, 0, 1, 200.0]]]
            return snapshot(ground, [slab], raised, [0], vehicle_id=[11])

    monkeypatch.setattr(scenario, "build_scene", lambda design: Roofed(load_materials()))
    case_file.write_text(CASE.replace("[sensor]", f"[sensor]\nsun_samples = {samples}"), encoding="utf-8")
    light = scenario.trace_frame(Case.from_toml(case_file), 1).hits.sun_visible
    assert (light == 0).any() == (material != "leaf") and (light == 1).any()
    assert ((light > 0) & (light < 1)).any() == half_shade


def test_no_rays_to_the_sun_is_one_sentence(monkeypatch, case_file, tmp_path, capsys):
    case_file.write_text(CASE.replace("[sensor]", "[sensor]\nsun_samples = 0"), encoding="utf-8")
    assert program(monkeypatch, "render", case_file, "-o", tmp_path / "out.png") == 2
    assert "`sensor.sun_samples` must be greater than or equal to 1; got 0" in capsys.readouterr().err


def test_an_unwritable_folder_is_one_sentence(monkeypatch, case_file, tmp_path, capsys):
    monkeypatch.setattr(os, "access", lambda path, mode: False)
    assert program(monkeypatch, "render", case_file, "-o", tmp_path / "out.nc") == 2
    assert "`output` must be writable" in capsys.readouterr().err


def test_an_empty_scene_and_a_lens_below_the_ground(monkeypatch, case_file, tmp_path, capsys):
    class Nothing(ThreeCars):
        def at(self, t):
            now = super().at(t)
            nothing = type(now.static)(now.static.vertices, now.static.faces[:0], now.static.material[:0])
            return type(now)(
                nothing, now.models, now.transforms[:0], now.model[:0], now.paint[:0], np.zeros(0, int)
            )

    class Hill(ThreeCars):
        @property
        def terrain(self):
            return super().terrain + 4000.0

    for city, sentence in (
        (Nothing, "`scene` must hold at least one triangle; got none"),
        (Hill, "`flight.altitude_m` must put the lens above the ground, at 4000 m there; got 3000 m"),
    ):
        monkeypatch.setattr(scenario, "build_scene", lambda design, city=city: city(load_materials()))
        assert program(monkeypatch, "render", case_file, "-o", tmp_path / "out.png") == 2
        assert sentence in capsys.readouterr().err
    assert not (tmp_path / "out.png").exists()
