"""Tables: CSV in and out, Parquet out."""

import codecs
import csv
import io
import re
import warnings
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from glintrack.io.atomic import write_bytes
from glintrack.io.untrusted import MAX_TEXT_BYTES, check_file, plain

if TYPE_CHECKING:  # a process that solves a wire grid reads no table and loads none of it
    import pandas as pd
    import xarray as xr

_MOST_COLUMNS, _WIDEST = 5000, 10_000_000  # of a table; bytes of its first row that are looked at
_COMMENT = re.compile(rb"^[ \t]*#[^\n]*\n?", re.MULTILINE)


def read_csv(
    path: str | Path,
    name: str,
    *,
    separator: str = ",",
    types: Any = None,
    only: Callable[[Any], bool] | None = None,
    comments: bool = True,
    most_bytes: int | None = MAX_TEXT_BYTES,
) -> "pd.DataFrame":
    """A CSV file with a header row, in UTF-8; spaces around names and before cells are left out.

    Parameters
    ----------
    path, name
        The file, and what it is in the error.
    separator
        Between cells.
    types
        ``str`` for cells as text, an empty one as an empty text; or types by column; else what they look
        like.
    only
        Says of a column's name whether it is read.
    comments
        Leave out lines that begin with ``#``. Where not, the file is read piece by piece.
    most_bytes
        Larger files are refused; None for no limit.

    Raises
    ------
    ValueError
        If the file cannot be read, is too large, has no header, or a row is longer than the header.
    """
    import pandas as pd

    path = check_file(path, name, most_bytes)
    _check_width(path, name, separator)
    options: dict[str, Any] = {"dtype": types, "usecols": only, "keep_default_na": types is not str}
    try:
        source = (
            io.BytesIO(_COMMENT.sub(b"", path.read_bytes().removeprefix(codecs.BOM_UTF8)))
            if comments
            else path
        )
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            options |= {"index_col": False, "skipinitialspace": True, "encoding": "utf-8-sig"}
            table = pd.read_csv(source, sep=separator, **options)
    except pd.errors.EmptyDataError as error:
        raise ValueError(f"`{name}` must have a header row, got the empty file {path}") from error
    except OSError as error:
        raise ValueError(f"`{name}` must be a readable CSV file, got {path} ({error.strerror})") from error
    except (ValueError, TypeError, OverflowError, csv.Error, pd.errors.ParserWarning) as error:
        reason = plain(str(error).strip().splitlines()[-1], 200)
        if separator == "," and b";" in _first_line(path):
            reason = "its columns are separated by semicolons (use commas, and points in numbers)"
        raise ValueError(f"`{name}` must be a CSV file in UTF-8, got {path}: {reason}") from error
    table.columns = [str(column).strip() for column in table.columns]
    return table.fillna("") if types is str else table


def _check_width(path: Path, name: str, separator: str) -> None:
    """Refuse a table of more columns than any has; each costs pandas a tenth of a millisecond."""
    columns = _first_line(path).count(separator.encode()) + 1
    if columns > _MOST_COLUMNS:
        raise ValueError(f"`{name}` must have at most {_MOST_COLUMNS} columns, got {columns} in {path}")


def _first_line(path: Path) -> bytes:
    """Of a table, without comments; empty where it cannot be read, which is told by who reads it."""
    try:
        with path.open("rb") as file:
            lines = iter(lambda: file.readline(_WIDEST), b"")
            return next((line for line in lines if line[:1] != b"#"), b"")
    except OSError:
        return b""


def write_table(path: Path, rows: "xr.Dataset", columns: Mapping[str, str]) -> None:
    """A dataset with dim ``row`` as CSV: column -> variable, those it has, in order."""
    if rows.sizes.get("row"):
        columns = {column: name for column, name in columns.items() if name in rows}
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(columns)
        if rows.sizes.get("row"):
            values = [rows[name].values for name in columns.values()]
            writer.writerows(zip(*([_cell(v) for v in column] for column in values), strict=True))


def _cell(value) -> str:
    if isinstance(value, str):
        return value
    return str(int(value)) if isinstance(value, (int, np.integer)) else f"{float(value):.6g}"


def write_parquet(path: Path, rows: "xr.Dataset", columns: Mapping[str, str]) -> None:
    """A dataset with dim ``row`` as Parquet: column -> variable, those it has; fields carry units."""
    import pyarrow as pa
    import pyarrow.parquet

    columns = {column: name for column, name in columns.items() if name in rows}
    names = list(columns.values())
    units = [{"units": str(rows[name].attrs.get("units", "1"))} for name in names]
    types = [pa.from_numpy_dtype(rows[name].dtype) for name in names]
    fields = [pa.field(*field) for field in zip(columns, types, [True] * len(names), units, strict=True)]
    arrays = [pa.array(rows[name].values) for name in names]
    sink = pa.BufferOutputStream()
    pyarrow.parquet.write_table(pa.Table.from_arrays(arrays, schema=pa.schema(fields)), sink)
    write_bytes(path, sink.getvalue().to_pybytes())
