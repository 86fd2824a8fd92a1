"""The same frames by orthority (Harris et al., AGPL; a test's oracle, never imported by the product).

Numbers in `PINNED` were computed with orthority 0.7.0's frame camera; where it is installed it is asked
again.
"""

import warnings

import numpy as np
import pytest

from glintrack.camera import Camera, from_omega_phi_kappa, ground_points, project
from glintrack.ortho import rectify_onto

TWENTIETH_PX = 0.05
CUBIC_PX = 0.07  # OpenCV's cubic kernel bends a slope by 0.048 pixel, and OpenCV 4 rounds places to 1/32
# An Intergraph DMC's image reduced twelve times (orthority's own example: South Africa's NGI), and an oblique
# from a drone's flight; size (columns, rows), focal length and pixel [mm], place [m], omega phi kappa [°]
REAL = {
    "DMC 3324c_2015_1004_05_0182": (
        (640, 1152), 120.0, 0.144,
        (-55094.50448, -3727407.03748, 5258.30793),
        (-0.349216, 0.298484, -179.086702),
    ),
    "DJI 100_0005_0142": (
        (684, 456), 8.8, 0.0192836,
        (292710.2172910783, 2731048.771034353, 186.44574655349854),
        (28.8308728, 0.9402990, 1.7823248),
    ),
}  # fmt: skip
OBLIQUE = ((880, 560), 68.0, 0.017, (-2100.0, -900.0, 1928.0), (23.0, -49.0, 18.0))
CASES = {**REAL, "oblique": OBLIQUE}
# east, north, up [m], row, column
PINNED = {
    "DMC 3324c_2015_1004_05_0182": [
        (-53453.99, -3730317.96, 1054.66, -0.4122, -0.2236),
        (-55731.98, -3730362.66, 1054.66, -0.4111, 450.0960),
        (-54224.91, -3729571.04, 1054.66, 149.6942, 149.8819),
        (-56504.83, -3729613.59, 1054.66, 149.6938, 600.2015),
    ],
    "DJI 100_0005_0142": [
        (292527.31, 2731258.06, 40.29, -5.4272, -3.8629),
        (292758.51, 2731266.40, 40.29, -5.4170, 451.2261),
        (292627.39, 2731164.46, 40.29, 145.3410, 147.2894),
        (292812.53, 2731171.07, 40.29, 145.3363, 603.6614),
    ],
    "oblique": [
        (-191.36, 18.67, 3.00, -0.8366, 3.0204),
        (321.65, 156.82, 3.00, -0.7284, 452.8814),
        (-186.35, -91.29, 3.00, 149.2519, 3.0536),
        (322.33, 29.30, 3.00, 149.3437, 452.9091),
    ],
}


def cameras(case):
    """Ours, and the arguments of theirs."""
    (columns, rows), focal_mm, pixel_mm, place, opk_deg = CASES[case]
    camera = Camera(focal_mm * 1e-3, pixel_mm * 1e-3, rows, columns)
    opk = np.radians(opk_deg)
    theirs = {
        "im_size": (columns, rows),
        "focal_len": focal_mm,
        "sensor_size": (columns * pixel_mm, rows * pixel_mm),
        "xyz": place,
        "opk": tuple(opk.tolist()),
    }
    return camera, from_omega_phi_kappa(place, *opk.tolist()), theirs


def ground_of(case, step=40):
    camera, pose, _ = cameras(case)
    pixels = np.stack(np.mgrid[0 : camera.rows : step, 0 : camera.columns : step], axis=-1).astype(float)
    level = 0.0 if case == "oblique" else pose.up_m * 0.2
    return pixels, ground_points(camera, pose, pixels, level)


@pytest.mark.parametrize("case", CASES)
def test_ground_points_fall_where_orthority_puts_them(case):
    module = pytest.importorskip("orthority.camera", reason="orthority is not installed")
    camera, pose, theirs = cameras(case)
    pixels, ground = ground_of(case)
    oracle = module.PinholeCamera(**theirs)
    found = oracle.world_to_pixel(ground.reshape(-1, 3).T.copy())[::-1].T.reshape(pixels.shape)
    np.testing.assert_allclose(found, pixels, atol=TWENTIETH_PX)
    np.testing.assert_allclose(project(camera, pose, ground), found, atol=TWENTIETH_PX)
    back = oracle.pixel_to_world_z(pixels.reshape(-1, 2)[:, ::-1].T.copy(), ground[0, 0, 2])
    np.testing.assert_allclose(back.T.reshape(ground.shape), ground, atol=1e-4)


@pytest.mark.parametrize("method", ["nearest", "bilinear", "cubic"])
@pytest.mark.parametrize("case", CASES)
def test_rectified_frames_agree_with_orthoritys(case, method):
    """Frames that hold their own coordinates: a difference in value is a difference in pixels."""
    module = pytest.importorskip("orthority.camera", reason="orthority is not installed")
    camera, pose, theirs = cameras(case)
    _, ground = ground_of(case)
    inner = ground[2:-2, 2:-2]
    west, south = inner[..., 0].min(), inner[..., 1].min()
    span = min(np.ptp(inner[..., 0]), np.ptp(inner[..., 1]))
    x, y = np.meshgrid(west + span * np.linspace(0, 1, 90), south + span * np.linspace(1, 0, 80))
    z = ground[0, 0, 2] + 0.01 * span * np.sin(x / span * 9) * np.cos(y / span * 7)
    frame = np.moveaxis(np.mgrid[: camera.rows, : camera.columns].astype(np.float32), 0, -1)
    ours = rectify_onto(frame, camera, pose, x, y, z, method)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        oracle = module.PinholeCamera(**theirs)
        bands = np.ascontiguousarray(np.moveaxis(frame, -1, 0))
        found, _ = oracle.remap(bands, x, y, z, nodata=float("nan"), interp=module.Interp(method))
    found = np.moveaxis(found, 0, -1)
    both = np.isfinite(ours).all(-1) & np.isfinite(found).all(-1)
    # at the frame's edge a cubic kernel lacks pixels, which OpenCV 4 and 5 replace differently
    both &= ((ours > 2) & (ours < [camera.rows - 3, camera.columns - 3])).all(-1)
    assert both.mean() > 0.3
    difference = np.abs(ours - found)[both]
    if method == "nearest":  # a place between two pixels may round either way
        assert (difference > TWENTIETH_PX).mean() < 0.01 and difference.max() <= 1
    else:
        assert difference.max() < (CUBIC_PX if method == "cubic" else TWENTIETH_PX)


@pytest.mark.parametrize("case", PINNED)
def test_ground_points_fall_where_orthority_once_put_them(case):
    camera, pose, _ = cameras(case)
    rows = np.array(PINNED[case])
    np.testing.assert_allclose(project(camera, pose, rows[:, :3]), rows[:, 3:], atol=TWENTIETH_PX)
