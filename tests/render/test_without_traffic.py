"""The frame without traffic by a part of its rays, against all of them."""

import numpy as np
import pytest

from glintrack.case.build import build_scenario
from tests.render.same_hits import assert_same_hits, of_elements, small_case


@pytest.mark.parametrize("roughness", [0.0, 0.5])
def test_it_is_the_whole_frame_traced_again_bit_for_bit(three_cars, roughness):
    scene = build_scenario(small_case())
    scene.city.materials["roughness"][:] = roughness
    pose, now = scene.flight.pose(0.0), scene.city.at(0.0)
    hits = scene.observer.trace(now, pose)
    bare = scene.observer.trace_without_traffic(now, pose, hits)
    whole = scene.observer.trace(now.without_traffic(), pose)
    elements, others = np.flatnonzero(bare.rays > 0), np.flatnonzero(bare.rays == 0)
    assert_same_hits(bare, of_elements(whole, elements))
    assert_same_hits(of_elements(hits, others), of_elements(whole, others))
    assert (hits.sun_visible < 1).any() and not (bare.vehicle_id >= 0).any()
    share = len(elements) / len(hits.rays)
    assert share == 1 if roughness == 0 else 0 < share < 0.1


def test_its_light_is_the_whole_frames_bit_for_bit(three_cars):
    scene = build_scenario(small_case())
    pose, now, channels = scene.flight.pose(0.0), scene.city.at(0.0), scene.sensor.channels
    hits = scene.observer.trace(now, pose)
    bare = scene.observer.trace_without_traffic(now, pose, hits)
    whole = scene.observer.trace(now.without_traffic(), pose)
    pixels = np.argwhere((bare.rays > 0).reshape(bare.rows, bare.columns))
    some = scene.observer.partial_radiance(bare, hits)(channels, pixels).values
    np.testing.assert_array_equal(some, scene.observer.radiance(whole)(channels, pixels).values)
    assert 0 < len(pixels) < bare.rays.size
    assert np.abs(some / scene.observer.radiance(hits)(channels, pixels).values - 1).max() > 0.1


def test_without_vehicles_nothing_is_traced_anew(three_cars):
    scene = build_scenario(small_case())
    pose, now = scene.flight.pose(0.0), scene.city.at(0.0).without_traffic()
    materials = scene.city.materials
    materials["roughness"][:] = 0.5
    hits = scene.observer.trace(now, pose)
    bare = scene.observer.trace_without_traffic(now, pose, hits)
    assert not bare.rays.any()
    light = scene.observer.partial_radiance(bare, hits)
    assert light(scene.sensor.channels, np.zeros((0, 2), int)).shape == (0, len(scene.sensor.channels), 3)
