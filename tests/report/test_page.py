"""The page's data, and that nothing in a result can write HTML into it."""

import base64
import json
import re
from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
from markupsafe import escape

from glintrack import Case
from glintrack.bounds import STAGES
from glintrack.io.netcdf import write_tree
from glintrack.report import build_page
from glintrack.report.page import design_rows, flatten, in_code, read_terms, script_json
from glintrack.report.page_data import budget_bars, encode, page_data, plan
from glintrack.results.read import SCORE_LABELS, read_result
from tests.report import made


@pytest.fixture
def folder(tmp_path):
    return made.write_small_result(tmp_path / "result")


def unpack(column):
    return np.frombuffer(base64.b64decode(column["data"]), f"<{column['kind']}")


def embedded(html, ident):
    found = re.search(rf'<script type="application/json" id="{ident}">(.*?)</script>', html)
    assert found is not None
    return json.loads(found[1])


def test_columns_keep_their_numbers():
    assert unpack(encode(np.array([-3.4, 0, 40000]), "i2")).tolist() == [-3, 0, 32767]
    np.testing.assert_array_equal(unpack(encode(np.array([0.5, np.nan]), "f4")), [0.5, np.nan])


def test_the_page_holds_what_the_result_holds(folder):
    html = build_page(read_result(folder))
    data = embedded(html, "data")
    pan = data["channels"]["pan"]
    assert pan["counts"] == {"tracks": made.TRACKS, "rows": 12, "queries": made.QUERIES}
    assert data["truth"]["vehicles"] == made.VEHICLES
    first = unpack(pan["tracks"]["x"])[0] / 10 + 0.5 * (made.EXTENT_M[0] + made.EXTENT_M[2])
    assert first == pytest.approx(made.FIRST_X_M, abs=0.05)  # decimetres
    assert unpack(pan["tracks"]["per"]).tolist() == [2] * 6
    assert unpack(pan["tracks"]["vx"])[0] / 100 == made.SPEED_M_S
    pictures = embedded(html, "pictures")
    assert {kind: len(of) for kind, of in pictures.items()} == dict.fromkeys(("rgb", "pan", "dolp", "aop"), 3)
    assert base64.b64decode(pictures["pan"][0])[8:12] == b"WEBP"


def test_a_paints_mean_is_over_its_vehicles(folder):
    spectra = page_data(read_result(folder))["channels"]["pan"]["spectra"]
    assert {name: (c["count"], c["mean"][0], c["spread"][0]) for name, c in spectra["classes"].items()} == {
        "red": (2, 2.0, 1.0),
        "blue": (1, 5.0, 0.0),
    }
    four = spectra["tracks"]["4"]
    assert four["t"] == [2, 3] and "-1" not in spectra["tracks"]
    np.testing.assert_allclose(unpack(four["values"]) * four["step"], np.repeat([1, 3], 7), atol=four["step"])


def test_the_roc_is_the_results(folder):
    froc = page_data(read_result(folder))["channels"]["pan"]["froc"]
    assert [p[:2] for p in froc["points"]] == [[4.0, 0.6], [1.0, 0.5], [0.0, 0.2]]
    assert froc["own"] == [0.0, 0.45] and froc["table"][2] == [0.4, 0.2, 0.0, None]
    html = build_page(read_result(folder))
    assert "<td>pan</td><td>0.4</td><td>0.2</td><td>0</td><td>–</td>" in html


def add_loss_budget(folder, group: str = "pan", attrs: Mapping[str, float] | None = None):
    """The small result with a loss budget of two stages, of which one was measured, and attributes."""
    result = read_result(folder)
    budget = xr.Dataset(
        {"of_moving": ("stage", [1.0, 0.5, np.nan])},
        coords={"stage": ["moving", "known_background", "tracker"]},
    )
    assert result.tree is not None
    tree = result.tree.copy(deep=True)
    tree["bound"] = xr.DataTree(children={group: xr.DataTree(budget)})
    tree.attrs.update(attrs or {})
    return replace(result, tree=tree)


def test_the_loss_budget_stands_on_the_page_where_there_is_one(folder):
    assert 'id="loss-budget"' not in build_page(read_result(folder))
    html = build_page(add_loss_budget(folder))
    assert re.search(r'<th scope="row">background known<small>[^<]+</small></th><td>0.5</td>', html)
    assert '<th scope="row">tracker<' not in html
    evil = build_page(add_loss_budget(folder, group="<img src=x>"))
    assert "<img src=x>" not in evil and "&lt;img src=x&gt;" in evil


def test_the_first_screen_has_headline_loss_budget_facts_north_sun_and_scale(folder):
    html = build_page(add_loss_budget(folder))
    first = html[html.index("<header>") : html.index("</header>")]
    assert "<strong>45</strong> of 100 moving vehicles in the window are tracked" in first
    assert "stand close together: 100 are left before this stage, 50 after it." in first
    assert "per 100 moving vehicles in the window" in first and "visible vehicles" not in first
    labels = re.findall(r'<th scope="row">([^<]*?) ?<.*?<span style="width: (.*?)%">', first)
    assert labels == [("moving in the scored area", "100.0"), ("background known", "50.0")]
    assert first.count("largest loss that no later stage recovers") == 1
    facts = dict(re.findall(r"<dt>(.*?)</dt><dd>(.*?)</dd>", first.partition('id="facts"')[2]))
    assert list(facts) == ["case", "flight", "sun", "altitude", "off nadir", "an element sees"]
    assert facts["case"] == "small" and facts["sun"].endswith("azimuth 251°")
    assert ">N</text>" in first and ">sun 251°</text>" in first and ">20 m</text>" in first
    assert "The window, 120 m × 80 m, north up" in first and "data:image/webp" in first


def test_without_a_loss_budget_the_first_screen_shows_channels_and_how_to_get_one(folder):
    caption, bars = budget_bars(read_result(folder))
    assert caption == "Of 100 moving vehicles, how many each channel tracks"
    assert [(bar.label, bar.per_hundred, bar.last) for bar in bars] == [("pan", 45.0, True)]
    assert "<code>glintrack bound case.toml</code>" in build_page(read_result(folder))


def test_every_stage_and_score_is_explained(folder):
    terms = read_terms()
    assert set(terms["stages"]) == set(STAGES) and set(terms["scores"]) == set(SCORE_LABELS)
    html = build_page(add_loss_budget(folder))
    assert all(str(escape(text)) in html for text in (*terms["scores"].values(), *terms["terms"].values()))
    assert "It does not predict tracking" in html


def test_the_suns_arrow_points_to_where_it_stands():
    drawn = plan((0, 0, 100, 50), 90.0)["sun"]
    assert float(drawn["x"]) == pytest.approx(7.0) and float(drawn["y"]) == pytest.approx(0.0)  # east
    assert float(plan((0, 0, 100, 50), 0.0)["sun"]["y"]) == pytest.approx(-7.0)  # north is up
    assert plan((0, 0, 100, 50), None)["sun"] is None


def test_sections_without_content_are_absent(tmp_path, folder):
    html = build_page(read_result(folder))
    assert 'id="quality-section"' in html and 'href="#figures"' not in html and 'id="figures"' not in html
    (folder / "result.nc").unlink()
    html = build_page(read_result(folder))
    for gone in ("quality-section", "scores", "froc", "track", "track-card"):
        assert f'id="{gone}"' not in html and f'href="#{gone}"' not in html
    assert 'id="flight"' in html and 'id="design"' in html


def test_how_well_positions_can_be_known_stands_on_the_page(folder):
    result = add_loss_budget(folder, group="pan")
    assert "bound from sensor noise" not in build_page(result) and result.tree is not None
    result.tree["bound/pan"].attrs.update({"position_bound_sensor_median_m": 0.0123})
    assert (
        "pan, median position error of visible moving vehicles: lower bound from sensor noise 0.012 m."
        in build_page(result)
    )


def test_names_with_html_are_escaped(tmp_path):
    evil = '</script><script>window.hacked = 1</script><img src=x onerror="hacked=1">'
    folder = made.write_small_result(
        tmp_path / "result", name="x", case=Case().replace({"scene.dem_file": evil})
    )
    (folder / "provenance.toml").write_text(f"case = {json.dumps(evil)}\nglintrack_version = '<b>9</b>'\n")
    html = build_page(read_result(folder))
    assert "window.hacked = 1</script>" not in html and "<img src=x" not in html and "<b>9</b>" not in html
    assert "&lt;b&gt;9&lt;/b&gt;" in html
    assert embedded(html, "data")["name"] == evil


def test_a_refused_name_with_html_is_escaped(tmp_path):
    """No case may be so named, but a folder of somebody else's can hold one that is: a note quotes it."""
    case = made.named("<img src=x onerror=1>")
    html = build_page(read_result(made.write_small_result(tmp_path / "result", name="x", case=case)))
    assert "<img src=x" not in html and "not a case of this version" in html
    assert "&lt;img src=x onerror=1&gt;" in html


def test_json_in_a_script_cannot_end_it():
    text = script_json({"a": "</script>\u2028&"})
    assert "<" not in text and "\u2028" not in text and json.loads(text) == {"a": "</script>\u2028&"}


def test_nothing_is_loaded_from_elsewhere(folder):
    html = build_page(read_result(folder))
    assert re.findall(r'(?:src|href)="(?!data:|#)([^"]+)"', html) == []
    assert "default-src 'none'; img-src data:" in html


def test_the_design_is_a_diff():
    mine, base = Case().replace({"seed": 3, "flight.off_nadir_deg": 40.0}), Case()
    changed = {key: (value, other) for key, value, other, differs in design_rows(mine, base) if differs}
    assert changed == {"seed": ("3", "0"), "flight.off_nadir_deg": ("40", "50")}
    assert flatten({"a": {"b": [1.5, None]}, "c": ""}) == [("a.b", "1.5, –"), ("c", "–")]


def test_the_base_may_be_named(folder, tmp_path):
    html = build_page(read_result(folder), "quickstart")
    assert "differ from quickstart" in html
    with pytest.raises(ValueError, match="must be a readable file"):
        build_page(read_result(folder), str(tmp_path / "none.toml"))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("quickstart", "the packaged case quickstart"),
        ("table1", "the defaults"),  # a study's name
        ("../cases/quickstart", "the defaults"),
        ("x.toml", "the defaults"),
    ],
)
def test_the_base_is_a_packaged_case_of_that_very_name(tmp_path, name, said):
    result = read_result(made.write_small_result(tmp_path / "result"))
    assert f"differ from {said}." in build_page(replace(result, case=made.named(name)))


@pytest.mark.parametrize("kept", [["case.toml"], ["provenance.toml"], ["result.nc"]])
def test_a_half_finished_result_has_a_page(folder, kept):
    for path in folder.iterdir():
        if path.is_file() and path.name not in kept:
            path.unlink()
    html = build_page(read_result(folder))
    assert html.count('class="note"') == 2 and "</html>" in html


@pytest.mark.slow
def test_a_minute_at_ten_hertz_stays_small(tmp_path, monkeypatch):
    """600 frames of a full film, 250 tracks and 600 vehicles in each, a spectrum for every other track."""
    folder = made.write_small_result(tmp_path / "result")
    film = json.loads((folder / "film" / "film.json").read_text())
    rng = np.random.default_rng(0)
    times = (0.1 * np.arange(600)).tolist()
    for kind in film["kinds"]:
        for k in range(600):
            (folder / "film" / f"{kind}_{k:05d}.webp").write_bytes(rng.bytes(made_film_share()))
    (folder / "film" / "film.json").write_text(
        json.dumps(film | {"frames": list(range(600)), "times_s": times})
    )
    monkeypatch.setattr(made, "TIMES_S", np.array(times))

    def table(count, **columns):
        return made.rows(list(range(count)), rng.uniform(-30, 30, (count, 2)), **columns)

    ids, cars = np.tile(np.arange(250), 600), np.tile(np.arange(600), 600)
    flags = np.zeros(len(ids), int)
    tracks = table(250, track_id=ids, vehicle_id=ids, valid=flags, false=flags, status=flags)
    truth = table(600, vehicle_id=cars, visible_fraction=np.ones(len(cars)))
    truth["east_m"] = truth["east_m"] % 40
    tree = made.xr.DataTree.from_dict(
        {
            **{f"/{m}": made.xr.Dataset({"completeness": ("time", rng.uniform(0, 1, 600))}, {"time": times})
               for m in ("pan", "dolp")},
            **{f"/{m}/tracks": tracks for m in ("pan", "dolp")},
            **{f"/{m}/queries": queries(rng, times) for m in ("pan", "dolp")},
            "/truth": truth,
        }
    )  # fmt: skip
    write_tree(folder / "result.nc", tree)
    html = build_page(read_result(folder))
    assert len(html.encode()) < 40e6
    assert embedded(html, "data")["truth"]["count"] == len(cars)


def made_film_share():
    """Bytes of one picture where the film takes all it may."""
    return made.FILM_BYTES // (4 * 600)


def queries(rng, times, each=125):
    n = each * len(times)
    return made.xr.Dataset(
        {
            "time_s": ("row", np.repeat(times, each)),
            "track_id": ("row", rng.integers(0, 2000, n)),
            "vehicle_id": ("row", rng.integers(0, 600, n)),
            "east_m": ("row", rng.uniform(-30, 30, n)),
            "north_m": ("row", rng.uniform(-30, 30, n)),
            "radiance": (("row", "wavelength"), rng.uniform(0, 100, (n, 60)).astype(np.float32)),
        },
        coords={"wavelength": np.linspace(0.4, 1.0, 60)},
    )


def test_what_stands_between_backticks_is_code_and_all_else_escaped():
    assert in_code("set `a = <1>` & fly") == "set <code>a = &lt;1&gt;</code> &amp; fly"
    assert in_code("an odd ` <b>") == "an odd ` &lt;b&gt;"
