"""Read CSV tables and their numbers, write CSV tables, and encode Parquet tables."""

import codecs
import contextlib
import csv
import io
import re
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.units import number_hint, unit_of
from glintrack.io.untrusted import MAX_TEXT_BYTES, check_file, open_unzipped, plain

_MAX_COLUMNS, _MAX_ROW_BYTES = 5000, 10_000_000  # of a table; of its first row that are read
_MAX_CELL = 200  # characters of a cell in a message
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
) -> pd.DataFrame:
    """Read a CSV file with a header row in UTF-8; spaces around names and before cells are removed.

    Parameters
    ----------
    path, name
        File, and its name in error messages.
    separator
        Separator of cells.
    types
        ``str`` for cells as text (empty cells as empty texts); or types by column; None to infer them.
    only
        Returns True for the names of columns to read.
    comments
        Leave out lines that begin with ``#``. If False, the file is read piece by piece, and may be zipped.
    most_bytes
        Maximum size of the file; None for no limit. [byte]

    Raises
    ------
    ValueError
        If the file cannot be read, is too large, has no header, or a row is longer than the header.
    """
    path = check_file(path, name, most_bytes)
    header = b""
    try:
        with open_unzipped(path, name) as file:
            lines = iter(lambda: file.readline(_MAX_ROW_BYTES), b"")
            header = next((line for line in lines if line[:1] != b"#"), b"")
        if (columns := header.count(separator.encode()) + 1) > _MAX_COLUMNS:
            raise ValueError(f"more than {_MAX_COLUMNS} columns ({columns})")
        with contextlib.ExitStack() as stack:
            source: Any = stack.enter_context(open_unzipped(path, name))
            if comments:
                source = io.BytesIO(_COMMENT.sub(b"", path.read_bytes().removeprefix(codecs.BOM_UTF8)))
            stack.enter_context(warnings.catch_warnings())
            warnings.simplefilter("error", pd.errors.ParserWarning)
            table = pd.read_csv(
                source,
                sep=separator,
                dtype=types,
                usecols=only,
                keep_default_na=types is not str,
                index_col=False,
                skipinitialspace=True,
                encoding="utf-8-sig",
            )
    except pd.errors.EmptyDataError as error:
        raise ValueError(f"`{name}` must have a header row; got the empty file {path}.") from error
    except (OSError, EOFError) as error:
        raise ValueError(
            f"`{name}` must be a readable CSV file; got {path}: {getattr(error, 'strerror', None) or error}."
        ) from error
    except (ValueError, TypeError, OverflowError, csv.Error, pd.errors.ParserWarning) as error:
        reason = plain(str(error).strip().splitlines()[-1], 200).rstrip(".")
        if separator == "," and b";" in header:
            reason = "its columns are separated by semicolons. Use commas, and points in numbers"
        elif "saw" in reason or "not match length of data" in reason:
            reason += ". A row has more cells than the header. Write numbers with points, not commas"
        raise ValueError(f"`{name}` must be a CSV file in UTF-8; got {path}: {reason}.") from error
    table.columns = [str(column).strip() for column in table.columns]
    return table.fillna("") if types is str else table


def read_numbers(
    table: pd.DataFrame, path: Path, columns: Sequence[str], *, finite: bool = True
) -> Float[Array, "row column"]:
    """Return columns of a table as numbers, NaN where empty, which is refused if they must be finite.

    Raises
    ------
    ValueError
        With the column, row and content of a cell that is none.
    """
    out = np.empty((len(table), len(columns)))
    for k, column in enumerate(columns):
        try:
            out[:, k] = np.asarray(pd.to_numeric(table[column], errors="coerce"), dtype=float)
        except (OverflowError, TypeError) as error:
            raise ValueError(f"`{column}` must hold numbers that fit; got {error} in {path}.") from error
        words = np.flatnonzero(np.isnan(out[:, k]) & table[column].notna().to_numpy())
        if words.size:
            cell = table[column].iloc[row := int(words[0])]
            raise ValueError(
                f"`{column}` must hold numbers; got {plain(repr(cell), _MAX_CELL)} in row {row + 2} of "
                f"{path}.{number_hint(cell)}"
            )
    if finite and not np.isfinite(out).all():
        row, k = np.argwhere(~np.isfinite(out))[0]
        raise ValueError(
            f"`{columns[k]}` must be finite; got {out[row, k]:g} in row {row + 2} of {path}. "
            "Leave the row out."
        )
    return out


def write_table(path: Path, rows: xr.Dataset, columns: Sequence[str]) -> None:
    """Write some variables of a dataset with dim ``row`` as CSV, if it has them; booleans as 0 or 1."""
    if rows.sizes.get("row"):
        table = pd.DataFrame({name: rows[name].values for name in columns if name in rows})
        table = table.astype({str(column): int for column in table.select_dtypes(bool)})
    else:
        table = pd.DataFrame(columns=list(columns))
    table.to_csv(path, index=False, float_format="%.6g", na_rep="nan", lineterminator="\r\n")


def parquet_bytes(table: pd.DataFrame, metadata: Mapping[str, str]) -> bytes:
    """Encode a table as Parquet; the fields have the units of their names, the file further metadata."""
    arrow = pa.Table.from_pandas(table, preserve_index=False)
    fields = [field.with_metadata({"units": unit_of(field.name) or "1"}) for field in arrow.schema]
    schema = pa.schema(fields, {**(arrow.schema.metadata or {}), **metadata})
    sink = pa.BufferOutputStream()
    pyarrow.parquet.write_table(arrow.cast(schema), sink)
    return sink.getvalue().to_pybytes()
