"""Boxes raw and rectified: layover in closed form, rectified masks, parked vehicles, what a run writes."""

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from glintrack import label_frame
from glintrack.ortho import ground_grid, rectify_array
from glintrack.render import build_tracer, build_vehicle_tracer
from glintrack.render.vehicles import PARKED_ID
from glintrack.results.epoch import BOX_COLUMNS, SceneView, label_mask, vehicle_boxes
from glintrack.results.run import run
from tests.bounds.test_run import case
from tests.render.test_vehicles import aslant, scene_of

HALF_A_CELL_M = 0.05


def level():
    edge = np.array([-500.0, 500.0])
    return xr.Dataset(
        {"height": (("y", "x"), np.zeros((2, 2)), {"units": "m"})},
        coords={"y": ("y", -edge, {"units": "m"}), "x": ("x", edge, {"units": "m"})},
    )


def truth_of(ids, speeds, visible):
    nothing = np.zeros(len(ids))
    columns = {"east_m": nothing, "north_m": nothing, "east_speed_m_s": speeds, "north_speed_m_s": nothing}
    columns |= {"visible_fraction": visible}
    return xr.Dataset({k: ("vehicle", np.asarray(v, float)) for k, v in columns.items()}, {"vehicle": ids})


def imaged(reported=None):
    """One car parked, one that drives and one that stands in the lane; seen from the south at 45°."""
    scene, (camera, pose) = scene_of([(-8.0, 4.0), (0.0, -6.0), (7.0, 3.0)], fixed=1), aslant()
    observer: Any = SimpleNamespace(
        camera=camera,
        city=SimpleNamespace(terrain=level()),
        tracer=build_tracer(scene),
        vehicle_tracer=build_vehicle_tracer(scene),
    )
    truth = truth_of([5, 6], [9.0, 0.2], [0.5, 1.0])
    return SceneView(observer, scene, truth, pose, reported or replace(pose, kind="reported"))


def test_rectified_boxes_lean_away_from_the_camera_by_their_height():
    """From 1000 m, 45° off nadir, a roof edge at height h and distance d lies h·d/(1000 − h) farther away."""
    boxes = vehicle_boxes(imaged())
    assert boxes["vehicle"].values.tolist() == [5, 6, PARKED_ID]
    for vehicle, (east, north) in {5: (0.0, -6.0), 6: (7.0, 3.0), PARKED_ID: (-8.0, 4.0)}.items():
        one = boxes.sel(vehicle=vehicle)
        far = north + 0.9 + 1000.0
        assert float(one["north_m"]) == pytest.approx(far * 1000 / 998.5 - 1000.0, abs=1e-3)
        assert float(one["south_m"]) == pytest.approx(north - 0.9, abs=1e-3)  # the sill nearest the camera
        assert float(one["east_m"]) == pytest.approx(
            max(e * 1000 / h for e in [east + 2.25] for h in (1000, 998.5)), abs=1e-3
        )
    assert boxes["moving"].values.tolist() == [1, 0, 0] and boxes["parked"].values.tolist() == [0, 0, 1]
    np.testing.assert_allclose(boxes["visible_fraction"], [0.5, 1.0, 1.0])
    assert set(boxes["class"].values) == {"car"}


def test_rectified_boxes_hold_the_rectified_mask():
    frame = imaged()
    boxes, mask = vehicle_boxes(frame), label_mask(frame)
    area, cell_m = (-12.0, -12.0, 12.0, 12.0), 2 * HALF_A_CELL_M
    x, y = ground_grid(area, cell_m)
    for vehicle in boxes["vehicle"].values.tolist():
        drawn = (mask.values == vehicle).astype(float)[..., None]
        on_map = rectify_array(
            drawn,
            frame.observer.camera,
            frame.reported_pose,
            frame.observer.city.terrain,
            cell_m,
            area,
            "nearest",
        )[..., 0]
        row, column = np.nonzero(on_map > 0.5)
        one = boxes.sel(vehicle=vehicle)
        within = 3 * HALF_A_CELL_M  # a cell, and an element of 0.075 m to 0.11 m
        assert float(one["west_m"]) == pytest.approx(x[column.min()] - HALF_A_CELL_M, abs=within)
        assert float(one["east_m"]) == pytest.approx(x[column.max()] + HALF_A_CELL_M, abs=within)
        assert float(one["south_m"]) == pytest.approx(y[row.max()] - HALF_A_CELL_M, abs=within)
        assert float(one["north_m"]) == pytest.approx(y[row.min()] + HALF_A_CELL_M, abs=within)


def test_an_error_of_the_reported_pose_moves_the_rectified_box_alone():
    true, pose = imaged(), imaged().true_pose
    moved = imaged(replace(pose, east_m=pose.east_m + 2.0, kind="reported"))
    before, after = vehicle_boxes(true), vehicle_boxes(moved)
    np.testing.assert_allclose(after["x0_px"], before["x0_px"])
    np.testing.assert_allclose(after["west_m"], before["west_m"] + 2.0, atol=1e-9)


def test_a_run_writes_the_boxes_of_every_frame(three_cars, tmp_path):
    flight = {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 3}
    design = case(flight=flight, output={"boxes": True, "film_frames": 0}, bound={"every": 0})
    result = run(design, tmp_path / "out")
    rows = pd.read_csv(result.path / "boxes.csv")
    assert list(rows.columns) == list(BOX_COLUMNS)
    assert len(rows) == 9 and sorted(rows["vehicle_id"].unique()) == [11, 22, 33]
    assert set(rows["class"]) == {"car"} and set(rows["moving"]) == {1} and set(rows["parked"]) == {0}
    np.testing.assert_allclose(rows["visible_fraction"], 1.0)
    again = label_frame(design, 2)
    last = rows[rows["frame"] == 2].set_index("vehicle_id")
    np.testing.assert_allclose(last.loc[[11, 22, 33], "x0_px"], again["x0_px"], rtol=1e-5)
    np.testing.assert_allclose(last.loc[[11, 22, 33], "west_m"], again["west_m"], rtol=1e-5)
    assert set(np.unique(again["mask"])) == {-1, 11, 22, 33}


def test_a_frame_that_is_none_is_refused(three_cars):
    with pytest.raises(ValueError, match=r"`frame` must lie in the flight's 0 to 12; got 13"):
        label_frame(case(), 13)
