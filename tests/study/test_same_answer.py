"""A study is the same, to the last bit, whoever flies its cases, from whatever hits, and resumed."""

import shutil

import pytest

from glintrack.case import build as scenario
from glintrack.study import StudyFolder, dask, processes, read_plan, run_study, serial, write_results
from glintrack.study.workers import simulate_case
from tests.conftest import ThreeCars, load_materials
from tests.study.cases import write_study

SMALL = """
channels = ["pan", "dolp"]
[flight]
off_nadir_deg = 20.0
altitude_m = 2819.0
frames = 3
[sensor]
rows = 80
columns = 120
pitch_um = 50.0
"""


def over_three_cars(case, task):
    """A real case, wherever the worker is."""
    scenario.build_scene = lambda design: ThreeCars(load_materials())
    return simulate_case(case, task)


@pytest.mark.slow
def test_a_study_is_the_same_whoever_flies_it_from_whatever_hits_and_resumed(three_cars, tmp_path):
    pytest.importorskip("distributed", reason="needs the extra `cluster`")
    plan = read_plan(write_study(tmp_path, "[axes]\nsensor.f_number = [5.6, 8.0]\n", base=SMALL))
    tables = {}

    def fly(name, pool, hits):
        folder = StudyFolder(tmp_path / name)
        with folder.open(plan), pool as workers:
            report = run_study(plan, folder, workers, hits, over_three_cars)
            assert not report.failed, folder.failure(report.failed[0])
            write_results(plan, folder)
        tables[name] = (tmp_path / name / "results.parquet").read_bytes()
        return report

    fly("serial, nothing kept", serial(), None)
    cold = fly("serial, cold", serial(), tmp_path / "hits")
    warm = fly("processes, warm", processes(2), tmp_path / "hits")
    fly("dask, cold", dask("local", 2), tmp_path / "other")
    assert (cold.frames_traced, warm.frames_traced, warm.frames_read) == (3, 0, 6)
    shutil.rmtree(next(iter((tmp_path / "serial, cold" / "cases").iterdir())))
    resumed = fly("serial, cold", serial(), tmp_path / "hits")
    assert (resumed.finished_before, resumed.finished) == (1, 1)
    assert len(set(tables.values())) == 1, [name for name in tables if tables[name] != tables["dask, cold"]]
