"""Rows of floating-car data in the forms that SUMO writes: XML, CSV and Parquet, also zipped.

The forms of one simulation give the same rows. CSV and Parquet name all columns after the first object, a
person perhaps, and have a row without a vehicle for a time step without one. Times may be ``H:M:S``.
"""

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from xml.etree.ElementTree import ParseError

import defusedxml.ElementTree
import numpy as np
import pandas as pd
import pyarrow.parquet
from defusedxml import DefusedXmlException
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.io.tables import read_csv
from glintrack.io.untrusted import check_file, open_unzipped

_TIME, _ID, _KIND = "timestep_time", "vehicle_id", "vehicle_type"
_NUMBERS = ("vehicle_x", "vehicle_y", "vehicle_angle")
_PLACE = ("vehicle_lane", "vehicle_edge")  # a person has an edge, a vehicle a lane
_COLUMNS = (_TIME, _ID, _KIND, *_NUMBERS, *_PLACE)
_OTHERS = ("person", "container")
_MAX_ROWS, _ALWAYS_ALLOWED_ROWS = 50_000_000, 100_000  # no format needs less than a byte a row
_MAX_LINE_BYTES = 100_000


@dataclass(frozen=True)
class FcdRows:
    """Times of all time steps [s], and a table of vehicles at times in the order of the file.

    The table has ``timestep_time`` [s], ``vehicle_id``, ``vehicle_type`` (``person`` for persons and
    containers, empty if unknown), ``vehicle_x``, ``vehicle_y``, and ``vehicle_angle`` [deg] if given.
    """

    clock_s: Float[Array, "time"]
    table: pd.DataFrame


def read_fcd_rows(path: Path) -> FcdRows:
    """Read the rows of a file; a ValueError tells what is damaged, missing or hostile."""
    raw = _reader(path)(path)
    source_of: dict[str, str] = {}
    for name in raw.columns:
        own = _column(name)
        if own in _COLUMNS and (own == name or own not in raw.columns):
            source_of.setdefault(own, name)
    missing = [c for c in (_TIME, _ID, *_NUMBERS[:2]) if c not in source_of]
    if missing:
        raise ValueError(
            f"`{path.name}` must be SUMO's floating-car data with the columns {', '.join(_COLUMNS[:6])} "
            f"(type and angle may be left out); got no {', '.join(missing)}."
        )
    if source_of[_ID].startswith(_OTHERS) and not {_KIND, *_PLACE} & set(source_of):
        raise ValueError(
            f"`{path.name}` must tell persons from vehicles; got persons without type, lane and edge. Write "
            "these too, or the file as XML."
        )
    table = pd.DataFrame({own: raw[name] for own, name in source_of.items()})
    table[_TIME] = _seconds(pd.Series(table[_TIME]))
    try:
        for name in filter(table.__contains__, _NUMBERS):
            table[name] = pd.Series(pd.to_numeric(table[name], errors="coerce"), dtype=float)
    except OverflowError as error:
        raise ValueError(f"`{path.name}` must hold numbers that fit; got {error}.") from error
    person = np.zeros(len(table), bool)
    if set(_PLACE) <= set(table):  # an edge and no lane, where others have a lane
        lane, edge = (table[name].notna() & (table[name] != "") for name in _PLACE)
        person |= (edge & ~lane).to_numpy() & bool(lane.any())
    for other in _OTHERS:  # of xml2csv, which gives them columns of their own
        ids = raw.get(f"{other}_id")
        if ids is not None and source_of[_ID] == _ID:
            person |= ids.notna().to_numpy()
            table[_ID] = table[_ID].where(ids.isna(), ids)
    kind = table[_KIND].astype(object) if _KIND in table else pd.Series(None, table.index, object)
    table[_KIND] = kind.where(~person, _OTHERS[0])
    time_s = table[_TIME].to_numpy(dtype=float)
    empty = table.drop(columns=_TIME).isna().all(axis=1).to_numpy()
    nameless = table[_ID].isna().to_numpy() & ~empty
    for what, bad in (("a time", ~np.isfinite(time_s)), ("a vehicle", nameless)):
        if bad.any():
            raise ValueError(
                f"`{path.name}` must give each row {what}; got none in {int(bad.sum())} of {bad.size} rows, "
                f"first in data row {int(np.flatnonzero(bad)[0]) + 1}. Correct it, or delete it."
            )
    table[_KIND] = table[_KIND].fillna("").astype(str)
    used = [name for name in _COLUMNS[:6] if name in table]
    return FcdRows(np.unique(time_s), table.loc[~empty, used].reset_index(drop=True))


def _reader(path: Path) -> Callable[[Path], pd.DataFrame]:
    """Choose the reader by the first bytes, which are the same under every name."""
    with open_unzipped(path, path.name) as file:
        try:
            head = file.read(4096).lstrip(b"\xef\xbb\xbf \t\r\n")
        except (OSError, EOFError, zlib.error) as error:
            raise ValueError(f"`{path.name}` must be a whole archive; got {error}.") from error
    if head.startswith(b"<") or path.name.endswith((".xml", ".xml.gz")):
        return _read_xml
    return _read_parquet if head.startswith(b"PAR1") or path.suffix == ".parquet" else _read_csv


def _column(name: str) -> str:
    """Name of a column as that of a vehicle, also where it is a person's, or has no prefix."""
    bare = name.removeprefix("timestep_")
    for kind in ("vehicle", *_OTHERS):
        bare = bare.removeprefix(f"{kind}_")
    return next((known for known in _COLUMNS if known.partition("_")[2] == bare), name)


def _seconds(column: pd.Series) -> pd.Series:
    """Parse times that are numbers, or SUMO's ``H:M:S`` or ``D:H:M:S``; NaN for others. [s]"""
    numbers = pd.Series(pd.to_numeric(column, errors="coerce"), dtype=float)
    if numbers.notna().all():
        return numbers
    texts = column.astype(str).str.replace(r"^(\d+):(\d+:\d+:)", r"\1 days \2", regex=True)
    return numbers.fillna(pd.to_timedelta(texts.where(numbers.isna()), errors="coerce").dt.total_seconds())


def _most_rows(path: Path) -> int:
    return min(_MAX_ROWS, _ALWAYS_ALLOWED_ROWS + path.stat().st_size)


def _read_csv(path: Path) -> pd.DataFrame:
    try:
        with open_unzipped(path, path.name) as file:
            head = file.readline(_MAX_LINE_BYTES)
            separator = b";" if head.count(b";") >= head.count(b",") else b","
            count, most = head.count(separator), _most_rows(path)
            for number, line in enumerate(iter(lambda: file.readline(_MAX_LINE_BYTES), b""), 1):
                if number > most or len(line) == _MAX_LINE_BYTES:
                    raise ValueError(f"`{path.name}` must have at most {most:,} rows, each below 100 kB")
                if line.count(separator) > count and b'"' not in line:  # pandas would shift the columns
                    raise ValueError(
                        f"`{path.name}` must give each row the header's {count + 1} columns; got "
                        f"{line.count(separator) + 1} in data row {number}. Correct it, or delete it."
                    )
    except (OSError, EOFError, zlib.error) as error:
        raise ValueError(f"`{path.name}` must be SUMO's floating-car data as CSV; got {error}.") from error
    texts = (_ID, _KIND, *_PLACE, *(f"{k}_{end}" for k in _OTHERS for end in ("id", "type", "lane", "edge")))
    return read_csv(
        path,
        path.name,
        separator=separator.decode(),
        types=dict.fromkeys((*texts, "id", "type", "lane", "edge"), "str"),
        only=lambda column: _column(column.strip()) in _COLUMNS,
        comments=False,
        most_bytes=None,
    )


def _read_parquet(path: Path) -> pd.DataFrame:
    try:
        file = pyarrow.parquet.ParquetFile(check_file(path, path.name))
        if file.metadata.num_rows > _most_rows(path):
            raise ValueError(f"more than {_most_rows(path):,} rows")
        arrow = file.read([name for name in file.schema_arrow.names if _column(name) in _COLUMNS])
        arrow.validate(full=True)  # also finds names that are not text
        return arrow.to_pandas()
    except Exception as error:  # Arrow has many errors for damaged files
        raise ValueError(f"`{path.name}` must be a whole Parquet file; got {error}.") from error


def _read_xml(path: Path) -> pd.DataFrame:
    """Read the rows of an ``fcd-export`` as a stream: whole files may be larger than memory."""
    rows: dict[str, list] = {name: [] for name in _COLUMNS[:6]}
    has_angle, now, most = False, "nan", _most_rows(path)

    def add(values: Callable[[str], str | None]) -> None:
        if len(rows[_TIME]) >= most:
            raise ValueError(f"more than {most:,} rows")
        rows[_TIME].append(now)
        for name in _COLUMNS[1:6]:
            rows[name].append(values(name.partition("_")[2]))

    try:
        with open_unzipped(path, path.name) as file:
            events = defusedxml.ElementTree.iterparse(file, events=("start", "end"), forbid_dtd=True)
            _, root = next(events)
            if root.tag != "fcd-export":
                raise ValueError(f"the root element {root.tag[:40]!r}, which is not fcd-export")
            for event, element in events:
                if event == "start" and element.tag == "timestep":
                    now = element.get("time", "nan")
                    add(lambda _: None)
                elif event == "end" and element.tag in ("vehicle", *_OTHERS):
                    add(element.get)
                    has_angle |= rows[_NUMBERS[2]][-1] is not None
                    if element.tag in _OTHERS:
                        rows[_KIND][-1] = _OTHERS[0]
                elif event == "end" and element.tag == "timestep":
                    element.clear()
    except DefusedXmlException as error:
        raise ValueError(
            f"`{path.name}` must be plain XML without DTD or entities; got {type(error).__name__}."
        ) from error
    except (ParseError, OSError, zlib.error, EOFError, ValueError, LookupError) as error:
        raise ValueError(f"`{path.name}` must be whole, well-formed XML; got {error}.") from error
    if not has_angle:
        del rows[_NUMBERS[2]]
    return pd.DataFrame(rows)
