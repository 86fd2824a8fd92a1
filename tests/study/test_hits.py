"""Kept hits: without loss, shared by cases of one geometry only, rebuilt when damaged, by several at once."""

import multiprocessing

import numpy as np
import pandas as pd
import pytest
import xarray as xr

from glintrack import simulate
from glintrack.camera import Camera, Pose, look_at
from glintrack.case import build as scenario
from glintrack.core.distortion import Distortion
from glintrack.render import TracedFrame, build_tracer, trace
from glintrack.scene import load_materials
from glintrack.study import HitsCache, StudyFolder, read_plan, run_study, serial, write_results
from glintrack.study import hits as kept
from glintrack.study.hits import frame_times, geometry, pack, unpack
from tests.conftest import ThreeCars, box, plane, snapshot
from tests.plain import plain_case
from tests.study.cases import write_study


def case(**changes):
    design = {
        "channels": ["pan"],
        "flight": {"off_nadir_deg": 20.0, "altitude_m": 2819.0, "frames": 4},
        "sensor": {"rows": 80, "columns": 120, "pitch_um": 50.0},
    }
    for table, keys in changes.items():
        design[table] = {**design.get(table, {}), **keys} if isinstance(keys, dict) else keys
    return plain_case(design)


class Kept(dict):
    """Frames by time, in memory."""

    def get(self, time_s, observe):
        self[time_s] = observe()
        return self[time_s]


def scores(tree):
    return tree["pan"].to_dataset(inherit=False), tree["pan/tracks"].to_dataset(inherit=False)


def test_packed_hits_are_the_same(three_cars):
    kept = Kept()
    simulate(case(), hits_cache=kept)
    assert list(kept) == frame_times(case().flight).tolist()
    traced = kept[1.0]
    again = unpack(pack(traced))
    for one, other in zip(traced.hits, again.hits, strict=True):
        np.testing.assert_array_equal(one, other)
    np.testing.assert_array_equal(traced.seen, again.seen)


def test_a_distorted_frame_comes_back_as_it_was_packed():
    scene = snapshot(plane(400.0), [box(4.5, 1.8, 1.5)], [[[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]], [0])
    camera = Camera(0.05, 1e-4, 20, 30, distortion=Distortion(k1=-5.0))
    pose = look_at(Pose(0.0, -300.0, 500.0), (0.0, 0.0, 0.0))
    hits = trace(scene, camera, pose, np.array([0.0, 0.6, 0.8]), np.ones(2), 0, tracer=build_tracer(scene))
    back = unpack(pack(TracedFrame(hits, np.ones(1), camera, pose)))
    assert back.camera == camera
    np.testing.assert_array_equal(back.hits.point, hits.point)


def test_a_flight_over_kept_hits_is_the_same_flight(three_cars, tmp_path):
    plain = simulate(case())
    first, second = (HitsCache(tmp_path, geometry(case())) for _ in range(2))
    traced, recalled = simulate(case(), hits_cache=first), simulate(case(), hits_cache=second)
    assert (first.traced, first.read, second.traced, second.read) == (4, 0, 0, 4)
    for tree in (traced, recalled):
        for mine, expected in zip(scores(tree), scores(plain), strict=True):
            xr.testing.assert_identical(mine, expected)


def test_a_truncated_frame_is_traced_again(three_cars, tmp_path):
    simulate(case(), hits_cache=HitsCache(tmp_path, geometry(case())))
    entry = sorted(tmp_path.rglob("*.hits"))[0]
    entry.write_bytes(entry.read_bytes()[:1000])
    again = HitsCache(tmp_path, geometry(case()))
    simulate(case(), hits_cache=again)
    assert (again.traced, again.read) == (1, 3)
    assert entry.stat().st_size > 1000


def test_nothing_is_kept_where_no_one_else_needs_it(three_cars, tmp_path):
    alone = HitsCache(tmp_path / "hits", geometry(case()), keep=False)
    simulate(case(), hits_cache=alone)
    assert alone.traced == 4 and not (tmp_path / "hits").exists()


def test_frames_of_some_times_are_kept(three_cars, tmp_path):
    some = HitsCache(tmp_path, geometry(case()), keep=(0.0, 1.0))
    simulate(case(), hits_cache=some)
    assert [some.contains(t) for t in frame_times(case().flight).tolist()] == [True, False, True, False]


def test_a_full_disk_costs_the_cache_not_the_case(three_cars, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("glintrack.study.hits.cache.store", full)
    kept = HitsCache(tmp_path, geometry(case()))
    assert simulate(case(), hits_cache=kept).attrs["frames_done"] == 4
    assert kept.bytes_kept == 0


@pytest.mark.parametrize(
    "changes",
    [
        {"sensor": {"polarizer": "grid_a"}},
        {"sensor": {"f_number": 8.0, "max_frame_rate_hz": 5.0}},
        {"sensor": {"optics": {"defocus_um": 10.0}}},
        {"track": {"detect": {"detector": "median-motion", "dolp_boost": 5.0}}},
        {"navigation": {"position_rms_m": 1.0}},
        {"atmosphere": {"aerosol": "urban"}},
        {"ortho": {"gsd_m": 0.75}},
        {"flight": {"frames": 9, "rate_hz": 10.0}},
        {"seed": 5},
    ],
    ids=str,
)
def test_what_does_not_move_a_ray_shares_hits(changes):
    assert geometry(case(**changes)) == geometry(case())


@pytest.mark.parametrize(
    "changes",
    [
        {"sensor": {"pitch_um": 10.8}},
        {"sensor": {"oversampling": 2}},
        {"sensor": {"sun_samples": 4}},
        {"sensor": {"optics": {"distortion": {"k1": -0.1}}}},
        {"sensor": {"optics": {"lens": "relay"}}},
        {"scene": {"trees": False}},
        {"scene": {"seed": 2}},
        {"atmosphere": {"local_time_h": 12.0}},
        {"flight": {"azimuth_from_sun_deg": 90.0}},
        {"flight": {"start_s": 5.0}},
        {"flight": {"jitter_rms_urad": 5.0}},
    ],
    ids=str,
)
def test_what_moves_a_ray_has_hits_of_its_own(changes):
    assert geometry(case(**changes)) != geometry(case())


@pytest.mark.parametrize("file", ["render/trace.py", "render/shading/diffuse.py", "scene/materials.py"])
def test_hits_of_another_source_are_not_read(file, tmp_path, monkeypatch):
    """A file of renderer or scene that differs gives hits another address."""
    (tmp_path / file).parent.mkdir(parents=True)
    (tmp_path / file).write_text("1")
    monkeypatch.setattr("glintrack.case.identity._PACKAGE", tmp_path)
    before = kept._code_key.__wrapped__()
    assert kept._code_key.__wrapped__() == before
    (tmp_path / file).write_text("2")
    assert kept._code_key.__wrapped__() != before


def test_the_code_that_traces_is_part_of_the_address(monkeypatch):
    before = geometry(case())
    monkeypatch.setattr("glintrack.study.hits._code_key", lambda: "another version of the intersector")
    assert geometry(case()) != before


SMALL = """
channels = ["pan", "dolp"]
[flight]
off_nadir_deg = 20.0
altitude_m = 2819.0
frames = 6
[sensor]
rows = 80
columns = 120
pitch_um = 50.0
"""
PAIR = "[axes]\nsensor.f_number = [5.6, 8.0]\n"


def small_study(folder, cache, before=lambda: None):
    """A real study of two small cases of one geometry; its table and how it went."""
    plan = read_plan(write_study(folder, PAIR, base=SMALL))
    results = StudyFolder(folder / "out")
    with results.open(plan), serial() as pool:
        before()
        report = run_study(plan, results, pool, cache)
        return write_results(plan, results), report


def small_study_elsewhere(folder, cache, begin):
    scenario.build_scene = lambda design: ThreeCars(load_materials())
    small_study(folder, cache, begin.wait)


@pytest.mark.slow
def test_two_studies_on_one_cache_at_once_give_what_one_without_gives(three_cars, tmp_path):
    expected, _ = small_study(tmp_path / "alone", None)
    context, cache = multiprocessing.get_context("spawn"), tmp_path / "cache"
    begin = context.Barrier(2, timeout=300)  # both are ready before one traces its first frame
    other = context.Process(target=small_study_elsewhere, args=(tmp_path / "a", cache, begin))
    other.start()
    table, report = small_study(tmp_path / "b", cache, begin.wait)
    other.join()
    assert other.exitcode == 0 and report.finished == 2
    pd.testing.assert_frame_equal(table, expected)
    table, report = small_study(tmp_path / "a", cache)  # reads back what the other process has flown
    assert (report.finished_before, report.finished) == (2, 0)
    pd.testing.assert_frame_equal(table, expected)
    late, report = small_study(tmp_path / "late", cache)
    assert (report.frames_read, report.frames_traced) == (12, 0)
    pd.testing.assert_frame_equal(late, expected)


def test_a_case_that_reads_its_hits_scores_what_one_that_traces_does(three_cars, tmp_path):
    """To the last bit: a boost of DoLP must not move pan because its case came second."""
    base = SMALL + '[track.detect]\ndetector = "median-motion"\n'
    plan = read_plan(write_study(tmp_path, "[axes]\ntrack.detect.dolp_boost = [1, 5]\n", base=base))
    with StudyFolder(tmp_path / "out").open(plan) as folder, serial() as pool:
        report = run_study(plan, folder, pool, tmp_path / "cache")
        table = write_results(plan, folder)
    assert (report.frames_traced, report.frames_read) == (6, 6)
    assert table["completeness"].gt(0).any()
    pan = table[table["channel"] == "pan"].drop(columns=["point", "case", "track.detect.dolp_boost"])
    pd.testing.assert_series_equal(pan.iloc[0], pan.iloc[1], check_names=False, check_exact=True)
