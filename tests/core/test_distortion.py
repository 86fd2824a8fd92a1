"""Brown's lens distortion: there and back, wherever light passes the camera."""

import math

import numpy as np
import pytest

from glintrack.camera import Camera, Pose, from_omega_phi_kappa, ground_points, look_at, project, rays
from glintrack.core.distortion import Distortion
from glintrack.ortho import rectify_onto
from glintrack.render.trace import element_rays

THOUSANDTH_PX, HUNDREDTH_PX = 1e-3, 1e-2
# a drone's wide lens: the corner of the frame below moves by some 100 px
WIDE = Distortion(k1=-0.27, k2=0.11, k3=-0.02, p1=0.0008, p2=-0.0005)
PINCUSHION = Distortion(k1=0.2, p1=-0.001)
UNEVEN = Distortion(k1=-0.1, p2=0.0006, b1=-0.03, b2=0.004)
LENSES = {"barrel": WIDE, "pincushion": PINCUSHION, "uneven": UNEVEN, "none": None}


def camera_with(distortion):
    return Camera(0.0088, 19.3e-6, 456, 684, 230.2, 338.5, distortion)


def oblique(off_nadir_deg, up_m=1000.0):
    across = up_m * math.tan(math.radians(off_nadir_deg))
    return look_at(Pose(0.6 * across, -0.8 * across, up_m, 0.4, 0.05, -0.03), (0.0, 0.0, 0.0))


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("off_nadir_deg", [0.0, 50.0, 70.0])
def test_ground_to_detector_to_ground(lens, off_nadir_deg):
    camera, pose = camera_with(LENSES[lens]), oblique(off_nadir_deg)
    pixels = np.moveaxis(np.mgrid[:456:19, :684:19].astype(float), 0, -1)
    ground = ground_points(camera, pose, pixels, 12.0)
    down = np.isfinite(ground[..., 0])
    assert down.mean() > 0.5  # at 70° the rest looks over the horizon
    np.testing.assert_allclose(project(camera, pose, ground)[down], pixels[down], atol=THOUSANDTH_PX)
    there = project(camera, pose, ground)[down]
    again = ground_points(camera, pose, there, 12.0)
    element = np.linalg.norm(ground[down] - pose.position, axis=-1) * 19.3e-6 / 0.0088
    error = np.linalg.norm(np.cross(again - ground[down], rays(camera, pose, there)), axis=-1)
    assert (error / element).max() < HUNDREDTH_PX


def test_the_polynomial_is_browns():
    """By hand, at one place: x right, y down, in focal lengths."""
    lens = Distortion(k1=0.1, k2=0.02, k3=0.003, p1=0.01, p2=0.02, b1=-0.05, b2=0.01)
    camera = Camera(1.0, 1e-3, 1001, 1001, distortion=lens)
    x, y = 0.3, -0.2
    r2 = x * x + y * y
    radial = 1 + 0.1 * r2 + 0.02 * r2**2 + 0.003 * r2**3
    xd = x * radial + 2 * 0.01 * x * y + 0.02 * (r2 + 2 * x * x)
    yd = y * radial + 0.01 * (r2 + 2 * y * y) + 2 * 0.02 * x * y
    xd = xd - 0.05 * xd + 0.01 * yd
    found = project(camera, Pose(0, 0, 1), (x, -y, 0.0))  # straight down: east is right, north is up
    np.testing.assert_allclose(found, (500 + 1e3 * yd, 500 + 1e3 * xd), rtol=1e-12)


def test_points_beyond_the_fold_are_not_seen():
    camera = camera_with(Distortion(k1=-0.1))
    beyond = 1.01 / math.sqrt(3 * 0.1)  # where r + k1 r³ turns back
    assert np.isnan(project(camera, Pose(0, 0, 1), (beyond, 0.0, 0.0))).all()
    assert np.isfinite(project(camera, Pose(0, 0, 1), (0.97 * beyond, 0.0, 0.0))).all()


def test_a_lens_that_folds_within_the_array_is_refused():
    with pytest.raises(ValueError, match="`distortion` must image each place of the array"):
        camera_with(Distortion(k1=-2.0))
    with pytest.raises(ValueError, match="finite"):
        Distortion(k1=math.nan)
    assert camera_with(Distortion()).distortion is None  # costs nothing


@pytest.mark.parametrize("lens", [WIDE, UNEVEN])
@pytest.mark.parametrize("oversampling", [1, 2])
def test_the_renderer_looks_where_the_camera_does(oversampling, lens):
    camera, pose, n = Camera(0.01, 1e-4, 60, 90, distortion=lens), oblique(50.0), oversampling
    rows, columns = ((np.arange(count * n) + 0.5) / n - 0.5 for count in (60, 90))
    pixels = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    found = element_rays(camera, pose, np.arange(60 * 90), n).reshape(60, 90, n, n, 3)
    found = found.swapaxes(1, 2).reshape(pixels.shape[:2] + (3,))
    np.testing.assert_allclose(found, rays(camera, pose, pixels), atol=1e-6)


@pytest.mark.parametrize("lens", [WIDE, UNEVEN])
@pytest.mark.parametrize("method", ["nearest", "bilinear", "cubic"])
def test_rectification_undoes_it(method, lens):
    """A frame that holds its own coordinates, sampled where each cell is projected."""
    camera, pose = camera_with(lens), oblique(50.0)
    frame = np.moveaxis(np.mgrid[:456, :684].astype(np.float32), 0, -1)
    east, north = np.meshgrid(np.linspace(-300, 300, 41), np.linspace(300, -300, 37))
    height = 5 * np.sin(east / 40)
    where = project(camera, pose, np.stack([east, north, height], axis=-1))
    found = rectify_onto(frame, camera, pose, east, north, height, method)
    seen = np.isfinite(found).all(axis=-1)
    assert seen.mean() > 0.4
    tolerance = 0.5 + THOUSANDTH_PX if method == "nearest" else THOUSANDTH_PX
    np.testing.assert_allclose(found[seen], where[seen], atol=tolerance)
    # other places of the same lens, by superpixels
    coarse = rectify_onto(frame[::2, ::2], camera, pose, east, north, height, method, pitch=2.0)
    inner = np.isfinite(coarse).all(axis=-1) & seen
    if method != "nearest":
        np.testing.assert_allclose(coarse[inner], where[inner], atol=1.0)


# east, north, up [m], row, column by orthority 0.7.0's BrownCamera
PINNED = (
    (292471.26, 2731296.92, 40.00, 4.9970, 8.0066),
    (292928.55, 2731313.39, 40.00, 4.9994, 670.0040),
    (292706.93, 2731129.15, 40.00, 228.0113, 339.9946),
    (292601.41, 2731039.40, 40.00, 450.0006, 20.0094),
    (292819.60, 2731050.30, 40.00, 439.9892, 660.0065),
)


def test_places_are_those_of_orthority():
    """The same coefficients, with the same meaning; see `tests/ortho/test_against_orthority.py`."""
    columns, rows, focal_mm, pixel_mm = 684, 456, 8.8, 0.0192836
    place, opk = (292710.217, 2731048.771, 186.446), np.radians((28.8308728, 0.9402990, 1.7823248))
    camera = Camera(focal_mm * 1e-3, pixel_mm * 1e-3, rows, columns, distortion=WIDE)
    pose = from_omega_phi_kappa(place, *opk.tolist())
    pixels = np.moveaxis(np.mgrid[0:rows:45, 0:columns:45].astype(float), 0, -1)
    ground = ground_points(camera, pose, pixels, 40.0)
    rows_of = np.array(PINNED)
    np.testing.assert_allclose(project(camera, pose, rows_of[:, :3]), rows_of[:, 3:], atol=0.05)
    module = pytest.importorskip("orthority.camera", reason="orthority is not installed")
    oracle = module.BrownCamera(
        im_size=(columns, rows), focal_len=focal_mm, sensor_size=(columns * pixel_mm, rows * pixel_mm),
        xyz=place, opk=tuple(opk.tolist()), **WIDE.model_dump(exclude={"b1", "b2"}),
    )  # fmt: skip
    found = oracle.world_to_pixel(ground.reshape(-1, 3).T.copy())[::-1].T.reshape(pixels.shape)
    np.testing.assert_allclose(found, pixels, atol=0.05)


def test_an_uneven_scale_is_two_focal_lengths():
    """Across and down, as OpenCV's camera matrix and orthority's camera have them."""
    columns, rows, focal_mm, pixel_mm = 684, 456, 8.8, 0.02
    lens = Distortion(k1=-0.05, b1=-0.04)
    camera = Camera(focal_mm * 1e-3, pixel_mm * 1e-3, rows, columns, distortion=lens)
    pose = from_omega_phi_kappa((100.0, 200.0, 300.0), 0.4, -0.1, 0.3)
    pixels = np.moveaxis(np.mgrid[0:rows:45, 0:columns:45].astype(float), 0, -1)
    ground = ground_points(camera, pose, pixels, 40.0)
    module = pytest.importorskip("orthority.camera", reason="orthority is not installed")
    oracle = module.BrownCamera(
        im_size=(columns, rows), focal_len=(0.96 * focal_mm, focal_mm), k1=-0.05,
        sensor_size=(columns * pixel_mm, rows * pixel_mm), xyz=(100.0, 200.0, 300.0), opk=(0.4, -0.1, 0.3),
    )  # fmt: skip
    found = oracle.world_to_pixel(ground.reshape(-1, 3).T.copy())[::-1].T.reshape(pixels.shape)
    np.testing.assert_allclose(found, pixels, atol=HUNDREDTH_PX)
