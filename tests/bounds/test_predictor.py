"""The frozen predictor on made scenes: a plane is met exactly, vehicles are left out, motion is followed."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.bounds.predictor import PastFrame, predict
from glintrack.camera import Pose, ground_points
from glintrack.core.distortion import Distortion
from tests.conftest import small_camera

SIZE = 40
CAMERA = small_camera(SIZE, SIZE, 40.0)


def pixels():
    return np.moveaxis(np.mgrid[:SIZE, :SIZE], 0, -1)


def scene(east, north):
    """Electrons that rise by 20 a metre eastward and 5 a metre northward."""
    return 2000.0 + 20.0 * east + 5.0 * north


def past(poses, electrons=None, hidden=None):
    out = []
    for k, pose in enumerate(poses):
        place = ground_points(CAMERA, pose, pixels())
        values = scene(place[..., 0], place[..., 1]) if electrons is None else electrons[k]
        out.append(
            PastFrame(values, np.zeros((SIZE, SIZE), bool) if hidden is None else hidden[k], pose, 0.5 * k)
        )
    return out


def poses(count, step_m=1.3):
    return [Pose(step_m * k, 0.4 * k, 1000.0) for k in range(count)]


@pytest.mark.parametrize("distortion", [None, Distortion(k1=300.0, p1=5.0, p2=-3.0)])
def test_a_plane_is_predicted_from_moving_frames(distortion, monkeypatch):
    monkeypatch.setattr(f"{__name__}.CAMERA", replace(CAMERA, distortion=distortion))
    *before, now = poses(6)
    place = ground_points(CAMERA, now, pixels())
    found = predict(past(before), place, CAMERA, 2, 2.5)
    inner = slice(12, -12)
    expected = scene(place[..., 0], place[..., 1])
    np.testing.assert_allclose(found.electrons[inner, inner], expected[inner, inner], atol=2.0)
    assert np.nanmax(found.variance[inner, inner]) < 10.0


def test_kinds_of_elements_do_not_mix():
    """Each kind of a 2 × 2 superpixel has a level of its own; four frames a whole element apart."""
    kinds = np.tile([[1000.0, 2000.0], [3000.0, 4000.0]], (SIZE // 2, SIZE // 2))
    before = [Pose(float(2 * k), 0.0, 1000.0) for k in range(4)]
    place = ground_points(CAMERA, before[-1], pixels())
    found = predict(past(before, [kinds] * 4), place, CAMERA, 2, 2.0)
    inner = slice(12, -12)
    np.testing.assert_allclose(found.electrons[inner, inner], kinds[inner, inner], atol=1.0)


def test_what_is_hidden_is_left_out():
    level = np.full((SIZE, SIZE), 500.0)
    wrong, hidden = level.copy(), np.zeros((SIZE, SIZE), bool)
    wrong[15:25, 15:25], hidden[15:25, 15:25] = 9000.0, True
    before = [Pose(0.0, 0.0, 1000.0)] * 4
    place = ground_points(CAMERA, before[0], pixels())
    masked = predict(
        past(before, [wrong, level, level, level], [hidden] + [~hidden & hidden] * 3), place, CAMERA, 2, 2.0
    )
    np.testing.assert_allclose(masked.electrons[10:30, 10:30], 500.0, atol=1e-3)


def test_disagreement_of_the_past_is_the_predictions_variance():
    """Frames of 400 and 600 in turn lie 100 from their mean.

    Weights of age and distance leave some ten samples, of which the plane takes three, and its own value is
    off by a tenth of their variance: √(100² · 10/7 · 1.1) = 125.
    """
    frames = [np.full((SIZE, SIZE), 400.0 if k % 2 else 600.0) for k in range(8)]
    before = [Pose(0.0, 0.0, 1000.0)] * 8
    found = predict(past(before, frames), ground_points(CAMERA, before[0], pixels()), CAMERA, 2, 4.0)
    assert np.sqrt(found.variance[20, 20]) == pytest.approx(125.0, rel=0.05)


def test_nothing_is_known_without_a_past_or_off_its_frames():
    place = ground_points(CAMERA, Pose(0.0, 0.0, 1000.0), pixels())
    assert np.isnan(predict([], place, CAMERA, 2, 0.0).electrons).all()
    far = predict(past([Pose(500.0, 0.0, 1000.0)] * 3), place, CAMERA, 2, 2.0)
    assert np.isnan(far.electrons).all()
