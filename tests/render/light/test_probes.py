"""Sky view against closed forms: the open, a wall, a street canyon, a pit, and shade of half-open cards."""

import math

import numpy as np
import pytest

from glintrack.camera import Pose, look_at
from glintrack.render import trace
from glintrack.render.light.lattice import FACET, SPACE, facet_cell, facet_corners
from glintrack.render.light.sky import hemisphere_directions
from glintrack.render.tracer import build_tracer, standing_box
from glintrack.scene import Mesh
from tests.conftest import box, nadir, plane, small_camera, snapshot

UP = np.array([0.0, 0.0, 1.0])
SPREAD = 0.07  # of some forty-five directions at a probe, whose neighbours have others
LATTICE = 0.11  # and probes two metres apart, a little above the ground


def block(west, east, height, length=2000.0, material=1):
    """A long building from west to east, along north."""
    mesh = box(east - west, length, height, material)
    return mesh.vertices + np.float32([(west + east) / 2, 0, 0]), mesh.faces, mesh.material


def joined(*parts):
    start = np.cumsum([0, *(len(v) for v, _, _ in parts)])
    return Mesh(
        np.concatenate([v for v, _, _ in parts]),
        np.concatenate([f + s for (_, f, _), s in zip(parts, start, strict=False)]).astype(np.int32),
        np.concatenate([m for _, _, m in parts]),
    )


def parts_of(mesh):
    return mesh.vertices, mesh.faces, mesh.material


def look(mesh, pose=None, camera=None, gaps=None):
    scene = snapshot(mesh)
    return trace(
        scene,
        camera or small_camera(101, 101, 60),
        pose or nadir(),
        UP,
        np.ones(2),
        tracer=build_tracer(scene, gaps),
    )


def test_the_open_sees_the_whole_sky():
    np.testing.assert_allclose(look(plane()).sky_view, 1, atol=1e-4)
    away = look(plane(), look_at(Pose(0, -3000, 400), [0, 5000, 400]))  # beyond the plane, and the sky itself
    assert (away.material < 0).any()
    np.testing.assert_allclose(away.sky_view, 1, atol=1e-4)


@pytest.mark.parametrize("tilt_deg", [20, 45, 70])
def test_an_open_slope_sees_all_that_its_tilt_lets_it(tilt_deg):
    """The definition divides by what the facet would see in the open: a lone slope has sky view 1."""
    s, c = math.sin(math.radians(tilt_deg)), math.cos(math.radians(tilt_deg))
    level = plane(40)
    turned = level.vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32)
    hits = look(
        Mesh(turned + np.float32([0, 0, 30]), level.faces, level.material), camera=small_camera(41, 41, 8)
    )
    np.testing.assert_allclose(abs(hits.normal[:, 2]), c, atol=1e-4)
    np.testing.assert_allclose(hits.sky_view, 1, atol=SPREAD)


def test_the_foot_of_a_high_wall_sees_half_the_sky():
    """Level ground at distance d from an endless wall of height h: V = ½ (1 + d/√(d² + h²))."""
    hits = look(joined(parts_of(plane()), block(0, 40, 400)))
    d = -hits.point[:, 0]
    ground = (hits.material == 0) & (d > 0.3)
    expected = 0.5 * (1 + d / np.hypot(d, 400))[ground]
    np.testing.assert_allclose(hits.sky_view[ground], expected, atol=SPREAD)
    assert abs(hits.sky_view[ground][d[ground] < 1].mean() - 0.5) < SPREAD


@pytest.mark.parametrize(("width_m", "height_m"), [(20.0, 15.0), (24.0, 8.0), (12.0, 20.0)])
def test_a_street_canyon(width_m, height_m):
    """Floor: V = ½ (cos a + cos b), a and b the elevations of the two eaves; wall: V = 1 − sin a."""
    w, h = width_m, height_m
    mesh = joined(parts_of(plane()), block(-w / 2 - 30, -w / 2, h), block(w / 2, w / 2 + 30, h))
    hits = look(mesh, camera=small_camera(61, 61, 1.2 * w))
    floor = (hits.material == 0) & (np.abs(hits.point[:, 0]) < w / 2 - 0.5)
    left, right = hits.point[floor, 0] + w / 2, w / 2 - hits.point[floor, 0]
    expected = 0.5 * (left / np.hypot(left, h) + right / np.hypot(right, h))
    error = hits.sky_view[floor] - expected
    assert abs(error.mean()) < 0.04 and np.abs(error).max() < 0.06 + LATTICE

    pose = look_at(Pose(-300, 0, 300 * h / w + h), [w / 2, 0, 0.6 * h])
    hits = look(mesh, pose, small_camera(61, 61, h, 300))
    wall = (hits.normal[:, 0] < -0.99) & (hits.point[:, 0] > 0) & (hits.point[:, 2] < h - 0.5)
    rise = h - hits.point[wall, 2]
    error = hits.sky_view[wall] - (1 - rise / np.hypot(rise, w))
    assert wall.sum() > 100 and abs(error.mean()) < 0.04 and np.abs(error).max() < 0.06 + LATTICE


def test_roofs_stay_open_and_inner_courts_do_not():
    roof = look(joined(parts_of(plane()), block(-20, 20, 15)))
    middle = (roof.material == 1) & (np.abs(roof.point[:, 0]) < 19)
    np.testing.assert_allclose(roof.sky_view[middle], 1, atol=SPREAD)
    slab = plane(400, 6.0, 1)
    tilted = look_at(Pose(0, -260, 3), [0, -140, 1])
    under = look(joined(parts_of(plane()), parts_of(slab)), tilted, small_camera(61, 61, 20, 120))
    deep = (under.material == 0) & (under.point[:, 1] > -160) & (under.point[:, 1] < 0)
    assert deep.any() and under.sky_view[deep].max() < 0.05  # forty metres in under a roof six metres up


def test_cards_let_their_share_of_the_sky_through():
    """Under a wide roof of cards with gaps of 0.4, level ground has sky view 0.4 in the mean."""
    step, side = 2.0, 120
    x, y = (v.ravel() for v in np.meshgrid(*2 * [step * (np.arange(side + 1) - side / 2)], indexing="ij"))
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    beyond = first + side + 1
    quads = np.stack([first, beyond, first + 1, first + 1, beyond, beyond + 1], axis=1)
    faces = quads.reshape(-1, 3).astype(np.int32)
    roof = np.stack([x, y, np.full_like(x, 4.0)], axis=1).astype(np.float32), faces
    scene = joined(parts_of(plane()), (*roof, np.full(len(faces), 1, np.int16)))
    hits = look(
        scene, look_at(Pose(0, 0, 3.5), [0, 0, 0]), small_camera(31, 31, 20, 3.5), np.array([0.0, 0.4])
    )
    assert (hits.material == 0).all()
    np.testing.assert_allclose(hits.sky_view.mean(), 0.4, atol=0.05)


def test_a_crown_is_darker_inside_and_below_and_its_cards_have_two_sides():
    """Six hundred cards in a block of 8 m × 8 m × 5 m: the sky is seen from the top, not from beneath."""
    rng = np.random.default_rng(3)
    middle = rng.uniform([-4, -4, 3], [4, 4, 8], (600, 3))
    corners = (middle[:, None] + rng.uniform(-0.6, 0.6, (600, 3, 3))).reshape(-1, 3).astype(np.float32)
    cards = corners, np.arange(1800, dtype=np.int32).reshape(-1, 3), np.full(600, 1, np.int16)
    mesh = joined(parts_of(plane()), cards)
    pose = look_at(Pose(-100, -80, 90), [0, 0, 5])
    hits = look(mesh, pose, small_camera(61, 61, 16, 156), np.array([0, 0.1]))
    leaf, height = hits.material == 1, hits.point[:, 2]
    assert (hits.light_cell[leaf] <= SPACE).all() and leaf.sum() > 500
    upward = leaf & (hits.normal[:, 2] > 0.5)
    top, bottom = (hits.sky_view[upward & mask].mean() for mask in (height > 7, height < 4.5))
    assert top > bottom + 0.2
    behind = hits.probe_view[hits.probe_cells[(SPACE - hits.light_cell[upward]) ^ 7, 0]]
    np.testing.assert_array_equal(behind, 0)  # of a facet that looks down no sky counts


def test_vertices_without_a_face_do_not_count():
    """A scene cut out of a larger one keeps its vertices: where the scene ends its faces say."""
    whole = joined(parts_of(plane()), block(0, 40, 30))
    far = np.concatenate([whole.vertices, np.float32([[9e4, 9e4, 500], [-9e4, -9e4, -500]])])
    for one, other in zip(
        standing_box(snapshot(whole)),
        standing_box(snapshot(Mesh(far, whole.faces, whole.material))),
        strict=True,
    ):
        np.testing.assert_array_equal(one, other)


def test_probes_do_not_see_what_moves_and_later_frames_agree():
    """Probes are of the still scene alone; they do not depend on who asked first."""
    wall = joined(parts_of(plane()), block(5, 40, 20))
    here = np.array([[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]])
    scene = snapshot(wall, [box(8, 8, 12)], [here], [0])
    tracer, camera = build_tracer(scene), small_camera(61, 61, 60)
    first = trace(scene, camera, nadir(), UP, np.ones(2), tracer=tracer)
    again = trace(scene, camera, nadir(), UP, np.ones(2), tracer=tracer)
    alone = look(wall, camera=camera)
    same = first.material == alone.material
    assert same.mean() > 0.9
    np.testing.assert_array_equal(first.sky_view, again.sky_view)
    same &= first.sky_left == 255
    np.testing.assert_array_equal(first.sky_view[same], alone.sky_view[same])


def test_the_key_of_a_cell_says_which_probes_it_has():
    """Else a cell would have those of whoever asked first, and a flight what else was traced in between."""
    rng = np.random.default_rng(5)
    places = rng.uniform(-6, 6, (20_000, 3)) * [1, 1, 0.1]
    normals = np.concatenate([rng.normal(0, 0.1, (20_000, 2)), np.ones((20_000, 1))], axis=1)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    found = {}
    for place, normal in zip(places, normals, strict=True):
        key, _, _ = facet_cell(*place, *normal, FACET, 1.0)
        corners, _, _ = facet_corners(*place, *normal, FACET, 1.0)
        assert found.setdefault(key, corners) == corners
    lowest = {four[0] for four in found.values()}
    assert len(lowest) < len(found) == len(set(found.values()))  # cells that share their lowest probe


def test_directions_are_even():
    directions = hemisphere_directions(64)
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(directions.mean(axis=0), [0, 0, 0.5], atol=0.01)
    np.testing.assert_allclose((directions[:, 2] ** 2).mean(), 1 / 3, atol=1e-3)
