"""Maps of P_D and clutter: a drawn detector comes back, files, a flight of another seed, Stone Soup."""

import io
import sys
from datetime import datetime, timedelta

import numpy as np
import pytest
import rasterio
from rich.console import Console

from glintrack.bounds.calibrate import calibrate, other_flights
from glintrack.bounds.maps import (
    Chances,
    clutter_at,
    detection_maps,
    motion_angle,
    probability_at,
    read_maps,
    write_maps,
)
from glintrack.bounds.stone_soup import drawn_detections, map_sensor
from glintrack.cli.bound import bound as command
from glintrack.cli.bound import print_maps
from glintrack.core.lazy import load_guarded
from glintrack.scene import load_materials
from tests.bound.test_run import case
from tests.conftest import ThreeCars

load_guarded("glintrack.cli")  # as a call of the command does

AREA_M = (-150.0, -120.0, 150.0, 120.0)
LENS_M = np.array([0.0, -3000.0])
EPOCH = datetime(2026, 6, 21, 12)


def drawn(frames=400, seed=0):
    """It finds 0.8 in the east and 0.4 in the west, half of that below 4 m/s; clutter is in the west."""
    rng = np.random.default_rng(seed)
    count = 60 * frames
    place = rng.uniform([-150, -120], [150, 120], (count, 2))
    direction, speed = rng.uniform(0, 2 * np.pi, count), rng.choice([3.0, 9.0], count)
    velocity = speed[:, None] * np.stack([np.sin(direction), np.cos(direction)], axis=1)
    chance = np.where(place[:, 0] > 0, 0.8, 0.4) * np.where(speed < 4, 0.5, 1.0)
    found = rng.random(count) < chance
    false = rng.uniform([-150, -120], [0, 120], (rng.poisson(6 * frames), 2))
    return Chances(place, speed, motion_angle(place, velocity, LENS_M), found, false, frames)


def maps_of(chances=None):
    maps = detection_maps(drawn() if chances is None else chances, AREA_M)
    place = {"crs": "EPSG:32618", "origin_m": [288000.0, 4781000.0]}
    return maps.assign_attrs(place, detection_sigma_away_m=1.5, detection_sigma_right_m=0.6)


def test_maps_give_back_the_detector_that_was_drawn():
    maps = maps_of()
    assert maps.attrs["detection_probability"] == pytest.approx(0.45, abs=0.02)
    assert maps["vehicles"].values.sum() == maps["motion_vehicles"].values.sum() == 24_000
    for east, speed, expected in ((60, 9.0, 0.8), (60, 3.0, 0.4), (-60, 9.0, 0.4), (-60, 3.0, 0.2)):
        for direction in ([1.0, 0.0], [0.0, -1.0]):
            place, velocity = np.array([[float(east), 10.0]]), speed * np.array([direction])
            four_errors = 0.1  # 300 vehicles a cell
            assert probability_at(maps, place, velocity, LENS_M)[0] == pytest.approx(
                expected, abs=four_errors
            )
    per_km2 = 6 / (150 * 240e-6)
    assert clutter_at(maps, np.array([[-75.0, 0.0]]))[0] == pytest.approx(per_km2, rel=0.3)
    assert clutter_at(maps, np.array([[75.0, 0.0]]))[0] < 0.05 * per_km2
    assert float(maps["clutter"].mean()) == pytest.approx(maps.attrs["clutter_per_km2"], rel=0.02)
    outside = np.array([[151.0, 0.0], [0.0, -121.0]])
    assert (probability_at(maps, outside, np.ones((2, 2)), LENS_M) == 0).all()
    assert (clutter_at(maps, outside) == 0).all()


def test_few_counts_are_drawn_toward_the_mean():
    place, speed, angle, found = (values[:10] for values in drawn()[:4])
    one = Chances(place, speed, angle, found, np.zeros((0, 2)), 1)
    maps = detection_maps(one, AREA_M)
    mean = maps.attrs["detection_probability"]
    empty = maps["vehicles"].values == 0
    np.testing.assert_allclose(maps["detection_probability"].values[empty], mean)
    assert (np.abs(maps["detection_probability"].values - mean) < 0.5).all()
    assert (maps["clutter"].values == 0).all()


def test_angles_are_from_the_line_of_sight_and_the_same_to_either_side():
    place, away = np.zeros((4, 2)), np.array([[0, 5.0], [5, 0], [-5, 0], [0, -5]])
    angles = motion_angle(place, away, np.array([0.0, -1000.0]))
    np.testing.assert_allclose(np.degrees(angles), [0, 90, 90, 180])


def test_the_first_row_of_the_map_is_the_north():
    place = np.array([[-149.0, 119.0]])
    one = Chances(place, np.array([9.0]), np.zeros(1), np.array([True]), place, 1)
    maps = detection_maps(one, AREA_M)
    assert maps["vehicles"].values[0, 0] == 1 and maps["y"].values[0] == 105 and maps["x"].values[0] == -135
    assert maps["clutter"].values.argmax() == 0


def test_files_hold_the_maps_where_they_lie(tmp_path):
    maps = maps_of()
    files = write_maps(tmp_path / "maps.nc", {"pan": maps})
    assert [f.name for f in files] == ["maps.nc", "maps-pan.tif"]
    again = read_maps(files[0], "pan")
    np.testing.assert_allclose(again["clutter"], maps["clutter"])
    place, velocity = np.array([[60.0, 10.0]]), np.array([[9.0, 0.0]])
    assert probability_at(again, place, velocity, LENS_M) == probability_at(maps, place, velocity, LENS_M)
    with rasterio.open(files[1]) as raster:
        assert raster.bounds[:2] == (288000 - 150, 4781000 - 120) and raster.res == (30, 30)
        assert raster.descriptions == ("detection_probability", "vehicles", "clutter")
        np.testing.assert_allclose(raster.read(1), maps["detection_probability"], rtol=1e-6)
    with pytest.raises(ValueError, match=r"`channel` must be one of the maps' \(pan\), got 'dolp'"):
        read_maps(files[0], "dolp")
    with pytest.raises(ValueError, match=r"`output` must end in .nc, got 'maps.tif'"):
        write_maps(tmp_path / "maps.tif", {"pan": maps})


def test_three_cars_calibrate_their_detector(three_cars, monkeypatch):
    city = ThreeCars(load_materials())
    monkeypatch.setattr(ThreeCars, "duration_s", 8.0, raising=False)
    monkeypatch.setattr("glintrack.bounds.calibrate.build_scene", lambda design: city)
    done = []
    maps = calibrate(case(), (7,), done.append)["pan"]
    assert done[-1] == 13 and maps.attrs["seeds"] == [7]
    assert maps.attrs["visible_detection_probability"] > 0.5
    assert maps.attrs["acceleration_psd_m2_s3"] == pytest.approx(0.0, abs=1e-12)
    assert maps.attrs["speed_sigma_m_s"] == pytest.approx(9 / np.sqrt(2))
    assert maps["vehicles"].values.sum() == 3 * 13


def test_flights_have_other_seeds_and_other_traffic():
    design = case(flight={"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 10})
    flights = other_flights(design, (7, 8), 12.0)
    assert [f.seed for f in flights] == [7, 8]
    assert [f.flight.start_s for f in flights] == [5.0, 0.0]  # the second would outlast the recording
    with pytest.raises(ValueError, match=r"`seeds` must differ from the case's own, got 0 among \[7, 0\]"):
        other_flights(design, (7, 0), 12.0)
    with pytest.raises(ValueError, match="`seeds` must name one flight at least, got none"):
        other_flights(design, (), 12.0)


def test_no_movers_are_refused():
    nothing = np.zeros((0, 2))
    with pytest.raises(ValueError, match="`chances` must hold moving vehicles in the window, got none"):
        detection_maps(Chances(nothing, np.zeros(0), np.zeros(0), np.zeros(0, bool), nothing, 3), AREA_M)


def truth_paths(scans):
    types = pytest.importorskip("stonesoup.types.groundtruth", reason="needs the extra stonesoup")
    cars = (np.array([20.0, 9.0, -40.0, 0.0]), np.array([-100.0, 0.0, 20.0, 3.0]))
    return [
        types.GroundTruthPath(
            [
                types.GroundTruthState(
                    start + 0.05 * k * np.array([start[1], 0, start[3], 0]),
                    timestamp=EPOCH + timedelta(seconds=0.05 * k),
                )
                for k in range(scans)
            ]
        )
        for start in cars
    ]


def test_stone_soup_gets_what_the_maps_say():
    maps, scans = maps_of(), 200
    paths = truth_paths(scans)
    times = [EPOCH + timedelta(seconds=0.05 * k) for k in range(scans)]
    told = list(drawn_detections(maps, paths, times, lambda when: LENS_M, np.random.default_rng(5)))
    assert [when for when, _ in told] == times
    true = [d for _, found in told for d in found if hasattr(d, "groundtruth_path")]
    false = [d for _, found in told for d in found if not hasattr(d, "groundtruth_path")]
    for path in paths:
        mine = [d for d in true if d.groundtruth_path is path]
        states = np.array([np.ravel(s.state_vector) for s in path])
        chance = probability_at(maps, states[:, [0, 2]], states[:, [1, 3]], LENS_M)
        four_errors = 4 * np.sqrt((chance * (1 - chance)).sum())
        assert len(mine) == pytest.approx(chance.sum(), abs=four_errors)
        place = {s.timestamp: np.ravel(s.state_vector)[[0, 2]] for s in path}
        away = np.array([np.ravel(d.state_vector).astype(float) - place[d.timestamp] for d in mine])
        assert away.std(axis=0) == pytest.approx([0.6, 1.5], rel=0.3)  # north is away from the camera
    expected = maps.attrs["clutter_per_km2"] * 300 * 240e-6 * scans
    assert len(false) == pytest.approx(expected, abs=4 * np.sqrt(expected) + 0.02 * expected)


def test_a_stone_soup_sensor_draws_by_the_maps():
    """In a suite, as its simulators ask it: as often as P_D says, with clutter, exact where noise is off."""
    sensors = pytest.importorskip("stonesoup.sensor.sensor", reason="needs the extra stonesoup")
    maps, truth = maps_of(), truth_paths(1)
    sensor = map_sensor(maps, np.random.default_rng(3), position=np.array([[LENS_M[0]], [LENS_M[1]]]))
    suite = sensors.SensorSuite([sensor], attributes_inform=set())
    scans = [suite.measure(set(truth), noise=False) for _ in range(300)]
    for path in truth:
        place = np.ravel(path[0].state_vector).astype(float)
        mine = [d for scan in scans for d in scan if getattr(d, "groundtruth_path", None) is path]
        chance = float(probability_at(maps, place[None, [0, 2]], place[None, [1, 3]], LENS_M)[0])
        four_errors = 4 * np.sqrt(chance * (1 - chance) * len(scans))
        assert len(mine) == pytest.approx(chance * len(scans), abs=four_errors)
        assert all(np.array_equal(np.ravel(d.state_vector).astype(float), place[[0, 2]]) for d in mine)
    false = [d for scan in scans for d in scan if not hasattr(d, "groundtruth_path")]
    expected = maps.attrs["clutter_per_km2"] * 300 * 240e-6 * len(scans)
    assert len(false) == pytest.approx(expected, abs=4 * np.sqrt(expected) + 0.02 * expected)
    assert sensor.measurement_model.covar().shape == (2, 2) and sensor.measure(set()) == set()
    with pytest.raises(ValueError, match="`noise` must be True or False"):
        sensor.measure(set(truth), noise=np.zeros((2, 1)))


def test_a_stone_soup_tracker_follows_what_is_drawn():
    paths = truth_paths(60)[:1]
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.types.state import GaussianState
    from stonesoup.types.track import Track
    from stonesoup.updater.kalman import KalmanUpdater

    times = [state.timestamp for state in paths[0]]
    drawn_scans = drawn_detections(maps_of(), paths, times, lambda when: LENS_M, np.random.default_rng(2))
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(1.0)] * 2))
    updater = KalmanUpdater(None)
    choose = DistanceHypothesiser(predictor, updater, Mahalanobis(), missed_distance=3)
    state = GaussianState([20, 9, -40, 0], np.diag([4, 4, 4, 4.0]), timestamp=times[0])
    for when, found in drawn_scans:
        best = min(choose.hypothesise(Track([state]), found, when), key=lambda one: one.distance)
        state = updater.update(best) if best else best.prediction
    end = np.ravel(paths[0][-1].state_vector).astype(float)
    assert np.hypot(*(np.ravel(state.state_vector).astype(float) - end)[[0, 2]]) < 3.0


def test_what_is_missing_is_said(monkeypatch):
    maps = maps_of()
    bare = maps.assign_attrs()
    del bare.attrs["detection_sigma_right_m"]
    rng = np.random.default_rng(0)
    pytest.importorskip("stonesoup", reason="needs the extra stonesoup")
    with pytest.raises(ValueError, match="`maps` must have the attribute detection_sigma_right_m, got none"):
        next(drawn_detections(bare, [], [EPOCH], lambda when: LENS_M, rng))
    for name in [m for m in sys.modules if m.startswith("stonesoup")]:
        monkeypatch.delitem(sys.modules, name)
    monkeypatch.setitem(sys.modules, "stonesoup", None)
    with pytest.raises(ValueError, match="the extra `stonesoup` must be installed to draw detections"):
        next(drawn_detections(maps, [], [EPOCH], lambda when: LENS_M, rng))


def test_the_command_refuses_what_does_not_fit_before_it_flies(tmp_path):
    with pytest.raises(ValueError, match="`--seed` must come with --calibrate, got it alone"):
        command(seeds=[3])
    with pytest.raises(ValueError, match=r"`output` must end in .nc, got 'maps.tif'"):
        command(calibrate=True, output=tmp_path / "maps.tif")
    with pytest.raises(ValueError, match="`seeds` must differ from the case's own, got 1"):
        command("quickstart", calibrate=True, seeds=[1])


def test_the_printed_table_fits_a_terminal_of_80_columns():
    page = Console(width=80, record=True, file=io.StringIO())
    motion = {"acceleration_psd_m2_s3": 0.86, "speed_sigma_m_s": 6.7}
    print_maps(page, {"pan": maps_of().assign_attrs(motion)})
    text = page.export_text()
    assert "…" not in text and "1.5, 0.6" in text and "σ, m" in text
    assert "accelerations of 0.86 m²/s³, speeds of 6.7 m/s each way" in text
