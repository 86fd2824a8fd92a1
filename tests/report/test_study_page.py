"""The page of a study: its rows, effects and links, in Python and in a browser."""

import json
import re
from dataclasses import replace

import pyarrow.parquet
import pytest

from glintrack.report.study_page import RUN_PAGE, build_study_page, is_study, shorten_design
from glintrack.study import StudyFolder, read_plan, run_study, serial, write_results
from glintrack.study.text_tables import NAMES
from tests.cli.test_cli import program
from tests.study.cases import TWELVE, cheap, write_study

try:
    from tests.report.test_page_in_browser import CHROMIUM, CUT_LABELS, Watched, browser  # noqa: F401
except pytest.skip.Exception:  # no playwright
    CHROMIUM, CUT_LABELS = None, ""


@pytest.fixture
def folder(tmp_path):
    plan, folder = read_plan(write_study(tmp_path, TWELVE)), StudyFolder(tmp_path / "study")
    # no plan takes a name with html in it, but a folder of somebody else's can hold one
    plan = replace(plan, design=plan.design.model_copy(update={"name": "<b>twelve</b>"}))
    (tmp_path / "cache").mkdir()
    with folder.open(plan), serial() as pool:
        run_study(plan, folder, pool, tmp_path / "cache", simulate=cheap)
        write_results(plan, folder)
    return folder.path


def embedded(html):
    return json.loads(re.search(r'<script type="application/json" id="data">(.*?)</script>', html)[1])


def test_the_page_holds_the_studys_rows_and_effects(folder):
    html = build_study_page(folder, folder.parent)
    data = embedded(html)
    assert is_study(folder) and not is_study(folder.parent)
    assert len(data["rows"]) == 24 and data["varied"] == ["sensor.pitch_um", "atmosphere.aerosol"]
    haze = [
        e for e in data["effects"] if e["axis"] == "atmosphere.aerosol" and e["response"] == "completeness"
    ]
    assert [round(e["effect"], 6) for e in haze] == [-0.1, -0.1]  # as `cheap` has it, in both channels
    links = re.findall(r'<td [^>]*><a href="([^"]+)">', html)
    assert len(links) == 24 and all((folder.parent / link / "case.toml").is_file() for link in links)
    assert [p["ylabel"] for p in data["plots"]] == [NAMES["completeness"], NAMES["purity"]]
    assert "<b>twelve" not in html and "&lt;b&gt;twelve" in html


@pytest.mark.parametrize("labels", [["small"], ["small", "large"]])
def test_every_finished_study_is_drawn(tmp_path, labels):
    """A list without axes, of one case or two: what each design holds."""
    rows = {"small": 280, "large": 380}
    text = "".join(f"[[cases]]\nlabel = '{name}'\nsensor.rows = {rows[name]}\n" for name in labels)
    plan = read_plan(write_study(tmp_path, 'design = "list"\n' + text))
    folder = StudyFolder(tmp_path / "study")
    (tmp_path / "cache").mkdir()
    with folder.open(plan), serial() as pool:
        run_study(plan, folder, pool, tmp_path / "cache", simulate=cheap)
        write_results(plan, folder)
    html = build_study_page(folder.path, tmp_path)
    points = [p for p in embedded(html)["points"] if p["response"] == "completeness"]
    assert [p["point"] for p in points if p["channel"] == "pan"] == labels
    assert 'id="points-chart"' in html and ('id="effects"' in html) == (len(labels) > 1)
    assert 'id="answer"' in html


AXES = ["sensor.pitch_um", "flight.off_nadir_deg", "seed", "scene.seed", "view"]


@pytest.mark.parametrize(
    ("point", "short"),
    [
        ("base", "base"),
        ("sensor.pitch_um = 8.512345, seed = 7", "pitch_um = 8.51"),
        ("seed = 7, flight.off_nadir_deg = 20", "off_nadir_deg = 20"),
        ("seed = 7, scene.seed = 8", "seed = 7, scene.seed = 8"),  # nothing else differs
        ("view = toward the sun, 5 PM, sensor.pitch_um = 17", "view = toward the sun, 5 PM, pitch_um = 17"),
    ],
)
def test_a_design_is_named_by_what_differs(point, short):
    assert shorten_design(point, AXES) == short


def test_keys_of_one_ending_keep_their_tables():
    keys = ["sensor.rate_hz", "flight.rate_hz"]
    assert shorten_design("sensor.rate_hz = 2, flight.rate_hz = 3", keys) == (
        "sensor.rate_hz = 2, flight.rate_hz = 3"
    )


def test_the_first_screen_and_the_pareto_fronts_of_a_study(folder):
    html = build_study_page(folder, folder.parent)
    first = html[html.index("<header>") : html.index("</header>")]
    assert re.search(r'id="headline" class="headline"><strong>[+−][\d.]+</strong> completeness', first)
    assert [*re.findall(r"<dt>(Best design|What matters|What does not)</dt>", first)] == [
        "Best design", "What matters", "What does not",
    ]  # fmt: skip
    plot = embedded(html)["plots"][0]
    assert plot["numbered"] and all("seed" not in name for name in plot["numbered"])
    for line in plot["lines"]:
        assert line["label"] in ("pan", "DoLP")
        for _, _, name, number in line["joined"]:
            assert plot["numbered"][int(number) - 1] == name
    assert "NIIRS" not in first and "pitch_um = 10.8" in {p["point"] for p in embedded(html)["points"]}


EVIL = "</script><script>window.hacked=1</script><img src=x onerror=window.hacked=1>"


def change_results(folder, change):
    """Put another table into a study's folder, as somebody may who sends it."""
    path = folder / "results.parquet"
    arrow = pyarrow.parquet.read_table(path)
    source = json.loads(arrow.schema.metadata[b"glintrack"])
    table, source = change(arrow.to_pandas(), source)
    made = pyarrow.Table.from_pandas(table, preserve_index=False)
    text = json.dumps(source)
    pyarrow.parquet.write_table(made.replace_schema_metadata({"glintrack": text}), path)


def poisoned(table, source):
    """HTML in the name, the axes, their levels, channels, states, keys of cases and provenance."""
    axes = {axis: f"{axis}{EVIL}" for axis in source["axes"]}
    table = table.rename(columns=axes)
    for name in (*axes.values(), "channel", "case"):
        table[name] = [f"{value}{EVIL}" for value in table[name]]
    table.loc[0, "status"] = EVIL
    design = source["design"] | {"name": EVIL, EVIL: EVIL}
    return table, source | {"axes": list(axes.values()), "design": design, "glintrack": EVIL, EVIL: EVIL}


def test_html_in_a_studys_table_stays_text(folder):
    change_results(folder, poisoned)
    html = build_study_page(folder, folder.parent)
    assert "<script>window.hacked" not in html and "<img src=x" not in html
    assert embedded(html)["varied"][0].endswith(EVIL)


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs a chromium in the path, and playwright")
def test_html_in_a_studys_table_stays_text_in_a_browser(folder, tmp_path, request):
    change_results(folder, poisoned)
    path = tmp_path / "study.html"
    path.write_text(build_study_page(folder, tmp_path), encoding="utf-8")
    watched = Watched(request.getfixturevalue("browser"), path.as_uri())
    page = watched.page
    for k in range(page.locator("#table th button").count()):
        page.locator("#table th button").nth(k).click()
    for select in page.locator("select").all():  # every effect and coordinate is drawn
        for option in select.locator("option").all():
            select.select_option(index=int(option.evaluate("o => o.index")))
    page.wait_for_timeout(200)
    assert page.evaluate("window.hacked") is None and page.locator("img[src=x]").count() == 0
    assert watched.complaints == []


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (lambda t, s: (t.drop(columns="case"), s), "no column case"),
        (lambda t, s: (t, []), "no list of axes"),
        (lambda t, s: (t, s | {"axes": ["none"]}), "no list of axes"),
        (lambda t, s: (t, s | {"design": 3}), "no design"),
        (lambda t, s: (t.assign(point="x"), s), "a point that is no number"),
        (lambda t, s: (t.assign(case=3.0), s), "a case that is no text"),
        (lambda t, s: (t.assign(purity="much"), s), "words in column purity"),
        (lambda t, s: (t.assign(over_time='{"purity": "a"}'), s), "scores over time"),
        (lambda t, s: (t.assign(over_time="[" * 50_000), s), "scores over time"),
    ],
)
def test_a_table_that_is_no_studys_is_refused(folder, change, reason):
    change_results(folder, change)
    with pytest.raises(ValueError, match=f"`results.parquet` must be a study's table; got {reason}"):
        build_study_page(folder, folder.parent)


def test_the_program_tells_a_study_from_a_run(monkeypatch, folder, tmp_path, capsys):
    assert program(monkeypatch, "report", folder, "-o", tmp_path / "study.html") == 0
    assert "links lead to" in capsys.readouterr().out
    (folder / "results.parquet").unlink()
    assert program(monkeypatch, "report", folder, "-o", tmp_path / "study.html") == 2
    assert "must hold results.parquet" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.skipif(CHROMIUM is None, reason="needs a chromium in the path, and playwright")
def test_it_sorts_and_filters_in_a_browser(folder, tmp_path, request):
    browser = request.getfixturevalue("browser")
    for case in (folder / "cases").iterdir():
        (case / RUN_PAGE).write_text("<title>a run's page</title>")
    path = tmp_path / "study.html"
    path.write_text(build_study_page(folder, tmp_path), encoding="utf-8")
    watched = Watched(browser, path.as_uri())
    page = watched.page
    assert watched.complaints == [] and page.locator("#count-finished").inner_text() == "24"
    first = "document.querySelector('#table tbody tr').cells[{}].dataset.value"
    place = embedded(path.read_text())["columns"].index("completeness")
    values = [row[place] for row in embedded(path.read_text())["rows"]]
    head = page.locator("#table th button", has_text=re.compile(f"^{NAMES['completeness']}$"))
    for expected in (min(values), max(values)):
        head.click()
        assert float(page.evaluate(first.format(place))) == pytest.approx(expected)
    assert page.locator(".parallel polyline").count() == 24
    page.locator(".parallel").scroll_into_view_if_needed()
    box = page.locator(".parallel .hit").first.bounding_box()
    x = box["x"] + box["width"] / 2
    page.mouse.move(x, box["y"] + 2)  # the widest pitch, at the top
    page.mouse.down()
    page.mouse.move(x, box["y"] + 40, steps=4)
    page.mouse.up()
    assert page.locator("#parallel-count").inner_text() == "8 of 24 rows"
    assert page.locator("#table tbody tr:visible").count() == 8
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-playwright-python")
    found = axe.Axe().run(page).response["violations"]
    assert [(v["id"], [n["target"] for n in v["nodes"]]) for v in found] == []
    for width in (2560, 1280, 768, 390):
        page.set_viewport_size({"width": width, "height": 900})
        assert page.evaluate("document.documentElement.scrollWidth") <= width
        assert page.evaluate(CUT_LABELS) == []
        page.screenshot(path=str(tmp_path / f"study_{width}.png"), full_page=True)
    page.locator("#table tbody tr:visible a").first.click()
    assert page.title() == "a run's page"
    watched.context.close()
