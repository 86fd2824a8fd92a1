"""The pages with sliders: they hold the answer, and their program predicts what Python predicts."""

import json
import re

import numpy as np
import pytest

from glintrack.report.study_page import build_study_page
from glintrack.study import StudyFolder, read_plan, read_results, run_study, serial, write_results
from glintrack.study.optimize import StudyRunner, build_result, read_optimization, write_result
from glintrack.study.optimize.report import INTERVAL_DEVIATE
from glintrack.study.optimize.run import run_search
from glintrack.study.optimize.spec import encode
from glintrack.study.report import response_surfaces
from tests.study.optimize.cameras import SPEC, camera, write_spec

try:
    from tests.report.test_page_in_browser import CHROMIUM, Watched, browser  # noqa: F401
except pytest.skip.Exception:  # no playwright
    CHROMIUM = None
in_browser = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs playwright and a chromium in the path"),
]


@pytest.fixture(scope="module")
def optimization(tmp_path_factory):
    """A finished search over a range, a list of numbers and words, and its folder."""
    folder = tmp_path_factory.mktemp("optimization")
    text = SPEC.replace("{ from = 1, to = 4 }", "[1, 2, 4]").replace("to = 17 }", "to = 17, log = true }")
    text += 'atmosphere.aerosol = ["clear", "urban"]\n'
    setup = read_optimization(write_spec(folder, text))
    stored = StudyFolder(folder / "out")
    runner = StudyRunner(setup, stored, None, None, camera)
    with serial() as runner.pool, stored.open(runner.plan()):
        outcome = run_search(runner)
        write_results(runner.plan(), stored)
    write_result(stored.path, build_result(setup, outcome))
    return setup, outcome, stored.path


@pytest.fixture(scope="module")
def sampled(tmp_path_factory):
    """A study with response surfaces."""
    folder = tmp_path_factory.mktemp("sampled")
    write_spec(folder)
    path = folder / "study.toml"
    axes = SPEC.partition("[axes]\n")[2].replace("to = 17 }", "to = 17, log = true }")
    path.write_text(f'case = "base.toml"\ndesign = "sobol"\nsamples = 16\n[axes]\n{axes}')
    plan, stored = read_plan(path), StudyFolder(folder / "out")
    with stored.open(plan), serial() as pool:
        run_study(plan, stored, pool, simulate=camera)
        write_results(plan, stored)
    return stored.path


def embedded(html):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', html)[1])


def test_the_page_of_an_optimization_says_its_answer(optimization):
    setup, _, folder = optimization
    html = build_study_page(folder, folder.parent)
    assert "<h1>Optimization spec</h1>" in html and "costs" in html and "Pareto front" in html
    data = embedded(html)
    assert [axis["name"] for axis in data["predict"]["axes"]] == [axis.name for axis in setup.axes]
    assert len(data["predict"]["predictors"]) == 2 and data["front"][0]["lines"][0]["points"]
    assert {path.name for path in (folder / "report").iterdir()} == {"front.csv", "front.png", "front.pdf"}


def test_a_changed_file_of_an_optimization_is_refused(optimization, tmp_path):
    _, _, folder = optimization
    page = folder / "optimization.json"
    text = page.read_text()
    page.write_text(text.replace('"answer":', '"anser":'))
    try:
        with pytest.raises(ValueError, match="`anser` must be a known key"):
            build_study_page(folder, tmp_path)
    finally:
        page.write_text(text)


@pytest.mark.parametrize("mark", [pytest.param(0, marks=in_browser)])
def test_the_pages_program_predicts_what_python_does(optimization, sampled, tmp_path, browser, mark):
    setup, outcome, folder = optimization
    (tmp_path / "page.html").write_text(build_study_page(folder, tmp_path))
    watched = Watched(browser, (tmp_path / "page.html").as_uri())
    names = [axis.name for axis in setup.axes]
    for levels in ([11.3, 2, "urban"], [8, 4, "clear"], [17, 1, "clear"]):
        place = np.array([encode(setup.axes, dict(zip(names, levels, strict=True)))])
        expected = []
        for process, undo in zip(outcome.processes, (lambda value: value, np.expm1), strict=True):
            mean, sd = process.predict(place)
            expected.append([undo(mean + side * INTERVAL_DEVIATE * sd)[0] for side in (0, -1, 1)])
        shown = watched.page.evaluate(f"predict.at({json.dumps(levels)})")
        np.testing.assert_allclose(shown, expected, rtol=1e-9)
    assert watched.page.evaluate('predict.at([17.1, 2, "urban"])') is None
    watched.page.locator("#predict-axes input[type=number]").first.fill("20")
    assert "no prediction" in watched.page.inner_text("#predict-note")
    assert "–" in watched.page.inner_text("#predict-scores")
    watched.page.locator("#predict-axes input[type=number]").first.fill("11.3")
    assert watched.page.inner_text("#predict-note") == "" and watched.complaints == []

    (tmp_path / "study.html").write_text(build_study_page(sampled, tmp_path))
    watched = Watched(browser, (tmp_path / "study.html").as_uri())
    surfaces = response_surfaces(*read_results(sampled))
    assert list(surfaces) == [
        (name, "pan") for name in ("completeness", "custody", "purity", "false_per_km2")
    ]
    shown = watched.page.evaluate("predict.at([11.3, 2.2])")
    expected = [np.ravel(one.predict(np.array([[11.3, 2.2]]))) for one in surfaces.values()]
    np.testing.assert_allclose(shown, expected, rtol=1e-9, atol=1e-12)
    assert watched.page.evaluate("predict.at([7, 2.2])") is None and watched.complaints == []
