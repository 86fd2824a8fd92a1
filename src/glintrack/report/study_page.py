"""Page of a study: sortable table of runs with links, effects, parallel coordinates and curves."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false

import math
import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any
from urllib.parse import quote

import numpy as np
import pandas as pd

from glintrack.report.page import flatten, in_code, render_page, script_json
from glintrack.study import analyse, read_results
from glintrack.study.report import view_notes
from glintrack.study.text_tables import (
    NAMES,
    RESPONSES,
    answer,
    comparison_tables,
    importance_table,
    narrow_intervals,
)

HEAD = "study.json"
RUN_PAGE = "report.html"
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
    plots = _plots(tables)
    varied = [axis for axis in axes if table[axis].nunique() > 1]
    matters = importance_table(tables)
    values = [[_plain(v) for v in row] for row in table[columns].itertuples(index=False)]
    links = {key: _link(folder, str(key), Path(page_folder)) for key in table["case"].unique()}
    cells = [
        ([(_cell(v), "" if v is None else v) for v in row], links[row[columns.index("case")]])
        for row in values
    ]
    return render_page(
        "study.html.j2",
        scripts=("theme.js", "plots.js", "study.js"),
        title=str(source["design"].get("name") or folder.resolve().name),
        notes=_notes(table, source),
        answer=in_code(answer(tables)) if tables else "",
        narrow=in_code(narrow_intervals(table, source)) if matters else "",
        reservations=[in_code(note) for note in view_notes(tables["views"])] if "views" in tables else [],
        matters=matters,
        text_tables=comparison_tables(tables),
        has_points="points" in tables,
        has_parallel=bool(tables) and bool(varied) and bool(responses),
        has_plots=bool(plots),
        counts=_counts(table),
        columns=[NAMES.get(c, c) for c in columns],
        link_column=columns.index("case"),
        rows=cells,
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
            }
        ),
    )


def _notes(table: pd.DataFrame, source: Mapping[str, Any]) -> list[str]:
    """Sentences about unfinished rows and another version."""
    notes = []
    for status, words in (("missing", "have not been simulated yet"), ("failed", "failed")):
        count = int((table["status"] == status).sum())
        if count:
            notes.append(f"{count} of {len(table)} rows {words}.")
    if source.get("glintrack") != version("glintrack"):
        notes.append(f"Written by glintrack {source.get('glintrack')}, shown by {version('glintrack')}.")
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


def _plots(tables: Mapping[str, pd.DataFrame]) -> list[dict]:
    """FROC curves of a swept threshold, and Pareto fronts over the data rate."""
    out = []
    if "froc" in tables and len(tables["froc"]):
        lines = [
            _line(part.sort_values("false_per_frame"), "false_per_frame", "completeness", *names)
            for names, part in tables["froc"].groupby(["group", "channel"], sort=False)
        ]
        drawn = _plot("FROC: completeness against false tracks", "false_per_frame", "completeness", lines)
        out.append(drawn | {"fromZero": True})
    found = tables.get("pareto")
    for gain in ("completeness", "purity"):
        if found is None or found["data_rate_mbit_s"].nunique() < 2:
            continue
        lines = []
        for channel, part in found.groupby("channel", sort=False):
            part = part.sort_values("data_rate_mbit_s")
            lines.append(_line(part, "data_rate_mbit_s", gain, "", channel, part[f"{gain}_front"]))
        out.append(_plot(f"{NAMES[gain]} against data rate, front joined", "data_rate_mbit_s", gain, lines))
    return out


def _plot(title: str, x: str, y: str, lines: Sequence[dict]) -> dict:
    return {"title": title, "xlabel": NAMES[x], "ylabel": NAMES[y], "lines": list(lines)}


def _line(
    part: pd.DataFrame, x: str, y: str, group: object, channel: object, joined: pd.Series | None = None
) -> dict:
    points = part[[x, y]].dropna()
    front = points if joined is None else part[joined][[x, y]].dropna()
    label = f"{channel} {group}".strip()
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
