"""A user's photograph rectified from Python: the same places as by collinearity, and files that come back."""

import warnings

import numpy as np
import pytest
import rasterio
from rasterio.crs import CRS
from rasterio.enums import ColorInterp
from rasterio.errors import NotGeoreferencedWarning

from glintrack import rectify
from glintrack.camera import Camera, Pose, look_at, project
from glintrack.core.distortion import Distortion
from glintrack.io.photographs import PlacedPose, camera_file, pose_file, read_camera, read_pose
from glintrack.ortho import rectify_onto
from glintrack.ortho.rasters import MapGrid

CAMERA = Camera(0.068, 17e-6, 120, 160)
PLACED = PlacedPose(look_at(Pose(20.0, -150.0, 880.0), (0.0, 0.0, 80.0)), "EPSG:32632", (604000.0, 5792000.0))


@pytest.fixture
def photo(tmp_path):
    """A photograph of its own row and column numbers."""
    values = np.stack(np.indices((CAMERA.rows, CAMERA.columns)), axis=0).astype(np.float32)
    path = tmp_path / "photo.tif"
    with rasterio.open(path, "w", driver="GTiff", height=120, width=160, count=2, dtype="float32") as file:
        file.write(values)
    return path


def test_each_cell_shows_the_pixel_that_collinearity_names(photo):
    found = rectify(photo, CAMERA, PLACED, 80.0, gsd=2.0)
    east, north = found.grid.places(PLACED)
    places = np.stack([east, north, np.full(east.shape, 80.0)], axis=-1)
    pixels = project(CAMERA, PLACED.pose, places.reshape(-1, 3)).reshape(places.shape[:2] + (2,))
    inside = ((pixels > 0) & (pixels < [119, 159])).all(axis=-1)
    a_thousandth = 1e-3
    np.testing.assert_allclose(found.bands[inside], pixels[inside], atol=a_thousandth)
    beyond = ((pixels < -1) | (pixels > [120, 160])).any(axis=-1)
    assert inside.mean() > 0.5 and np.isnan(found.bands[beyond]).all()
    assert CRS.from_user_input(found.grid.crs).to_epsg() == 32632


def test_files_and_what_they_give_rectify_alike(photo, tmp_path):
    bent = Camera(0.068, 17e-6, 120, 160, 60.0, 79.5, Distortion(k1=0.1))
    (tmp_path / "camera.toml").write_text(camera_file(bent))
    (tmp_path / "pose.toml").write_text(pose_file(PLACED))
    from_files = rectify(photo, tmp_path / "camera.toml", tmp_path / "pose.toml", 80.0, gsd=2.0)
    direct = rectify(photo, bent, PLACED, 80.0, gsd=2.0)
    np.testing.assert_allclose(from_files.bands, direct.bands, atol=1e-3)
    from_files.write(str(tmp_path / "ortho.tif"))
    with rasterio.open(tmp_path / "ortho.tif") as file:
        np.testing.assert_array_equal(np.moveaxis(file.read(), 0, -1), from_files.bands)
        assert file.tags()["frame"] == "photo.tif"


def test_camera_and_pose_files_come_back(tmp_path):
    bent = Camera(0.068, 17e-6, 120, 160, 60.0, 79.5, Distortion(k1=0.1))
    (tmp_path / "camera.toml").write_text(camera_file(bent))
    (tmp_path / "pose.toml").write_text(pose_file(PLACED))
    assert read_camera(tmp_path / "camera.toml") == bent
    placed = read_pose(tmp_path / "pose.toml", "photo.tif")
    shift = np.array([*placed.origin_m, 0.0]) - [*PLACED.origin_m, 0.0]
    np.testing.assert_allclose(placed.pose.position + shift, PLACED.pose.position, atol=1e-6)
    points = np.array([[0.0, 0.0, 80.0], [50.0, 30.0, 80.0]])
    np.testing.assert_allclose(
        project(bent, placed.pose, points - shift), project(bent, PLACED.pose, points), atol=1e-6
    )


def test_a_frame_above_the_horizon_is_refused(photo):
    up = PlacedPose(Pose(0.0, 0.0, 880.0, pitch_rad=1.57), PLACED.crs, PLACED.origin_m)
    with pytest.raises(ValueError, match="must look below the horizon"):
        rectify(photo, CAMERA, up, 80.0)
    with pytest.raises(ValueError, match=r"`pose.height_m` must be above the ground"):
        rectify(photo, CAMERA, PLACED, 900.0)


def test_the_nearest_pixel_is_the_kernels(photo):
    found = rectify(photo, CAMERA, PLACED, 80.0, gsd=2.0, method="nearest")
    east, north = found.grid.places(PLACED)
    with rasterio.open(photo) as file:
        values = np.moveaxis(file.read(), 0, -1)
    wanted = rectify_onto(values, CAMERA, PLACED.pose, east, north, np.full(east.shape, 80.0), "nearest")
    np.testing.assert_array_equal(found.bands, wanted)


def colours():
    """Bands of a colour photograph, smooth, and black in one corner."""
    row, column = np.indices((CAMERA.rows, CAMERA.columns))
    return np.stack([column, 2 * row, (row + column) // 2]).astype(np.uint8)


def write_colours(path, bands, driver="PNG", **more):
    _, rows, columns = bands.shape
    size = {"height": rows, "width": columns, "count": len(bands), "dtype": bands.dtype.name}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver=driver, **size, **more) as file:
            file.write(bands)
    return path


def rectified(path):
    """The orthophoto of a picture, and its GeoTIFF: values, mask, colours, types."""
    found = rectify(path, CAMERA, PLACED, 80.0, gsd=2.0)
    found.write(path.with_name("ortho.tif"))
    with rasterio.open(path.with_name("ortho.tif")) as file:
        return found, file.read(), file.dataset_mask() > 0, file.colorinterp, set(file.dtypes)


RGB = (ColorInterp.red, ColorInterp.green, ColorInterp.blue)


def test_a_colour_photograph_stays_one_of_8_bits(tmp_path):
    found, values, seen, kinds, types = rectified(write_colours(tmp_path / "photo.png", colours()))
    assert kinds == RGB and types == {"uint8"} and found.names == ["red", "green", "blue"]
    np.testing.assert_array_equal(seen, np.isfinite(found.bands).all(axis=-1))
    assert 0.5 < seen.mean() < 1
    np.testing.assert_array_equal(values[:, seen].T, np.rint(found.bands[seen]))
    assert (values[:, ~seen] == 0).all()
    black = seen & (values[0] == 0)  # black is a colour, not missing
    assert black.any()


def test_what_alpha_hides_has_no_data(tmp_path):
    clear = np.where(np.arange(CAMERA.columns) < 40, 0, 255)
    alpha = np.broadcast_to(clear, (1, CAMERA.rows, CAMERA.columns)).astype(np.uint8)
    shown = rectified(write_colours(tmp_path / "photo.png", colours()))
    part = rectified(write_colours(tmp_path / "hidden.png", np.concatenate([colours(), alpha])))
    assert part[3] == RGB
    kept = part[2]
    assert part[2].sum() / shown[2].sum() == pytest.approx(0.75, abs=0.02)
    np.testing.assert_array_equal(part[1][:, kept], shown[1][:, kept])


def test_a_palette_becomes_its_colours(tmp_path):
    numbers = (np.indices((1, CAMERA.rows, CAMERA.columns))[2] >= 80).astype(np.uint8)
    path = write_colours(tmp_path / "photo.tif", numbers, "GTiff", photometric="palette")
    with rasterio.open(path, "r+") as file:
        file.write_colormap(1, {0: (200, 100, 0, 255), 1: (10, 20, 30, 255)})
    _, values, seen, kinds, _ = rectified(path)
    assert kinds == RGB
    ends = {tuple(colour) for colour in values[:, seen].T}
    assert {(200, 100, 0), (10, 20, 30)} <= ends


@pytest.mark.parametrize("dtype", ["uint16", "int16", "float32", "uint32"])
def test_16_bits_stay_and_others_are_float32_with_nan(tmp_path, dtype):
    bands = (colours()[:1].astype(float) * 200).astype(dtype)
    found, values, seen, _, types = rectified(write_colours(tmp_path / "photo.tif", bands, "GTiff"))
    wanted = dtype if dtype in ("uint16", "int16") else "float32"
    assert types == {wanted}
    if wanted == "float32":
        np.testing.assert_array_equal(values[0], found.bands[..., 0])
    else:
        np.testing.assert_array_equal(values[0][seen], np.rint(found.bands[seen, 0]))


def test_cubic_interpolation_of_bytes_stays_in_their_range(tmp_path):
    edge = np.zeros((3, CAMERA.rows, CAMERA.columns), np.uint8)
    edge[:, :, 80:] = 255
    path = write_colours(tmp_path / "photo.png", edge)
    found = rectify(path, CAMERA, PLACED, 80.0, gsd=0.2, method="cubic")
    assert np.nanmin(found.bands) < -1 and np.nanmax(found.bands) > 256  # Keys' weights overshoot
    found.write(tmp_path / "ortho.tif")
    with rasterio.open(tmp_path / "ortho.tif") as file:
        seen, values = file.dataset_mask() > 0, file.read(1)
    wanted = np.clip(np.rint(found.bands[seen, 0]), 0, 255)
    np.testing.assert_array_equal(values[seen], wanted)


@pytest.mark.parametrize("cut", [60, 400, -1])
def test_a_png_that_is_cut_off_or_damaged_is_refused(tmp_path, cut):
    path = tmp_path / "photo.png"
    values = np.random.default_rng(0).integers(0, 255, (1, 120, 160), np.uint8)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path, "w", driver="PNG", height=120, width=160, count=1, dtype="uint8") as file:
            file.write(values)
    whole = path.read_bytes()
    rectify(path, CAMERA, PLACED, 80.0, gsd=8.0)
    flipped = whole[:300] + bytes([whole[300] ^ 1]) + whole[301:]
    path.write_bytes(whole[:cut] if cut > 0 else flipped)
    with pytest.raises(
        ValueError, match=r"`FRAME` must be a whole PNG file; got .*photo.png, which is cut off"
    ):
        rectify(path, CAMERA, PLACED, 80.0, gsd=8.0)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (
            "principal_row = 5000.0",
            r"`principal_row` must lie in the image, 0 to 119; got 5000. If it is an offset",
        ),
        ("principal_column = -3.0", r"`principal_column` must lie in the image, 0 to 159; got -3"),
        ("[distortion]\nb1 = 500.0", r"`distortion.b1` must lie within ±0.1; got 500. If it is in pixels"),
    ],
)
def test_what_no_camera_has_is_refused(tmp_path, more, message):
    path = tmp_path / "camera.toml"
    path.write_text(f"focal_length_mm = 68.0\npitch_um = 17.0\nrows = 120\ncolumns = 160\n{more}\n")
    with pytest.raises(ValueError, match=message):
        read_camera(path)


def test_cells_of_a_map_in_feet_are_as_large_as_those_in_metres():
    """EPSG:2263 is in US survey feet of 0.3048 m."""
    new_york = PlacedPose(Pose(0.0, 0.0, 1000.0), "EPSG:32618", (585000.0, 4510000.0))
    metres, feet = (MapGrid.over(CAMERA, new_york, (0.0, 0.0), crs) for crs in (None, "EPSG:2263"))
    assert feet.gsd == pytest.approx(metres.gsd / 0.3048, rel=0.05)
    assert len(feet.x) == pytest.approx(len(metres.x), rel=0.1)
