"""The page in a real browser, from disk and with the network off: Debian's chromium, driven by Playwright."""

import json
import shutil
import threading
import time

import numpy as np
import pytest

from glintrack import Case
from glintrack.io.images import write_picture
from glintrack.report import build_page, serve_result
from glintrack.results.read import read_result
from tests.report import made

playwright = pytest.importorskip("playwright.sync_api", reason="needs playwright")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
WIDTHS = (2560, 1280, 768, 390)
# labels in a picture that reach beyond it
CUT_LABELS = (
    "[...document.querySelectorAll('svg text')].filter(t => { const a = t.getBoundingClientRect(),"
    "b = t.ownerSVGElement.getBoundingClientRect(); return a.width && (a.left < b.left - 1 ||"
    "a.right > b.right + 1 || a.top < b.top - 1 || a.bottom > b.bottom + 1) }).map(t => t.textContent)"
)
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(CHROMIUM is None, reason="needs a chromium in the path"),
]


@pytest.fixture(scope="module")
def browser():
    with playwright.sync_playwright() as driver:
        running = driver.chromium.launch(
            executable_path=CHROMIUM, args=["--no-sandbox", "--disable-gpu", "--disable-dev-shm-usage"]
        )
        yield running
        running.close()


class Watched:
    """One page, with all that it complained of or asked for."""

    def __init__(self, browser, address, offline=True, **options):
        self.context = browser.new_context(offline=offline, **options)
        self.page = self.context.new_page()
        self.complaints, self.asked = [], []
        self.page.on("console", lambda m: self.complaints.append(m.text) if m.type == "error" else None)
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda request: self.asked.append(request.url))
        self.page.goto(address)
        self.page.wait_for_selector("html[data-ready=yes]", timeout=60_000)
        self.settle()

    def settle(self):
        """Two frames later everything queued is drawn."""
        self.page.evaluate("new Promise(r => requestAnimationFrame(() => requestAnimationFrame(r)))")

    def wait_for(self, condition, seconds=20):
        """Ask until it is so; the page's policy forbids Playwright's own way, which evaluates text."""
        end = time.monotonic() + seconds
        while not self.page.evaluate(condition):
            assert time.monotonic() < end, condition
            time.sleep(0.05)

    def picture(self, kind="pan"):
        return self.page.evaluate(f"document.querySelector('canvas[data-kind={kind}]').toDataURL()")

    def place(self, east_m, north_m, kind="pan"):
        """Where a point of the ground lies on the screen."""
        canvas = self.page.locator(f"canvas[data-kind={kind}]")
        canvas.scroll_into_view_if_needed()
        box = canvas.bounding_box()
        west, south, east, north = made.EXTENT_M
        return (
            box["x"] + (east_m - west) / (east - west) * box["width"],
            box["y"] + (north - north_m) / (north - south) * box["height"],
        )


@pytest.fixture
def opened(browser, tmp_path):
    contexts = []

    def open_result(folder=None, **options):
        folder = folder or made.write_small_result(tmp_path / "result")
        path = tmp_path / "report.html"
        path.write_text(build_page(read_result(folder)), encoding="utf-8")
        watched = Watched(browser, path.as_uri(), **options)
        contexts.append(watched.context)
        return watched

    yield open_result
    for context in contexts:
        context.close()


def test_it_opens_from_disk_and_counts_as_the_result_does(opened):
    watched = opened()
    assert watched.complaints == []
    assert [url for url in watched.asked if not url.startswith(("file:", "data:"))] == []
    counted = {
        name: int(watched.page.locator(f"#count-{name}").inner_text())
        for name in ("frames", "vehicles", "tracks-pan", "queries-pan", "film")
    }
    assert counted == {
        "frames": len(made.TIMES_S),
        "vehicles": made.VEHICLES,
        "tracks-pan": made.TRACKS,
        "queries-pan": made.QUERIES,
        "film": 3,
    }
    rows = watched.page.evaluate("[page.channels.pan.tracks.count, page.truth.count]")
    assert rows == [made.TRACKS * len(made.TIMES_S), made.VEHICLES * len(made.TIMES_S)]
    said = watched.page.locator(
        "#now"
    ).inner_text()  # opens three quarters through, where frame 3 has one query
    assert said == "At 1.50 s: 2 tracks in pan, 3 moving vehicles inside, 1 spectra."


def test_slider_keys_and_play_move_all_pictures(opened):
    watched = opened()
    page = watched.page
    page.locator("#time").focus()
    page.keyboard.press("Home")
    watched.settle()
    assert page.locator("#clock").inner_text() == "0.00 s"
    first = watched.picture()
    page.locator("body").click(position={"x": 2, "y": 2})
    for _ in range(2):
        page.keyboard.press("ArrowRight")
    watched.settle()
    assert page.locator("#clock").inner_text() == "1.00 s" and page.locator("#time").input_value() == "2"
    assert watched.picture() != first
    frames = page.evaluate("[...document.querySelectorAll('canvas[data-kind]')].map(c => c.dataset.frame)")
    assert frames == ["2"] * 4
    page.keyboard.press("Space")
    watched.wait_for("page.state.t === page.times - 1 && !page.state.playing")
    assert page.locator("#play").inner_text() == "Play"


def test_every_layer_toggles(opened):
    watched = opened()
    page = watched.page
    watched.wait_for("Object.values(film.panels).every(p => p.last)")
    watched.settle()
    for name in ("tracks", "truth", "tails", "ids", "predictions", "queries"):
        before, box = watched.picture(), page.locator(f"#layers-{name}")
        assert box.is_checked() == (name in ("tracks", "truth"))
        box.click()
        watched.settle()
        assert watched.picture() != before, name
        box.click()
        watched.settle()
        assert watched.picture() == before, name
    page.locator("#kinds-dolp").uncheck()
    watched.settle()
    assert page.locator("canvas[data-kind=dolp]").is_hidden()


def test_a_click_on_a_track_shows_its_life(opened):
    watched = opened()
    page, t = watched.page, 1.5
    page.mouse.click(*watched.place(made.FIRST_X_M + made.SPEED_M_S * t, made.FIRST_Y_M))
    watched.settle()
    said = page.locator("#track-text").inner_text()
    assert said.startswith("Track 4 in pan: 0.00 s to 2.50 s, 6 frames, 0 of them without a detection.")
    assert "On vehicle 11 (red) in 6 frames. 0 identity switches." in said
    assert page.locator("#spectra canvas").count() == 1
    card, picture = page.locator("#track-card").bounding_box(), page.locator("#panels").bounding_box()
    assert card["x"] >= picture["x"] + picture["width"] and card["y"] < picture["y"] + picture["height"]
    title = page.locator("#spectra figcaption").inner_text()
    assert title == "Spectra of track 4 against the mean of red"
    page.mouse.click(*watched.place(-30 + made.SPEED_M_S * t, -20, "rgb"))
    watched.settle()
    said = page.locator("#track-text").inner_text()
    assert said.startswith("Track 7") and "6 of them without a detection" in said
    switch = page.locator("#switches button")
    assert switch.inner_text() == "1.50 s: vehicle 22 (blue) → vehicle 33 (blue)"
    page.locator("#time").fill("0")
    switch.click()
    watched.settle()
    assert page.locator("#clock").inner_text() == "1.50 s"
    page.mouse.click(*watched.place(50, 30))  # nothing there
    watched.settle()
    assert page.locator("#track-card").is_hidden()
    page.locator("body").click(position={"x": 2, "y": 2})
    page.keyboard.press("n")
    assert page.locator("#track").input_value() == "4"
    page.locator("#track-close").click()
    assert page.locator("#track-card").is_hidden() and page.locator("#track").input_value() == ""
    assert watched.complaints == []


@pytest.mark.parametrize("width", [390, 1280])
def test_the_legend_stays_in_view(opened, width):
    watched = opened(viewport={"width": width, "height": 600})
    for kind in ("pan", "aop"):
        watched.page.evaluate(
            f"document.querySelector('canvas[data-kind={kind}]').scrollIntoView({{block: 'end'}})"
        )
        watched.settle()
        box = watched.page.locator(".legend").bounding_box()
        assert box and 0 <= box["y"] and box["y"] + box["height"] <= 600, (kind, box)


def test_north_sun_and_scale_are_drawn_on_each_picture(opened):
    """White over black: at the scale bar's end, in the corner where the films of noise have grey."""
    watched = opened()
    found = watched.page.evaluate(
        "[...document.querySelectorAll('canvas[data-kind]')].map(c => { const r = devicePixelRatio;"
        "const d = c.getContext('2d').getImageData(12 * r, c.height - 13 * r, 1, 1).data; return [...d] })"
    )
    assert found == [[255, 255, 255, 255]] * 4


def test_scores_quality_roc_design_devices_and_provenance_are_there(opened, tmp_path):
    folder = made.write_small_result(tmp_path / "result")
    (folder / "pictures").mkdir()
    for name in ("sky", "light", "elements", "polarizer", "etalon"):
        write_picture(folder / "pictures" / f"{name}.png", np.full((30, 40, 3), 0.4))
    watched = opened(folder)
    page = watched.page
    assert page.locator("#score-charts figcaption").all_inner_texts()[:2] == [
        "Track completeness, Eq. (13)",
        "Track purity of the flight so far, Eq. (14)",
    ]
    assert page.locator("#quality-charts figcaption").inner_text() == "Picture: PSNR"
    marks = page.locator("#froc-charts circle title").all_text_contents()
    swept = "pan, reporting.max_false_share"
    assert marks == [
        f"{swept} 0: 4, 0.6",
        f"{swept} 0.06: 1, 0.5",
        f"{swept} 0.4: 0, 0.2",
        "pan, this run: 0, 0.45",
    ]
    changed = page.locator("#design table").first.locator("tbody tr").all_inner_texts()
    assert [row.split()[0] for row in changed] == ["name", "seed"]
    seen = page.evaluate(
        "Promise.all([...document.querySelectorAll('#figures img')].map(async i => {"
        "i.loading = 'eager'; await i.decode(); return i.naturalWidth }))"
    )
    assert seen == [40] * 5
    assert "glintrack_version" in page.locator("#provenance").inner_text()
    assert watched.complaints == []


@pytest.mark.parametrize("width", WIDTHS)
def test_it_fits_the_screen(opened, tmp_path, width):
    watched = opened(viewport={"width": width, "height": 900})
    page = watched.page
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    assert page.evaluate(CUT_LABELS) == []
    page.screenshot(path=str(tmp_path / f"page_{width}.png"), full_page=True)
    colours = page.evaluate(
        "(() => { const c = document.querySelector('canvas[data-kind=pan]');"
        "const d = c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "return new Set(Array.from({length: d.length / 4}, (_, i) => d[4 * i])).size })()"
    )
    assert colours > 50  # a picture, not a plain
    small = page.evaluate(
        "[...document.querySelectorAll('button, select')]"
        ".filter(b => b.offsetHeight && b.offsetHeight < 24).length"
    )
    assert small == 0  # WCAG 2.2, target size


@pytest.mark.parametrize(("scheme", "width"), [("light", 1400), ("dark", 390)])
def test_labels_and_contrast(opened, scheme, width):
    axe = pytest.importorskip("axe_playwright_python.sync_playwright", reason="needs axe-playwright-python")
    watched = opened(color_scheme=scheme, viewport={"width": width, "height": 900})
    watched.page.select_option("#track", "7")
    watched.settle()
    assert watched.page.evaluate("document.documentElement.dataset.theme") == scheme
    found = axe.Axe().run(watched.page).response["violations"]
    assert [(v["id"], [n["target"] for n in v["nodes"]]) for v in found] == []


def test_html_in_names_stays_text(opened, tmp_path):
    evil = "</script><script>window.hacked=1</script><img src=x onerror=window.hacked=1>"
    folder = made.write_small_result(tmp_path / "evil", case=Case(scene={"dem_file": evil}))
    (folder / "provenance.toml").write_text(f"case = {json.dumps(evil)}\nglintrack_version = '<b>9</b>'\n")
    watched = opened(folder)
    watched.page.select_option("#track", "4")
    watched.settle()
    assert watched.page.evaluate("window.hacked") is None
    assert watched.page.locator("h1").inner_text() == evil
    assert "Written by glintrack <b>9</b>" in watched.page.locator(".note").first.inner_text()
    assert watched.complaints == []


@pytest.mark.parametrize("missing", ["result.nc", "film", "film frames", "case.toml"])
def test_half_a_result_opens(opened, tmp_path, missing):
    folder = made.write_small_result(tmp_path / "half")
    path = folder / missing
    if missing == "film frames":
        nothing = {"kinds": [], "frames": [], "times_s": [], "extent_m": made.EXTENT_M}
        (folder / "film" / "film.json").write_text(json.dumps(nothing))
    elif path.is_dir():
        shutil.rmtree(path)
    else:
        path.unlink()
    watched = opened(folder)
    assert watched.complaints == []
    assert watched.page.locator(".note").count() == 1


def test_the_server_shows_the_same(browser, tmp_path):
    server = serve_result(read_result(made.write_small_result(tmp_path / "result")))
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
    thread.start()
    try:
        watched = Watched(browser, f"http://127.0.0.1:{server.server_address[1]}/", offline=False)
        watched.wait_for("Object.values(film.panels).every(p => p.last && p.last.naturalWidth > 0)")
        assert watched.complaints == []
        assert any(url.endswith("/film/dolp_00002.webp") for url in watched.asked)
        watched.context.close()
    finally:
        server.shutdown()
        server.server_close()
        thread.join()
