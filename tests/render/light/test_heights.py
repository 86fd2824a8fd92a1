"""Sky view past the horizon of a map of heights against closed forms, and which rays leaves alone hide."""

import math
from dataclasses import replace

import numpy as np
import pytest

from glintrack.render.light.heights import (
    CELL_M,
    UNKNOWN,
    VIEW_UNIT,
    find_leaf_occlusion,
    solid_heights,
    view_of_solids,
)
from glintrack.scene import Mesh
from tests.conftest import box, plane, snapshot
from tests.render.light.test_probes import block, joined, parts_of

WINDOW = (-30.0, -30.0, 30.0, 30.0)
EDGE = 0.04  # of sky view: where a wall stands is known to half a cell
LEAVES = np.array([False, False, True])
UP = (0.0, 0.0, 1.0)


def views(heights, places, normal=UP):
    return np.array([view_of_solids(heights, *map(float, place), *normal) for place in places])


def height_m(heights):
    return heights.middle_m + heights.step_m * heights.cells[..., 0]


def test_the_open_sees_all_of_the_sky():
    heights = solid_heights(snapshot(plane()), LEAVES, WINDOW)
    np.testing.assert_array_equal(heights.cells[..., 3], round(1 / VIEW_UNIT))


@pytest.mark.parametrize("height_m", [1.4, 8.0, 200.0])
def test_level_ground_before_a_long_wall(height_m):
    """V = ½ (1 + d/√(d² + h²)) at the distance d from a wall of height h."""
    heights = solid_heights(snapshot(joined(parts_of(plane()), block(0, 20, height_m))), LEAVES, WINDOW)
    d = np.linspace(2 * CELL_M, 10, 40)  # farther off the map's edge cuts the wall short
    found = views(heights, np.stack([-d, np.full_like(d, 1.7), np.zeros_like(d)], axis=1))
    expected = 0.5 * (1 + d / np.hypot(d, height_m))
    np.testing.assert_allclose(found, expected, atol=EDGE)


@pytest.mark.parametrize("tilt_deg", [20, 45])
def test_a_lone_slope_has_sky_view_one(tilt_deg):
    """What a facet's own plane hides is no loss."""
    s, c = math.sin(math.radians(tilt_deg)), math.cos(math.radians(tilt_deg))
    level = plane(40)
    turned = level.vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)
    mesh = Mesh(turned + np.array([0, 0, 30], np.float32), level.faces, level.material)
    heights = solid_heights(snapshot(mesh), LEAVES, WINDOW)
    known = height_m(heights) > 0
    np.testing.assert_allclose(VIEW_UNIT * heights.cells[known][:, 3], 1, atol=0.01)


def test_the_valley_of_two_slopes():
    """At the bottom of two slopes of 45° half of the facet's hemisphere is left."""
    x = np.array([-20.0, 0.0, 20.0])
    points = np.array([(a, b, abs(a)) for a in x for b in (-2000.0, 2000.0)], np.float32)
    faces = np.array([(0, 2, 1), (1, 2, 3), (2, 4, 3), (3, 4, 5)], np.int32)
    heights = solid_heights(snapshot(Mesh(points, faces, np.zeros(4, np.int16))), LEAVES, WINDOW)
    normal = np.array([-1.0, 0, 1.0]) / math.sqrt(2)
    found = views(heights, [(0.4, 1.7, 0.4)], normal)[0]
    # what is left lies between the plane's normal and its own plane: ½ of the cosines, over ½ (1 + cos 45°)
    assert found == pytest.approx(0.5 / (0.5 * (1 + math.cos(math.pi / 4))), abs=0.03)


def test_places_that_the_map_does_not_have():
    """Under a roof, on its wall, and beyond the map."""
    heights = solid_heights(snapshot(joined(parts_of(plane()), block(0, 20, 8, 20))), LEAVES, WINDOW)
    found = views(heights, [(10, 0, 0), (10, 0, 8), (900, 0, 0), (-20, 0, 0)])
    assert found[0] == UNKNOWN == found[2]
    assert found[1] > 0.99 and found[3] > 0.9


def test_cards_are_no_solids_and_rays_go_past_them():
    """A card before the open sky hides it by itself; one before a wall does not."""
    card = plane(6, 2.0, 2)
    scene = snapshot(joined(parts_of(plane()), parts_of(card), block(10, 12, 30)))
    heights = solid_heights(scene, LEAVES, WINDOW)
    assert views(heights, [(0, 0, 0)])[0] < 0.9  # the wall
    free = solid_heights(snapshot(joined(parts_of(plane()), parts_of(card))), LEAVES, WINDOW)
    assert views(free, [(0, 0, 0)])[0] == pytest.approx(1, abs=1e-6)
    point = np.tile(np.array([[0, 0, 2]], np.float32), (3, 1))
    direction = np.array([[0.8, 0, 0.6], [-0.8, 0, 0.6], [-0.8, 0, 0.6]], np.float32)
    hidden = find_leaf_occlusion(heights, np.array([2, 2, 0], np.int16), point, direction)
    np.testing.assert_array_equal(hidden, [False, True, False])


def test_instances_are_drawn_where_they_stand_and_traffic_is_not():
    here = np.array([[1.0, 0, 0, 5], [0, 1, 0, -7], [0, 0, 1, 0]])
    model = [box(4, 2, 1.5)]
    scene = snapshot(plane(), model, [here], [0])
    still = solid_heights(replace(scene, fixed=1), LEAVES, WINDOW)
    moving = solid_heights(scene, LEAVES, WINDOW)
    area = (height_m(still) > 1).sum() * CELL_M**2
    assert area == pytest.approx(8, rel=0.15)
    assert height_m(moving).max() == 0


@pytest.mark.parametrize("high_m", [0.5, 30.0, 3000.0])
def test_heights_are_kept_to_half_a_step(high_m):
    """A ramp: to a millimetre, or where 64,000 of them do not suffice, to a 64,000th of what there is."""
    level, step_m = plane(400.0), max(1e-3, high_m / 64_000)
    ramp = level.vertices.copy()
    ramp[:, 2] = high_m / 140 * ramp[:, 0]
    heights = solid_heights(snapshot(Mesh(ramp, level.faces, level.material)), LEAVES, WINDOW)
    x = heights.corner[0] + (np.arange(heights.cells.shape[1]) + 0.5) * heights.cell_m
    assert heights.step_m == pytest.approx(step_m, rel=0.01)
    np.testing.assert_allclose(height_m(heights)[100], high_m / 140 * x, atol=0.51 * step_m + 1e-6 * high_m)


def test_rays_skip_blocks_and_stop_where_a_cell_at_a_time_would():
    """Over scattered blocks, beside a walk in NumPy that looks at every cell on the way."""
    draw = np.random.default_rng(11)
    blocks = [block(x, x + w, h, 4 * w) for x, w, h in draw.uniform((-40, 0.5, 3), (40, 6, 25), (16, 3))]
    heights = solid_heights(snapshot(joined(parts_of(plane()), *blocks)), LEAVES, WINDOW)
    count = 400
    point = draw.uniform((-45, -20, 0.2), (45, 20, 8), (count, 3)).astype(np.float32)
    direction = draw.normal(size=(count, 3))
    direction[:, 2] = abs(direction[:, 2]) * 0.5 + 0.01
    direction = (direction / np.linalg.norm(direction, axis=1)[:, None]).astype(np.float32)
    found = find_leaf_occlusion(heights, np.full(count, 2, np.int16), point, direction)
    along = heights.cell_m / np.linalg.norm(direction[:, :2], axis=1)
    place = point[:, None] + np.arange(1, 900)[:, None] * (along[:, None] * direction)[:, None]
    column, row = ((place[..., k] - heights.corner[k]) / heights.cell_m for k in (0, 1))
    rows, columns = heights.cells.shape[:2]
    on_map = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    at = np.where(on_map, row, 0).astype(int), np.where(on_map, column, 0).astype(int)
    free = ~(on_map & (height_m(heights)[at] > place[..., 2])).any(axis=1)
    assert 0.1 < free.mean() < 0.9
    assert (found == free).mean() > 0.99  # rounding at the edge of a cell
