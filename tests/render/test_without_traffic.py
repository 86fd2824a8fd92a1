"""The frame without traffic by a part of its rays, against all of them."""

import pytest

from glintrack.render import without_traffic
from glintrack.scenario import build_scenario
from tests.render.same_hits import assert_same_hits
from tests.render.test_sampling import small_case


@pytest.mark.parametrize("roughness", [0.0, 0.5])
def test_it_is_the_whole_frame_traced_again_bit_for_bit(three_cars, roughness):
    scene = build_scenario(small_case())
    scene.city.materials["roughness"][:] = roughness
    pose, now = scene.flight.pose(0.0), scene.city.at(0.0)
    hits = scene.observer.trace(now, pose)
    bare, elements = without_traffic(scene.observer, now, pose, hits)
    whole = scene.observer.trace(now.without_traffic(), pose, like=hits)
    assert_same_hits(bare, whole)
    assert (hits.sun_visible < 1).any() and not (bare.vehicle_id >= 0).any()
    share = len(elements) / len(hits.rays)
    assert share == 1 if roughness == 0 else 0 < share < 0.1
