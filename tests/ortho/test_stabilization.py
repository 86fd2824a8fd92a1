"""Frames of a camera that moves over painted ground, with homographies that are known."""

import numpy as np
import pytest
from scipy import ndimage

from glintrack.io.orthoimages import FrameSource, Geotransform, image_of
from glintrack.ortho.stabilization import (
    KERNEL_PX,
    MAX_SIDES,
    plan_grid,
    register_frames,
    stabilize,
    transform_points,
    warp_frame,
)

cv2 = pytest.importorskip("cv2")
SHAPE = (200, 240)
A_QUARTER_PIXEL = 0.25


def ground(side=620, seed=0):
    """Roofs and streets: rectangles of many sizes, slightly blurred."""
    rng, values = np.random.default_rng(seed), np.full((side, side), 40.0)
    for _ in range(1500):
        (r, c), (h, w) = rng.integers(0, side, 2), rng.integers(4, 30, 2)
        values[r : r + h, c : c + w] = rng.uniform(20, 200)
    return ndimage.gaussian_filter(values, 0.8).astype(np.float32)


def onto_ground(k):
    """Homography of frame k onto the ground: it moves, turns and leans."""
    turn = np.radians(1.3 * k)
    c, s = np.cos(turn), np.sin(turn)
    move = np.array([[c, -s, 150.0 + 4 * k], [s, c, 160.0 - 3 * k], [0, 0, 1]])
    return move @ np.array([[1, 0, 0], [0, 1, 0], [1e-5 * k, -8e-6 * k, 1]])


def seen(values, onto):
    """Frame of a camera over the ground."""
    return cv2.warpPerspective(values, np.linalg.inv(onto), SHAPE[::-1], flags=cv2.INTER_CUBIC)


def corners():
    return np.array([[0.0, 0.0], [SHAPE[1], 0.0], [SHAPE[1], SHAPE[0]], [0.0, SHAPE[0]]])


def error_px(found, k, first=0):
    """Greatest error of a frame's corners in the first frame."""
    true = np.linalg.inv(onto_ground(first)) @ onto_ground(k)
    return np.abs(transform_points(found, corners()) - transform_points(true, corners())).max()


def test_homographies_are_found_and_do_not_drift():
    """There and back: the last frame is as near as the second, by the first keyframe."""
    way = [0, 3, 6, 9, 12, 15, 18, 21, 24, 20, 14, 8, 2]
    found = list(register_frames(seen(ground(), onto_ground(k)) for k in way))
    errors = [error_px(one, k) for one, k in zip(found, way, strict=True)]
    assert max(errors) < 4 * A_QUARTER_PIXEL and errors[-1] < A_QUARTER_PIXEL


def test_a_frame_of_another_place_is_left_out_and_the_next_one_found_again():
    frames = [seen(ground(), onto_ground(k)) for k in (0, 1, 2)]
    frames[1] = seen(ground(seed=9), onto_ground(1))
    first, other, again = register_frames(frames)
    assert other is None and error_px(first, 0) == 0 and error_px(again, 2) < A_QUARTER_PIXEL


def test_frames_without_features_are_refused():
    found = list(register_frames([np.full(SHAPE, 7.0, np.float32)] * 3))
    assert found == [None] * 3
    with pytest.raises(ValueError, match="`frames` must have 60 features that match to be stabilized"):
        plan_grid(found, SHAPE)


def test_nothing_near_the_border_is_resampled():
    """A frame of 1 with its borders and a hole: what is left is 1, and farther from both than the kernel."""
    image = np.ones(SHAPE, np.float32)
    image[80:90, 100:110] = np.nan
    out = warp_frame(image, np.array([[1.0, 0, 20.4], [0, 1.0, 10.6], [0, 0, 1]]), (230, 290))
    known = np.isfinite(out)
    np.testing.assert_allclose(out[known], 1, atol=1e-6)
    rows, columns = np.nonzero(known)
    assert rows.min() >= 10.6 + KERNEL_PX - 0.5 and columns.min() >= 20.4 + KERNEL_PX - 0.5
    assert not known[88:103, 118:133].any() and known.sum() > 0.9 * image.size


def test_the_grid_is_bounded():
    """A frame far away does not make it large."""
    far = np.array([[1.0, 0, 1e7], [0, 1.0, 0], [0, 0, 1]])
    rows, columns = plan_grid([np.eye(3), np.eye(3), far], SHAPE).shape
    assert columns <= (1 + 2 * MAX_SIDES) * SHAPE[1] + 2 and rows <= SHAPE[0] + 2


def test_ground_stays_in_its_place():
    """Stabilized frames agree with each other, and the reference frame keeps its place."""
    place = Geotransform(500.0, 900.0, 0.5)
    frames = [seen(ground(), onto_ground(k)) for k in range(5)]

    def source():
        made = ((float(k), image_of({"pan": frame}, place)) for k, frame in enumerate(frames))
        return FrameSource(5, None, False, made)

    images = [image for _, image in stabilize(source(), list(register_frames(frames))).frames]
    stack = np.stack([image["pan"].values for image in images])
    inside = np.isfinite(stack).all(axis=0)
    spread = np.ptp(stack, axis=0)[inside]
    assert inside.sum() > 0.5 * frames[0].size and np.median(spread) < 0.1 * np.ptp(frames[0])
    x, y = images[2]["x"].values, images[2]["y"].values
    column, row = np.argmin(np.abs(x - 560.25)), np.argmin(np.abs(y - 849.75))
    np.testing.assert_allclose(stack[2, row, column], frames[2][100, 120], rtol=1e-3)
