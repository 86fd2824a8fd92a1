"""A whole optimization over cases that cost nothing: folder, resumption, findings and exit codes."""

import json

import pytest
from typer.testing import CliRunner

from glintrack.cli import optimize as command
from glintrack.cli.app import app
from glintrack.study import StudyFolder, read_results, serial
from glintrack.study.optimize import StudyRunner, read_optimization, read_result
from glintrack.study.optimize.run import run_search
from tests.study.optimize.cameras import SPEC, camera, true_scores, write_spec


@pytest.fixture
def cheap_cases(monkeypatch):
    whole = command.search.run_search

    def run(runner):
        runner.simulate = camera
        runner.cache.mkdir(exist_ok=True)
        return whole(runner)

    monkeypatch.setattr(command.search, "run_search", run)


def invoke(*arguments):
    return CliRunner().invoke(app, ["optimize", *map(str, arguments)])


def simulated(folder):
    return len(list(folder.glob("simulated-*")))


def test_a_search_is_confirmed_stored_and_not_repeated(tmp_path, cheap_cases):
    spec, out, cache = write_spec(tmp_path), tmp_path / "out", tmp_path / "cache"
    first = invoke(spec, "-o", out, "--serial", "--cache", cache)
    assert first.exit_code == 0, first.output
    assert "Yes: the cheapest confirmed design costs" in first.output and "Pareto front" in first.output
    count = simulated(cache)
    assert 12 <= count <= 60
    result = read_result(out)
    assert result is not None and result.answer == "yes"
    design = {axis.name: axis.value for axis in result.axes}
    custody, false = true_scores(design["sensor.pitch_um"], design["flight.rate_hz"])
    assert custody >= 0.58 and false <= 20.5
    table, source = read_results(out)
    assert len(table) == count and set(table["status"]) == {"finished"}
    assert source["axes"] == ["sensor.pitch_um", "flight.rate_hz", "duration_s"]
    assert set(table["duration_s"]) == {6, 12}
    again = invoke(spec, "-o", out, "--serial", "--cache", cache)
    assert again.exit_code == 0 and read_result(out) == result
    assert simulated(cache) == count  # all read from the folder


def test_an_interrupted_search_goes_on_to_the_same_answer(tmp_path):
    setup = read_optimization(write_spec(tmp_path))
    calls, events = [], []

    def interrupted(case, task):
        calls.append(case)
        if len(calls) == 9:
            raise KeyboardInterrupt
        return camera(case, task)

    def run(name, simulate):
        folder = StudyFolder(tmp_path / name)
        runner = StudyRunner(setup, folder, None, None, simulate, events.append)
        with serial() as runner.pool, folder.open(runner.plan()):
            return run_search(runner)

    with pytest.raises(KeyboardInterrupt):
        run("stopped", interrupted)
    stopped, whole = run("stopped", camera), run("whole", camera)
    assert (stopped.answer, stopped.design) == (whole.answer, whole.design)
    assert json.dumps(stopped.observations.scores.tolist()) == json.dumps(whole.observations.scores.tolist())
    assert len(events) < 2 * len(whole.observations.city) + 1


def test_what_nothing_meets_is_exit_code_1(tmp_path, cheap_cases):
    spec = write_spec(tmp_path, SPEC.replace("false_per_km2 <= 20", "false_per_km2 <= 5"))
    done = invoke(spec, "-o", tmp_path / "out", "--serial", "--cache", tmp_path / "cache")
    assert done.exit_code == 1 and "No: no design in the ranges meets" in done.output, done.output
    assert "`pan.false_per_km2 <= 5` limits it" in done.output and "widen the ranges" in done.output


def test_a_budget_that_confirms_nothing_is_exit_code_3(tmp_path, cheap_cases):
    text = SPEC.replace("simulations = 60", "simulations = 12").replace(">= 0.6", ">= 0.95")
    done = invoke(write_spec(tmp_path, text), "-o", tmp_path / "out", "--serial", "--cache", tmp_path / "c")
    assert done.exit_code == 3 and "Undecided: no design is confirmed" in done.output, done.output


def test_cities_with_the_same_recorded_traffic_are_told(tmp_path):
    words = "all cities have the same recorded traffic"
    own = SPEC.replace("[axes]", "base.scene.traffic_duration_s = 130\n[axes]")
    assert words in invoke(write_spec(tmp_path), "--dry-run").output
    assert words not in invoke(write_spec(tmp_path, own), "--dry-run").output
    packaged = SPEC.replace("base.toml", "arterial").replace(", 12]", ", 24]")
    assert words in invoke(write_spec(tmp_path, packaged), "--dry-run").output


def test_a_dry_run_writes_nothing_and_other_options_exclude_each_other(tmp_path):
    spec = write_spec(tmp_path)
    done = invoke(spec, "-o", tmp_path / "out", "--dry-run")
    assert done.exit_code == 0 and "at most 60 simulations" in done.output, done.output
    assert not (tmp_path / "out").exists()
    assert "`--serial`" in str(invoke(spec, "--serial", "--workers", 2).exception)


def test_failures_of_all_designs_are_told(tmp_path):
    def broken(case, task):
        raise RuntimeError("the optics fell off")

    setup = read_optimization(write_spec(tmp_path, SPEC.replace("candidates", "retries = 0\ncandidates")))
    folder = StudyFolder(tmp_path / "out")
    runner = StudyRunner(setup, folder, None, None, broken)
    with (
        serial() as runner.pool,
        folder.open(runner.plan()),
        pytest.raises(ValueError, match=r"got failures only, see .*the optics fell off"),
    ):
        run_search(runner)
