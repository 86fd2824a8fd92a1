"""The detector on raw mosaics: closed forms, symmetries, causality, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from scipy import stats
from scipy.optimize import linear_sum_assignment

from glintrack.camera import Camera, Pose
from glintrack.core.records import Mosaic
from glintrack.track.calibration import read_calibration
from glintrack.track.design import DetectDesign
from glintrack.track.detect import mosaic_model as model
from glintrack.track.detect import mosaic_peaks
from glintrack.track.detect.detections import Association
from glintrack.track.detect.detector import detector_of
from glintrack.track.detect.frame import Frame, Grid
from glintrack.track.detect.median_motion import MedianMotionDetector
from glintrack.track.detect.mosaic import LAYERS, SPACING_S, MosaicDetector, StrengthLayer, _supporting_layers
from glintrack.track.detect.mosaic_peaks import FEATURES, MIN_RATIO, log_likelihood_ratio
from glintrack.track.detect.mosaic_windows import WINDOW_FEATURES
from tests.track.detect import mosaic_flight as flight
from tests.track.moving_blobs import image

DETECTOR = MosaicDetector(DetectDesign())


def fly(frames, detector=DETECTOR):
    """Detections of each frame, without a tracker."""
    state, out = detector.start(frames[0]), []
    for frame in frames:
        found = detector.detect(state, frame)
        out.append(found)
        state = detector.update(state, frame, found, Association(np.zeros(len(found), bool)))
    return out, state


def likeliest(found):
    return found.position[np.argmax(found.log_likelihood_ratio)]


@pytest.mark.parametrize("step_sigmas", [2.0, 3.5])
def test_step_in_known_noise_is_found_as_often_as_gaussian_noise_says(step_sigmas):
    rng = np.random.default_rng(1)
    camera, grid = Camera(0.1, 0.1 * 0.75 / 1000, 120, 120), Grid((50, 50), (-36.75, 36.75), 1.5)
    pose, sigma, level = Pose(0.0, 0.0, 1000.0), 30.0, 5000.0
    ground = model.empty_ground(grid, ((0, 0),), 1)
    none = np.zeros(ground.differed_s.shape, bool)

    def frame_of(light, time_s):
        noisy = light + sigma * rng.standard_normal((120, 120))
        mosaic = Mosaic(noisy, np.full((120, 120), sigma), (("open",),), np.ones((1, 1, 3)))
        return Frame(time_s, mosaic=mosaic, camera=camera, pose=pose)

    for k in range(40):  # the fit is then known to a few hundredths of the noise's variance
        seen = model.predict(ground, frame_of(level, 0.1 * k))
        ground = model.update_ground(ground, seen, none, 0.1 * k, 0.1)
    seen = model.predict(ground, frame_of(level + step_sigmas * sigma, 4.0))
    known = np.isfinite(seen.z2[0])
    assert known.sum() > 5000
    threshold = 3.0
    residual = (seen.readings[0] - seen.fitted[0][..., 0])[known] / sigma
    closed_form = stats.norm.sf(threshold - step_sigmas)
    assert np.mean(residual > threshold) == pytest.approx(closed_form, abs=0.02)


@pytest.mark.parametrize(("gsd_m", "side", "count"), [(0.4, 1, 1.0), (0.75, 1, 4.0), (0.375, 2, 4.0)])
def test_the_scale_rises_by_one_step_in_a_cell_of_many_elements(gsd_m, side, count):
    """Otherwise a vehicle of many elements hides itself from the next frame."""
    camera, grid = Camera(0.1, 1e-4 * gsd_m, 96, 96), Grid((12, 12), (-8.25, 8.25), 1.5)
    layout = tuple(("open",) * side for _ in range(side))

    def frame_of(level, time_s):
        noisy = np.full((96, 96), level), np.full((96, 96), 30.0)
        mosaic = Mosaic(*noisy, layout, np.ones((side, side, 3)))
        return Frame(time_s, mosaic=mosaic, camera=camera, pose=Pose(0.0, 0.0, 1000.0))

    ground = model.empty_ground(grid, ((0, 0),), side)
    none = np.zeros(ground.differed_s.shape, bool)
    for k in range(60):
        ground = model.update_ground(
            ground, model.predict(ground, frame_of(5e3, k / 30)), none, k / 30, 1 / 30
        )
    after = model.update_ground(ground, model.predict(ground, frame_of(6e3, 2.0)), none, 2.0, 1 / 30)
    rise = np.log(after.scales[0] / ground.scales[0])[8:-8, 8:-8]
    step = 4 * -np.expm1(-1 / 30 / (model.SCALE_SHARE * 2.0)) * model.SCALE_QUANTILE
    elements_at_the_edge_of_cells = 0.3
    assert rise.mean() / step == pytest.approx(count, rel=elements_at_the_edge_of_cells)


def test_what_is_expected_has_no_bias_and_little_variance():
    frames = flight.frames(10, "all", vehicle=False, noise=False)
    _, state = fly(frames)
    frame = frames[-1]
    seen = model.predict(state.ground, replace(frame, terrain=None))
    error = np.concatenate(
        [
            (r - e)[np.isfinite(e)]
            for r, e in zip(seen.readings, (f[..., 0] for f in seen.fitted), strict=True)
        ]
    )
    a_quarter_of_the_noise = 0.25 * np.sqrt(flight.ELECTRONS)
    assert abs(error.mean()) < a_quarter_of_the_noise
    assert np.quantile(np.abs(error), 0.9) < 2 * a_quarter_of_the_noise


@pytest.mark.parametrize("channel", ["pan", "all"])
def test_static_scene_under_a_moving_camera_has_few_false_detections(channel):
    found, _ = fly(flight.frames(12, channel, vehicle=False))
    likely = [int((one.log_likelihood_ratio > 0).sum()) for one in found]
    area_km2 = 0.09**2
    stated_per_km2 = 40.0
    assert np.mean(likely) / area_km2 < stated_per_km2


@pytest.mark.parametrize("channel", ["pan", "all"])
def test_moving_vehicle_is_found_where_it_is(channel):
    frames = flight.frames(9, channel)
    found, _ = fly(frames)
    a_flat_box_is_moved_back_by_a_cars_height_m = 0.8
    an_element_of_a_kind_on_the_ground_m = 2.3
    least_m = a_flat_box_is_moved_back_by_a_cars_height_m + an_element_of_a_kind_on_the_ground_m
    hits = [
        np.hypot(*(one.position - flight.place_of_vehicle(frame.time_s)).T).min(initial=np.inf) < least_m
        for frame, one in zip(frames[5:], found[5:], strict=True)
    ]
    assert sum(hits) >= len(hits) - 1  # a car lies on three elements of a kind: one frame may miss it


def test_places_stay_on_the_ground_where_roofs_take_the_map_with_them():
    """Half of the scene is 20 m high, and goes against the flight in what frames are registered to."""
    mean_m, map_m = {}, {}
    for roof_m in (0.0, 20.0):
        ahead = []
        for seed in range(5, 8):
            frames = flight.frames(16, "all", seed=seed, roof_m=roof_m)
            found, state = fly(frames)
            for frame, one in zip(frames[8:], found[8:], strict=True):
                gap = one.position - flight.place_of_vehicle(frame.time_s)
                nearest = np.hypot(*gap.T).argmin()
                ahead += [gap[nearest, 0]] if np.hypot(*gap[nearest]) < 3.0 else []
        mean_m[roof_m], map_m[roof_m] = np.mean(ahead), state.ground.shift_m[0]
    assert map_m[20.0] - map_m[0.0] > 0.4
    assert abs(mean_m[20.0] - mean_m[0.0]) < 0.55  # 0.88 by places on the map


def share_found_in_rows(gap_m, channel, frames):
    """Share of the vehicles in rows that are told, of each frame."""
    first, norths = np.arange(-150.0, 60.0, gap_m), (-30.0, -10.0, 10.0, 30.0)
    told, _ = fly(flight.frames(frames, channel, vehicle=False, rows=(first, norths)))
    out = []
    for k, one in enumerate(told):
        east = first + flight.SPEED_M_S * 0.5 * k
        places = np.array([(x, y) for x in east[np.abs(east) < 35.0] for y in norths])
        distance_m = np.hypot(*(one.position[:, None] - places).transpose(2, 0, 1))
        a_boxs_height_and_an_element_m = 3.1
        out.append((distance_m.min(axis=0, initial=np.inf) < a_boxs_height_and_an_element_m).mean())
    return out


@pytest.mark.parametrize("channel", ["pan", "all"])
def test_as_many_vehicles_are_told_as_there_are(channel):
    """Twelve in 90 m × 90 m: 1500 per km²."""
    assert np.mean(share_found_in_rows(24.0, channel, 10)[4:]) > 0.8


@pytest.mark.parametrize("channel", ["pan", "all"])
def test_cars_six_metres_apart_are_two_detections(channel):
    """Of three pairs, one behind the other, most cars have a detection of their own."""
    own = []
    for north in (-20.0, 0.0, 20.0):
        first = np.array([-50.0, -44.0])
        told, _ = fly(flight.frames(12, channel, vehicle=False, rows=(first, (north,))))
        for k, one in enumerate(told):
            east = first + flight.SPEED_M_S * 0.5 * k
            if k >= 5 and np.abs(east).max() < 40.0:
                far = np.hypot(*(one.position[:, None] - np.stack([east, 0 * east + north], 1)).T)
                alone_m = 3.1  # a box's height and an element, and nearer than the other car
                own.append(sum(kept < alone_m for kept in far[linear_sum_assignment(far)]))
    assert np.mean(own) / 2 > 0.8


@pytest.mark.parametrize(("channel", "least"), [("pan", 0.75), ("all", 0.83)])
def test_cars_of_the_first_frames_are_not_taken_for_ground(channel, least):
    """Under cars 12 m apart that drive 4 m a frame each place is under one in three frames of eight."""
    assert np.mean(share_found_in_rows(12.0, channel, 10)[4:]) > least


def test_motion_of_what_is_likeliest_is_that_of_the_vehicle():
    found, _ = fly(flight.frames(10))
    motions = [one.velocity[np.argmax(one.log_likelihood_ratio)] for one in found[5:]]
    a_step_between_the_motions_tried_m_s = 1.2
    error = np.abs(np.median(motions, axis=0) - [flight.SPEED_M_S, 0.0])
    assert (error <= a_step_between_the_motions_tried_m_s).all()


@pytest.mark.parametrize(("turn", "mirror"), [(np.pi / 2, False), (np.radians(30), False), (0.0, True)])
def test_turned_and_mirrored_scenes_give_turned_and_mirrored_detections(turn, mirror):
    straight, _ = fly(flight.frames(8))
    other, _ = fly(flight.frames(8, turn=turn, mirror=mirror))
    c, s = np.cos(turn), np.sin(turn)
    for a, b in zip(straight[5:], other[5:], strict=True):
        east, north = likeliest(a)
        east = -east if mirror else east
        one_and_a_half_cells_m = 1.2
        assert (
            np.hypot(*(likeliest(b) - [c * east - s * north, s * east + c * north])) < one_and_a_half_cells_m
        )


def test_nothing_leaks_from_later_frames_and_states_stay_as_they_are():
    frames = flight.frames(10)
    first, _ = fly(frames[:7])
    swapped = [
        *frames[:7],
        *(replace(a, mosaic=b.mosaic) for a, b in zip(frames[7:], frames[:3], strict=True)),
    ]
    second, _ = fly(swapped)
    for a, b in zip(first, second, strict=False):
        np.testing.assert_array_equal(a.position, b.position)
        np.testing.assert_array_equal(a.log_likelihood_ratio, b.log_likelihood_ratio)
    _, state = fly(frames[:6])
    once = DETECTOR.detect(state, frames[6])
    DETECTOR.update(state, frames[6], once, Association(np.zeros(len(once), bool)))
    np.testing.assert_array_equal(once.position, DETECTOR.detect(state, frames[6]).position)


def test_mirrors_that_fed_the_spectrometer_have_no_say():
    frames = flight.frames(8)
    dark = []
    for frame in frames:
        electrons = frame.mosaic.electrons.copy()
        electrons[40:44:2, 60:64:2] = np.nan
        dark.append(replace(frame, mosaic=replace(frame.mosaic, electrons=electrons)))
    found, state = fly(dark)
    assert all(np.isfinite(one).all() for one in state.ground.maps)
    assert np.hypot(*(likeliest(found[-1]) - flight.place_of_vehicle(3.5))) < 2.5


@pytest.mark.parametrize("missing", ["mosaic", "camera", "pose"])
def test_frame_without_its_raw_parts_is_refused_by_name(missing):
    frame = replace(flight.frames(1)[0], **{missing: None})
    with pytest.raises(ValueError, match=rf"`frame\.{missing}` must be given"):
        DETECTOR.start(frame)


def test_mosaic_of_another_layout_is_refused():
    frames = flight.frames(2)
    _, state = fly(frames[:1])
    other = replace(frames[1].mosaic, layout=((0.0, 60.0), (120.0, "mirror")))
    with pytest.raises(ValueError, match="`mosaic` must keep the first frame's layout"):
        DETECTOR.detect(state, replace(frames[1], mosaic=other))
    bare = replace(frames[0].mosaic, layout=(("open",),))
    with pytest.raises(ValueError, match="three polarizers in a superpixel for channel 'dolp'; got 0"):
        DETECTOR.start(replace(frames[0], mosaic=bare, channel="dolp"))


def test_hills_are_followed_by_the_terrain():
    frames = flight.frames(2)
    hill = xr.Dataset(
        {"height": (("y", "x"), np.full((2, 2), 40.0), {"units": "m"})},
        coords={"x": ("x", [-200.0, 200.0], {"units": "m"}), "y": ("y", [200.0, -200.0], {"units": "m"})},
    )
    _, low = fly(frames)
    seen = model.predict(low.ground, replace(frames[1], time_s=1.0, terrain=None))
    raised = model.predict(low.ground, replace(frames[1], time_s=1.0, terrain=hill))
    toward_camera_m = 40.0 * np.tan(np.radians(50.0))
    moved = np.hypot(raised.x - seen.x, raised.y - seen.y)[80, 100] * model.CELL_M
    assert moved == pytest.approx(toward_camera_m, rel=0.02)


def test_neither_what_stands_nor_an_empty_place_is_likelier_than_what_moves():
    moving, standing, nothing = (
        np.array([[np.sqrt(s), 1.5, still, np.sqrt(still), 0.3, np.sqrt(0.3), np.log(0.1)]])
        for s, still in ((1.4, 0.4), (1.4, 1.4), (0.3, 0.3))
    )
    # a car of even change, a quarter brighter than the ground, with little change around it
    signed = {"across_root": 1.2, "signed": 1.8, "evidence": 2.0, "contrast": 0.25, "disagreement": 0.04}
    signed |= {"ring_signed": 0.1, "ring_evidence": 0.3, "ring_contrast": 0.03, "ring_disagreement": 0.02}
    values = [
        signed[name] if name in signed else np.sqrt(signed[name.removesuffix("_root")])
        for name in WINDOW_FEATURES
    ]
    for channel in ("pan", "dolp", "all"):
        around = np.array([values if channel == "all" else []])
        likely, still, weak = (
            log_likelihood_ratio(channel, np.hstack([one, around])).item()
            for one in (moving, standing, nothing)
        )
        assert likely > 0 > weak
        assert still < likely - 3


def test_raw_mosaics_are_searched_raw_and_rectified_frames_rectified():
    raw = flight.frames(1, "all")[0]
    rectified = image(np.ones((20, 20), np.float32), (0.0, 0.0, 30.0, 30.0), 1.5)
    assert isinstance(detector_of(DetectDesign(), raw), MosaicDetector)
    assert isinstance(detector_of(DetectDesign(), Frame(0.0, rectified)), MedianMotionDetector)
    assert isinstance(detector_of(DetectDesign(detector="median-motion"), raw), MedianMotionDetector)


def test_vehicles_faster_than_the_greatest_speed_have_less_evidence():
    """The vehicle drives 8 m/s: with 5 m/s as the greatest speed no motion leads along its way."""
    frames = flight.frames(10)
    found, slow = (fly(frames, MosaicDetector(DetectDesign(max_speed_m_s=v)))[0][-1] for v in (22.0, 5.0))
    support, less = (one.detail.peaks.features[one.detail.ratio.argmax(), 0] for one in (found, slow))
    assert less < 0.95 * support
    assert np.hypot(*slow.velocity.T).max() <= 5.0
    assert found.velocity_most_m_s == 22.0 and slow.velocity_most_m_s == 5.0


def test_a_state_stays_as_it_is():
    frames = flight.frames(9, "all")
    _, state = fly(frames[:8])
    before = [one.copy() for one in state.ground.maps]
    found = DETECTOR.detect(state, frames[8])
    DETECTOR.update(state, frames[8], found, Association(np.zeros(len(found), bool)))
    assert all(np.array_equal(one, was) for one, was in zip(state.ground.maps, before, strict=True))


@pytest.mark.parametrize("rate_hz", [2.0, 5.0, 10.0, 30.0])
def test_frames_that_support_a_peak_lie_as_far_apart_at_any_rate(rate_hz):
    layers = tuple(StrengthLayer(k / rate_hz, np.full((1, 1), k)) for k in range(round(4 * rate_hz)))
    apart_s = np.diff([0.0, *(4.0 - layer.time_s for layer in _supporting_layers(layers, 4.0))])
    assert len(apart_s) == LAYERS
    assert np.all((apart_s >= SPACING_S) & (apart_s < SPACING_S + 1 / rate_hz))


@pytest.mark.parametrize("channel", ["pan", "dolp", "all"])
def test_ratios_of_detections_weigh_against_the_clutter_that_is_detected(channel, monkeypatch):
    """Of clutter, the mean of a likelihood ratio is 1: among all peaks, and among those detected."""
    rng, gap = np.random.default_rng(4), 3.0  # between the means, in their common standard deviation
    vehicle, clutter = (gap * rng.normal(side * gap / 2, 1.0, 1_000_000) for side in (1, -1))
    assert np.exp(clutter).mean() == pytest.approx(1.0, abs=0.1)
    shares = [np.mean(ratio > MIN_RATIO) for ratio in (vehicle, clutter)]
    known = {"detection_ratio": {channel: np.log(shares[0] / shares[1])}}
    calibration = replace(read_calibration("mosaic"), constants=known)
    monkeypatch.setattr(mosaic_peaks, "read_calibration", lambda name: calibration)
    detected = clutter[clutter > MIN_RATIO]
    assert np.exp(detected).mean() > 5.0
    assert np.exp(mosaic_peaks.detection_ratio(channel, detected)).mean() == pytest.approx(1.0, abs=0.1)


def test_vehicles_are_detected_much_more_often_than_clutter():
    known = read_calibration("mosaic")
    ratios = known.constants["detection_ratio"]
    assert ratios.keys() == known.models.keys()
    assert all(np.log(5) < ratio < np.log(200) for ratio in ratios.values())
    assert all(model.features == FEATURES[channel] for channel, model in known.models.items())
