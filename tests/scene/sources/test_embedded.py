"""The embedded layout: what is parked stands free of everything else."""

import numpy as np
import pytest
import shapely
from shapely.geometry import Polygon, box
from shapely.ops import unary_union

from glintrack.scene.design import SceneDesign
from glintrack.scene.objects.layout import body_to_enu
from glintrack.scene.objects.surfaces import RoadAreas, RoadNetwork
from glintrack.scene.sources.embedded import (
    NETWORK_MARGIN_M,
    draw_plan,
    fill_streets,
    load_shipped_recording,
    plan_xml,
)
from glintrack.scene.sources.neighbourhood import neighbourhood
from glintrack.scene.vehicles import load_vehicles

EXTENT_M = SceneDesign().extent_m


@pytest.fixture(scope="module")
def layout():
    return fill_streets(load_shipped_recording().network, EXTENT_M, np.random.default_rng(1))


@pytest.fixture(scope="module")
def parked(layout):
    return plan_of(
        [(p.east_m, p.north_m) for p in layout.parked],
        [p.heading_rad for p in layout.parked],
        [p.model for p in layout.parked],
    )


def plan_of(centres, headings, models):
    sizes = np.array([[d.length_m, d.width_m] for d in load_vehicles().values()])[np.asarray(models)]
    local = sizes[:, None, :] / 2 * np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]])
    position = np.c_[np.asarray(centres), np.zeros(len(sizes))]
    turn = body_to_enu(position, np.asarray(headings))
    plan = np.einsum("kij,kcj->kci", turn[:, :2, :2], local) + position[:, None, :2]
    return np.array([Polygon(p) for p in plan])


def overlap_m2(first, second):
    i, j = shapely.STRtree(second).query(first, predicate="intersects")
    return [
        first[a].intersection(second[b]).area for a, b in zip(i, j, strict=True) if first[a] is not second[b]
    ]


@pytest.mark.parametrize("use", ["shopping", "offices"])
def test_a_block_without_its_corner_is_built_upon(use):
    """Where the small shop would stand there is a square; the office park is hardly wider than its houses."""
    empty = Polygon()
    square = shapely.box(0, 0, 45, 40) if use == "shopping" else shapely.box(0, 0, 110, 110)
    streets = RoadAreas(square, empty, empty, empty, empty)
    block = shapely.box(0, 0, 150, 150)
    rng = np.random.default_rng(1)
    plan = neighbourhood(RoadNetwork((), ()), streets, block, lambda *_: use, rng)
    assert plan.buildings
    assert all(building.footprint.disjoint(square) for building in plan.buildings)


def test_parked_vehicles_overlap_neither_each_other_nor_buildings(layout, parked):
    assert len(parked) > 500
    assert max(overlap_m2(parked, parked), default=0.0) < 1e-6
    buildings = np.array([b.footprint for b in layout.buildings])
    assert max(overlap_m2(parked, buildings), default=0.0) < 1e-6


def test_no_driving_vehicle_touches_a_parked_one(parked):
    traffic = load_shipped_recording().traffic
    for time_s in np.arange(0.0, traffic.duration_s, 6.0):
        ids, states = traffic.at(float(time_s))
        driving = plan_of(states[:, :2], states[:, 2], traffic.model[ids])
        assert max(overlap_m2(driving, parked), default=0.0) == 0.0


def test_trees_and_buildings_stand_clear_of_the_street(layout):
    trunks = shapely.points([(t.east_m, t.north_m) for t in layout.trees])
    assert shapely.distance(trunks, layout.streets.carriageway).min() > 0.3
    built = unary_union([b.footprint for b in layout.buildings])
    assert built.intersection(layout.streets.all).area < 1e-6
    assert len(layout.buildings) > 250 and len(layout.trees) > 800


def test_the_window_has_streets_of_every_rank():
    network = load_shipped_recording().network.within(box(*EXTENT_M))
    kinds = {lane.street_type for lane in network.of_kind("car")}
    assert {"street.arterial", "street.collector", "street.residential"} <= kinds
    assert network.of_kind("crossing") and any(lane.signalled for lane in network.lanes)


def test_a_drawn_plan_fits_its_window_and_its_seed():
    one, again, other = (draw_plan(400, 900, np.random.default_rng(seed)) for seed in (3, 3, 4))
    assert one == again and one != other
    for lines, size in ((one.columns, 400), (one.rows, 900)):
        assert lines[0] == -size / 2 - NETWORK_MARGIN_M and lines[-1] == size / 2 + NETWORK_MARGIN_M
        assert 80 < np.diff(lines).min() and np.diff(lines).max() < 160
    assert one.arterial_columns and not one.arterial_columns & one.collector_columns
    nodes, edges = plan_xml(one)
    assert nodes.count("<node ") == len(one.columns) * len(one.rows)
    pieces = 2 * len(one.columns) * len(one.rows) - len(one.columns) - len(one.rows) - len(one.left_out)
    assert edges.count("<edge ") == 2 * pieces
