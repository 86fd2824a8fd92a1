"""``glintrack ortho`` on images of one's own, written as any user would have them."""

import math
import re
from dataclasses import replace

import numpy as np
import pytest
import rasterio
import rasterio.warp
import xarray as xr
from pyproj import Proj, Transformer
from scipy.ndimage import binary_erosion
from typer.testing import CliRunner

from glintrack.camera import Camera, Pose, ground_points, look_at, omega_phi_kappa
from glintrack.cli.app import app
from glintrack.core.distortion import Distortion
from glintrack.io.photographs import read_pose

CRS, EAST0, NORTH0, GROUND_M = "EPSG:32632", 604120.0, 5792310.0, 80.0
CAMERA = Camera(0.05, 20e-6, 120, 160)
CAMERA_FILE = "focal_length_mm = 50\npitch_um = 20\nrows = 120\ncolumns = 160\n"
POSE = look_at(Pose(-300.0, -500.0, 880.0, heading_rad=0.3, roll_rad=0.02), (0.0, 0.0, GROUND_M))


def field(east, north):
    """What lies on the ground, of places from (EAST0, NORTH0)."""
    return 100 + 40 * np.sin(east / 15.0) + 40 * np.cos(north / 18.0)


WAVES = np.random.default_rng(2).normal(0, 0.05, (60, 2)), np.linspace(0, 60, 60)


def town(east, north):
    """Ground of all scales, that looks like itself at no other place."""
    phase = 2 * np.pi * (east[..., None] * WAVES[0][:, 0] + north[..., None] * WAVES[0][:, 1])
    return 100 + 8 * np.cos(phase + WAVES[1]).sum(axis=-1)


def slope(east, north):
    return GROUND_M + 0.05 * east - 0.03 * north


def write_raster(path, values, crs=CRS, transform=None, nodata=None):
    values = np.asarray(values, np.float32)
    values = values if values.ndim == 3 else values[None]
    profile = {"driver": "GTiff", "count": len(values), "dtype": "float32", "nodata": nodata}
    profile |= {"height": values.shape[1], "width": values.shape[2], "crs": crs}
    if transform is not None:
        profile["transform"] = transform
    with rasterio.open(path, "w", **profile) as file:
        file.write(values)


def photograph(path, ground_of=field, camera=CAMERA):
    pixels = np.moveaxis(np.mgrid[: camera.rows, : camera.columns].astype(float), 0, -1)
    ground = ground_points(camera, POSE, pixels, GROUND_M)
    for _ in range(30):  # onto the slope, by fixed point
        ground = ground_points(camera, POSE, pixels, slope(ground[..., 0], ground[..., 1]))
    seen = ground_of(ground[..., 0], ground[..., 1])
    write_raster(path, np.stack([seen, 2 * seen]), crs=None)


@pytest.fixture
def folder(tmp_path):
    photograph(tmp_path / "photo.tif")
    (tmp_path / "camera.toml").write_text("[camera]\n" + CAMERA_FILE)
    omega, phi, kappa = (math.degrees(a) for a in omega_phi_kappa(POSE))
    place = (
        f"easting_m = {EAST0 + POSE.east_m}\nnorthing_m = {NORTH0 + POSE.north_m}\nheight_m = {POSE.up_m}\n"
    )
    angles = f"omega_deg = {omega!r}\nphi_deg = {phi!r}\nkappa_deg = {kappa!r}\n"
    (tmp_path / "pose.toml").write_text(f'crs = "{CRS}"\n{place}{angles}')
    x, y = np.arange(-600.0, 600, 10) + 5, np.arange(600.0, -600, -10) - 5
    dem = slope(x[None], y[:, None])
    write_raster(
        tmp_path / "dem.tif", dem, transform=rasterio.transform.from_origin(EAST0 - 600, NORTH0 + 600, 10, 10)
    )
    return tmp_path


def rectify(folder, *options, pose="pose.toml", out="ortho.tif", again=True):
    arguments = ["ortho", "photo.tif", "--camera", "camera.toml", "--pose", pose, "-o", out, *options]
    arguments = [str(folder / a) if a.endswith((".tif", ".toml", ".csv", ".nc")) else a for a in arguments]
    if again:
        (folder / out).unlink(missing_ok=True)  # what is there is never written over
    return CliRunner().invoke(app, arguments)


def error_of(path, crs=CRS, ground_of=field):
    """Largest difference from the ground on cells in whole data, and the share of cells with data."""
    with rasterio.open(path) as file:
        bands = file.read()
        assert file.crs == rasterio.crs.CRS.from_string(crs)
        rows, columns = np.mgrid[: file.height, : file.width]
        x, y = (np.reshape(v, rows.shape) for v in file.xy(rows.ravel(), columns.ravel()))
    east, north = Transformer.from_crs(crs, CRS, always_xy=True).transform(x, y)
    truth = ground_of(np.subtract(east, EAST0), np.subtract(north, NORTH0))
    inner = binary_erosion(np.isfinite(bands[0]))  # half a pixel at the border holds the last value
    np.testing.assert_allclose(bands[1], 2 * bands[0], rtol=1e-5)
    return float(np.abs(bands[0] - truth)[inner].max()), float(np.isfinite(bands[0]).mean())


# half a metre is a pixel here; the steepest slope of the field is 2.7 a metre; bilinear errs by
# h²/8 · |f''| = 0.6² / 8 · 0.3
TOLERANCE = 0.1


@pytest.mark.parametrize("crs", [CRS, "EPSG:25833"])
def test_an_image_comes_to_its_place_in_any_crs(folder, crs):
    result = rectify(folder, "--dem", "dem.tif", "--crs", crs, "--gsd", "2")
    assert result.exit_code == 0, result.exception
    error, share = error_of(folder / "ortho.tif", crs=crs)
    assert error < TOLERANCE and share > 0.15
    with rasterio.open(folder / "ortho.tif") as file:
        assert file.tags(ns="IMAGE_STRUCTURE")["LAYOUT"] == "COG"


def far_relief(folder):
    """The same heights under the frame; a mountain above the lens and a pit elsewhere in the file."""
    with rasterio.open(folder / "dem.tif") as file:
        dem, transform = file.read(1), file.transform
    dem[:20, :20], dem[-20:, :20] = 2500, -400
    write_raster(folder / "dem.tif", dem, transform=transform)


def test_heights_that_the_frame_does_not_see_change_nothing(folder):
    rectify(folder, "--dem", "dem.tif", out="alone.tif")
    far_relief(folder)
    result = rectify(folder, "--dem", "dem.tif")
    assert result.exit_code == 0, result.exception
    with rasterio.open(folder / "alone.tif") as alone, rasterio.open(folder / "ortho.tif") as file:
        assert file.transform == alone.transform
        np.testing.assert_array_equal(file.read(), alone.read())


def test_a_distorting_lens_is_undone_by_its_camera_file(folder):
    lens = Distortion(k1=-20.0, p1=0.05)  # over a narrow field: the corners move by three pixels
    photograph(folder / "photo.tif", camera=replace(CAMERA, distortion=lens))
    (folder / "camera.toml").write_text(CAMERA_FILE + "[distortion]\nk1 = -20.0\np1 = 0.05\n")
    result = rectify(folder, "--dem", "dem.tif", "--gsd", "2")
    assert result.exit_code == 0, result.exception
    error, share = error_of(folder / "ortho.tif")
    assert error < TOLERANCE and share > 0.15
    (folder / "camera.toml").write_text(CAMERA_FILE)
    rectify(folder, "--dem", "dem.tif", "--gsd", "2")
    assert error_of(folder / "ortho.tif")[0] > 10 * TOLERANCE


def test_a_dem_in_another_crs_gives_the_same(folder):
    with rasterio.open(folder / "dem.tif") as file:
        west, south, east, north = rasterio.warp.transform_bounds(CRS, "EPSG:4326", *file.bounds)
        degrees = np.full((300, 300), np.nan)
        transform = rasterio.transform.from_bounds(west, south, east, north, 300, 300)
        rasterio.warp.reproject(
            rasterio.band(file, 1),
            degrees,
            dst_transform=transform,
            dst_crs="EPSG:4326",
            dst_nodata=np.nan,
            resampling=rasterio.warp.Resampling.bilinear,
        )
    write_raster(folder / "far.tif", degrees, "EPSG:4326", transform, nodata=np.nan)
    result = rectify(folder, "--dem", "far.tif", "--gsd", "2")
    assert result.exit_code == 0, result.exception
    assert error_of(folder / "ortho.tif")[0] < 2 * TOLERANCE


def test_default_cell_and_netcdf(folder):
    result = rectify(folder, "--height", "80", out="ortho.nc")
    assert result.exit_code == 0, result.exception
    with xr.open_dataset(folder / "ortho.nc", engine="h5netcdf") as found:
        assert set(found.data_vars) == {"band_1", "band_2"} and "spatial_ref" in found.coords
        cell = float(found["x"][1] - found["x"][0])
    range_m = np.linalg.norm(POSE.position - [0, 0, 80])
    assert cell == pytest.approx(range_m * 20e-6 / 0.05 / math.sqrt(0.8), rel=0.1)


def test_heading_roll_pitch_and_a_csv_say_the_same(folder):
    degrees = [math.degrees(a) for a in (POSE.heading_rad, POSE.roll_rad, POSE.pitch_rad)]
    gimbal = [math.degrees(a) for a in (POSE.gimbal_azimuth_rad, POSE.gimbal_depression_rad)]
    header = "name,crs,easting_m,northing_m,height_m,heading_deg,roll_deg,pitch_deg"
    header += ",gimbal_azimuth_deg,gimbal_depression_deg"
    values = [EAST0 + POSE.east_m, NORTH0 + POSE.north_m, POSE.up_m, *degrees, *gimbal]
    row = ",".join(["photo", CRS, *(repr(v) for v in values)])
    (folder / "poses.csv").write_text(f"# two frames\n{header}\nother{row.removeprefix('photo')}\n{row}\n")
    assert rectify(folder, "--dem", "dem.tif", "--gsd", "2", pose="poses.csv").exit_code == 0
    assert error_of(folder / "ortho.tif")[0] < TOLERANCE


def test_degrees_and_true_north(folder):
    """UTM's grid north lies east of true north east of the central meridian: 1.205° at this place."""
    x, y = EAST0 + POSE.east_m, NORTH0 + POSE.north_m
    longitude, latitude = Transformer.from_crs(CRS, "EPSG:4326", always_xy=True).transform(x, y)
    convergence = Proj(CRS).get_factors(longitude, latitude).meridian_convergence
    assert convergence == pytest.approx((longitude - 9) * math.sin(math.radians(latitude)), abs=0.01)
    text = f'crs = "{CRS}"\nlongitude_deg = {longitude!r}\nlatitude_deg = {latitude!r}\nheight_m = 880\n'
    text += f'heading_deg = {30 + convergence!r}\nroll_deg = 0\npitch_deg = 0\nnorth = "true"\n'
    (folder / "north.toml").write_text(text)
    placed = read_pose(folder / "north.toml", "photo.tif")
    # true azimuth = grid azimuth + convergence
    assert math.degrees(placed.pose.heading_rad) == pytest.approx(30, abs=1e-3)
    assert placed.pose.east_m + placed.origin_m[0] == pytest.approx(x, abs=1e-4)


def test_what_a_surface_model_hides_is_blank_and_flagged(folder):
    with rasterio.open(folder / "dem.tif") as file:
        dem, transform = file.read(1), file.transform
    roof = dem.copy()
    roof[59:61, 59:61] += 60  # 20 m wide, over the middle
    write_raster(folder / "dsm.tif", roof, transform=transform)
    assert rectify(folder, "--dem", "dem.tif", "--gsd", "2", "--surface", "dsm.tif").exit_code == 0
    with rasterio.open(folder / "ortho.tif") as file:
        value, _, dark = file.read()
        behind = file.index(EAST0 + 8, NORTH0 + 19)  # beyond the roof as the camera looks
        before = file.index(EAST0 - 9, NORTH0 - 20)
    assert dark[behind] == 1 and np.isnan(value[behind])
    assert dark[before] == 0 and np.isfinite(value[before])
    inside = np.isfinite(value)
    assert (dark[inside] == 0).all()


def test_registration_moves_a_misplaced_image_onto_a_reference(folder):
    photograph(folder / "photo.tif", town)
    options = ("--dem", "dem.tif", "--gsd", "1", "--area", "604080", "5792270", "604160", "5792350")
    assert rectify(folder, *options, out="right.tif").exit_code == 0
    text = (folder / "pose.toml").read_text().replace(str(EAST0 + POSE.east_m), str(EAST0 + POSE.east_m + 5))
    (folder / "wrong.toml").write_text(text)
    assert rectify(folder, *options, pose="wrong.toml").exit_code == 0
    right, wrong = (error_of(folder / name, ground_of=town)[0] for name in ("right.tif", "ortho.tif"))
    result = rectify(folder, *options, "--register", "right.tif", pose="wrong.toml")
    assert result.exit_code == 0, result.exception
    rows, columns = map(float, re.findall(r"moved by (\S+) rows, (\S+) columns", result.output)[0])
    # the wrong place has the slope's wrong height: 0.25 m of it lean over by its tangent, 0.73
    assert (rows, columns) == pytest.approx((0, 5), abs=0.25)
    assert error_of(folder / "ortho.tif", ground_of=town)[0] < right + 0.3 * wrong


def edited(folder, name, old, new):
    (folder / name).write_text((folder / name).read_text().replace(old, new))
    return ()


def holed(folder, rows=slice(55, 65)):
    with rasterio.open(folder / "dem.tif") as file:
        dem, transform = file.read(1), file.transform
    dem[rows, 55:65] = -9999
    write_raster(folder / "dem.tif", dem, transform=transform, nodata=-9999)
    return ()


def test_ground_without_height_is_nan_and_told(folder):
    """A hole under the north of the frame: the rest is as without it."""
    options = ("--dem", "dem.tif", "--gsd", "0.5", "--area", "604070", "5792260", "604170", "5792360")
    rectify(folder, *options, out="whole.tif")
    holed(folder, slice(55, 60))
    with pytest.warns(UserWarning, match="`dem` has no height in .* % of the ground in the frame: NaN there"):
        result = rectify(folder, *options)
    assert result.exit_code == 0, result.exception
    with rasterio.open(folder / "whole.tif") as whole, rasterio.open(folder / "ortho.tif") as file:
        full, bands, share = whole.read(), file.read(), float(file.tags()["ground_without_height"])
    kept = np.isfinite(bands)
    np.testing.assert_allclose(bands[kept], full[kept], rtol=1e-6)
    assert 0.2 < share < 0.9
    lost = np.isfinite(full[0]) & ~kept[0]
    assert lost.sum() / np.isfinite(full[0]).sum() == pytest.approx(share, rel=0.1)


@pytest.mark.parametrize("name", ["ortho.tif", "ortho.nc"])
def test_what_is_there_is_not_written_over(folder, name):
    (folder / name).write_text("mine")
    result = rectify(folder, "--dem", "dem.tif", out=name, again=False)
    assert isinstance(result.exception, ValueError) and "`output` must be a new file" in str(result.exception)
    assert (folder / name).read_text() == "mine"


def elsewhere(folder):
    write_raster(
        folder / "dem.tif", np.zeros((9, 9)), transform=rasterio.transform.from_origin(3e5, 5e6, 10, 10)
    )
    return ()


def exchanged(folder):
    edited(folder, "pose.toml", "easting_m", "other")
    edited(folder, "pose.toml", "northing_m", "easting_m")
    return edited(folder, "pose.toml", "other", "northing_m")


def above_take_off(folder):
    """A height above a take-off at 80 m, lower than its ground but above the lowest of the file."""
    far_relief(folder)
    edited(folder, "pose.toml", "height_m = 880", "height_m = 60")


def exchanged_near(folder):
    """On a map of small numbers both ways are places."""
    local = "+proj=tmerc +lat_0=52.27 +lon_0=10.5 +x_0=30000 +y_0=9000 +ellps=WGS84 +units=m"
    edited(folder, "pose.toml", CRS, local)
    edited(folder, "pose.toml", f"easting_m = {EAST0 + POSE.east_m}", f"easting_m = {9000 + POSE.north_m}")
    edited(
        folder, "pose.toml", f"northing_m = {NORTH0 + POSE.north_m}", f"northing_m = {30000 + POSE.east_m}"
    )
    corner = rasterio.transform.from_origin(29400, 9600, 10, 10)
    write_raster(folder / "dem.tif", np.full((120, 120), 80.0), crs=local, transform=corner)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda f: ("--dem", "dem.tif", "--height", "3"), "must get one of --dem and --height; got both"),
        (
            lambda f: edited(f, "camera.toml", "rows = 120", "rows = 122"),
            "must be 160 pixels wide and 122 high",
        ),
        (lambda f: edited(f, "camera.toml", "pitch_um", "pitch"), "`pitch_um` must be given; got only"),
        (
            lambda f: (f / "camera.toml").write_text((f / "pose.toml").read_text()) and (),
            "^`camera` must be a camera file; got a pose file, camera.toml.*exchanged\\?$",
        ),
        (lambda f: edited(f, "camera.toml", "mm = 50", "mm = 0.05"), "sees 17.*Are they in mm and µm"),
        (lambda f: edited(f, "pose.toml", "kappa_deg", "yaw_deg"), "Did you mean `heading_deg`"),
        (lambda f: edited(f, "pose.toml", "omega_deg", "roll_deg"), "attitude as heading_deg, roll_deg"),
        (lambda f: edited(f, "pose.toml", "omega_deg = ", "omega_deg = 9"), "below the horizon"),
        (lambda f: edited(f, "pose.toml", "height_m = 880", "height_m = 20"), "above the ground"),
        (
            above_take_off,
            "above the ground, .*; got 60 m. Are .* not above take-off",
        ),
        (lambda f: edited(f, "pose.toml", CRS, "EPSG:4326"), "projected and in metres"),
        (lambda f: edited(f, "pose.toml", CRS, "EPSG:77"), "a coordinate reference system such as"),
        (lambda f: edited(f, "pose.toml", CRS, "EPSG:2263"), "projected and in metres"),
        (lambda f: edited(f, "pose.toml", CRS, "EPSG:3857"), "must count metres of the ground"),
        (
            lambda f: edited(f, "pose.toml", "easting_m = ", "easting_m = 99"),
            "nowhere in|metres of the ground",
        ),
        (lambda f: ("--height", "nan"), "`height` must lie within -500 to 9000 m; got nan"),
        (lambda f: ("--height", "-1e308"), "`height` must lie within"),
        (lambda f: ("--gsd", "nan"), "`gsd` must be positive and at most 100000; got nan"),
        (
            lambda f: edited(f, "camera.toml", "pitch_um = 20", "pitch_um = 0.02"),
            "`pitch_um` must be at least 0.1 µm; got 0.02 µm. Is it in mm",
        ),
        (lambda f: ("--gsd", "1e308"), "`gsd` must be positive and at most"),
        (lambda f: ("--area", "nan", "0", "9", "9"), "`area` must lie within ±1e\\+08; got nan 0 9 9"),
        (lambda f: ("--area", "-inf", "-inf", "inf", "inf"), "`area` must lie within"),
        (exchanged, "EPSG:32632|Are east and north exchanged.*then lie at 10.5.°, 52.2.°"),
        (exchanged_near, "Are they exchanged.* With easting_m = 29.* the pose is over dem.tif.$"),
        (holed, "must have heights where the frame looks; got none there"),
        (elsewhere, "must reach the frame's ground"),
        (lambda f: write_raster(f / "dem.tif", np.zeros((9, 9)), crs=None) or (), "must have a CRS"),
        (lambda f: (f / "photo.tif").write_text("no picture") and (), "an image \\(GeoTIFF"),
        (lambda f: ("--area", "0", "0", "9", "9"), "ground that the frame sees|must reach the frame"),
        (lambda f: ("--gsd", "0.00001"), "must be larger"),
        (lambda f: ("--crs", "EPSG:4326"), "in degrees for a geographic CRS"),
    ],
)
def test_bad_input_is_one_sentence(folder, spoil, message):
    options = spoil(folder) or ()
    options = (*options, *(() if {"--dem", "--height"} & {*options} else ("--dem", "dem.tif")))
    result = rectify(folder, *options)
    assert isinstance(result.exception, ValueError), (result.output, result.exception)
    text = str(result.exception)
    assert re.search(message, text), text
    assert all(line.startswith("`") for line in text.splitlines())  # each fault is one
    assert not (folder / "ortho.tif").exists()


def test_degrees_taken_for_metres_are_told_and_the_result_is_described(folder):
    said = " ".join(rectify(folder, "--height", "80").output.split())
    assert " m in WGS 84 / UTM zone 32N, 2 bands" in said
    edited(folder, "pose.toml", f"easting_m = {EAST0 + POSE.east_m}", "easting_m = 10.5")
    edited(folder, "pose.toml", f"northing_m = {NORTH0 + POSE.north_m}", "northing_m = 52.2")
    with pytest.warns(UserWarning, match="outside what WGS 84 / UTM zone 32N is made for"):
        rectify(folder, "--height", "80")
