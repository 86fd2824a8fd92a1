"""Results of a study as one table, a row for each point and channel, whatever flew them in what order."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import io
import json
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import xarray as xr

from glintrack.case.check import ground_view
from glintrack.case.design import Case
from glintrack.io import atomic, netcdf
from glintrack.io.untrusted import check_file
from glintrack.study.contrasts import asked_contrasts
from glintrack.study.design import flat
from glintrack.study.folder import StudyFolder
from glintrack.study.plan import Plan
from glintrack.study.source import source_key

FIRST_COLUMNS = ("point", "replicate", "case", "channel", "status")
RESULTS = "results.parquet"
_MOST_BYTES = 2_000_000_000
VIEW = ("gsd_across_m", "gsd_along_m", "window_km2")


def collect_table(plan: Plan, folder: StudyFolder) -> pd.DataFrame:
    """Levels and scores of every point and channel, in the design's order.

    Returns
    -------
    ``point``, ``replicate``, ``case``, ``channel``, ``status`` (finished, failed or missing), a column an
    axis, what the case sees of the ground (`VIEW`), the scores, and ``over_time``: JSON of the scores frame
    by frame.
    """
    told = {key: folder.finished(key) for key in plan.cases}
    rows = []
    for point in plan.points:
        found = told[point.case_key]
        case = plan.cases[point.case_key]
        status = "finished" if found else "failed" if folder.failure(point.case_key) else "missing"
        for channel in case.channels:
            row: dict[str, Any] = {
                "point": point.index,
                "replicate": point.replicate,
                "case": point.case_key,
                "channel": channel,
                "status": status,
                **point.levels,
            }
            row |= _view(case)
            scores = dict(found["scores"].get(channel, {})) if found else {}
            row["over_time"] = json.dumps(scores.pop("over_time", {}), sort_keys=True)
            rows.append(row | scores)
    table = pd.DataFrame(rows)
    axes = list(dict.fromkeys(name for point in plan.points for name in point.levels))
    others = sorted(set(table) - set(FIRST_COLUMNS) - set(axes) - {"over_time"})
    return table[[*FIRST_COLUMNS, *axes, *others, "over_time"]]


def _view(case: Case) -> dict[str, float]:
    """What a case sees of the ground: a design that sees less of a fixed city holds fewer of its vehicles."""
    (across_m, along_m), (width_m, depth_m) = ground_view(case)
    return {"gsd_across_m": across_m, "gsd_along_m": along_m, "window_km2": 1e-6 * width_m * depth_m}


def provenance(plan: Plan) -> dict[str, Any]:
    """What the results come from, the same on every host."""
    design = plan.design.model_dump(mode="json", exclude_none=True)
    axes = list(dict.fromkeys(name for point in plan.points for name in point.levels))
    return {
        "study": plan.key,
        "glintrack": version("glintrack"),
        "source": source_key(),
        "axes": axes,
        "design": design,
    }


def write_results(plan: Plan, folder: StudyFolder) -> pd.DataFrame:
    """Write ``results.parquet``, ``results.nc`` and ``provenance.json`` into the folder.

    Returns
    -------
    The table.
    """
    table, source = collect_table(plan, folder), provenance(plan)
    text = json.dumps(source, indent=1, sort_keys=True)
    arrow = pa.Table.from_pandas(table, preserve_index=False).replace_schema_metadata({"glintrack": text})
    made = io.BytesIO()
    pyarrow.parquet.write_table(arrow, made)
    atomic.write_bytes(folder.path / RESULTS, made.getvalue())
    netcdf.write_dataset(folder.path / "results.nc", to_dataset(table, source))
    atomic.write_text(folder.path / "provenance.json", text + "\n")
    return table


def read_results(path: str | Path) -> tuple[pd.DataFrame, dict[str, Any]]:
    """The table of a study's folder and where it comes from.

    Raises
    ------
    ValueError
        If it is no study's folder, of a newer format, or holds no results yet.
    """
    folder = StudyFolder(path)
    folder.head()
    try:
        arrow = pyarrow.parquet.read_table(check_file(folder.path / RESULTS, RESULTS, _MOST_BYTES))
        arrow.validate(full=True)  # text that is none would be found by whoever looks at it
        source = json.loads((arrow.schema.metadata or {})[b"glintrack"])
        table = arrow.to_pandas()
    except (OSError, KeyError, ValueError, RecursionError, pa.ArrowException) as error:
        raise ValueError(
            f"`result` must hold {RESULTS}, got {folder.path} without a readable one (run the study first)"
        ) from error
    fault = _fault_of(table, source)
    if fault:
        raise ValueError(f"`{RESULTS}` must be a study's table, got {fault} in {folder.path}")
    return table, source


def flown(table: pd.DataFrame) -> pd.DataFrame:
    """The replicates of which a case is finished, as if there were no others; all of them if none is."""
    there = sorted(set(table.loc[table["status"] == "finished", "replicate"]))
    asked = table["replicate"].nunique()
    if not there or len(there) == asked:
        return table
    mine = table[table["replicate"].isin(there)]
    place = mine["replicate"].map({replicate: k for k, replicate in enumerate(there)})
    return mine.assign(point=mine["point"] // asked * len(there) + place, replicate=place)


def _fault_of(table: pd.DataFrame, source: Any) -> str:
    """What a table lacks to be a study's; empty if nothing."""
    columns = [str(column) for column in table.columns]
    missing = [name for name in (*FIRST_COLUMNS, "over_time") if name not in columns]
    if missing or len(set(columns)) < len(columns):
        return f"no column {missing[0]}" if missing else "a column twice"
    axes = source.get("axes") if isinstance(source, dict) else None
    if not (isinstance(axes, list) and all(isinstance(axis, str) and axis in columns for axis in axes)):
        return "no list of axes"
    if not (isinstance(source.get("design"), dict) and isinstance(source["design"].get("design"), str)):
        return "no design"
    fault = _fault_of_asked(source["design"], axes)
    if fault:
        return fault
    for name in ("point", "replicate"):
        if not pd.api.types.is_integer_dtype(table[name]) or (table[name] < 0).any():
            return f"a {name} that is no number from 0"
    for name in ("case", "channel", "status", "over_time"):
        if not all(isinstance(value, str) for value in table[name]):
            return f"a {name} that is no text"
    scores = table.drop(columns=[*FIRST_COLUMNS, "over_time", *axes])
    words = [str(name) for name in scores if not pd.api.types.is_numeric_dtype(scores[name])]
    if words:
        return f"words in column {words[0]}"
    return "" if all(map(_is_series, table["over_time"])) else "scores over time that are no numbers"


def _fault_of_asked(design: Mapping[str, Any], axes: list[str]) -> str:
    """What is wrong with the contrasts and ranks that a design asks for; empty if nothing."""
    contrasts, under = design.get("contrasts", []), design.get("ranked_under", [])
    if not (isinstance(contrasts, list) and isinstance(under, list) and all(one in axes for one in under)):
        return "contrasts or ranks of no axis"
    if not isinstance(design.get("axes", {}), dict):
        return "axes that are no table"
    try:
        flat(design.get("axes", {}))
        asked_contrasts(design, axes)
    except (ValueError, RecursionError):
        return "contrasts of no axis"
    return ""


def _is_series(text: str) -> bool:
    """Whether a text is JSON of lists of numbers by score."""
    try:
        told = json.loads(text)
        return all(np.isfinite(np.array(one, dtype=float)).ndim == 1 for one in told.values())
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError):
        return False


def to_dataset(table: pd.DataFrame, source: Mapping[str, Any]) -> xr.Dataset:
    """Scores over point and channel, with the levels as coordinates of the point."""
    axes = list(source["axes"])
    points, channels = np.unique(table["point"]), sorted(set(table["channel"]))
    keyed = table.set_index(["point", "channel"])
    first = table.drop_duplicates("point").set_index("point").loc[points]
    scores = [c for c in table if c not in {*FIRST_COLUMNS, *axes, "over_time"}]
    index = pd.MultiIndex.from_product([points, channels])
    values = {
        name: (
            ("point", "channel"),
            keyed[name].reindex(index).to_numpy(dtype=float).reshape(len(points), len(channels)),
            {"units": _unit(name)},
        )
        for name in scores
    }
    coords: dict[str, Any] = {"point": points, "channel": channels}
    for name in ("replicate", "case", *axes):
        column = first[name].to_numpy()
        coords[name] = ("point", column if column.dtype.kind in "ifb" else column.astype(str))
    return xr.Dataset(values, coords, {"provenance": json.dumps(source, sort_keys=True)})


def _unit(name: str) -> str:
    for ending, unit in (
        ("_mbit_s", "Mbit s-1"),
        ("_per_km2", "km-2"),
        ("_km2", "km2"),
        ("_m", "m"),
        ("_db", "dB"),
        ("_deg", "degree"),
    ):
        if name.endswith(ending):
            return unit
    return "1"
