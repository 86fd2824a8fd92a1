"""The embedded city: same seed, same city; vehicles on its streets; truth that agrees with the picture."""

import numpy as np
import pytest
import shapely
from pydantic import ValidationError
from shapely.geometry import Polygon, box
from shapely.ops import unary_union

from glintrack.core import schema
from glintrack.render.rays.embree import EmbreeTracer
from glintrack.scene import PAINT, SceneDesign, build_scene
from glintrack.scene.objects.layout import body_to_enu
from glintrack.scene.objects.surfaces import MARKING_M, PAVEMENT_M, ROAD_M, road_areas
from glintrack.scene.sources.embedded import fill_streets, load_shipped_recording
from glintrack.scene.vehicles import VEHICLE_CLASSES

LEAVES = ("leaf", "leaf_walnut", "leaf_conifer")


@pytest.fixture(scope="module")
def city():
    return build_scene(SceneDesign(seed=1))


@pytest.fixture(scope="module")
def level():
    return build_scene(SceneDesign(seed=1, relief_m=0, trees=False))


def faces_of(city, *materials):
    names = list(city.materials["material"].values)
    return np.isin(city.static.material, [names.index(m) for m in materials])


@pytest.mark.slow
def test_same_seed_same_bytes(city, monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))  # built anew, not read
    again = build_scene(SceneDesign(seed=1))
    for name in ("vertices", "faces", "material"):
        assert getattr(again.static, name).tobytes() == getattr(city.static, name).tobytes()
        for one, other in zip(again.models, city.models, strict=True):
            assert getattr(one, name).tobytes() == getattr(other, name).tobytes()
    for name in ("transforms", "model", "paint"):
        assert getattr(again.planted, name).tobytes() == getattr(city.planted, name).tobytes()
    assert again.paints.tobytes() == city.paints.tobytes()
    assert again.terrain["height"].values.tobytes() == city.terrain["height"].values.tobytes()


def test_same_seed_same_layout_and_other_seed_other_layout():
    network = load_shipped_recording().network.within(box(-150, -100, 0, 0))
    extent = (-140.0, -90.0, -10.0, -10.0)
    one, again, other = (fill_streets(network, extent, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert one.buildings == again.buildings and one.trees == again.trees and one.parked == again.parked
    assert one.trees != other.trees and one.parked != other.parked


@pytest.mark.slow
def test_without_trees_there_is_no_leaf_and_all_else_stays(city):
    bare = build_scene(SceneDesign(seed=1, trees=False))
    assert not faces_of(bare, *LEAVES).any() and bare.planted.model.max() <= len(VEHICLE_CLASSES)
    grown = city.planted.model > len(VEHICLE_CLASSES)  # after the vehicles comes a hedge
    assert (
        grown.sum() > 800 and bare.planted.transforms.tobytes() == city.planted.transforms[~grown].tobytes()
    )
    assert bare.static.vertices.tobytes() == city.static.vertices.tobytes()


def test_half_of_the_trees_are_half_of_them_where_they_stood(city):
    half = build_scene(SceneDesign(seed=1, trees=0.5))
    places = [
        {tuple(t) for t in one.planted.transforms[one.planted.model > len(VEHICLE_CLASSES), :, 3].tolist()}
        for one in (half, city)
    ]
    assert places[0] < places[1]
    assert len(places[0]) == pytest.approx(0.5 * len(places[1]), abs=1)


def test_what_is_planted_comes_first_and_never_moves(city):
    one, later = city.at(3.0), city.at(50.0)
    assert one.fixed == later.fixed == len(city.planted) > 1500
    fixed = slice(0, one.fixed)
    assert one.transforms[fixed].tobytes() == later.transforms[fixed].tobytes()
    assert (one.vehicle_id[fixed] == -1).all() and (one.vehicle_id[one.fixed :] >= 0).all()
    # rotations times one scale, so that a normal turns as the model does
    square = np.einsum("kij,kil->kjl", one.transforms[..., :3], one.transforms[..., :3])
    scale = np.sqrt(square[:, 0, 0])
    np.testing.assert_allclose(square, np.eye(3) * scale[:, None, None] ** 2, atol=1e-9)
    assert (np.linalg.det(one.transforms[..., :3]) > 0).all()
    tree = one.model > len(VEHICLE_CLASSES)
    np.testing.assert_allclose(scale[~tree], 1)
    assert 5 <= scale[tree].min()


def test_datasets_satisfy_their_schemas(city):
    schema.check(city.materials, "materials")
    schema.check(city.terrain, "terrain")
    assert np.all(np.diff(city.terrain["y"]) < 0)
    west, south, east, north = city.extent_m
    assert (east - west, north - south) == (660, 420) and (west + east, south + north) == (0, 0)
    assert city.materials.sizes["material"] > city.static.material.max() and city.static.material.min() >= 0


def test_ground_lies_at_its_heights_and_covers_the_window(level):
    city = level
    vertices = city.static.vertices[city.static.faces]
    for material, height in (("asphalt", ROAD_M), ("pavement", None), ("road_paint", MARKING_M)):
        z = vertices[faces_of(city, material)][..., 2]
        allowed = [height] if height is not None else [PAVEMENT_M, 0.10]
        if material == "road_paint":
            allowed.append(0.03)  # the stalls of car parks are painted at the car park's height
        assert np.isin(np.round(z, 4), np.round(np.float32(allowed), 4)).all()


def test_level_surfaces_do_not_overlap_in_plan(level):
    city = level
    plan = city.static.vertices[city.static.faces]
    level = np.ptp(plan[..., 2], axis=1) == 0
    ground = level & (np.abs(plan[:, 0, 2]) <= 0.15) & (plan[:, 0, 2] > -0.09)
    raised_paint = faces_of(city, "road_paint") & (np.abs(plan[:, 0, 2] - MARKING_M) < 1e-6)
    a, b, c = (plan[ground & ~raised_paint][:, i, :2].astype(float) for i in range(3))
    area = 0.5 * np.abs((b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0])
    x0, y0, x1, y1 = -410, -290, 410, 290  # the window and its margin
    slack = 2e-3  # slivers left out, rounding to float32
    assert area.sum() == pytest.approx((x1 - x0) * (y1 - y0), rel=slack)


def test_size_and_number(city):
    stored = len(city.static.faces) + sum(len(m.faces) for m in city.models)
    assert stored < 300_000
    assert all(city.truth(t).sizes["vehicle"] > 200 for t in np.linspace(0, city.duration_s, 13))
    assert city.duration_s >= 60


def test_truth_and_snapshot_agree_and_ids_are_stable(city):
    for time_s in (0.0, 7.35, city.duration_s):
        truth, snapshot = city.truth(time_s), city.at(time_s)
        moving = snapshot.transforms[snapshot.fixed :]
        np.testing.assert_array_equal(truth["vehicle"].values, snapshot.vehicle_id[snapshot.fixed :])
        np.testing.assert_allclose(moving[:, 0, 3], truth["east_m"])
        along = np.cos(truth["pitch_rad"].values)
        np.testing.assert_allclose(moving[:, 0, 0], along * np.sin(truth["heading_rad"]), atol=1e-12)
        np.testing.assert_allclose(moving[:, 1, 0], along * np.cos(truth["heading_rad"]), atol=1e-12)
        assert snapshot.models is city.models and snapshot.static is city.static
    one, later = city.truth(10.0), city.truth(10.1)
    both = np.intersect1d(one["vehicle"], later["vehicle"])
    assert both.size > 100
    moved = np.hypot(
        *(later[n].sel(vehicle=both).values - one[n].sel(vehicle=both).values for n in ("east_m", "north_m"))
    )
    assert moved.max() < 2.0  # no id jumps to another vehicle: 20 m/s is beyond the limit of 13.9 m/s
    first, second = city.at(10.0), city.at(10.1)
    paint, after = (
        dict(zip(s.vehicle_id[s.fixed :].tolist(), s.paint[s.fixed :].tolist(), strict=True))
        for s in (first, second)
    )
    assert all(paint[i] == p for i, p in after.items() if i in paint)


def test_velocity_is_the_change_of_position(city):
    before, now, after = (city.truth(t) for t in (19.9, 20.0, 20.1))
    same = np.intersect1d(np.intersect1d(before["vehicle"], now["vehicle"]), after["vehicle"])
    for position, speed in (("east_m", "east_speed_m_s"), ("north_m", "north_speed_m_s")):
        slope = (after[position].sel(vehicle=same) - before[position].sel(vehicle=same)) / 0.2
        braking_over_two_tenths = 1.0  # m/s: 5 m/s² within the 0.2 s spans compared
        assert np.abs(slope - now[speed].sel(vehicle=same)).max() < braking_over_two_tenths


def test_moving_vehicles_head_where_they_go(city):
    truth = city.truth(30.0)
    speed = np.hypot(truth["east_speed_m_s"], truth["north_speed_m_s"])
    fast = speed.values > 3
    along = truth["east_speed_m_s"] * np.sin(truth["heading_rad"]) + truth["north_speed_m_s"] * np.cos(
        truth["heading_rad"]
    )
    assert fast.sum() > 30
    assert (along / speed).values[fast].min() > np.cos(np.radians(20))  # turning and changing lanes


def test_vehicles_stand_on_the_carriageway_and_drive_on_the_right(city):
    network = load_shipped_recording().network
    streets = road_areas(network, box(-410, -290, 410, 290))
    shapely.prepare(streets.carriageway)
    for time_s in (0.0, 33.3, 66.6, 99.9):
        truth = city.truth(time_s)
        on_road = shapely.contains_xy(streets.carriageway, truth["east_m"].values, truth["north_m"].values)
        assert on_road.all()
    # right-hand traffic: a lane of the opposite direction lies to the left
    cars = network.of_kind("car")
    lane = next(c for c in cars if c.line.length > 60 and c.edge_id.startswith("n4_4-n5_4"))
    twin = next(c for c in cars if c.edge_id.startswith("n5_4-n4_4"))
    ahead = lane.points[-1] - lane.points[0]
    aside = np.mean(twin.points, axis=0) - np.mean(lane.points, axis=0)
    assert ahead[0] * aside[1] - ahead[1] * aside[0] > 0


def test_moving_vehicles_do_not_overlap_each_other(city):
    worst = 0.0
    for time_s in (5.0, 50.0, 95.0):
        truth = city.truth(time_s)
        bodies = footprints(truth)
        tree = shapely.STRtree(bodies)
        i, j = tree.query(bodies, predicate="intersects")
        worst = max(
            [worst, *(bodies[a].intersection(bodies[b]).area for a, b in zip(i, j, strict=True) if a < b)]
        )
    # SUMO lets long vehicles cut the corner in turns; half a square metre is a brush of mirrors
    assert worst < 0.5


def footprints(truth):
    transforms = body_to_enu(
        np.stack([truth["east_m"], truth["north_m"], truth["up_m"]], axis=1), truth["heading_rad"].values
    )
    half = np.stack([truth["length_m"], truth["width_m"]], axis=1) / 2
    signs = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    local = half[:, None, :] * signs
    plan = np.einsum("kij,kcj->kci", transforms[:, :2, :2], local) + transforms[:, None, :2, 3]
    return np.array([Polygon(p) for p in plan])


def test_no_corner_of_a_vehicle_leaves_the_carriageway(city):
    streets = road_areas(load_shipped_recording().network, box(-410, -290, 410, 290))
    a_kerb_brushed_m = 0.2
    for time_s in np.linspace(0.0, city.duration_s, 7):
        corners = shapely.points(shapely.get_coordinates(footprints(city.truth(time_s))))
        assert shapely.distance(corners, streets.carriageway).max() < a_kerb_brushed_m


@pytest.mark.parametrize("time_s", [0.0, 31.0, 77.0, 120.0])
def test_no_wheel_leaves_the_road_it_sees_below_it(city, time_s):
    """Over the default city's hills: each tyre's lowest corners against the surface met by a plumb line."""
    assert np.ptp(city.terrain["height"].values) == pytest.approx(6)
    snapshot, tracer = city.at(time_s), EmbreeTracer(city.static, ())
    moving, heights = slice(snapshot.fixed, None), []
    for model, transform in zip(snapshot.model[moving], snapshot.transforms[moving], strict=True):
        body = snapshot.models[model].vertices
        foot = body[body[:, 2] == 0] @ transform[:, :3].T + transform[:, 3]
        above = (foot + [0, 0, 4.0]).astype(np.float32)
        below = tracer.intersect(above, np.array([[0, 0, -1]], np.float32).repeat(len(foot), axis=0))[0]
        heights.append(4.0 - below)
    off = np.concatenate(heights)  # of the road over the tyre; its kerbs and marks are 2 to 12 cm high
    assert np.abs(off).max() < 0.2
    assert np.ptp(snapshot.transforms[moving, 2, 3]) > 2


def test_vehicle_heading_east_points_its_nose_east():
    (transform,) = body_to_enu(np.array([[3.0, 4.0, 0.0]]), np.array([np.pi / 2]))
    np.testing.assert_allclose(transform @ [2, 0, 0, 1], [5, 4, 0], atol=1e-12)
    np.testing.assert_allclose(transform @ [0, 1, 0, 1], [3, 5, 0], atol=1e-12)  # its left is north


def test_vehicles_far_outside_are_dropped(city):
    for time_s in (0.0, 60.0):
        truth = city.truth(time_s)
        assert np.abs(truth["east_m"]).max() < 360 and np.abs(truth["north_m"]).max() < 240


def test_time_outside_the_recording_is_refused(city):
    with pytest.raises(
        ValueError, match="`time_s` must lie within the recorded traffic, 0 to 120 s; got 121"
    ):
        city.truth(121.0)


def test_unknown_key_is_refused():
    with pytest.raises(ValidationError, match="tree"):
        SceneDesign(tree=False)


def test_models_carry_the_paint_of_their_instance_only(city):
    assert all((m.material == PAINT).any() for m in city.models)
    assert (city.static.material != PAINT).all()
    share = city.materials["paint_share"].values
    assert (share[city.paints] > 0).all()


def test_markings_lie_on_asphalt():
    network = load_shipped_recording().network
    streets = road_areas(network, box(-410, -290, 410, 290))
    assert streets.markings.difference(streets.carriageway).area == pytest.approx(0, abs=1e-6)
    parts = (streets.carriageway, streets.kerb, streets.pavement)
    assert sum(p.area for p in parts) == pytest.approx(unary_union(parts).area, rel=1e-9)


@pytest.mark.parametrize("size_m", [(170.0, 160.0), (50.0, 50.0), (80.0, 50.0)])
def test_a_window_whose_streets_clip_badly_is_built(size_m):
    """Where quick clipping leaves rings that cross themselves, the ground was refused by GEOS."""
    width, height = size_m
    city = build_scene(SceneDesign(width_m=width, height_m=height, traffic_duration_s=2))
    assert len(city.static.faces) > 0


def test_roads_that_no_vehicle_enters_name_the_key_that_lets_them():
    empty = SceneDesign(
        width_m=170.0,
        height_m=160.0,
        traffic_insertion_period_s=3600,
        traffic_duration_s=2,
    )
    with pytest.raises(ValueError, match=r"`scene.traffic_insertion_period_s` must let a vehicle drive"):
        build_scene(empty)
