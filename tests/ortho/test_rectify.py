"""Rectification: what is on the ground comes back to its place, whatever the aircraft's heading."""

import math

import numpy as np
import pytest
import xarray as xr

from glintrack import stokes
from glintrack.camera import Camera, Pose, ground_points, look_at, project, rays, rotation
from glintrack.core.records import NONE_SERVED
from glintrack.core.spectral import wavelength_grid
from glintrack.ortho import ground_grid, orthorectify, rectify_array, rectify_onto
from glintrack.sensor import build_sensor, expose
from tests.ortho.frames import frame_of, level, plain_stokes, terrain
from tests.plain import plain_sensor

AREA_M = (-60.0, -45.0, 60.0, 45.0)
GSD_M = 1.5
CAMERA = Camera(0.068, 17e-6, 240, 320)  # 0.75 m elements, 1.5 m superpixels at 3000 m
HEADINGS = [0.0, 0.7, 2.0, -2.5]


def pose_at(off_nadir_deg, heading, range_m=3000.0):
    """A reported pose at a slant range from the origin, which it looks at; the nose is at ``heading``."""
    angle = math.radians(off_nadir_deg)
    across = range_m * math.sin(angle)
    position = (-across * math.sin(heading), -across * math.cos(heading), range_m * math.cos(angle))
    return look_at(Pose(*position, heading_rad=heading, kind="reported"), (0.0, 0.0, 0.0))


def seen(pose, pattern, height_m=0.0, offset=0.0):
    """A frame whose superpixels sample a ground pattern along their own rays (independent of `project`)."""
    places = np.stack(np.mgrid[: CAMERA.rows : 2, : CAMERA.columns : 2], axis=-1) + 0.5 + offset
    direction = rays(CAMERA, pose, places)
    ground = pose.position + ((height_m - pose.up_m) / direction[..., 2])[..., None] * direction
    pan = pattern(ground[..., 0], ground[..., 1])
    return frame_of(pan, plain_stokes(pan), offset)


def wave(east, north):
    """A smooth pattern whose steepest slope is 1 a metre."""
    return 30.0 + 10.0 * np.sin(east / 20.0) + 10.0 * np.cos(north / 20.0)


def grid_of(image):
    return image["x"].values[None, :], image["y"].values[:, None]


# --- the ground comes back -------------------------------------------------------------------------


@pytest.mark.parametrize("off_nadir_deg", [0, 20, 50])
@pytest.mark.parametrize("heading", HEADINGS)
def test_a_pattern_returns_to_its_place(off_nadir_deg, heading):
    pose = pose_at(off_nadir_deg, heading)
    image = orthorectify(seen(pose, wave), CAMERA, pose, level(), GSD_M, AREA_M)
    # bilinear: h²/8 · |f''| summed over two axes, h the oblique superpixel, |f''| ≤ 10/20²
    h = GSD_M / math.cos(math.radians(off_nadir_deg))
    np.testing.assert_allclose(image["pan"], wave(*grid_of(image)), atol=2 * h**2 / 8 * 10 / 400)
    assert np.isfinite(image["pan"]).all()


def test_nearest_errs_by_half_a_superpixel_of_slope_at_most():
    pose = pose_at(0, 0.3)
    frame = seen(pose, wave)
    nearest = orthorectify(frame, CAMERA, pose, level(), GSD_M, AREA_M, "nearest")
    error = np.abs(nearest["pan"] - wave(*grid_of(nearest)))
    half_a_diagonal_m = GSD_M / math.sqrt(2)
    assert error.max() <= half_a_diagonal_m * math.hypot(0.5, 0.5) * 1.01
    assert np.isin(nearest["pan"].values, frame["pan"].values.astype(np.float32)).all()


def test_bilinear_is_exact_for_a_ramp_seen_from_nadir_and_nearest_is_not():
    pose = pose_at(0, 0.3)
    frame = seen(pose, lambda e, n: 50 + 0.3 * e - 0.2 * n)
    smooth, rough = (
        orthorectify(frame, CAMERA, pose, level(), GSD_M, AREA_M, method)
        for method in ("bilinear", "nearest")
    )
    ramp = 50 + 0.3 * grid_of(smooth)[0] - 0.2 * grid_of(smooth)[1]
    np.testing.assert_allclose(smooth["pan"], ramp, atol=1e-4)  # float32 frames
    assert np.abs(rough["pan"] - ramp).max() > 0.1


@pytest.mark.parametrize("height_m", [-15.0, 40.0])
def test_terrain_height_is_taken_into_account(height_m):
    pose = pose_at(50, 0.7)
    frame = seen(pose, wave, height_m)
    right = orthorectify(frame, CAMERA, pose, level(height_m), GSD_M, AREA_M)
    wrong = orthorectify(frame, CAMERA, pose, level(), GSD_M, AREA_M)
    np.testing.assert_allclose(right["pan"], wave(*grid_of(right)), atol=0.05)
    assert np.nanmax(np.abs(wrong["pan"] - wave(*grid_of(wrong)))) > 1


def test_sloping_terrain_is_interpolated():
    """A spike seen from a slope comes back where it stands, its height between the terrain's nodes."""
    pose = pose_at(50, 0.7)

    def slope(east, north):
        return 0.1 * east + 0.05 * north

    image = orthorectify(seen(pose, wave), CAMERA, pose, terrain(slope), GSD_M, AREA_M)
    east, north = np.broadcast_arrays(*grid_of(image))
    points = np.stack([east, north, slope(east, north)], axis=-1)
    pixels = project(CAMERA, pose, points)
    direction = rays(CAMERA, pose, pixels)
    at_zero = pose.position - (pose.up_m / direction[..., 2])[..., None] * direction
    np.testing.assert_allclose(image["pan"], wave(at_zero[..., 0], at_zero[..., 1]), atol=0.05)


@pytest.mark.parametrize("heading", HEADINGS)
def test_pan_knows_where_its_mirror_stands(heading):
    """The mirror is element (0, 0), half an element from the superpixel's centre."""
    pose = pose_at(0, heading)
    east0, north0 = 10.25, -7.5

    def spot(east, north):
        return np.exp(-((east - east0) ** 2 + (north - north0) ** 2) / (2 * 4.0**2))

    image = orthorectify(seen(pose, spot, offset=-0.5), CAMERA, pose, level(), 0.75, AREA_M)
    east, north = grid_of(image)
    weight = image["pan"].values / image["pan"].values.sum()
    tenth_of_a_superpixel_m = 0.15
    assert abs((weight * east).sum() - east0) < tenth_of_a_superpixel_m
    assert abs((weight * north).sum() - north0) < tenth_of_a_superpixel_m


def test_no_data_outside_the_frame():
    pose = pose_at(0, 0.0)
    image = orthorectify(seen(pose, wave), CAMERA, pose, level(), GSD_M, (-200.0, -150.0, 200.0, 150.0))
    east, north = np.broadcast_arrays(*grid_of(image))
    inside = (np.abs(east) < 119) & (np.abs(north) < 89)
    outside = (np.abs(east) > 121) | (np.abs(north) > 91)  # the frame is 240 m × 180 m
    for name in ("pan", "dolp"):
        assert np.isfinite(image[name].values[inside]).all() and np.isnan(image[name].values[outside]).all()


def test_ground_behind_the_lens_is_no_data():
    level_flight = Pose(0.0, 0.0, 100.0, gimbal_depression_rad=0.2, kind="reported")
    frame = frame_of(np.ones((120, 160)), plain_stokes(np.ones((120, 160))))
    image = orthorectify(frame, CAMERA, level_flight, level(), 10.0, (-500.0, -1000.0, 500.0, 1000.0))
    assert np.isnan(image["pan"].values[image["y"].values < 0]).all()
    assert np.isfinite(image["pan"].values).any()


def test_a_dark_mirror_stays_dark_and_spreads_no_further_than_half_a_superpixel():
    pose = pose_at(0, 0.0)
    pan = np.full((120, 160), 30.0)
    pan[60, 80] = np.nan
    frame = frame_of(pan, plain_stokes(np.full((120, 160), 30.0)))
    for method in ("nearest", "bilinear"):
        image = orthorectify(frame, CAMERA, pose, level(), 0.75, AREA_M, method)
        blank = np.isnan(image["pan"].values)
        assert 0 < blank.sum() <= 4  # 2 × 2 cells of 0.75 m
        np.testing.assert_allclose(image["pan"].values[~blank], 30)
        assert np.isfinite(image["stokes_radiance"]).all()


# --- polarization ----------------------------------------------------------------------------------


def detector_stokes(pose, field):
    """Detector-frame Stokes of a field (azimuth axis in the world, DoLP) by electric vectors.

    Every pixel sends light polarized along the transverse part of a fixed world vector.
    """
    places = np.stack(np.mgrid[: CAMERA.rows : 2, : CAMERA.columns : 2], axis=-1) + 0.5
    travel = -rays(CAMERA, pose, places)
    e1 = rotation(pose)[0] - (travel @ rotation(pose)[0])[..., None] * travel
    e1 /= np.linalg.norm(e1, axis=-1, keepdims=True)
    e2 = np.cross(travel, e1)
    a, b = e1 @ field, e2 @ field
    return np.stack([a**2 + b**2, a**2 - b**2, 2 * a * b], axis=-1)


@pytest.mark.parametrize("off_nadir_deg", [20, 50])
@pytest.mark.parametrize("heading", HEADINGS)
@pytest.mark.parametrize("roll", [0.0, 0.4])
def test_stokes_leave_in_the_meridian_frame(off_nadir_deg, heading, roll):
    """Light polarized along the vertical has Q = +I, U = 0 wherever the aircraft is and however it banks."""
    pose = pose_at(off_nadir_deg, heading)
    pose = look_at(Pose(*pose.position, heading_rad=heading + 1.0, roll_rad=roll, kind="reported"), (0, 0, 0))
    polarized = detector_stokes(pose, np.array([0, 0, 1.0]))
    frame = frame_of(polarized[..., 0], polarized)
    image = orthorectify(frame, CAMERA, pose, level(), GSD_M, (-30.0, -30.0, 30.0, 30.0))
    assert image["stokes_radiance"].attrs["stokes_frame"] == "meridian"
    i, q, u = np.moveaxis(image["stokes_radiance"].values, -1, 0)
    np.testing.assert_allclose(q, i, rtol=1e-4)  # bilinear between rays that differ by half a milliradian
    np.testing.assert_allclose(u, 0, atol=1e-4 * i.max())
    np.testing.assert_allclose(image["dolp"], 1, rtol=1e-4)


def test_horizontal_light_is_negative_q_and_u_is_counter_clockwise_as_seen():
    pose = pose_at(50, 0.0)  # looks north: the light travels south and up
    area = (-3.0, -3.0, 3.0, 3.0)
    east_west = detector_stokes(pose, np.array([1.0, 0, 0]))
    image = orthorectify(frame_of(east_west[..., 0], east_west), CAMERA, pose, level(), GSD_M, area)
    np.testing.assert_allclose(stokes.aop(image["stokes_radiance"].values), math.pi / 2, atol=2e-3)
    # up is image up and east is image right for this viewer: counter-clockwise from up leans west
    travel = pose.position / np.linalg.norm(pose.position)
    leaning = np.array([0, 0, 1.0]) - travel[2] * travel
    leaning = leaning / np.linalg.norm(leaning) - np.array([1.0, 0, 0])
    turned = detector_stokes(pose, leaning)
    image = orthorectify(frame_of(turned[..., 0], turned), CAMERA, pose, level(), GSD_M, area)
    np.testing.assert_allclose(stokes.aop(image["stokes_radiance"].values), math.pi / 4, atol=2e-3)


def test_what_comes_in_the_meridian_frame_is_not_turned():
    pose = pose_at(50, 0.7)
    polarized = np.broadcast_to([2.0, 0.4, -0.3], (120, 160, 3))
    frame = frame_of(polarized[..., 0], polarized)
    frame["stokes_radiance"].attrs["stokes_frame"] = "meridian"
    image = orthorectify(frame, CAMERA, pose, level(), GSD_M, (-9.0, -9.0, 9.0, 9.0))
    np.testing.assert_allclose(
        image["stokes_radiance"], np.broadcast_to([2, 0.4, -0.3], (12, 12, 3)), rtol=1e-6
    )


def test_dolp_is_masked_under_the_floor():
    pose = pose_at(0, 0.0)
    polarized = np.broadcast_to([1.0, 0.5, 0.0], (120, 160, 3))
    frame = frame_of(polarized[..., 0], polarized)
    area = (-9.0, -9.0, 9.0, 9.0)
    seen_dolp = orthorectify(frame.assign_attrs(dolp_floor=0.9), CAMERA, pose, level(), GSD_M, area)["dolp"]
    np.testing.assert_allclose(seen_dolp, 0.5, rtol=1e-6)
    masked = orthorectify(frame.assign_attrs(dolp_floor=1.1), CAMERA, pose, level(), GSD_M, area)["dolp"]
    assert np.isnan(masked).all()


# --- through the sensor ----------------------------------------------------------------------------


@pytest.mark.parametrize("heading", [0.3, 2.0])
def test_sensor_and_rectification_agree_where_an_element_stands(heading):
    """Each element samples the ground along its own ray; pan and S0 of a ramp come back in place."""
    grid = wavelength_grid(0.4, 1.0, 0.1)
    quiet = {"read_noise_e": 0.0, "full_well_e": 1e12, "bits": 24, "integration_time_ms": 100.0}
    sensor = build_sensor(plain_sensor(rows=240, columns=320, spectrometer_bandwidth_um=0.1, **quiet), grid)
    pose = pose_at(0, heading)
    direction = rays(sensor.camera, pose)
    ground = pose.position - (pose.up_m / direction[..., 2])[..., None] * direction
    light = np.zeros((240, 320, 1, 3))
    light[..., 0, 0] = 60 + 0.4 * ground[..., 0] - 0.3 * ground[..., 1]
    frame = expose(lambda channels: xr.DataArray(light), sensor, NONE_SERVED, np.random.default_rng(0), 1.5)
    image = orthorectify(frame, sensor.camera, pose, level(), GSD_M, AREA_M)
    ramp = 60 + 0.4 * grid_of(image)[0] - 0.3 * grid_of(image)[1]
    hundredth_of_a_superpixel = 0.01 * GSD_M * 0.5  # times the ramp's slope
    for name, values in (("pan", image["pan"].values), ("S0", image["stokes_radiance"].values[..., 0])):
        assert abs((values - ramp).mean()) < hundredth_of_a_superpixel, name
        assert np.abs(values - ramp).max() < 10 * hundredth_of_a_superpixel, name  # shot noise, float32
    assert image["dolp"].max() < 0.005
    assert image.attrs["time_s"] == 1.5 and image.attrs["gsd_m"] == GSD_M


# --- grids and whole arrays ------------------------------------------------------------------------


def test_ground_grid_is_cell_centres_north_up():
    east, north = ground_grid((-3.0, 10.0, 3.0, 14.0), 2.0)
    np.testing.assert_allclose(east, [-2, 0, 2])
    np.testing.assert_allclose(north, [13, 11])


def test_rectify_array_equals_orthorectify_of_the_same_elements():
    pose = pose_at(20, 0.7)
    pixels = np.stack(np.mgrid[: CAMERA.rows, : CAMERA.columns], axis=-1)
    direction = rays(CAMERA, pose, pixels)
    ground = pose.position - (pose.up_m / direction[..., 2])[..., None] * direction
    values = wave(ground[..., 0], ground[..., 1])
    got = rectify_array(np.stack([values, 2 * values], -1), CAMERA, pose, level(), GSD_M, AREA_M)
    east, north = ground_grid(AREA_M, GSD_M)
    wanted = wave(east[None], north[:, None])
    np.testing.assert_allclose(got[..., 0], wanted, atol=0.02)
    np.testing.assert_allclose(got[..., 1], 2 * got[..., 0], rtol=1e-6)
    assert rectify_array(values, CAMERA, pose, level(), GSD_M, AREA_M, "nearest").shape == wanted.shape


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"method": "sinc"}, "`method` must be one of nearest, bilinear, cubic; got 'sinc'"),
        ({"gsd_m": 0.0}, "`area_m` must hold at least one cell of 0.0 m"),
        ({"area_m": (0.0, 0.0, 1.0, 30.0)}, "`area_m` must hold at least one cell of 1.5 m; got"),
    ],
)
def test_errors_name_what_came(arguments, message):
    pose, grid = pose_at(0, 0.0), {"gsd_m": GSD_M, "area_m": AREA_M, **arguments}
    with pytest.raises(ValueError, match=message):
        orthorectify(seen(pose, wave), CAMERA, pose, level(), **grid)
    with pytest.raises(ValueError, match=message):
        rectify_array(np.zeros((240, 320)), CAMERA, pose, level(), **grid)


def test_rectify_array_refuses_another_size():
    with pytest.raises(ValueError, match=r"`values` must be 240 × 320 elements; got \(120, 160\)"):
        rectify_array(np.zeros((120, 160)), CAMERA, pose_at(0, 0.0), level(), GSD_M, AREA_M)


def test_frames_that_break_their_schema_are_refused():
    pose = pose_at(0, 0.0)
    frame = seen(pose, wave)
    del frame["stokes_radiance"].attrs["stokes_frame"]
    with pytest.raises(ValueError, match=r"`frame\.stokes_radiance` must name its stokes_frame"):
        orthorectify(frame, CAMERA, pose, level(), GSD_M, AREA_M)


# --- cubic, and the round trip ---------------------------------------------------------------------


def test_cubic_is_third_order_and_better_than_bilinear():
    pose = pose_at(20, 0.5)

    def ripples(e, n):
        return 30 + 10 * np.sin(e / 4.0) + 10 * np.cos(n / 5.0)

    frame = seen(pose, ripples)
    errors = {}
    for method in ("bilinear", "cubic"):
        image = orthorectify(frame, CAMERA, pose, level(), GSD_M, AREA_M, method)
        east, north = grid_of(image)
        errors[method] = np.abs(
            image["pan"] - (30 + 10 * np.sin(east / 4.0) + 10 * np.cos(north / 5.0))
        ).max()
    assert errors["cubic"] < errors["bilinear"] / 3


def test_cubic_is_exact_for_a_parabola_between_pixels():
    """Keys' kernel with a = −½ reproduces quadratics."""
    camera = Camera(0.1, 1e-5, 20, 20)
    values = np.add.outer(np.arange(20.0) ** 2, 3.0 * np.arange(20.0) ** 2)
    places = np.array([[5.3, 7.8], [10.0, 4.25], [12.9, 11.1]])
    pose = Pose(0, 0, 1000.0)
    ground = pose.position + 1000.0 * rays(camera, pose, places) / -rays(camera, pose, places)[:, 2:]
    columns = (ground[None, :, k] for k in range(3))
    found = rectify_onto(values, camera, pose, *columns, method="cubic")[0]
    np.testing.assert_allclose(found, places[:, 0] ** 2 + 3 * places[:, 1] ** 2, rtol=1e-5)


@pytest.mark.parametrize("method", ["nearest", "bilinear", "cubic"])
def test_every_method_keeps_a_level_and_its_holes(method):
    pose, pan = pose_at(0, 0.0), np.full((120, 160), 7.0)
    pan[60, 80] = np.nan
    image = orthorectify(
        frame_of(pan, plain_stokes(np.full((120, 160), 7.0))), CAMERA, pose, level(), 0.75, AREA_M, method
    )
    blank = np.isnan(image["pan"].values)
    assert 0 < blank.sum() <= 4
    np.testing.assert_allclose(image["pan"].values[~blank], 7.0, rtol=1e-6)


@pytest.mark.parametrize("altitude_m", [200.0, 3000.0, 20000.0])
@pytest.mark.parametrize("off_nadir_deg", [0, 50, 70])
def test_ground_to_detector_to_ground(altitude_m, off_nadir_deg):
    """To a hundredth of a pixel, at every height and obliquity."""
    range_m = altitude_m / math.cos(math.radians(off_nadir_deg))
    pose = pose_at(off_nadir_deg, 1.1, range_m)
    pixels = np.stack(np.mgrid[: CAMERA.rows : 16, : CAMERA.columns : 16], axis=-1).astype(float)
    ground = ground_points(CAMERA, pose, pixels, height_m=12.0)
    hundredth_of_a_pixel = 0.01
    np.testing.assert_allclose(project(CAMERA, pose, ground), pixels, atol=hundredth_of_a_pixel)
    # through the kernel as well: a frame that holds its own coordinates gives them back
    rows_and_columns = np.moveaxis(np.mgrid[: CAMERA.rows, : CAMERA.columns].astype(float), 0, -1)
    inside = ground[1:-1, 1:-1]
    found = rectify_onto(rows_and_columns, CAMERA, pose, *np.moveaxis(inside, -1, 0))
    np.testing.assert_allclose(found, pixels[1:-1, 1:-1], atol=hundredth_of_a_pixel)


# --- the compiled sweep is in single precision --------------------------------------------------------

HUNDREDTH_PX = 0.01
UTM = np.array([604120.0, 5792310.0, 0.0])


def places_of(camera, pose, cells, level_m, margin=0.0):
    """An even grid over what a frame sees, as axes, and rolling heights."""
    edge = np.array([[0, 0], [0, 1], [1, 0], [1, 1]]) * (camera.rows - 1, camera.columns - 1)
    ground = ground_points(camera, pose, edge, level_m)
    (west, south), (east, north) = ground[:, :2].min(0), ground[:, :2].max(0)
    wide, high = margin * (east - west), margin * (north - south)
    x, y = np.linspace(west - wide, east + wide, cells[1]), np.linspace(north + high, south - high, cells[0])
    height = level_m + 0.01 * (east - west) * np.sin(np.add.outer(3 * np.arange(len(y)), np.arange(len(x))))
    return x[None], y[:, None], height


@pytest.mark.parametrize("method", ["bilinear", "cubic"])
@pytest.mark.parametrize(
    ("rows", "columns", "focal_m", "off_nadir_deg", "margin"),
    [
        (8, 30000, 0.12, 0.0, 0.0),  # a row as long as the largest cameras have
        (560, 880, 3.0, 50.0, 0.0),  # a narrow field
        (560, 880, 0.068, 70.0, 0.0),
        (560, 880, 0.068, 50.0, 40.0),  # a grid far larger than the frame
    ],
)
def test_places_in_the_frame_are_those_of_double_precision(
    rows, columns, focal_m, off_nadir_deg, margin, method
):
    """A frame that holds its own coordinates tells where each cell was sampled."""
    camera = Camera(focal_m, 6e-6 if columns > 9000 else 17e-6, rows, columns)
    heading = 0.7 if off_nadir_deg else 0.0
    place = pose_at(off_nadir_deg, heading).position + UTM
    pose = look_at(Pose(*place, heading_rad=heading, kind="reported"), UTM)
    east, north, height = places_of(camera, pose, (90, 120) if margin == 0 else (900, 1200), 0.0, margin)
    frame = np.moveaxis(np.mgrid[:rows, :columns].astype(np.float32), 0, -1)
    found = rectify_onto(frame, camera, pose, east, north, height, method)
    exact = project(camera, pose, np.stack(np.broadcast_arrays(east, north, height), axis=-1))
    seen = ((exact >= 0) & (exact <= (rows - 1, columns - 1))).all(axis=-1)
    assert seen.sum() > 20
    np.testing.assert_allclose(found[seen], exact[seen], atol=HUNDREDTH_PX)


def test_axes_and_whole_arrays_of_places_give_the_same():
    pose = pose_at(50, 0.7)
    east, north, height = places_of(CAMERA, pose, (40, 50), 0.0)
    frame = np.random.default_rng(0).random((240, 320, 3), np.float32)
    whole = np.broadcast_arrays(east, north)
    for method in ("nearest", "bilinear", "cubic"):
        by_axes = rectify_onto(frame, CAMERA, pose, east, north, height, method)
        np.testing.assert_array_equal(by_axes, rectify_onto(frame, CAMERA, pose, *whole, height, method))
        for band in range(3):  # and bands together what each gives alone
            alone = rectify_onto(frame[..., band], CAMERA, pose, east, north, height, method)
            np.testing.assert_array_equal(alone, by_axes[..., band])


def test_cubic_is_linear_across_the_border_and_keys_convolution_within():
    """Seen straight down, a cell a metre and a pixel a metre; by hand from Keys' weights at one half."""
    camera, pose = Camera(1.0, 1e-2, 6, 6), Pose(0.0, 0.0, 100.0, kind="reported")
    rng = np.random.default_rng(3)
    frame = rng.random((6, 6), np.float32)
    found = rectify_onto(frame, camera, pose, np.arange(-2.5, 3)[None] + 0.5, np.array([[0.5]]), 0.0, "cubic")
    row = frame[2]
    keys = (-row[:-3] + 9 * row[1:-2] + 9 * row[2:-1] - row[3:]) / 16
    np.testing.assert_allclose(found[0, 1:4], keys, rtol=1e-5)
    np.testing.assert_allclose(found[0, [0, 4]], [row[:2].mean(), row[-2:].mean()], rtol=1e-5)
