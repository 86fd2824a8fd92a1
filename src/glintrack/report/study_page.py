"""The page of a study: a table that sorts, effects, parallel coordinates, curves, a link to each run."""

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

from glintrack.report.page import flattened, in_code, render_page, script_json
from glintrack.study import analyse, read_results
from glintrack.study.report import view_notes
from glintrack.study.text_tables import (
    BESIDE,
    NAMES,
    RESPONSES,
    TextTable,
    answer,
    contrast_tables,
    headline,
    importance,
    narrow_intervals,
    ranks_table,
    surrogate_table,
)

HEAD = "study.json"
RUN_PAGE = "report.html"
_FIRST = ("point", "replicate", "case", "channel", "status")


def is_study(path: str | Path) -> bool:
    """Whether a folder is a study's."""
    return (Path(path) / HEAD).is_file()


def build_study_page(folder: str | Path, beside: str | Path) -> str:
    """The report of a study as HTML.

    Parameters
    ----------
    folder
        A study's, with results in it.
    beside
        Folder in which the page will lie; links to the runs are relative to it.

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
    matters_columns, matters = _matters(tables)
    values = [[_plain(v) for v in row] for row in table[columns].itertuples(index=False)]
    links = {key: _link(folder, str(key), Path(beside)) for key in table["case"].unique()}
    cells = [
        ([(_shown(v), "" if v is None else v) for v in row], links[row[columns.index("case")]])
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
        matters_columns=matters_columns,
        text_tables=_text_tables(tables),
        has_effects=bool(matters),
        has_points="points" in tables,
        has_parallel=bool(tables) and bool(varied) and bool(responses),
        has_plots=bool(plots),
        counts=_counts(table),
        columns=[NAMES.get(c, c) for c in columns],
        link_column=columns.index("case"),
        rows=cells,
        provenance=flattened(dict(source)),
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
    """What is unfinished or of another version."""
    notes = []
    for status, words in (("missing", "have not been flown yet"), ("failed", "failed")):
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


def _link(folder: Path, key: str, beside: Path) -> str:
    """Relative address of a case's page, or of its folder if it has none; empty where it was not flown."""
    case = folder / "cases" / key
    if not case.is_dir():
        return ""
    target = case / RUN_PAGE if (case / RUN_PAGE).is_file() else case
    return quote(os.path.relpath(target.resolve(), beside.resolve()).replace(os.sep, "/"))


def _matters(tables: Mapping[str, pd.DataFrame]) -> tuple[list[str], list[list[str]]]:
    """Headings and rows of the largest effect of each axis, with what else it changes."""
    found = importance(tables)
    if found.empty:
        return [], []
    beside = [name for name in BESIDE if found[name].notna().any()]
    heads = ["axis", "change", "in", NAMES[headline(tables["effects"])], "95 % interval"]
    rows = [
        [
            *(str(row[name]) for name in ("axis", "level", "channel")),
            f"{row['effect']:+.3g}",
            f"{row['low']:+.3g} … {row['high']:+.3g}{' *' if row['significant'] else ''}"
            if math.isfinite(row["low"])
            else "–",
            *(f"{row[name]:+.3g}" if math.isfinite(row[name]) else "–" for name in beside),
        ]
        for row in found.to_dict("records")
    ]
    return [*heads, *(NAMES[name] for name in beside)], rows


def _text_tables(tables: Mapping[str, pd.DataFrame]) -> list[TextTable]:
    """Contrasts, ranks, how well surrogates predict: those that there are."""
    out = contrast_tables(tables["contrasts"]) if "contrasts" in tables else []
    further = {"ranks": ranks_table, "surrogate_check": surrogate_table}
    return [*out, *(words(tables[name]) for name, words in further.items() if name in tables)]


def _records(tables: Mapping[str, pd.DataFrame], name: str, columns: Sequence[str]) -> list[dict]:
    """Rows of a table that the page draws with intervals."""
    if name not in tables:
        return []
    kept = ["channel", "response", *columns, "low", "high"]
    return [{key: _plain(v) for key, v in row.items()} for row in tables[name][kept].to_dict("records")]


def _plots(tables: Mapping[str, pd.DataFrame]) -> list[dict]:
    """ROC curves where a threshold was swept, and what more data rate buys."""
    out = []
    if "roc" in tables and len(tables["roc"]):
        lines = [
            _line(part.sort_values("false_per_epoch"), "false_per_epoch", "completeness", *names)
            for names, part in tables["roc"].groupby(["group", "channel"], sort=False)
        ]
        drawn = _plot("ROC: completeness against false tracks", "false_per_epoch", "completeness", lines)
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
    """A cell as JSON has it: None for what is missing."""
    if isinstance(value, (bool, np.bool_)):
        return str(bool(value)).lower()
    if isinstance(value, (int, np.integer)):
        return int(value)
    if isinstance(value, (float, np.floating)):
        return float(f"{value:.6g}") if math.isfinite(value) else None
    return None if value is None else str(value)


def _shown(value: Any) -> str:
    return "–" if value is None else f"{value:.4g}" if isinstance(value, float) else str(value)
