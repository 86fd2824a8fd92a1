"""Hits against hand-worked geometry."""

import importlib
import math
from dataclasses import replace

import numpy as np
import pytest

from glintrack.camera import Pose, look_at, project, rays
from glintrack.render import build_tracer, one_sample_each, trace
from glintrack.render.trace import element_rays
from tests.conftest import box, nadir, plane, small_camera, snapshot
from tests.render.same_hits import assert_same_hits, of_elements

UP = np.array([0.0, 0.0, 1.0])
FLOAT32_AT_1_KM_M = 1e-3


def standing(x, y, heading_rad):
    """Body (x forward, y left) to ENU for a heading clockwise from north."""
    s, c = math.sin(heading_rad), math.cos(heading_rad)
    return np.array([[s, -c, 0, x], [c, s, 0, y], [0, 0, 1.0, 0]])


def test_level_ground_ranges_points_and_normals():
    camera, pose = small_camera(), nadir()
    hits = trace(snapshot(plane()), camera, pose, UP, np.zeros(1))
    np.testing.assert_allclose(hits.point[:, 2], 0, atol=FLOAT32_AT_1_KM_M)
    np.testing.assert_allclose(hits.normal, np.broadcast_to(UP, hits.normal.shape), atol=1e-6)
    pixels = project(camera, pose, hits.point.astype(float)).reshape(21, 21, 2)
    expected = np.stack(np.mgrid[:21, :21], axis=-1)
    np.testing.assert_allclose(pixels, expected, atol=0.01)  # a hundredth of an element
    assert (hits.sun_visible == 1).all() and (hits.sky_view == 1).all()


def test_a_box_throws_its_shadow_away_from_the_sun():
    """Sun in the south at 45°: a 10 m box shades 10 m of ground to its north, none to its south."""
    sun = np.array([0, -1, 1]) / math.sqrt(2)
    scene = snapshot(plane(), [box(4, 4, 10)], [standing(0, 0, 0)], [0])
    camera = small_camera(201, 201, 60)
    hits = trace(scene, camera, nadir(), sun, np.zeros(2))
    ground = hits.material == 0
    x, y = hits.point[:, 0], hits.point[:, 1]
    inside = ground & (np.abs(x) < 1.8) & (y > 2.4) & (y < 11.6)
    assert inside.sum() > 50 and (hits.sun_visible[inside] == 0).all()
    assert (hits.sun_visible[ground & (np.abs(x) > 2.4)] == 1).all()
    assert (hits.sun_visible[ground & (y < -2.4)] == 1).all()


def test_a_vehicle_driving_east_moves_right_in_a_north_up_frame():
    camera = small_camera(101, 101, 50)
    columns = []
    for east in (0.0, 10.0):
        scene = snapshot(
            plane(), [box(4.5, 1.8, 1.5)], [standing(east, 3.0, math.pi / 2)], [0], vehicle_id=[7]
        )
        hits = trace(scene, camera, nadir(), UP, np.zeros(2))
        seen = np.argwhere((hits.vehicle_id == 7).reshape(101, 101))
        columns.append(seen.mean(axis=0))
        extent = (np.ptp(seen, axis=0) + 1) * 0.5
        assert extent[1] == pytest.approx(4.5, abs=0.6) and extent[0] == pytest.approx(1.8, abs=0.6)
    assert columns[1][1] - columns[0][1] == pytest.approx(20, abs=1)  # 10 m at half a metre an element
    assert columns[0][0] < 50  # north of the centre is up


def test_instances_come_go_and_keep_their_ids():
    camera = small_camera(51, 51, 60)
    first = snapshot(
        plane(), [box(4, 2, 2)], [standing(0, 0, 0), standing(15, 0, 0)], [0, 0], vehicle_id=[3, 9]
    )
    tracer = build_tracer(first)
    seen = [set(trace(first, camera, nadir(), UP, np.zeros(2), tracer=tracer).vehicle_id.tolist())]
    second = snapshot(plane(), first.models, [standing(15, 0, 0)], [0], vehicle_id=[9])
    seen.append(set(trace(second, camera, nadir(), UP, np.zeros(2), tracer=tracer).vehicle_id.tolist()))
    seen.append(set(trace(first, camera, nadir(), UP, np.zeros(2), tracer=tracer).vehicle_id.tolist()))
    assert seen == [{-1, 3, 9}, {-1, 9}, {-1, 3, 9}]


def test_mirror_sees_the_box_or_the_sky():
    """Smooth ground before a wall: looking north at 45°, the reflected ray meets the wall or clears it."""
    scene = snapshot(plane(), [box(2, 200, 10)], [standing(0, 20, 0)], [0])
    pose = look_at(Pose(0, -1000, 1000), [0, 0, 0])
    hits = trace(scene, small_camera(101, 101, 60, 1414), pose, UP, np.zeros(2))
    ground = (hits.material == 0) & (np.abs(hits.point[:, 0]) < 20)
    distance = 19 - hits.point[:, 1]  # to the wall's south face
    wall = hits.mirror_material[ground & (distance > 0.5) & (distance < 9.5)]
    assert len(wall) and (wall == 1).all()
    assert (hits.mirror_material[ground & (distance > 10.5)] == -1).all()


def test_rays_of_one_plane_are_one_sample():
    """Level ground, 3 × 3 rays: one sample an element, at the middle ray's point."""
    camera = small_camera(5, 7, 20)
    coarse = trace(snapshot(plane()), camera, nadir(), UP, np.ones(1))
    fine = trace(snapshot(plane()), camera, nadir(), UP, np.ones(1), oversampling=3)
    np.testing.assert_allclose(fine.point, coarse.point, atol=FLOAT32_AT_1_KM_M)
    np.testing.assert_array_equal(fine.weight, 1)
    np.testing.assert_array_equal(fine.rays, 9)
    smooth = trace(snapshot(plane()), camera, nadir(), UP, np.zeros(1), oversampling=3)
    np.testing.assert_array_equal(np.diff(smooth.first), 9)  # each mirrors along its own ray
    np.testing.assert_allclose(smooth.weight, 1 / 9, rtol=1e-6)


def test_samples_are_what_their_rays_are():
    """Weights, points and light against a frame of three times as many elements with one ray each."""
    sun = np.array([0.6, 0.0, 0.8])
    scene = snapshot(plane(), [box(4, 4, 10)], [standing(0, 0, 0.3)], [0], vehicle_id=[5])
    camera, fine_camera = small_camera(15, 9), small_camera(45, 27)
    fine_camera = replace(fine_camera, pitch_m=camera.pitch_m / 3, focal_length_m=camera.focal_length_m)
    hits = trace(scene, camera, nadir(), sun, np.ones(2), oversampling=3)
    one = trace(scene, fine_camera, nadir(), sun, np.ones(2))
    assert len(hits.weight) < 0.5 * 9 * 15 * 9 and np.diff(hits.first).max() > 1
    sums = np.add.reduceat(hits.weight, hits.first[:-1])
    np.testing.assert_allclose(sums, 1, rtol=1e-6)

    def means(values):
        return values.reshape(15, 3, 9, 3).mean(axis=(1, 3)).ravel()

    for name in ("sun_visible", "range_m"):
        mine = np.add.reduceat(hits.weight * getattr(hits, name), hits.first[:-1])
        np.testing.assert_allclose(mine, means(getattr(one, name)), rtol=2e-6, atol=1e-6)
    seen = np.add.reduceat(hits.weight * (hits.vehicle_id == 5), hits.first[:-1])
    np.testing.assert_allclose(seen, means((one.vehicle_id == 5).astype(float)), atol=1e-6)


def test_one_sample_each_is_the_heaviest():
    scene, camera = snapshot(plane(), [box(4, 4, 10)], [standing(0, 0, 0)], [0]), small_camera(15, 9)
    hits = trace(scene, camera, nadir(), UP, np.ones(2), oversampling=3)
    kept = one_sample_each(hits)
    np.testing.assert_array_equal(np.diff(kept.first), 1)
    np.testing.assert_array_equal(kept.weight, 1)
    for element in range(15 * 9):
        mine = slice(hits.first[element], hits.first[element + 1])
        assert kept.material[element] == hits.material[mine][hits.weight[mine].argmax()]


def test_level_planes_of_two_heights_are_two_samples():
    """The mean of a roof's and the ground's rays would lie in the air between them."""
    ground, block, camera = plane(), box(4, 4, 10, 0), small_camera(15, 9)
    vertices = np.concatenate([ground.vertices, block.vertices])
    faces = np.concatenate([ground.faces, block.faces + len(ground.vertices)])
    both = snapshot(type(ground)(vertices, faces, np.zeros(len(faces), np.int16)))
    hits = trace(both, camera, nadir(), UP, np.ones(1), oversampling=3)
    height = hits.point[hits.normal[:, 2] > 0.99, 2]
    assert np.diff(hits.first).max() > 1 and 0.001 < (height > 5).mean() < 0.9
    np.testing.assert_allclose(height, np.where(height > 5, 10, 0), atol=FLOAT32_AT_1_KM_M)


def test_some_elements_alone_are_those_of_the_frame():
    scene, camera = snapshot(plane(), [box(4, 4, 10)], [standing(0, 0, 0)], [0]), small_camera(15, 9)
    whole = trace(scene, camera, nadir(), UP, np.zeros(2), oversampling=2)
    some = trace(scene, camera, nadir(), UP, np.zeros(2), oversampling=2, elements=np.array([70, 3, 62]))
    assert np.flatnonzero(some.rays).tolist() == [3, 62, 70]
    assert_same_hits(some, of_elements(whole, np.array([70, 3, 62])))


def test_false_self_shadow_is_rare_at_3_km():
    """Sloping facets seen from 3 km under a high sun: less than 1e-4 of points may shade themselves."""
    rng = np.random.default_rng(1)
    vertices = np.concatenate(
        [np.stack(np.meshgrid(np.arange(-40, 41), np.arange(-40, 41)), -1).reshape(-1, 2) * 5.0,
         rng.uniform(0, 0.5, (81 * 81, 1))], axis=1,
    ).astype(np.float32)  # fmt: skip
    i = (np.arange(80)[:, None] * 81 + np.arange(80)).ravel()
    faces = np.concatenate([np.stack([i, i + 1, i + 82], 1), np.stack([i, i + 82, i + 81], 1)])
    mesh = type(plane())(vertices, faces.astype(np.int32), np.zeros(len(faces), np.int16))
    pose = look_at(Pose(0, -2298, 1928), [0, 0, 0])
    hits = trace(snapshot(mesh), small_camera(400, 400, 200, 3000), pose, UP, np.zeros(1))
    assert (hits.sun_visible == 0).mean() < 1e-4


def test_bad_poses_are_refused_in_one_sentence():
    with pytest.raises(ValueError, match=r"`pose.up_m` must be above the ground; got -5 m"):
        trace(snapshot(plane()), small_camera(), nadir(-5.0), UP, np.zeros(1))
    with pytest.raises(ValueError, match="`pose` must be a true pose to render with; got a reported one"):
        trace(snapshot(plane()), small_camera(), nadir(kind="reported"), UP, np.zeros(1))


def test_fixed_instances_stand_where_moving_ones_would():
    """A scaled and turned instance casts the same rays whether it is placed once or at every frame."""
    turned = 2.0 * standing(0, 0, 0.4)
    turned[:, 3] = [-12, 5, 0]
    places, camera = [turned, standing(15, 0, 0)], small_camera(101, 101, 60)
    moving = snapshot(plane(), [box(4, 2, 2)], places, [0, 0], vehicle_id=[-1, 9])
    fixed = replace(moving, fixed=1)
    tracer = build_tracer(fixed)
    first = {name: getattr(fixed, name)[:1] for name in ("transforms", "model", "paint", "vehicle_id")}
    gone = replace(fixed, **first)
    trace(gone, camera, nadir(), UP, np.zeros(2), tracer=tracer)  # the moving one leaves and comes back
    ours = trace(fixed, camera, nadir(), UP, np.zeros(2), tracer=tracer)
    theirs = trace(moving, camera, nadir(), UP, np.zeros(2))
    for name in ("range_m", "material", "vehicle_id", "normal", "point", "sun_visible"):
        found = getattr(ours, name)
        found = np.maximum(found, -1) if name == "vehicle_id" else found  # a parked vehicle has an id below
        np.testing.assert_array_equal(found, getattr(theirs, name), err_msg=name)
    assert (ours.vehicle_id == -2).any()
    area_m2 = (60 / 101) ** 2 * ((ours.material == 1) & (ours.point[:, 0] < 0)).sum()
    assert area_m2 == pytest.approx(4 * 4 * 2, rel=0.1)  # twice the size: four times the area
    np.testing.assert_allclose(np.linalg.norm(ours.normal, axis=1), 1, atol=1e-6)
    with pytest.raises(ValueError, match=r"`snapshot.fixed` must be 1, as when the tracer was built; got 0"):
        trace(moving, camera, nadir(), UP, np.zeros(2), tracer=tracer)


def test_a_mirror_sees_sunlit_and_shaded_walls():
    """The wall that smooth ground mirrors stands in the sun or in its own shade."""
    scene = snapshot(plane(), [box(2, 200, 10)], [standing(0, 20, 0)], [0])
    pose = look_at(Pose(0, -1000, 1000), [0, 0, 0])
    for north, expected in ((-1, math.sqrt(0.5)), (1, 0.0)):  # the wall faces south
        sun = np.array([0, north, 1]) / math.sqrt(2)
        hits = trace(scene, small_camera(101, 101, 60, 1414), pose, sun, np.zeros(2))
        wall = (hits.material == 0) & (hits.mirror_material == 1) & (np.abs(hits.point[:, 0]) < 20)
        np.testing.assert_allclose(hits.mirror_sun[wall], expected, atol=1e-6)
        np.testing.assert_allclose(hits.mirror_sky[wall], 0.5, atol=1e-6)
        assert (hits.mirror_sun[hits.mirror_material < 0] == 0).all()
    rough = trace(scene, small_camera(), pose, sun, np.ones(2))
    assert (rough.mirror_material[rough.material == 0] == -1).all()  # the wall may move, as a vehicle does


def test_an_empty_scene_is_refused_in_one_sentence():
    nothing = type(plane())(np.zeros((0, 3)), np.zeros((0, 3), int), np.zeros(0, int))
    with pytest.raises(ValueError, match="`snapshot` must hold at least one triangle; got an empty scene"):
        trace(snapshot(nothing), small_camera(), nadir(), UP, np.zeros(1))


@pytest.mark.parametrize("n", [1, 2, 3])
def test_rays_are_the_cameras(n):
    """The kernel that fills directions against `camera.rays` at the same places."""
    camera = replace(small_camera(6, 9, 300), principal_row=2.2, principal_column=5.1)
    pose = look_at(Pose(30, -900, 1000, 0.3, 0.05, -0.1), [0, 0, 0])
    offset = (np.arange(n) + 0.5) / n - 0.5
    row, column = np.divmod(np.arange(6 * 9), 9)
    down, right = (axis.ravel() for axis in np.meshgrid(offset, offset, indexing="ij"))
    pixels = np.stack([row[:, None] + down, column[:, None] + right], axis=-1)
    found = element_rays(camera, pose, np.arange(6 * 9), n)
    np.testing.assert_allclose(found, rays(camera, pose, pixels).reshape(-1, 3), atol=1e-7)
    hits = trace(snapshot(plane()), camera, pose, UP, np.ones(1))
    np.testing.assert_allclose(hits.direction, rays(camera, pose).reshape(-1, 3), atol=1e-7)


def test_a_lens_may_stand_in_a_valley_or_under_a_bridge_but_not_underground():
    valley, bridge = plane(400, -30.0), plane(50, 12.0, 1)
    vertices = np.concatenate([valley.vertices, bridge.vertices])
    material = np.concatenate([valley.material, bridge.material])
    mesh = type(valley)(vertices, np.concatenate([valley.faces, bridge.faces + 4]), material)
    for up_m in (-29.0, 5.0, 40.0):
        hits = trace(snapshot(mesh), small_camera(), nadir(up_m), UP, np.zeros(2))
        assert (hits.material[220] == 0) == (up_m < 12)
    with pytest.raises(ValueError, match=r"`pose.up_m` must be above the ground; got -31 m"):
        trace(snapshot(mesh), small_camera(), nadir(-31.0), UP, np.zeros(2))
    house = snapshot(plane(), [box(10, 10, 8)], [standing(30, 0, 0)], [0])
    sealed = replace(house, static=plane(20))
    with pytest.raises(ValueError, match="above the ground; got 4 m"):  # in a house that stands on its floor
        trace(sealed, small_camera(), Pose(30, 0, 4), UP, np.zeros(2))
    with pytest.raises(ValueError, match="above the ground; got -1 m"):  # beyond the edge
        trace(house, small_camera(), Pose(5000, 0, -1), UP, np.zeros(2))


@pytest.mark.parametrize("off_nadir_deg", [70, 85])
def test_oblique_views_reach_the_horizon_and_the_sky(off_nadir_deg):
    """Ranges of level ground h/cos, in the scene and beyond its edge; above the horizon nothing is met."""
    tangent = math.tan(math.radians(off_nadir_deg))
    pose = look_at(Pose(0, -1000 * tangent, 1000), [0, 0, 0])
    wide = small_camera(120, 90, 4 * 1000 / math.cos(math.radians(70)), 1000)
    hits = trace(snapshot(plane(3000)), wide, pose, UP, np.zeros(2), surroundings=1)
    sky = hits.material < 0
    np.testing.assert_array_equal(sky, hits.direction[:, 2] >= 0)
    assert 0.05 < sky.mean() < 0.6 and (hits.material == 1).any()
    assert (hits.material == 0).any() == (off_nadir_deg == 70)
    assert np.isinf(hits.range_m[sky]).all() and (hits.normal[sky] == 0).all()
    assert not hits.sun_visible[sky].any() and (hits.mirror_material == -1).all()
    expected = -1000 / hits.direction[~sky, 2].astype(float)
    np.testing.assert_allclose(hits.range_m[~sky], expected, rtol=1e-4)
    assert (hits.sun_visible[~sky] == 1).all() and np.isfinite(hits.point).all()


def test_the_sun_is_a_disc_if_asked():
    """Penumbra of an edge 100 m up under a sun of radius a: light falls from 1 to 0 over 2·100·tan a."""
    radius_m = 100 * math.tan(4.65e-3)
    half = plane(400, 100.0, 1)
    vertices = np.concatenate([plane().vertices, half.vertices + np.float32([200, 0, 0])])
    faces = np.concatenate([plane().faces, half.faces + 4])
    mesh = type(half)(vertices, faces, np.array([0, 0, 1, 1], np.int16))
    pose = look_at(Pose(-300, 0.5, 90), [0, 0.5, 0])  # looks in under the roof
    camera = small_camera(61, 61, 1.5, 313)
    sharp = trace(snapshot(mesh), camera, pose, UP, np.ones(2))
    soft = trace(snapshot(mesh), camera, pose, UP, np.ones(2), sun_samples=200)
    x = np.clip(-soft.point[:, 0] / radius_m, -1, 1)  # the part of a disc on one side of a chord
    expected = 0.5 + (np.arcsin(x) + x * np.sqrt(1 - x * x)) / math.pi
    one_sample = 1 / 200
    np.testing.assert_allclose(soft.sun_visible, expected, atol=4 * one_sample)
    assert ((soft.sun_visible > 0.1) & (soft.sun_visible < 0.9)).sum() > 100
    assert set(np.unique(sharp.sun_visible)) == {0.0, 1.0}
    with pytest.raises(ValueError, match="`sun_samples` must be at least 1; got 0"):
        trace(snapshot(mesh), camera, pose, UP, np.ones(2), sun_samples=0)


@pytest.mark.parametrize("slope_deg", [0, 25, 45])
def test_false_self_shadow_on_planes_and_roofs_at_3_km(slope_deg):
    """A lone roof in the sun, 3 km away at every tilt of the view: none of it may lie in shade."""
    s, c = math.sin(math.radians(slope_deg)), math.cos(math.radians(slope_deg))
    level = plane(120)
    roof = level.vertices @ np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]], np.float32) + np.float32(
        [250, -180, 40]
    )
    scene = snapshot(type(level)(roof, level.faces, level.material))
    tracer, camera = build_tracer(scene), small_camera(60, 60, 90, 3000)
    wrong, count = 0, 0
    for azimuth in np.radians([10, 100, 190, 280]):
        for off_nadir in np.radians([5, 50, 70]):
            away = 3000 * np.array(
                [math.sin(off_nadir) * math.sin(azimuth), math.sin(off_nadir) * math.cos(azimuth)]
            )
            pose = look_at(
                Pose(250 + away[0], -180 + away[1], 40 + 3000 * math.cos(off_nadir)), [250, -180, 40]
            )
            for elevation in np.radians([8, 30, 60]):
                sun = np.array([0, -math.cos(elevation), math.sin(elevation)])
                hits = trace(scene, camera, pose, sun, np.ones(1), tracer=tracer)
                lit = np.isfinite(hits.range_m) & (hits.normal @ sun > 0.02) & (hits.point[:, 2] != 0)
                wrong, count = wrong + int((hits.sun_visible[lit] == 0).sum()), count + int(lit.sum())
    assert count > 50_000 and wrong / count < 1e-4


def test_the_sun_lights_the_back_of_a_leaf_card_and_of_nothing_else():
    """Cards seen from below, the sun overhead: what arrives at their tops is reported; slabs stay dark."""
    slab = plane(60, 5.0, 1)
    mesh = type(slab)(
        np.concatenate([plane().vertices, slab.vertices]),
        np.concatenate([plane().faces, slab.faces + 4]),
        np.array([0, 0, 1, 1], np.int16),
    )
    pose = look_at(Pose(0, -40, 1), [0, 0, 5])
    for gap, expected in ((0.5, 1.0), (0.0, 0.0)):
        tracer = build_tracer(snapshot(mesh), np.array([0.0, gap]))
        hits = trace(snapshot(mesh), small_camera(41, 41, 8, 40), pose, UP, np.ones(2), tracer=tracer)
        under = hits.material == 1
        assert under.any() and (hits.normal[under, 2] < 0).all()
        np.testing.assert_array_equal(hits.sun_visible[under], expected)


def test_rows_that_are_traced_apart_make_one_frame(monkeypatch):
    """A frame in slices of a few rows, cut across its tiles' edge, against the frame in one."""
    scene = snapshot(plane(), [box(4, 4, 10)], [standing(3, -2, 0.3)], [0], vehicle_id=[5])
    sun, tracer = np.array([1, 0, 1]) / math.sqrt(2), build_tracer(scene)
    pose, frames = look_at(Pose(0, -800, 600), [0, 0, 0]), []
    for at_a_time in (1 << 30, 300):
        module = importlib.import_module("glintrack.render.trace")  # `trace` is also the function's name
        monkeypatch.setattr(module, "_RAYS_AT_A_TIME", at_a_time)
        frames.append(trace(scene, small_camera(51, 67, 60), pose, sun, np.zeros(2), 0, 2, tracer, 4))
    for name, ours, theirs in zip(frames[0]._fields, *frames, strict=True):
        np.testing.assert_array_equal(ours, theirs, err_msg=name)
    assert 0 < (frames[0].sun_visible < 1).mean() < 0.5 and (frames[0].mirror_material >= 0).any()
