"""Sunlight by rays: nothing is left over from the frame, the cars or the sun before."""

import math
from dataclasses import replace

import numpy as np

from glintrack.camera import Pose, look_at
from glintrack.render import build_tracer, trace
from glintrack.scene import Mesh
from tests.conftest import box, nadir, plane, small_camera, snapshot

GAPS = np.array([0.0, 0.0, 0.25])


def sun_at(elevation_deg, azimuth_deg=140.0):
    e, a = math.radians(elevation_deg), math.radians(azimuth_deg)
    return np.float32([math.cos(e) * math.sin(a), math.cos(e) * math.cos(a), math.sin(e)])


def crown(rng, cards=60):
    """Loose cards, each a triangle of leaves (material 2), over a stem."""
    centres = rng.uniform([-3, -3, 3], [3, 3, 8], (cards, 1, 3))
    vertices = (centres + rng.uniform(-1, 1, (cards, 3, 3))).reshape(-1, 3).astype(np.float32)
    stem = box(0.4, 0.4, 5.0)
    return Mesh(
        np.concatenate([vertices, stem.vertices]),
        np.concatenate([np.arange(3 * cards).reshape(-1, 3), stem.faces + 3 * cards]).astype(np.int32),
        np.r_[np.full(cards, 2), stem.material].astype(np.int16),
    )


def grove(rng, standing=40, driving=30):
    """Rolling ground, trees, houses and cars; the cars move."""
    x, y = np.meshgrid(np.linspace(-80, 80, 33), np.linspace(-80, 80, 33), indexing="ij")
    z = 1.5 * np.sin(0.1 * x) * np.cos(0.08 * y)
    k = (np.arange(32)[:, None] * 33 + np.arange(32)).ravel()
    faces = np.concatenate([np.stack([k, k + 33, k + 34], 1), np.stack([k, k + 34, k + 1], 1)])
    ground = Mesh(
        np.stack([x, y, z], -1).reshape(-1, 3).astype(np.float32),
        faces.astype(np.int32),
        np.zeros(len(faces), np.int16),
    )
    count = standing + driving
    turn, scale = rng.uniform(0, 2 * math.pi, count), np.r_[rng.uniform(0.7, 1.5, standing), np.ones(driving)]
    place = np.zeros((count, 3, 4))
    place[:, 0, 0], place[:, 1, 1], place[:, 2, 2] = np.cos(turn), np.cos(turn), 1
    place[:, 0, 1], place[:, 1, 0] = -np.sin(turn), np.sin(turn)
    place[:, :, :3] *= scale[:, None, None]
    place[:, :2, 3] = rng.uniform(-70, 70, (count, 2))
    model = np.r_[rng.integers(0, 2, standing), np.full(driving, 2)]
    vehicle = np.r_[np.full(standing, -1), np.arange(driving)]
    scene = snapshot(ground, (crown(rng), box(8, 12, 9), box(4.5, 1.8, 1.5)), place, model, vehicle)
    return replace(scene, fixed=standing)


def test_a_frame_is_the_same_at_first_and_again_and_after_another_sun():
    """Cars that moved leave nothing behind."""
    rng = np.random.default_rng(6)
    scene, camera, pose = grove(rng), small_camera(80, 90, 120), look_at(Pose(300, -900, 1000), [0, 0, 0])
    moved = replace(scene, transforms=scene.transforms.copy())
    moved.transforms[scene.fixed :, 0, 3] += 7.0
    tracer = build_tracer(scene, GAPS)
    names = "sun_visible", "mirror_sun", "material", "point"
    roughness = np.array([0.0, 0.5, 0.5])
    first, again, there, elsewhen, last = (
        trace(now, camera, pose, sun, roughness, tracer=tracer)
        for now, sun in (
            (scene, sun_at(35)),
            (scene, sun_at(35)),
            (moved, sun_at(35)),
            (scene, sun_at(60)),
            (scene, sun_at(35)),
        )
    )
    for name in names:
        for other in (again, last):
            np.testing.assert_array_equal(getattr(first, name), getattr(other, name), err_msg=name)
    assert (first.sun_visible != there.sun_visible).any() and (
        first.sun_visible != elsewhen.sun_visible
    ).any()
    fresh = trace(moved, camera, pose, sun_at(35), roughness, tracer=build_tracer(moved, GAPS))
    np.testing.assert_array_equal(fresh.sun_visible, there.sun_visible)


def test_a_sun_that_its_owner_turns_in_place_is_another_sun():
    scene, sun = snapshot(plane(60.0), (box(6, 6, 8),), np.eye(4)[None, :3], [0], [-1]), sun_at(30.0)
    scene = replace(scene, fixed=1)
    tracer, camera, pose = build_tracer(scene), small_camera(), nadir()
    trace(scene, camera, pose, sun, np.ones(2), tracer=tracer)
    sun[:] = sun_at(70.0)
    again = trace(scene, camera, pose, sun, np.ones(2), tracer=tracer)
    fresh = trace(scene, camera, pose, sun, np.ones(2), tracer=build_tracer(scene))
    np.testing.assert_array_equal(again.sun_visible, fresh.sun_visible)


def test_a_scene_in_which_nothing_stands_still_has_light():
    nothing = Mesh(np.zeros((0, 3), np.float32), np.zeros((0, 3), np.int32), np.zeros(0, np.int16))
    scene = replace(snapshot(nothing, (box(6, 6, 8),), np.eye(4)[None, :3], [0], [0]), fixed=0)
    seen = trace(scene, small_camera(), nadir(), sun_at(40.0), np.ones(2))
    assert (seen.sun_visible[seen.vehicle_id == 0] == 1).any()
