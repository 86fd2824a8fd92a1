"""Detectors and statistics by name: what they find, what they leave alone, and the closed forms."""

import sys

import numpy as np
import pytest

from glintrack import track
from glintrack.track.design import TrackDesign
from glintrack.track.detect import change
from tests.track.moving_blobs import grid, image, paint_cars, texture

EXTENT = (-60.0, -45.0, 60.0, 45.0)
GSD = 1.5
CARS = ((-50.0, 15.0, np.pi / 2, 9.0), (50.0, -15.0, 1.5 * np.pi, 7.0))


def frames(count, contrast, dolp_contrast, noise=0.01, interval_s=0.5):
    """Two cars that differ from the ground in radiance, in DoLP, or in both."""
    rng = np.random.default_rng(5)
    shape = tuple(len(axis) for axis in grid(EXTENT, GSD))[::-1]
    ground = texture(shape, GSD, rng)
    degree = np.full(shape, 0.1, np.float32)
    for k in range(count):
        t = interval_s * k
        places = [(e + v * t * np.sin(h), n + v * t * np.cos(h), h) for e, n, h, v in CARS]
        pan = paint_cars(ground, EXTENT, GSD, [(*p, 4.5, 1.8, 0.15 + contrast) for p in places])
        dolp = paint_cars(degree, EXTENT, GSD, [(*p, 4.5, 1.8, 0.1 + dolp_contrast) for p in places])
        if contrast == 0:
            pan = ground
        pan = 40 * (pan + rng.normal(0, noise, shape))
        dolp = np.clip(dolp + rng.normal(0, noise, shape), 0, 1)
        yield t, image(pan.astype(np.float32), EXTENT, GSD, dolp.astype(np.float32)), np.array(places)[:, :2]


def hits(design, contrast, dolp_contrast, count=12):
    """Share of the cars found in the second half of the frames, and other detections a frame."""
    state, found, others = track.start(design), [], []
    for t, frame, cars in frames(count, contrast, dolp_contrast):
        state, _ = track.step(state, track.Frame(t, frame))
        if t >= 0.25 * count:
            position = state.detections.position
            apart = np.hypot(*(cars[:, None] - position[None]).transpose(2, 0, 1))
            near = apart <= 3.0
            found.append(near.any(axis=1).mean())
            others.append((~near.any(axis=0)).sum())
    return np.mean(found), np.mean(others), state


@pytest.mark.parametrize("detector", ["background", "three-frame", "mog2"])
def test_every_detector_finds_cars_and_little_else(detector):
    if detector == "mog2":
        pytest.importorskip("cv2", reason="needs the extra opencv")
    found, others, _ = hits(TrackDesign().replace({"detect.detector": detector}), 0.35, 0.0)
    assert found == 1.0
    assert others <= 1.0


def test_three_frames_say_nothing_before_the_third():
    state = track.start(TrackDesign().replace({"detect.detector": "three-frame"}))
    for t, frame, _ in frames(2, 0.35, 0.0):
        state, _ = track.step(state, track.Frame(t, frame))
        assert len(state.detections) == 0


def test_mog2_without_opencv_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    _, frame, _ = next(frames(1, 0.35, 0.0))
    with pytest.raises(ValueError, match="the extra `opencv` must be installed"):
        track.step(track.start(TrackDesign().replace({"detect.detector": "mog2"})), track.Frame(0.0, frame))


def test_mog2_cannot_go_back():
    pytest.importorskip("cv2", reason="needs the extra opencv")
    (t0, first, _), (t1, second, _) = frames(2, 0.35, 0.0)
    start, _ = track.step(
        track.start(TrackDesign().replace({"detect.detector": "mog2"})), track.Frame(t0, first)
    )
    track.step(start, track.Frame(t1, second))
    with pytest.raises(ValueError, match="`state` must be the latest"):
        track.step(start, track.Frame(t1, second))


@pytest.mark.parametrize(
    ("contrast", "dolp_contrast", "sees"),
    [(0.35, 0.0, {"pan", "all"}), (0.0, 0.4, {"dolp", "all"})],
)
def test_channels_see_what_is_in_their_planes(contrast, dolp_contrast, sees):
    """Cars that show only in one plane: the other misses them, the fused channel does not."""
    for name in ("pan", "dolp", "all"):
        found, _, _ = hits(TrackDesign().replace({"detect.channel": name}), contrast, dolp_contrast)
        assert (found >= 0.9) == (name in sees), name


def test_two_weak_changes_make_one_that_is_seen():
    """Each plane's change lies at 2.5 noise scales: below the threshold of 3, together √12.5 = 3.54 above
    the fused threshold of 3.44."""
    assert 2.5**2 < change.fused_level2(3.0, 1) == 9.0
    assert 2 * 2.5**2 > change.fused_level2(3.0, 2)


def test_fused_threshold_keeps_the_rate_of_false_alarms():
    """Of Gaussian noise: P(χ²₁ > t²) = P(χ²₂ > s)."""
    chi2 = pytest.importorskip("scipy.stats").chi2
    for threshold in (1.0, 3.0, 6.0):
        s = change.fused_level2(threshold, 2)
        assert chi2.sf(s, 2) == pytest.approx(chi2.sf(threshold**2, 1), rel=1e-9)


def test_missing_plane_adds_nothing():
    pan, dolp = np.array([[4.0, -1.0, -1.0]], np.float32), np.array([[-1.0, 3.0, -1.0]], np.float32)
    assert change.fused([pan, dolp]).tolist() == [[4.0, 3.0, -1.0]]


def test_dolp_below_its_threshold_is_all_alike():
    """Change from 0.1 to 0.2 is none where 0.3 is the threshold; change to 0.5 is one."""
    design = TrackDesign().replace({"detect.channel": "dolp", "detect.dolp_threshold": 0.3})
    assert hits(design, 0.0, 0.1)[0] == 0.0
    assert hits(design, 0.0, 0.4)[0] == 1.0


def test_what_is_occluded_has_no_data():
    """A mask over half of the frame: nothing is found there, and its background stays unknown."""
    state = track.start()
    for t, frame, _ in frames(8, 0.35, 0.0):
        hidden = np.zeros(frame["pan"].shape, np.int8)
        hidden[:, :40] = 1
        masked = frame.assign(occluded=(("y", "x"), hidden, {"units": "1"}))
        state, _ = track.step(state, track.Frame(t, masked))
    assert np.isnan(state.memory.memory["pan"].mean[:, :40]).all()
    assert (state.detections.position[:, 0] > EXTENT[0] + 39 * GSD).all()


def test_unknown_detector_is_one_sentence():
    with pytest.raises(ValueError, match=r"`detect.detector` must be .*background"):
        TrackDesign().replace({"detect.detector": "optical-flow"})
