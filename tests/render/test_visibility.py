"""Visible fraction: 1 in an empty scene, 0 under a slab, half behind half a slab; the same for any image."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.camera import look_at
from glintrack.render import build_tracer, build_vehicle_tracer, trace, visible_fraction
from glintrack.render.vehicles import FAN_SIDE
from tests.conftest import box, nadir, plane, small_camera, snapshot

ONE_ROW_OF_THE_FAN = 1 / FAN_SIDE


def placed(east, north=0.0):
    return [[1.0, 0, 0, east], [0, 1, 0, north], [0, 0, 1, 0]]


def fractions(static, places, models=None, camera=None, pose=None):
    models = [box(4.5, 1.8, 1.5)] * len(places) if models is None else models
    ids = list(range(5, 5 + len(places)))
    scene = snapshot(static, models, [placed(*p) for p in places], list(range(len(places))), vehicle_id=ids)
    camera, pose = camera or small_camera(101, 101, 20), pose or nadir()
    return visible_fraction(scene, camera, pose, build_tracer(scene), build_vehicle_tracer(scene))


def slab(west):
    mesh = plane(20, 5.0)
    return type(mesh)(mesh.vertices + np.float32([10 + west, 0, 0]), mesh.faces, mesh.material)


@pytest.mark.parametrize(("static", "expected"), [(plane(), 1.0), (slab(-10), 0.0), (slab(0), 0.5)])
def test_open_covered_and_half_covered(static, expected):
    seen = fractions(static, [(0.0,), (500.0,)])
    assert seen[0] == pytest.approx(expected, abs=ONE_ROW_OF_THE_FAN)
    assert seen[1] == 0  # outside the frame


def test_who_is_far_off_the_frame_gets_no_rays():
    class Counting:
        def __init__(self, tracer):
            self.tracer, self.update, self.rays = tracer, tracer.update, 0

        def intersect(self, origins, directions, coherent):
            self.rays += len(directions)
            return self.tracer.intersect(origins, directions, coherent)

    places = [(0.0,), *((300.0 + 10 * k,) for k in range(50)), (10.0,)]
    scene = snapshot(plane(), [box(4.5, 1.8, 1.5)], [placed(*p) for p in places], [0] * len(places))
    bare = Counting(build_vehicle_tracer(scene))
    seen = visible_fraction(scene, small_camera(101, 101, 20), nadir(), build_tracer(scene), bare)
    assert bare.rays == 2 * FAN_SIDE**2
    assert seen[0] == 1 and 0 < seen[-1] < 1 and not seen[1:-1].any()


def test_the_frames_edge_hides():
    """A frame of 20 m ends 10 m east: of a car of 4.5 m about that place one half is in."""
    assert fractions(plane(), [(10.0,)])[0] == pytest.approx(0.5, abs=ONE_ROW_OF_THE_FAN)


def test_a_car_behind_a_lorry_is_hidden_though_the_lorry_stands_in_its_fan():
    """Seen from the south at 45°, a lorry 4 m high stands 0.5 m before a car: nothing is left of it."""
    lorry, car = box(8.0, 2.5, 4.0), box(4.5, 1.8, 1.5)
    pose = look_at(replace(nadir(1000.0), north_m=-1000.0), (0.0, 0.0, 0.0))
    camera = small_camera(201, 201, 60, 1414.0)
    seen = fractions(plane(), [(0.0, -2.7), (0.0, 0.0)], [lorry, car], camera, pose)
    assert seen[0] == pytest.approx(1.0) and seen[1] == 0.0
    alone = fractions(plane(), [(0.0, 0.0)], [car], camera, pose)
    assert alone[0] == 1.0


@pytest.mark.parametrize("elements", [5, 41, 401])
def test_the_images_own_sampling_has_no_part_in_it(elements):
    camera = small_camera(elements, elements, 20)
    expected = fractions(slab(0), [(0.0,)], camera=small_camera(101, 101, 20))
    np.testing.assert_allclose(fractions(slab(0), [(0.0,)], camera=camera), expected)


def test_half_a_fan_against_drawn_masks():
    """The share of the silhouette's pixels that a slab leaves, drawn at 2 cm, within one ray in twenty."""
    up, camera, pose = np.array([0.0, 0.0, 1.0]), small_camera(400, 400, 8), nadir()
    for west in (-1.2, 0.4, 1.7):
        scene = snapshot(slab(west), [box(4.5, 1.8, 1.5)], [placed(0.0)], [0], vehicle_id=[5])
        free = snapshot(plane(), [box(4.5, 1.8, 1.5)], [placed(0.0)], [0], vehicle_id=[5])
        drawn = [(trace(s, camera, pose, up, np.zeros(2)).vehicle_id == 5).sum() for s in (scene, free)]
        seen = visible_fraction(scene, camera, pose, build_tracer(scene), build_vehicle_tracer(scene))
        assert seen[0] == pytest.approx(drawn[0] / drawn[1], abs=0.05)
