"""Page of a study: sortable table of runs with links, effects, parallel coordinates and curves."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from glintrack.core.installation import VERSION
from glintrack.core.schema import CHANNEL_WORDS
from glintrack.report.page import flatten, in_code, read_terms, render_page, script_json
from glintrack.study import analyse, read_results
from glintrack.study.analysis import CHANCE, labels
from glintrack.study.optimize.report import INTERVAL_DEVIATE, OptimizationResult, SliderAxis
from glintrack.study.optimize.report import read_result as read_optimization_result
from glintrack.study.optimize.spec import WORD_DISTANCE
from glintrack.study.report import response_surfaces, view_notes
from glintrack.study.text_tables import (
    NAMES,
    RESPONSES,
    answer,
    comparison_tables,
    importance_table,
    narrow_intervals,
    study_headline,
)

HEAD = "study.json"
RUN_PAGE = "report.html"
_PREDICTS = {
    False: "From the response surfaces: the score of one simulation, with an interval of 90 %.",
    True: "From the Gaussian processes: means over all cities, with an interval of 90 %.",
}
_FIRST = ("point", "replicate", "case", "channel", "status")


def is_study(path: str | Path) -> bool:
    """Return True if a folder is that of a study."""
    return (Path(path) / HEAD).is_file()


def build_study_page(folder: str | Path, page_folder: str | Path) -> str:
    """Build the report of a study as HTML.

    Parameters
    ----------
    folder
        Folder of a study with results.
    page_folder
        Folder of the page; links to the runs are relative to it.

    Raises
    ------
    ValueError
        If it is no study's folder or holds no results.
    """
    folder = Path(folder)
    table, source = read_results(folder)
    axes = [str(axis) for axis in source["axes"]]
    responses = [name for name in RESPONSES if name in table and table[name].notna().any()]
    columns = [*(c for c in _FIRST if c in table), *axes]
    columns += [c for c in (*responses, "data_rate_mbit_s") if c in table]
    done = table["status"] == "finished"
    tables = analyse(table, source) if done.any() else {}
    varied = [axis for axis in axes if table[axis].nunique() > 1]
    plots, first = _plots(tables, varied), study_headline(tables)
    optimization = read_optimization_result(folder)
    predictions = _predictions(table, source, optimization) if tables else None
    if "points" in tables:
        tables["points"]["point"] = [shorten_design(point, axes) for point in tables["points"]["point"]]
    matters = importance_table(tables)
    values = [[_plain(v) for v in row] for row in table[columns].itertuples(index=False)]
    links = {key: _link(folder, str(key), Path(page_folder)) for key in table["case"].unique()}
    cells = [
        (
            [
                (CHANNEL_WORDS.get(v, _cell(v)) if name == "channel" else _cell(v), "" if v is None else v)
                for name, v in zip(columns, row, strict=True)
            ],
            links[row[columns.index("case")]],
        )
        for row in values
    ]
    return render_page(
        "study.html.j2",
        scripts=("theme.js", "plots.js", "predict.js", "study.js"),
        kind="study" if optimization is None else "optimization",
        optimization=optimization
        and {"sentences": [in_code(said) for said in optimization.sentences], "tables": optimization.tables},
        predicts=_PREDICTS[optimization is not None] if predictions else "",
        title=str(source["design"].get("name") or folder.resolve().name),
        notes=_notes(table, source),
        headline=None if first is None else {k: in_code(text) for k, text in first._asdict().items()},
        answer=in_code(answer(tables)) if tables else "",
        narrow=in_code(narrow_intervals(table, source)) if matters else "",
        reservations=[]
        if optimization or "views" not in tables
        else [in_code(n) for n in view_notes(tables["views"])],
        matters=matters,
        text_tables=comparison_tables(tables),
        has_points="points" in tables,
        base=_base_design(table, varied),
        has_parallel=bool(tables) and bool(varied) and bool(responses),
        has_plots=bool(plots),
        counts=_counts(table),
        columns=[NAMES.get(c, c) for c in columns],
        link_column=columns.index("case"),
        rows=cells,
        terms=read_terms(),
        score_terms={NAMES[key]: text for key, text in read_terms()["scores"].items() if key in NAMES},
        provenance=flatten(dict(source)),
        data=script_json(
            {
                "columns": columns,
                "rows": values,
                "labels": NAMES,
                "varied": varied,
                "responses": responses,
                "effects": _records(tables, "effects", ("axis", "level", "effect")),
                "points": _records(tables, "points", ("point", "score")),
                "plots": plots,
                "predict": predictions,
                "front": [] if optimization is None else [_front_plot(optimization)],
            }
        ),
    )


def _predictions(
    table: pd.DataFrame, source: Mapping[str, Any], optimization: OptimizationResult | None
) -> dict[str, Any] | None:
    """Axes and predictors for the page's program; None without any."""
    if optimization is not None:
        axes = [axis.model_dump() for axis in optimization.axes]
        own = [{**p.process, "label": p.label, "logarithmic": p.logarithmic} for p in optimization.predictors]
        return {"axes": axes, "predictors": own, "deviate": INTERVAL_DEVIATE, "word": WORD_DISTANCE}
    surfaces = response_surfaces(table, source)
    if not surfaces:
        return None
    first = next(iter(surfaces.values()))
    ends = zip(first.axes, first.low.tolist(), first.high.tolist(), first.log, strict=True)
    axes = [SliderAxis(name=name, low=a, high=b, log=log, value=a) for name, a, b, log in ends]
    found = [
        {**one.to_values(), "label": f"{NAMES[name]}, {CHANNEL_WORDS.get(channel, channel)}"}
        for (name, channel), one in surfaces.items()
        if one.axes == first.axes and np.array_equal([one.low, one.high], [first.low, first.high])
    ]
    return {"axes": [axis.model_dump() for axis in axes], "predictors": found}


def _front_plot(result: OptimizationResult) -> dict:
    """Pareto front of cost and probability, with numbered designs."""
    points = [[one.cost, one.probability, one.design, str(k)] for k, one in enumerate(result.front, start=1)]
    line = {"label": "Pareto front", "channel": "pan", "points": points, "joined": points}
    title = "Probability of meeting all requirements against cost; the numbers name the designs of the front"
    plot = {"title": title, "xlabel": "cost", "ylabel": "probability", "lines": [line]}
    return plot | {"numbered": [one.design for one in result.front]}


def shorten_design(point: str, axes: Sequence[str]) -> str:
    """Name of a design with keys by their last part, three digits, and without seeds.

    Parameters
    ----------
    point
        Its differences from the first design, as "sensor.pitch_um = 8.51234, seed = 7".
    axes
        Keys and labels that the study varies.
    """
    last = [axis.rpartition(".")[2] for axis in axes]
    short = point
    for axis, name in zip(axes, last, strict=True):
        if axis in CHANCE:
            short = re.sub(rf"(^|, ){re.escape(axis)} = [^,]*", "", short)
        elif last.count(name) == 1:
            short = re.sub(rf"(^|, ){re.escape(axis)} = ", rf"\g<1>{name} = ", short)
    return re.sub(r"-?\d+\.\d{3,}", lambda found: f"{float(found[0]):.3g}", short).lstrip(", ") or point


def _base_design(table: pd.DataFrame, varied: Sequence[str]) -> str:
    """Levels of the first design on the axes that vary, without seeds; empty for a single axis."""
    levels = [f"{axis} = {table[axis].iloc[0]}" for axis in varied if axis not in CHANCE]
    return shorten_design(", ".join(levels), varied) if len(levels) > 1 else ""


def _notes(table: pd.DataFrame, source: Mapping[str, Any]) -> list[str]:
    """Sentences about unfinished rows and another version."""
    notes = []
    for status, words in (("missing", "have not been simulated yet"), ("failed", "failed")):
        count = int((table["status"] == status).sum())
        if count:
            notes.append(f"{count} of {len(table)} rows {words}.")
    if source.get("glintrack") != VERSION:
        notes.append(f"Written by glintrack {source.get('glintrack')}, shown by {VERSION}.")
    return notes


def _counts(table: pd.DataFrame) -> list[tuple[str, str, int]]:
    count = [("points", "points", table["point"].nunique()), ("cases", "cases", table["case"].nunique())]
    states = [(s, f"rows {s}", int((table["status"] == s).sum())) for s in ("finished", "failed", "missing")]
    return [*count, *states]


def _link(folder: Path, key: str, page_folder: Path) -> str:
    """Relative address of a case's page, or of its folder; empty if it was not simulated."""
    case = folder / "cases" / key
    if not case.is_dir():
        return ""
    target = case / RUN_PAGE if (case / RUN_PAGE).is_file() else case
    return quote(os.path.relpath(target.resolve(), page_folder.resolve()).replace(os.sep, "/"))


def _records(tables: Mapping[str, pd.DataFrame], name: str, columns: Sequence[str]) -> list[dict]:
    """Rows of a table for a chart with intervals."""
    if name not in tables:
        return []
    names = ["channel", "response", *columns, "low", "high"]
    return [{key: _plain(v) for key, v in row.items()} for row in tables[name][names].to_dict("records")]


def _plots(tables: Mapping[str, pd.DataFrame], axes: Sequence[str]) -> list[dict]:
    """FROC curves of a swept threshold, and Pareto fronts over the data rate with numbered designs."""
    out = []
    if "froc" in tables and len(tables["froc"]):
        lines = [
            _line(part.sort_values("false_per_frame"), ("false_per_frame", "completeness"), *names)
            for names, part in tables["froc"].groupby(["group", "channel"], sort=False)
        ]
        drawn = _plot("FROC: completeness against false tracks", "false_per_frame", "completeness", lines)
        out.append(drawn | {"fromZero": True})
    found = tables.get("pareto")
    for gain in ("completeness", "purity"):
        if found is None or found["data_rate_mbit_s"].nunique() < 2:
            continue
        named = found.assign(design=[shorten_design(one, axes) for one in labels(found[list(axes)])])
        named = named.sort_values("data_rate_mbit_s")
        front = list(dict.fromkeys(named.loc[named[f"{gain}_front"], "design"]))
        named["number"] = [str(front.index(one) + 1) if one in front else "" for one in named["design"]]
        lines = [
            _line(part, ("data_rate_mbit_s", gain), "", channel, part[f"{gain}_front"])
            for channel, part in named.groupby("channel", sort=False)
        ]
        title = (
            f"{NAMES[gain]} against data rate; the lines join each Pareto front, the numbers name its designs"
        )
        out.append(_plot(title, "data_rate_mbit_s", gain, lines) | {"numbered": front})
    return out


def _plot(title: str, x: str, y: str, lines: Sequence[dict]) -> dict:
    return {"title": title, "xlabel": NAMES[x], "ylabel": NAMES[y], "lines": list(lines)}


def _line(
    part: pd.DataFrame, axes: tuple[str, str], group: object, channel: object, joined: pd.Series | None = None
) -> dict:
    columns = [*axes, *(name for name in ("design", "number") if name in part)]
    points = part[columns].dropna()
    front = points if joined is None else part[joined][columns].dropna()
    label = f"{CHANNEL_WORDS.get(str(channel), str(channel))} {group}".strip()
    rows = {name: [[_plain(v) for v in row] for row in of.to_numpy()]
            for name, of in (("points", points), ("joined", front))}  # fmt: skip
    return {"label": label, "channel": str(channel), **rows}


def _plain(value: Any) -> Any:
    """Value for JSON; None if it is missing."""
    if isinstance(value, (bool, np.bool_)):
        return str(bool(value)).lower()
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return None if value is None else str(value)


def _cell(value: Any) -> str:
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
