"""Folder of a study: finished cases, tracebacks of failed ones, and all results as one table."""

import io
import json
import math
import os
import shutil
from collections.abc import Iterable, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import xarray as xr

from glintrack.case.design import Case
from glintrack.case.identity import DECIDE_SCORES, source_key
from glintrack.case.quantities import ground_view
from glintrack.core.installation import VERSION
from glintrack.io import atomic, netcdf
from glintrack.io.atomic import content_hash
from glintrack.io.toml import to_toml
from glintrack.io.untrusted import check_file, read_json
from glintrack.study.comparisons import design_contrasts
from glintrack.study.design import flat
from glintrack.study.plan import FORMAT, Plan

try:
    import fcntl
except ImportError:  # not on Windows, where the folder is not locked
    fcntl = None  # type: ignore[assignment]
_HEAD = "study.json"
_SCORES = "scores.json"
FIRST_COLUMNS = ("point", "replicate", "case", "channel", "status")
RESULTS = "results.parquet"
VIEW = ("gsd_across_m", "gsd_along_m", "window_km2")
_MAX_BYTES = 2_000_000_000
_UNITS = {
    "_mbit_s": "Mbit s-1",
    "_per_km2": "km-2",
    "_km2": "km2",
    "_s": "s",
    "_m": "m",
    "_db": "dB",
    "_deg": "degree",
}


class StudyFolder:
    """Results of a study on disk.

    Parameters
    ----------
    path
        New folder, or that of the same study, which is then resumed.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._whole: dict[str, dict[str, Any]] = {}  # outcomes of cases with correct hashes

    @contextmanager
    def open(self, plan: Plan):
        """Lock the folder for one driver, and remove incomplete files of an earlier one.

        Raises
        ------
        ValueError
            If it is of another study or version, contains other files, is in use, or cannot be written.
        """
        self.check(plan)
        try:
            (self.path / "cases").mkdir(parents=True, exist_ok=True)
            lock = (self.path / ".lock").open("w")
        except OSError as error:
            raise ValueError(f"`output` must be writable; got {self.path}: {error.strerror}.") from error
        with lock:
            if fcntl is not None:
                try:
                    fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)  # freed by the system when a driver dies
                except OSError as error:
                    raise ValueError(
                        f"`output` must not be in use; got {self.path}, where another run writes."
                    ) from error
            for left in (self.path / "cases").glob(".*.partial"):
                shutil.rmtree(left, ignore_errors=True)
            if not (self.path / _HEAD).exists():
                head = {
                    "format": FORMAT,
                    "study": plan.key,
                    "name": plan.design.name,
                    "glintrack": VERSION,
                    "source": source_key(),
                    "points": len(plan.points),
                    "cases": len(plan.cases),
                }
                atomic.write_text(self.path / _HEAD, json.dumps(head, indent=1) + "\n")
            yield self

    def check(self, plan: Plan) -> None:
        """Check that the folder is new or of this study.

        Raises
        ------
        ValueError
            If it is of another study or version, or contains other files.
        """
        if not self.path.exists():
            return
        if not self.path.is_dir():
            raise ValueError(f"`output` must be a folder; got the file {self.path}.")
        if not {p.name for p in self.path.iterdir()} - {".lock", "cases"}:
            return
        head = self.head()
        if head["glintrack"] != VERSION:
            raise ValueError(
                f"`output` must be of glintrack {VERSION}; got {self.path} of glintrack "
                f"{head['glintrack']}. Choose another -o."
            )
        if head.get("source") != source_key():
            raise ValueError(
                f"`output` must have results of the current source code; got {self.path} of other source of "
                f"glintrack {head['glintrack']} or other versions of {', '.join(DECIDE_SCORES)}. Choose "
                "another -o, or go back. `glintrack study report` reads the folder as it is."
            )
        if head["study"] != plan.key:
            raise ValueError(
                f"`output` must be new or of the same study; got {self.path} of another study, "
                f"{head['name']!r}. Choose another -o."
            )

    def head(self) -> dict[str, Any]:
        """Study and version of the folder.

        Raises
        ------
        ValueError
            If it is not the folder of a study, or of a newer format.
        """
        try:
            head = read_json(self.path / _HEAD, _HEAD)
            needed = {"format": int, "study": str, "name": str, "glintrack": str}
            if not all(isinstance(head[key], kind) for key, kind in needed.items()):
                raise TypeError
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise ValueError(
                f"`result` must be the folder of a study; got {self.path}. For a new study choose another -o."
            ) from error
        if head["format"] > FORMAT:
            raise ValueError(
                f"`result` must be of format {FORMAT} or older; got {self.path} of format {head['format']}. "
                f"Update to glintrack {head['glintrack']}."
            )
        return head

    def outcome(self, case_key: str) -> dict[str, Any] | None:
        """Outcome of a finished case; None if it must be simulated. An incomplete folder is removed."""
        folder = self.path / "cases" / case_key
        if not folder.exists():
            return None
        if case_key in self._whole:
            return self._whole[case_key]
        try:
            outcome = _exchange(read_json(folder / _SCORES, _SCORES), None, math.nan)
            if all(
                Path(name).name == name and content_hash((folder / name).read_bytes()) == digest
                for name, digest in outcome["sha256"].items()
            ):
                self._whole[case_key] = outcome
                return outcome
        except (OSError, ValueError, KeyError, TypeError, AttributeError):
            pass
        shutil.rmtree(folder, ignore_errors=True)
        return None

    def cost(self, case_keys: Iterable[str]) -> dict[str, float]:
        """Finished ``flights``, their ``frames``, and their processor time ``cpu_s``. [1, s]"""
        done = [outcome for key in case_keys if (outcome := self.outcome(key)) is not None]
        frames = sum(max(of.get("frames", 0) for of in outcome["scores"].values()) for outcome in done)
        cpu_s = sum(outcome["cpu_seconds"] for outcome in done)
        return {"flights": len(done), "frames": int(frames), "cpu_s": cpu_s}

    def publish(self, case_key: str, outcome: Mapping[str, Any]) -> None:
        """Write the folder of a finished case in one step, and flush it to the disk."""
        target = self.path / "cases" / case_key
        partial = target.with_name(f".{case_key}.partial")
        files = outcome["files"]
        plain = {name: value for name, value in outcome.items() if name != "files"}
        plain["sha256"] = {name: content_hash(data) for name, data in files.items()}
        shutil.rmtree(partial, ignore_errors=True)
        try:
            partial.mkdir(parents=True)
            for name, data in {**files, _SCORES: _json(plain, indent=1).encode()}.items():
                with (partial / name).open("wb") as file:
                    file.write(data)
                    file.flush()
                    os.fsync(file.fileno())
            partial.rename(target)
        except BaseException:
            shutil.rmtree(partial, ignore_errors=True)
            raise

    def record_failure(self, case_key: str, case: Case, error: str, number: int) -> None:
        """Write the traceback of a case's failed attempt, with the case."""
        folder = self.path / "failed" / case_key
        folder.mkdir(parents=True, exist_ok=True)
        atomic.write_text(folder / "case.toml", to_toml(case))
        atomic.write_text(folder / f"attempt-{number}.txt", error)

    def remove_failure(self, case_key: str) -> None:
        """Remove tracebacks of a case that is tried again."""
        shutil.rmtree(self.path / "failed" / case_key, ignore_errors=True)

    def failure(self, case_key: str) -> str | None:
        """Last line of the last traceback of a case; None without one."""
        attempts = (self.path / "failed" / case_key).glob("attempt-*.txt")
        found = sorted(attempts, key=lambda path: int(path.stem.removeprefix("attempt-")))
        return found[-1].read_text(encoding="utf-8").strip().splitlines()[-1] if found else None


def _json(values: Any, **options: Any) -> str:
    """JSON with null for numbers that are not finite."""
    return json.dumps(_exchange(values, math.nan, None), allow_nan=False, **options)


def _exchange(values: Any, old: float | None, new: float | None) -> Any:
    """Values of nested tables and lists with None for numbers that are not finite, or the other way."""
    if isinstance(values, dict):
        return {key: _exchange(value, old, new) for key, value in values.items()}
    if isinstance(values, list | tuple):
        return [_exchange(value, old, new) for value in values]
    is_old = values is None if old is None else isinstance(values, float) and not math.isfinite(values)
    return new if is_old else values


def collect_table(plan: Plan, folder: StudyFolder) -> pd.DataFrame:
    """Levels and scores of every point and channel, in the design's order.

    Returns
    -------
    ``point``, ``replicate``, ``case``, ``channel``, ``status`` (finished, failed or missing), a column for
    each axis, the view of the ground (`VIEW`), the scores, and ``over_time``: JSON of the scores by frame.
    """
    outcomes, rows = {key: folder.outcome(key) for key in plan.cases}, []
    for point in plan.points:
        found = outcomes[point.case_key]
        case = plan.cases[point.case_key]
        status = "finished" if found else "failed" if folder.failure(point.case_key) else "missing"
        for channel in case.channels:
            first = (point.index, point.replicate, point.case_key, channel, status)
            row: dict[str, Any] = {**dict(zip(FIRST_COLUMNS, first, strict=True)), **point.levels}
            (across_m, along_m), (width_m, depth_m) = ground_view(case)
            row |= dict(zip(VIEW, (across_m, along_m, 1e-6 * width_m * depth_m), strict=True))
            scores = dict(found["scores"].get(channel, {})) if found else {}
            row["over_time"] = _json(scores.pop("over_time", {}), sort_keys=True)
            rows.append(row | scores)
    table = pd.DataFrame(rows)
    axes = list(dict.fromkeys(name for point in plan.points for name in point.levels))
    others = sorted(set(table) - set(FIRST_COLUMNS) - set(axes) - {"over_time"})
    return table[[*FIRST_COLUMNS, *axes, *others, "over_time"]]


def provenance(plan: Plan) -> dict[str, Any]:
    """Provenance of the results, the same on every host."""
    design = plan.design.model_dump(mode="json", exclude_none=True)
    axes = list(dict.fromkeys(name for point in plan.points for name in point.levels))
    of = {"study": plan.key, "glintrack": VERSION, "source": source_key()}
    return {**of, "axes": axes, "design": design}


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
    """Read the table of a study's folder and its provenance.

    Raises
    ------
    ValueError
        If it is not a study's folder, of a newer format, or without results.
    """
    folder = StudyFolder(path)
    folder.head()
    try:
        arrow = pyarrow.parquet.read_table(check_file(folder.path / RESULTS, RESULTS, _MAX_BYTES))
        arrow.validate(full=True)
        source = json.loads((arrow.schema.metadata or {})[b"glintrack"])
        table = arrow.to_pandas()
    except (OSError, KeyError, ValueError, RecursionError, pa.ArrowException) as error:
        raise ValueError(
            f"`result` must hold {RESULTS}; got {folder.path} without a readable one. Run the study first."
        ) from error
    if fault := _find_fault(table, source):
        raise ValueError(f"`{RESULTS}` must be a study's table; got {fault} in {folder.path}.")
    return table, source


def select_finished_replicates(table: pd.DataFrame) -> pd.DataFrame:
    """Rows of the replicates with a finished case, numbered without gaps; all rows if none is finished."""
    done = sorted(set(table.loc[table["status"] == "finished", "replicate"]))
    planned = table["replicate"].nunique()
    if not done or len(done) == planned:
        return table
    mine = table[table["replicate"].isin(done)]
    place = mine["replicate"].map({replicate: k for k, replicate in enumerate(done)})
    return mine.assign(point=mine["point"] // planned * len(done) + place, replicate=place)


def _find_fault(table: pd.DataFrame, source: Any) -> str:
    """First fault of a study's table or its provenance; empty if there is none."""
    columns = [str(column) for column in table.columns]
    source = source if isinstance(source, dict) else {}
    axes, design = source.get("axes"), source.get("design")
    missing = [name for name in (*FIRST_COLUMNS, "over_time") if name not in columns]
    if missing or len(set(columns)) < len(columns):
        return f"no column {missing[0]}" if missing else "a column twice"
    if not (isinstance(axes, list) and all(isinstance(axis, str) and axis in columns for axis in axes)):
        return "no list of axes"
    if not (isinstance(design, dict) and isinstance(design.get("design"), str)):
        return "no design"
    try:
        flat(design.get("axes", {}))
        design_contrasts(design, axes)
        if not all(one in axes for one in design.get("ranked_under", [])):
            return "ranks of no axis"
    except (AttributeError, TypeError, ValueError, RecursionError):
        return "contrasts or ranks of no axis"
    for name in ("point", "replicate"):
        if not pd.api.types.is_integer_dtype(table[name]) or (table[name] < 0).any():
            return f"a {name} that is no number from 0"
    for name in ("case", "channel", "status", "over_time"):
        if not all(isinstance(value, str) for value in table[name]):
            return f"a {name} that is no text"
    for name in table.columns.difference([*FIRST_COLUMNS, "over_time", *axes]):
        if not pd.api.types.is_numeric_dtype(table[name]):
            return f"words in column {name}"
    try:
        lists = [one for text in table["over_time"] for one in json.loads(text).values()]
        series = [np.array(one, dtype=float) for one in lists]
        return "" if all(one.ndim == 1 for one in series) else "scores over time that are no lists"
    except (ValueError, TypeError, AttributeError, RecursionError, OverflowError):
        return "scores over time that are no numbers"


def to_dataset(table: pd.DataFrame, source: Mapping[str, Any]) -> xr.Dataset:
    """Scores over point and channel, with the levels as coordinates of the point."""
    axes = list(source["axes"])
    scores = [c for c in table if c not in {*FIRST_COLUMNS, *axes, "over_time"}]
    out = table.set_index(["point", "channel"])[scores].astype(float).to_xarray()
    for name in scores:
        units = (
            unit for ending, unit in _UNITS.items() if str(name).removesuffix("_at_once").endswith(ending)
        )
        out[name].attrs["units"] = next(units, "1")
    first = table.drop_duplicates("point").set_index("point").loc[out["point"].values]
    for name in ("replicate", "case", *axes):
        column = first[name].to_numpy()
        out.coords[name] = ("point", column if column.dtype.kind in "ifb" else column.astype(str))
    return out.assign_attrs(provenance=json.dumps(source, sort_keys=True))
