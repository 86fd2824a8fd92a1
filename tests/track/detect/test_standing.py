"""Vehicles that stand: places that differ from their surroundings, and ground that is kept below them."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.track.design import DetectDesign
from glintrack.track.detect import mosaic_model as model
from glintrack.track.detect.detections import Association
from glintrack.track.detect.mosaic import FULL_SHARE, MosaicDetector, _follow
from glintrack.track.detect.standing import hold_s, is_occupied, select_standing, standing_ratio
from tests.track.detect import mosaic_flight as flight

DETECTOR = MosaicDetector(DetectDesign())
STOP_S, STOP_M = 5.0, 40.0  # the vehicle drives 8 m/s until then
STOPPED = np.array([[-25.0 + STOP_M, 5.0]])


def travel(time_s):
    """Way of a vehicle that stops at once and drives off again after 6 s. [m]"""
    return 8.0 * (min(time_s, STOP_S) + max(time_s - STOP_S - 6.0, 0.0))


def fly(frames, is_slow):
    """Detections of each frame; a track is slow at `STOPPED` at the times for which ``is_slow`` is true."""
    state, out = DETECTOR.start(frames[0]), []
    for frame in frames:
        frame = replace(frame, slow_m=STOPPED if is_slow(frame.time_s) else np.empty((0, 2)))
        found = DETECTOR.detect(state, frame)
        out.append(found)
        nobody = Association(np.zeros(len(found), bool))
        state = DETECTOR.update(state, frame, found, nobody)
    return out


def found_near(found, place_m):
    """Return True for a detection near a place that is likelier a vehicle than clutter."""
    likely = found.log_likelihood_ratio > 0.3
    return bool((likely & (np.hypot(*(found.position - place_m).T) < 2.5)).any())


@pytest.mark.parametrize("channel", ["pan", "all"])
def test_a_vehicle_that_stands_stays_detected_where_a_track_is_slow(channel):
    frames = flight.frames(22, channel, travel=travel)
    tracked = fly(frames, lambda t: STOP_S <= t)
    alone = fly(frames, lambda t: False)
    late = [k for k, frame in enumerate(frames) if 8.0 <= frame.time_s <= 10.5]
    assert np.mean([found_near(tracked[k], STOPPED) for k in late]) > 0.8
    assert np.mean([found_near(alone[k], STOPPED) for k in late]) < 0.3


def test_an_empty_place_is_no_vehicle_although_a_track_stays_there():
    """The vehicle has become ground where nothing held it; it drives off at 11 s and leaves a hole."""
    frames = flight.frames(26, travel=travel)
    left = [k for k, frame in enumerate(frames) if frame.time_s >= 12.0]
    stays = fly(frames, lambda t: t > STOP_S + 5.5)
    assert not any(found_near(stays[k], STOPPED) for k in left)


def grid_of_light(light, side=1):
    """Elements that see a cell of 0.75 m each, and their readings by kind."""
    i, j = np.mgrid[: light.shape[0], : light.shape[1]].astype(np.float32)
    kinds = tuple((a, b) for a in range(side) for b in range(side))
    return (i, j), (kinds, side, tuple(light[a::side, b::side] for a, b in kinds))


@pytest.mark.parametrize("side", [1, 2])
@pytest.mark.parametrize(("factor", "occupied"), [(1.0, False), (1.1, False), (1.4, True), (0.6, True)])
def test_a_car_brighter_or_darker_than_the_road_occupies_its_place(factor, occupied, side):
    light = np.full((40, 40), 1000.0, np.float32)
    light[17:23, 17:23] *= factor  # 4.5 m
    element, kinds = grid_of_light(light, side)
    place = np.array([[20 * 0.75, -20 * 0.75], [0.0, 0.0], [500.0, 0.0]])
    found = is_occupied(place, (0.0, 0.0), 0.75, element, kinds)
    np.testing.assert_array_equal(found, [occupied, False, False])


def test_a_wide_change_of_brightness_and_missing_readings_occupy_nothing():
    light = np.full((40, 40), 1000.0, np.float32)
    light[:, 20:] = np.nan
    element, kinds = grid_of_light(light)
    places = np.array([[18 * 0.75, -20 * 0.75], [30 * 0.75, -20 * 0.75]])
    assert not is_occupied(places, (0.0, 0.0), 0.75, element, kinds).any()
    black, kinds = grid_of_light(np.zeros((40, 40), np.float32))
    assert not is_occupied(places, (0.0, 0.0), 0.75, black, kinds).any()
    slope, kinds = grid_of_light(np.linspace(900, 1100, 40, dtype=np.float32)[None].repeat(40, axis=0))
    assert not is_occupied(places, (0.0, 0.0), 0.75, slope, kinds).any()


def test_strength_counts_at_occupied_places_and_nothing_at_empty_ones():
    place = np.array([[0.0, 0.0], [50.0, 0.0], [100.0, 0.0]])
    before = np.array([-2.0, 5.0, -2.0])
    slow = place[:2] + 0.5, np.array([True, False])
    after, by_motion = standing_ratio(before, np.full(3, 1.0), place, *slow)
    assert after[0] > 2 and after[1] == 0 and after[2] == before[2]
    np.testing.assert_array_equal(by_motion, [-2.0, 0.0, -2.0])
    nowhere = np.empty((0, 2))
    assert standing_ratio(before, before, place, nowhere, np.empty(0, bool))[0] is before


def test_the_likeliest_peak_of_each_occupied_place_without_one_is_selected():
    ratio = np.array([3.0, 4.0, 5.0, 0.5])
    place = np.array([[0.0, 0.0], [1.0, 0.0], [40.0, 0.0], [80.0, 0.0]])
    occupied = np.array([[0.5, 0.5], [40.5, 0.0], [80.0, 0.0], [200.0, 0.0]])
    none, third = np.empty(0, int), np.array([2])
    np.testing.assert_array_equal(select_standing(ratio, place, occupied, none), [1, 2])
    np.testing.assert_array_equal(select_standing(ratio, place, occupied, third), [1])
    assert len(select_standing(ratio[:0], place[:0], occupied, none)) == 0


def test_held_ground_keeps_its_weight_and_other_ground_loses_it():
    frames = flight.frames(12, vehicle=False)
    ground = model.empty_ground(flight.GRID, ((0, 0),), 2)
    none = np.zeros(ground.differed_s.shape, bool)
    for frame in frames[:6]:
        ground = model.update_ground(ground, model.predict(ground, frame), none, frame.time_s, 0.5)
    every = ~none
    kept = lost = ground
    for frame in frames[6:]:
        times = frame.time_s, 0.5
        kept = model.update_ground(kept, model.predict(kept, frame), every, *times, held=every)
        lost = model.update_ground(lost, model.predict(lost, frame), every, *times)
    inside = np.s_[10:-10, 10:-10, :10]  # beyond the edges no mask is known
    gain = np.exp(6 * 0.5 / model.MEMORY_S)
    np.testing.assert_allclose(kept.maps[0][inside], gain * ground.maps[0][inside], rtol=1e-3)
    np.testing.assert_array_equal(lost.maps[0][inside], ground.maps[0][inside])


@pytest.mark.parametrize("rate_hz", [1.0, 2.0, 10.0])
def test_ground_is_held_for_as_long_at_any_rate(rate_hz):
    share, frames = np.zeros(1), 0
    while share[0] < FULL_SHARE - 1e-6:
        share = _follow(share, np.ones(1), 1 / rate_hz, hold_s())
        frames += 1
    assert frames / rate_hz == pytest.approx(8.0)
