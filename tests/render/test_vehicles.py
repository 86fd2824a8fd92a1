"""Boxes and masks as imaged: projected corners, drawn masks at fine pitch, parked vehicles, what hides."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.camera import look_at
from glintrack.render import build_tracer, outlines, vehicle_mask
from glintrack.render.vehicles import PARKED_ID, vehicle_ids
from tests.conftest import box, nadir, plane, small_camera, snapshot

ONE_ELEMENT = 1.0


def placed(east, north=0.0):
    return [[1.0, 0, 0, east], [0, 1, 0, north], [0, 0, 1, 0]]


def scene_of(places, models=None, fixed=0):
    models = [box(4.5, 1.8, 1.5)] if models is None else models
    which = list(range(len(models))) if len(models) > 1 else [0] * len(places)
    ids = [-1] * fixed + list(range(5, 5 + len(places) - fixed))
    scene = snapshot(plane(), models, [placed(*p) for p in places], which, vehicle_id=np.array(ids, int))
    return replace(scene, fixed=fixed)


def aslant(elements=401, fov_m=30.0):
    """Seen from the south at 45°: what is h high leans h toward the north on the map."""
    pose = look_at(replace(nadir(1000.0), north_m=-1000.0), (0.0, 0.0, 0.0))
    return small_camera(elements, elements, fov_m, 1414.0), pose


def test_straight_down_the_box_is_that_of_the_roof():
    """The roof, 1.5 m nearer of 1000 m, of 4.5 m × 1.8 m in elements of 0.1 m; image up is north."""
    camera, pose = small_camera(401, 401, 40.1), nadir()
    seen = outlines(scene_of([(3.0, 1.0)]), camera, pose)
    per_m = 10 * 1000 / 998.5
    east, north = np.array([3 - 2.25, 3 + 2.25]), np.array([1 - 0.9, 1 + 0.9])
    low = 1000 / 998.5  # the roof's outer edges lie farther from the axis than those of the floor
    np.testing.assert_allclose(seen.box[0, [2]], 200 + per_m * east[1], atol=1e-6)
    np.testing.assert_allclose(seen.box[0, [0]], 200 + per_m / low * east[0], atol=1e-6)
    np.testing.assert_allclose(seen.box[0, [1]], 200 - per_m * north[1], atol=1e-6)
    assert seen.vehicle_id.tolist() == [5]


def test_boxes_are_those_of_the_masks_drawn():
    """Three cars, one parked, nothing in the way: mask and box agree to an element on every side."""
    camera, pose = aslant()
    scene = scene_of([(-8.0, 4.0), (0.0, -6.0), (7.0, 3.0)], fixed=1)
    seen = outlines(scene, camera, pose)
    mask = vehicle_mask(scene, camera, pose, build_tracer(scene), seen)
    assert (
        seen.vehicle_id.tolist() == [PARKED_ID, 5, 6] == [i for i in [PARKED_ID, 5, 6] if (mask == i).any()]
    )
    for vehicle, (x0, y0, x1, y1) in zip(seen.vehicle_id.tolist(), seen.box, strict=True):
        row, column = np.nonzero(mask == vehicle)
        drawn = [column.min(), row.min(), column.max(), row.max()]
        np.testing.assert_allclose([x0, y0, x1, y1], drawn, atol=ONE_ELEMENT)
        assert x0 <= drawn[0] and y0 <= drawn[1] and x1 >= drawn[2] and y1 >= drawn[3]


def test_a_lorry_takes_what_it_hides_from_the_mask_and_not_from_the_box():
    lorry, car = box(8.0, 2.5, 4.0), box(4.5, 1.8, 1.5)
    camera, pose = aslant()
    scene = scene_of([(0.0, -2.7), (0.0, 0.0)], [lorry, car])
    free = scene_of([(0.0, 0.0)], [car])
    seen = outlines(scene, camera, pose)
    mask = vehicle_mask(scene, camera, pose, build_tracer(scene), seen)
    assert (mask == 5).any() and not (mask == 6).any()
    np.testing.assert_allclose(seen.box[1], outlines(free, camera, pose).box[0])


@pytest.mark.parametrize(("east", "held"), [(14.0, True), (18.0, False), (400.0, False)])
def test_boxes_end_at_the_frames_edge(east, held):
    camera, pose = small_camera(301, 301, 30.1), nadir()
    seen = outlines(scene_of([(east, 0.0)]), camera, pose)
    assert (len(seen.instance) == 1) == held
    if held:
        assert seen.box[0, 2] == camera.columns - 0.5 and seen.box[0, 0] < 300


def test_trees_have_no_id():
    """Models after those of the vehicles are none: hedges and trees."""
    camera, pose = small_camera(101, 101, 30.0), nadir()
    models = [box(4.5, 1.8, 1.5)] * 8
    scene = scene_of([(3.0 * k - 12, 0.0) for k in range(8)], models, fixed=8)
    assert vehicle_ids(scene).tolist() == [PARKED_ID + k for k in range(7)] + [-1]
    seen = outlines(scene, camera, pose)
    mask = vehicle_mask(scene, camera, pose, build_tracer(scene), seen)
    assert PARKED_ID + 6 in mask and mask.max() == PARKED_ID + 6


def test_a_frame_without_vehicles_has_an_empty_mask():
    camera, pose = small_camera(11, 11, 30.0), nadir()
    scene = scene_of([])
    seen = outlines(scene, camera, pose)
    assert seen.box.shape == (0, 4) and seen.pixel.shape == (0, 2)
    assert (vehicle_mask(scene, camera, pose, build_tracer(scene_of([(0.0, 0.0)])), seen) == -1).all()
