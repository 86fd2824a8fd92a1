"""Report page: one HTML file with pictures, program and styles inside it.

A content security policy forbids to load anything else. All text from the result is escaped by jinja2, or
set as text by the page's program.
"""

import base64
import contextlib
import json
import math
from collections.abc import Mapping
from typing import NamedTuple

import jinja2
from markupsafe import Markup, escape

from glintrack.bounds import STAGE_LABELS, STAGES_NOTE
from glintrack.case.design import Case
from glintrack.case.niirs import describe_niirs
from glintrack.case.packaged import find_case, list_cases
from glintrack.core.installation import data_file, read_data
from glintrack.report.page_data import budget_bars, page_data, plan
from glintrack.results import read
from glintrack.results.headline import headline
from glintrack.results.verdict import (
    CHANNEL_WORDS,
    accuracy_lines,
    describe_other_channels,
    select_channel,
    stage_shares,
    sun_angles_deg,
    view_facts,
)

_FIGURES: Mapping[str, str] = read_data("page", "scores.toml")["figures"]
_FIGURE_SIDE = 1100  # longest side of a figure on the page [pixel]
_PLAN_SIDE = 640  # of the picture on the first screen [pixel]
_DASH = "–"
DEFAULTS = "the defaults"  # compared with cases of other names
_MAX_CHANGES = 6  # on the first screen


def build_page(result: read.Result, base: str | None = None, inline: bool = True) -> str:
    """Build the report of a run as HTML.

    Parameters
    ----------
    result
        From `read_result`.
    base
        Case to compare the design with: a file, or a packaged case by name. By default the packaged case of
        the same name if there is one, else the defaults.
    inline
        Whether pictures are in the page; else they are loaded from ``film/`` and ``pictures/``.

    Raises
    ------
    ValueError
        If the base case cannot be read.
    """
    data = page_data(result)
    budgets = {} if result.tree is None else stage_shares(result.tree)
    name, other = _base_case(result.case, base)
    rows = design_rows(result.case, other) if result.case else []
    caption, bars = budget_bars(result)
    azimuth_deg = None if result.case is None else sun_angles_deg(result.case)[1]
    facts = {"case": result.name} | (view_facts(result.case) if result.case is not None else {})
    if {"frames_done", "frames_asked"} <= set(result.provenance):
        facts["frames simulated"] = "{frames_done} of {frames_asked}".format(**result.provenance)
    accuracy = {} if result.tree is None else accuracy_lines(result.tree)
    first, terms = headline(result), read_terms()
    return render_page(
        "report.html.j2",
        scripts=("theme.js", "core.js", "plots.js", "charts.js", "film.js", "track.js", "report.js"),
        title=data["name"],
        verdict=result.verdict,
        headline=None if first is None else {k: in_code(text) for k, text in first._asdict().items()},
        other_channels=describe_other_channels(result.scores),
        reservations=[in_code(text) for text in result.reservations],
        facts=facts | _changes(rows, name),
        bars=bars,
        bars_caption=caption,
        plan=plan(data["extent_m"], azimuth_deg, _plan_picture(result, inline)) if data["times_s"] else None,
        notes=result.notes,
        data=script_json(
            data
            | {"film": result.film, "sun_azimuth_deg": azimuth_deg, "speaks": select_channel(result.scores)}
        ),
        pictures=script_json(_film_pictures(result) if inline else {}),
        policy_pictures="data:" if inline else "'self' data:",
        counts=_counts(result, data),
        scores=read.score_rows({name: part["scores"] for name, part in data["channels"].items()}),
        terms=terms,
        score_terms={read.SCORE_LABELS[key]: meaning for key, meaning in terms["scores"].items()},
        stage_terms={STAGE_LABELS[key]: meaning for key, meaning in terms["stages"].items()},
        niirs=[] if result.case is None else _niirs(result.case),
        score_columns=[CHANNEL_WORDS.get(name, name) for name in data["channels"]],
        loss_budget=budget_rows(budgets),
        stages_note=STAGES_NOTE,
        budget_columns=[CHANNEL_WORDS.get(name, name) for name in budgets],
        accuracy=[(CHANNEL_WORDS.get(g, g), line) for g, line in accuracy.items()],
        froc_rows=[
            [CHANNEL_WORDS.get(name, name), *(f"{row[0]:g}", *map(read.score_text, row[1:]))]
            for name, part in data["channels"].items()
            for row in (part["froc"] or {"table": []})["table"]
        ],
        froc_key=next((part["froc"]["key"] for part in data["channels"].values() if part["froc"]), ""),
        has_tracks=any(part["counts"]["tracks"] for part in data["channels"].values()),
        has_quality=any(part["quality"] for part in data["channels"].values()),
        base_name=name,
        changed=[row for row in rows if row.differs],
        same=[row for row in rows if not row.differs],
        figures=_figures(result, inline),
        case_text=result.case_text,
        provenance=flatten(result.provenance),
    )


def render_page(template: str, scripts: tuple[str, ...], **values: object) -> str:
    """Fill a template of ``data/page`` with values and the page's styles and programs."""
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(_part(template)).render(
        styles=Markup(_part("uPlot.min.css") + _part("page.css")),
        programs=[Markup(_part(name)) for name in ("uPlot.iife.min.js", *scripts)],
        **values,
    )


def read_terms() -> dict[str, dict[str, str]]:
    """Explanations of stages, scores and other terms."""
    return read_data("page", "terms.toml")


def script_json(value: object) -> Markup:
    """JSON for a script element, which it cannot end."""
    text = json.dumps(value, allow_nan=False, separators=(",", ":"))
    for mark in "<>&\u2028\u2029":
        text = text.replace(mark, f"\\u{ord(mark):04x}")
    return Markup(text)


def in_code(text: str) -> Markup:
    """Text for the page, with code between backticks, escaped."""
    parts = text.split("`")
    if len(parts) % 2 == 0:  # an odd backtick marks nothing
        return escape(text)
    return Markup("").join(
        Markup("<code>{}</code>").format(part) if k % 2 else escape(part) for k, part in enumerate(parts)
    )


class KeyRow(NamedTuple):
    """Key of a case with its value, the base's value, and whether they differ."""

    key: str
    value: str
    base: str
    differs: bool


def design_rows(case: Case, base: Case) -> list[KeyRow]:
    """Every key of a case with its value and that of a base."""
    mine, theirs = (dict(flatten(c.model_dump(mode="json"))) for c in (case, base))
    return [
        KeyRow(key, mine.get(key, _DASH), theirs.get(key, _DASH), mine.get(key) != theirs.get(key))
        for key in mine | theirs
    ]


def _changes(rows: list[KeyRow], base_name: str) -> dict[str, str]:
    """Differences from the base for the first screen; none from the defaults."""
    changes = [f"{row.key} = {row.value}" for row in rows if row.differs and row.key != "name"]
    if not changes or base_name == DEFAULTS:
        return {}
    if len(changes) > _MAX_CHANGES:
        changes[_MAX_CHANGES:] = [f"{len(changes) - _MAX_CHANGES} more"]
    return {f"changed from {base_name}": ", ".join(changes)}


def budget_rows(budgets: Mapping[str, Mapping[str, float]]) -> list[tuple[str, list[str]]]:
    """Label of each stage, and the share of all movers there for each group of elements."""
    stages = dict.fromkeys(stage for one in budgets.values() for stage in one)
    return [
        (
            STAGE_LABELS.get(stage, stage),
            [read.score_text(one.get(stage, math.nan)) for one in budgets.values()],
        )
        for stage in stages
    ]


def flatten(values: dict, prefix: str = "") -> list[tuple[str, str]]:
    """Nested tables as rows of dotted key and text."""
    rows: list[tuple[str, str]] = []
    for key, value in values.items():
        if isinstance(value, dict):
            rows += flatten(value, f"{prefix}{key}.")
        else:
            rows.append((f"{prefix}{key}", _text(value)))
    return rows


def _text(value: object) -> str:
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(_text(v) for v in value)
    return _DASH if value is None or value == "" else str(value)


def _base_case(case: Case | None, base: str | None) -> tuple[str, Case]:
    """Name and design to compare with."""
    if base is not None:
        return base, Case.from_toml(find_case(base))
    if case is None or case.name not in list_cases():
        return DEFAULTS, Case()
    return f"the packaged case {case.name}", Case.from_name(case.name)


def _niirs(case: Case) -> list[Markup]:
    """Sentence about NIIRS; none if a file that the sensor names is not here."""
    with contextlib.suppress(OSError, ValueError):
        return [in_code(f"{describe_niirs(case)}.")]
    return []


def _part(name: str) -> str:
    return data_file("page", name).read_text(encoding="utf-8")


def _film_pictures(result: read.Result) -> dict[str, list[str]]:
    """Base64 of each kind's pictures in the order of frames; an empty text if missing."""
    film, out = result.film, {}
    for kind in film.get("kinds", []):
        paths = [read.film_file(result.path, kind, frame) for frame in film["frames"]]
        out[kind] = ["" if p is None else base64.b64encode(p.read_bytes()).decode() for p in paths]
    return out


def _plan_picture(result: read.Result, inline: bool) -> str:
    """Address of the film's first kind, three quarters through; empty if it is missing."""
    frames, kinds, path = result.film.get("frames"), result.film.get("kinds"), None
    if frames and kinds:
        path = read.film_file(result.path, kinds[0], frames[3 * (len(frames) - 1) // 4])
    if path is None:
        return ""
    return read.picture_url(path, _PLAN_SIDE) if inline else f"film/{path.name}"


def _figures(result: read.Result, inline: bool) -> list[tuple[str, str, str]]:
    """Name, source and caption of each figure of the result."""
    found = {name: read.picture_file(result.path, name) for name in _FIGURES}
    return [
        (name, read.picture_url(path, _FIGURE_SIDE) if inline else f"pictures/{name}.png", _FIGURES[name])
        for name, path in found.items()
        if path is not None
    ]


def _counts(result: read.Result, data: dict) -> list[tuple[str, str, int]]:
    """Id, label and number of frames, vehicles, tracks and queries."""
    rows = [("frames", "frames", len(data["times_s"]))]
    if data["truth"]:
        rows.append(("vehicles", "vehicles inside", data["truth"]["vehicles"]))
    for name, part in data["channels"].items():
        words = CHANNEL_WORDS.get(name, name)
        rows.append((f"tracks-{name}", f"tracks in {words}", part["counts"]["tracks"]))
        rows.append((f"queries-{name}", f"spectra for {words}", part["counts"]["queries"]))
    if result.film:
        rows.append(("film", "film frames", len(result.film["frames"])))
    return rows
