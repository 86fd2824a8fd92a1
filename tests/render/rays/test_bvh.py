"""The tree in numba against Embree, ray by ray, and against geometry that is known."""

import math

import numpy as np
import pytest

from glintrack.camera import Pose, look_at, rays
from glintrack.render import trace
from glintrack.render.rays.bvh import BvhTracer
from glintrack.render.rays.surfaces import NO_HIT
from glintrack.render.tracer import SceneTracer, build_tracer
from glintrack.scene import SceneDesign, build_scene
from tests.conftest import box, nadir, plane, small_camera, snapshot

UP = np.array([0.0, 0.0, 1.0])
FLOAT32_AT_3_KM_M = 4e-3  # sixteen steps of float32 at 3 km
GRAZING = 1e-3  # of all rays: those through a common edge of two faces, or past a silhouette


def numba_tracer(scene, gaps=None):
    """As `build_tracer` makes it where there is no Embree."""
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("glintrack.render.tracer.importlib.util.find_spec", lambda name: None)
        with pytest.warns(UserWarning, match="`embreex` is not installed: rays are traced by numba"):
            built = build_tracer(scene, gaps)
    assert isinstance(built.rays, BvhTracer)
    return built


@pytest.fixture(scope="module")
def city():
    return build_scene(SceneDesign())


@pytest.fixture(scope="module")
def both(city):
    now, gaps = city.at(20.0), city.materials["gap_fraction"].values
    made = build_tracer(now, gaps), numba_tracer(now, gaps)
    if type(made[0].rays) is BvhTracer:
        pytest.skip("needs embreex to compare with")
    for tracer in made:
        tracer.rays.update(now.transforms[now.fixed :], now.model[now.fixed :])
    return made


@pytest.mark.slow
def test_both_intersectors_give_the_same_hits_in_the_default_city(both):
    embree, numba = both
    pose = look_at(Pose(0, -2298, 1928), [0, 0, 0])
    camera = small_camera(140, 220, 660, 3000)
    directions = rays(camera, pose).reshape(-1, 3).astype(np.float32)
    origin = pose.position.astype(np.float32)[None]
    theirs, ours = embree.rays.intersect(origin, directions), numba.rays.intersect(origin, directions)
    same = (ours[1] == theirs[1]) & (ours[2] == theirs[2])
    assert (~same).mean() < GRAZING
    met = same & (ours[1] != NO_HIT)
    assert met.mean() > 0.9 and (ours[2][met] > embree.fixed).any()  # vehicles are among them
    apart = np.abs(ours[0][met] - theirs[0][met])
    assert (
        apart > FLOAT32_AT_3_KM_M
    ).mean() < GRAZING and apart.max() < 0.1  # facets seen edge-on magnify it

    toward_sun = np.array([[0.5, -0.5, math.sqrt(0.5)]], np.float32)
    points = origin + (ours[0] - np.float32(0.05))[:, None] * directions
    light = [
        tracer.rays.transmittance(points.astype(np.float32), toward_sun, met) for tracer in (embree, numba)
    ]
    assert (np.abs(light[0] - light[1]) > 1e-5).mean() < GRAZING
    assert 0.05 < (light[0] == 0).mean() < 0.9
    assert ((light[0] > 0) & (light[0] < 1)).any()  # the half shade of crowns


@pytest.mark.slow
def test_a_frame_is_the_same_from_either(city, both):
    embree, numba = both
    pose, camera = look_at(Pose(0, -500, 500), [0, 0, 0]), small_camera(60, 80, 200, 700)
    arguments = (city.at(20.0), camera, pose, UP, city.materials["roughness"].values)
    theirs, ours = (trace(*arguments, tracer=tracer) for tracer in (embree, numba))
    for name in ("material", "vehicle_id", "mirror_material"):
        assert (getattr(theirs, name) != getattr(ours, name)).mean() < 2 * GRAZING, name


def test_a_box_turned_scaled_and_moved():
    """Closed form: a ray down the axis of a cube of 2 m, scaled threefold, standing 5 m up."""
    turned = np.array([[0, -3, 0, 40], [3, 0, 0, -7], [0, 0, 3, 5.0]])
    scene = snapshot(plane(), [box(2, 2, 2)], [turned], [0])
    tracer = numba_tracer(scene)
    tracer.rays.update(scene.transforms[scene.fixed :], scene.model[scene.fixed :])
    origins = np.array([[40, -7, 100], [43.1, -7, 100], [40, -7, 1], [40, -7, 4.9]], np.float32)
    down, up = np.array([[0, 0, -1.0]], np.float32), np.array([[0, 0, 1.0]], np.float32)
    every = np.ones(4, np.bool_)
    ranges, primitives, slots, _ = tracer.rays.intersect(origins, np.repeat(down, 4, axis=0))
    np.testing.assert_allclose(ranges, [100 - 11, 100, 1, 4.9], rtol=1e-6)
    assert slots.tolist() == [1, 0, 0, 0]
    np.testing.assert_array_equal(tracer.rays.transmittance(origins, up, every), [1, 1, 0, 0])
    away = np.array([[1, 0, 0.0]], np.float32)
    ranges, primitives, slots, _ = tracer.rays.intersect(origins[:1], away)
    assert np.isinf(ranges[0]) and primitives[0] == NO_HIT and slots[0] == NO_HIT


def test_many_boxes_each_ray_meets_its_own():
    """A lattice of 400 boxes: every ray straight down meets the box below it."""
    lattice = np.stack(np.meshgrid(np.arange(20), np.arange(20), indexing="ij"), -1).reshape(-1, 2) * 10.0
    transforms = np.zeros((400, 3, 4))
    transforms[:, :, :3], transforms[:, :2, 3] = np.eye(3), lattice
    scene = snapshot(plane(10), [box(4, 4, 3)], transforms, np.zeros(400, int))
    tracer = numba_tracer(scene)
    tracer.rays.update(scene.transforms[scene.fixed :], scene.model[scene.fixed :])
    origins = np.c_[lattice + [0.3, 0.7], np.full(400, 50.0)].astype(np.float32)
    down = np.repeat(np.array([[0, 0, -1.0]], np.float32), 400, axis=0)
    ranges, _, slots, _ = tracer.rays.intersect(origins, down)
    np.testing.assert_allclose(ranges, 47, rtol=1e-6)
    np.testing.assert_array_equal(slots, 1 + np.arange(400))


@pytest.mark.parametrize("make", [build_tracer, numba_tracer], ids=["embree", "numba"])
def test_cards_pass_their_share_of_looks_and_light(make):
    """One and two layers of cards over ground: 0.3 and 0.09 of looks and of sunlight come through."""
    gap, side = 0.3, 40
    corner = np.stack(np.meshgrid(np.arange(side + 1), np.arange(side + 1), indexing="ij"), -1).reshape(-1, 2)
    first = (np.arange(side)[:, None] * (side + 1) + np.arange(side)).ravel()
    lower, upper = np.c_[first, first + 1, first + side + 2], np.c_[first, first + side + 2, first + side + 1]
    faces = np.vstack([lower, upper])
    sheet = np.c_[corner - side / 2, np.zeros(len(corner))].astype(np.float32)
    for layers in (1, 2):
        cards = [
            (sheet + np.float32([0.037 + 0.31 * k, 0.021 * k + 0.013, 5 + k]), faces) for k in range(layers)
        ]
        ground = plane(200)
        vertices = np.concatenate([ground.vertices, *(v for v, _ in cards)]).astype(np.float32)
        numbered = [f + 4 + k * len(sheet) for k, (_, f) in enumerate(cards)]
        material = np.r_[np.zeros(2), np.ones(layers * len(faces))].astype(np.int16)
        mesh = type(ground)(vertices, np.vstack([ground.faces, *numbered]).astype(np.int32), material)
        scene = snapshot(mesh)
        tracer = make(scene, np.array([0.0, gap]))
        assert isinstance(tracer, SceneTracer)
        hits = trace(scene, small_camera(300, 300, 30), nadir(), UP, np.ones(2), tracer=tracer)
        ground_seen = (hits.material == 0).mean()
        holes = layers * 30 * 30 * 2 * 21  # cards in view, of twenty-one cells each
        four_sigma = 4 * math.sqrt(gap**layers / holes)
        assert ground_seen == pytest.approx(gap**layers, abs=four_sigma)
        below = hits.sun_visible[hits.material == 0]
        edges = 0.01  # rays on an edge may be counted to both faces
        assert (np.abs(below - gap**layers) > 1e-5).mean() < edges
