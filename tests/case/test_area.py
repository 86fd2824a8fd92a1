"""Which vehicles are scored: of the window, of the ground in the frame, or of a polygon."""

import numpy as np
import pytest

from glintrack import Case, simulate
from glintrack.camera import Pose
from glintrack.case.area import describe_window, fit_window, scored_area
from glintrack.case.packaged import find_case
from glintrack.core.records import Extent
from glintrack.flight import Flight
from glintrack.metrics import area_km2
from glintrack.scene.objects.terrain import flat_terrain
from tests.conftest import nadir, small_camera
from tests.metrics.test_tracks import truth
from tests.system.test_loop import case as three_cars_case

WINDOW = Extent(-330.0, -210.0, 330.0, 210.0)


def area_of(case, camera):
    return scored_area(case, WINDOW, camera, Flight(case.flight, 0.0))


def looking_down(**changes):
    return Case().replace({"flight.off_nadir_deg": 0.0, "flight.altitude_m": 1000.0, **changes})


def camera_of(case):
    across_m = case.sensor.columns * case.sensor.pitch_m / case.sensor.focal_length_m * 1928
    return small_camera(case.sensor.rows, case.sensor.columns, across_m, 1928)


@pytest.mark.parametrize("name", ["quickstart", "braunschweig"])
def test_packaged_cases_keep_their_window_and_score_it(name):
    case = Case.from_toml(find_case(name))
    assert fit_window(case) is case
    area = area_of(case, camera_of(case))
    assert area.kind == "window"
    marked, of_frame = area.mark(three_vehicles(), flat_terrain(WINDOW), camera_of(case), nadir())
    assert of_frame == WINDOW and marked["inside"].values.tolist() == [True, True, False]


def three_vehicles():
    """One in the middle, one 200 m east, one beyond the window."""
    return truth((1, 0.0, 0.0, 10.0), (2, 200.0, 0.0, 10.0), (3, 400.0, 0.0, 10.0))


def test_a_small_footprint_is_scored_and_has_its_own_size():
    """A frame of 100 m × 60 m at nadir, level ground."""
    case, camera = looking_down(), small_camera(60, 100, 100.0, 1000.0)
    area = area_of(case, camera)
    assert area.kind == "footprint"
    marked, of_frame = area.mark(three_vehicles(), flat_terrain(WINDOW), camera, nadir(1000.0))
    assert area_km2(of_frame) == pytest.approx(0.006, rel=1e-6)
    assert marked["inside"].values.tolist() == [True, False, False]
    assert area_of(case.replace({"scene.area": "window"}), camera).kind == "window"


def test_a_footprint_beyond_the_window_has_no_vehicles_and_no_size():
    area = area_of(looking_down(**{"scene.area": "footprint"}), small_camera(60, 100, 100.0, 1000.0))
    far = Pose(5000.0, 0.0, 1000.0)
    marked, of_frame = area.mark(three_vehicles(), flat_terrain(WINDOW), small_camera(), far)
    assert not marked["inside"].any() and np.isnan(area_km2(of_frame))


def test_a_polygon_is_cut_at_the_window():
    triangle = [[0.0, -1000.0], [0.0, 1000.0], [1000.0, 0.0]]
    area = area_of(looking_down(**{"scene.area": triangle}), small_camera())
    assert area.kind == "polygon" and area.polygon.area == pytest.approx(330.0 * 420.0)
    with pytest.raises(ValueError, match=r"`scene.area` must lie in the window, east -330 to 330 m"):
        area_of(looking_down(**{"scene.area": [[900, 0], [900, 9], [990, 0]]}), small_camera())


@pytest.mark.parametrize(
    "corners", [[[0, 0], [1, 1]], [[0, 0], [9, 9], [9, 0], [0, 9]], [[0, 0], [1, 1], [2, 2]]]
)
def test_corners_that_bound_no_area_are_refused(corners):
    with pytest.raises(ValueError, match=r"`scene.area` must have 3 to 1,000 corners in their order"):
        Case().replace({"scene.area": corners})


def test_the_window_grows_to_a_large_footprint_unless_it_is_fixed():
    """2048 elements of 0.7 m at nadir: 1434 m of ground, on the default city of 660 m × 420 m."""
    wide = looking_down(
        **{"flight.altitude_m": 14_000.0, "sensor.pitch_um": 5.0, "sensor.focal_length_mm": 100.0,
           "sensor.rows": 2048, "sensor.columns": 2048, "atmosphere.altitudes_m": [500.0, 15_000.0]}
    )  # fmt: skip
    grown = fit_window(wide)
    line = describe_window(wide)
    assert (
        "grows from 660 m × 420 m of the city embedded to the ground in the frame, 1,430 m × 1,430 m" in line
    )
    assert "Its traffic needs SUMO" in line and "SUMO is not needed" in describe_window(Case())
    assert grown.scene.size_m == (1430.0, 1430.0)
    fixed = wide.replace({"scene.width_m": 660.0})
    assert fit_window(fixed) is fixed
    huge = wide.replace({"sensor.columns": 8192, "sensor.rows": 8192})
    assert np.prod(fit_window(huge).scene.size_m) <= 4e6


def test_scores_budget_and_truth_are_of_one_area(three_cars):
    """One of three cars starts in the polygon, which has a hundredth of a square kilometre."""
    left = [[-120.0, -90.0], [-20.0, -90.0], [-20.0, 10.0], [-120.0, 10.0]]
    case = three_cars_case(flight={"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 4, "rate_hz": 2.0})
    seen = []
    tree = simulate(case.replace({"scene.area": left}), seen.append)
    assert tree.attrs["area"] == "polygon" and tree["pan"].attrs["learning_frames"] == 2
    assert tree["pan"].attrs["frames"] == 2 and tree["pan"].sizes["time"] == 4
    assert tree["pan"].attrs["vehicles_per_frame"] == 1
    assert tree["truth"]["inside"].values.tolist() == [True, False, False] * 4
    assert seen[0].score.area_km2 == pytest.approx(0.01)
    assert 0 <= tree["pan"].attrs["completeness_window"] <= 1
