"""Read detections, tracks and truth from CSV files and MOTChallenge text; a fault is one sentence.

Columns carry their unit in the name.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.installation import read_data
from glintrack.io.orthoimages import Geotransform
from glintrack.io.readings import report_reading
from glintrack.io.tables import read_csv, read_numbers
from glintrack.io.times import check_steps
from glintrack.io.tracks import read_mot
from glintrack.io.untrusted import MAX_CELL_M, MAX_COORDINATE_M, plain

POSITION = ("east_m", "north_m")
COVARIANCE = ("east_var_m2", "north_var_m2", "east_north_cov_m2")
_SPEEDS = ("east_speed_m_s", "north_speed_m_s")
# columns that contain the answer, which are never features
NO_FEATURE = ("track_id", "vehicle_id", "truth_id", "id", "frame", "label", "class")
MAX_SPEED_M_S = 1e6
MAX_TIME_S = 1e11  # three thousand years, so that seconds since 1970 fit
_MAX_TEXT = 200  # of columns in a message
_WRONG_COLUMN = 0.2  # share of rows in which time decreases, above which it may be another column
_OTHER_NAMES: Mapping[str, Sequence[str]] = read_data("words.toml")["columns"]  # in other programs


@dataclass(frozen=True)
class DetectionTable:
    """Detections of all epochs, in the order of the file.

    Parameters
    ----------
    time_s
        Time of each row, never decreasing. [s]
    position, covariance
        East and north. [m, m²]
    features
        NaN where a detection has none.
    feature_names
        Columns of the features.
    """

    time_s: Float[Array, "row"]
    position: Float[Array, "row 2"]
    covariance: Float[Array, "row 2 2"]
    features: Float[Array, "row feature"]
    feature_names: tuple[str, ...]

    def epochs(self) -> list[tuple[float, Int[Array, "row"]]]:
        """Each time and its rows; rows of one epoch share their time exactly."""
        if len(self.time_s) == 0:
            return []
        times, first = np.unique(self.time_s, return_index=True)
        return list(zip(times.tolist(), np.split(np.arange(len(self.time_s)), first[1:]), strict=True))


def read_detections(
    path: Path,
    sigma_m: float = 0.5,
    feature_names: tuple[str, ...] | None = None,
    rate_hz: float | None = None,
    grid: Geotransform | None = None,
) -> DetectionTable:
    """Read detections from a CSV file, or from MOTChallenge text.

    Parameters
    ----------
    path
        Columns ``time_s, east_m, north_m``; optionally ``east_var_m2, north_var_m2, east_north_cov_m2``.
        Every other column of numbers with a name is a feature, except those that contain an answer
        (`NO_FEATURE`).
    sigma_m
        Standard deviation of each coordinate if the file holds no variances. [m]
    feature_names
        Columns to use as features; None for all there are.
    rate_hz, grid
        Frame rate [Hz] and position of the pixels of MOTChallenge text, see `io.tracks.read_mot`.

    Raises
    ------
    ValueError
        In one sentence: the column or row, the requirement, and what was found.
    """
    if not 0 < sigma_m <= MAX_CELL_M:
        raise ValueError(f"`sigma_m` must be greater than 0 and at most {MAX_CELL_M:g} m; got {sigma_m:g}.")
    table = _read_columns(path, "detections", ("time_s", *POSITION), rate_hz, grid)
    time_s, position = _times_and_positions(table, path)
    fall = np.flatnonzero(np.diff(time_s) < 0)
    if fall.size:
        k = int(fall[0])
        other = "Is time_s the column of times? " if len(fall) > _WRONG_COLUMN * len(time_s) else ""
        raise ValueError(
            f"`time_s` must not go backwards; got {time_s[k + 1]:g} after {time_s[k]:g} in row {k + 3} "
            f"of {path}. {other}Sort the rows by time."
        )
    if len(position) > 1:
        extent_m, middle = np.ptp(position, axis=0).max(), np.abs(position.mean(axis=0))
        if extent_m < 1.0 and middle.min() > 1.0 and middle[0] <= 180 and middle[1] <= 90:
            raise ValueError(
                f"`east_m` and `north_m` must be metres; got numbers that look like degrees in {path}: all "
                f"within {extent_m:.2g} m of each other. Project them first."
            )
    others = [c for c in table.columns if c not in ("time_s", *POSITION, *COVARIANCE, *NO_FEATURE)]
    others = [c for c in others if not c.startswith("Unnamed: ")]  # an index that pandas wrote
    # a column without any number, such as a status, is no feature unless it is asked for
    numbers = {c: np.asarray(pd.to_numeric(table[c], errors="coerce"), dtype=float) for c in others}
    others = [c for c in others if np.isfinite(numbers[c]).any()]
    names = tuple(others) if feature_names is None else feature_names
    if missing := [n for n in names if n not in table.columns]:
        known = plain(", ".join(map(str, table.columns)), _MAX_TEXT)
        raise ValueError(f"`features` must name columns of {path}; got {missing[0]!r}. It has {known}.")
    features = read_numbers(table, path, names, finite=False)
    features[~np.isfinite(features)] = np.nan
    return DetectionTable(time_s, position, _covariance(table, path, sigma_m), features, names)


def read_tracks(path: Path, rate_hz: float | None = None, grid: Geotransform | None = None) -> xr.Dataset:
    """Read rows of tracks from a CSV file with at least ``time_s, track_id, east_m, north_m``.

    For MOTChallenge text (``.txt``) give its frame rate [Hz] and position, see `io.tracks.read_mot`.
    """
    return _read_rows(path, "tracks", "track_id", rate_hz, grid)[0]


def read_truth(path: Path, rate_hz: float | None = None, grid: Geotransform | None = None) -> xr.Dataset:
    """Read rows of truth as `read_tracks`, with ``vehicle_id``.

    Without ``east_speed_m_s`` and ``north_speed_m_s`` the speeds are the differences between a vehicle's own
    positions. Optional columns are ``visible_fraction``, 0 to 1, and ``inside``, 0 or 1.
    """
    rows, table = _read_rows(path, "truth", "vehicle_id", rate_hz, grid)
    if "visible_fraction" in table:
        visible = read_numbers(table, path, ("visible_fraction",))[:, 0]
        if visible.size and (visible.min() < 0 or visible.max() > 1):
            span = f"{visible.min():g} to {visible.max():g}"
            raise ValueError(f"`visible_fraction` must lie within 0 to 1; got {span} in {path}.")
        rows = rows.assign(visible_fraction=("row", visible))
    if "inside" in table:
        inside = read_numbers(table, path, ("inside",))[:, 0]
        if not np.isin(inside, (0, 1)).all():
            raise ValueError(f"`inside` must hold 0 or 1; got others in {path}.")
        rows = rows.assign(inside=("row", inside > 0))
    return rows


def _read_rows(
    path: Path, name: str, id_column: str, rate_hz: float | None, grid: Geotransform | None
) -> tuple[xr.Dataset, pd.DataFrame]:
    """Rows with time, id, position and velocity, and the whole table."""
    table = _read_columns(path, name, ("time_s", id_column, *POSITION), rate_hz, grid)
    time_s, position = _times_and_positions(table, path)
    ids = _identities(table, path, id_column)
    wrong = (ids != np.rint(ids)) | (ids < 0) | (ids >= 2**53)
    if wrong.any():
        raise ValueError(
            f"`{id_column}` must hold whole numbers from 0 to 2⁵³; got {ids[wrong][0]:g} in {path}."
        )
    repeated = np.flatnonzero(pd.DataFrame({"time": time_s, "id": ids}).duplicated())
    if repeated.size:
        k = int(repeated[0])
        raise ValueError(
            f"`{id_column}` must appear once in each frame; got {ids[k]:g} again at {time_s[k]:g} s "
            f"in row {k + 2} of {path}."
        )
    if all(c in table for c in _SPEEDS):
        velocity = read_numbers(table, path, _SPEEDS)
    else:
        velocity = np.zeros_like(position)
        order = np.lexsort((time_s, ids))
        for mine in np.split(order, np.flatnonzero(np.diff(ids[order])) + 1):
            if len(mine) > 1:
                with np.errstate(all="ignore"):  # times too close are refused below
                    velocity[mine] = np.gradient(position[mine], time_s[mine], axis=0)
    fast = ~(np.abs(velocity) <= MAX_SPEED_M_S).all(axis=1)
    if fast.any():
        raise ValueError(
            f"`{id_column}` must move by at most {MAX_SPEED_M_S:g} m/s; got {ids[fast][0]:g} faster at "
            f"{time_s[fast][0]:g} s in {path}."
        )
    more = ("visible_fraction", "inside") if name == "truth" else ()
    known = {"time_s", id_column, *POSITION, *_SPEEDS, *more}
    notes = [f"{len(np.unique(ids)):,} ids at {len(np.unique(time_s)):,} times"]
    notes += [f"not used: {plain(', '.join(rest), _MAX_TEXT)}" for rest in [sorted({*table} - known)] if rest]
    report_reading(path, "rows", len(table), len(ids), notes=notes)
    columns = {"time_s": time_s, id_column: ids.astype(np.int64)}
    columns |= dict(zip((*POSITION, *_SPEEDS), (*position.T, *velocity.T), strict=True))
    return xr.Dataset({key: ("row", column) for key, column in columns.items()}), table


def _identities(table: pd.DataFrame, path: Path, column: str) -> Float[Array, "row"]:
    """Identities as numbers; where one is a text, they are numbered in the order in which they appear."""
    given = pd.Series(table[column])
    if pd.api.types.is_numeric_dtype(given) or given.isna().any():
        return read_numbers(table, path, (column,))[:, 0]
    return pd.factorize(given.astype(str).str.strip())[0].astype(float)


def _read_columns(
    path: Path, name: str, required: tuple[str, ...], rate_hz: float | None, grid: Geotransform | None
) -> pd.DataFrame:
    if path.suffix.lower() == ".txt":
        table = read_mot(path, name, rate_hz, grid)
        return table if required[1] in table else table.rename(columns={"id": required[1]})
    table = read_csv(path, name, most_bytes=None)
    if missing := [c for c in required if c not in table.columns]:
        present = [str(c) for c in table.columns]
        raise ValueError(
            f"`{name}` must have the columns {', '.join(required)}; got no {', '.join(missing)} in {path}. "
            f"It has {plain(', '.join(present), _MAX_TEXT)}.{_column_remedy(missing, present)}"
        )
    return table


def _column_remedy(missing: Sequence[str], present: Sequence[str]) -> str:
    """Remedy for columns of other names, other separators, or degrees; may be empty."""
    if all(re.fullmatch(r"-?\d+(\.\d+)*", name) for name in present):
        return " Without a header it may be MOTChallenge text: let its name end in .txt."
    if len(present) == 1 and any(sign in present[0] for sign in ";\t|"):
        return " Separate the columns by commas."
    ids = {"track_id", "vehicle_id"}
    if len(ids & {*missing}) == len(ids & {*present}) == 1:
        return " Are tracks and truth exchanged? The tracks come first."
    lower = {name.strip().lower(): name for name in present}
    if any(name.startswith(("lon", "lat")) for name in lower):
        return " Project them into metres first."
    known = {want: lower[k] for want in missing for k in (*_OTHER_NAMES.get(want, ()), want) if k in lower}
    return f" Rename {', '.join(f'{own} to {want}' for want, own in known.items())}." if known else ""


def _times_and_positions(
    table: pd.DataFrame, path: Path
) -> tuple[Float[Array, "row"], Float[Array, "row 2"]]:
    position = read_numbers(table, path, POSITION)
    time_s = read_numbers(table, path, ("time_s",))[:, 0]
    if np.abs(time_s).max(initial=0) > MAX_TIME_S:
        raise ValueError(f"`time_s` must be seconds within ±{MAX_TIME_S:g}; got others in {path}.")
    check_steps(time_s, "time_s", path)
    far = np.flatnonzero(np.abs(position).max(axis=1, initial=0) > MAX_COORDINATE_M)
    if far.size:
        raise ValueError(
            f"`east_m` and `north_m` must be metres within ±{MAX_COORDINATE_M:g}; got "
            f"{position[far[0]].tolist()} in row {int(far[0]) + 2} of {path}."
        )
    return time_s, position


def _covariance(table: pd.DataFrame, path: Path, sigma_m: float) -> Float[Array, "row 2 2"]:
    present = [c for c in COVARIANCE if c in table.columns]
    out = np.zeros((len(table), 2, 2))
    if not present:
        out[:, 0, 0] = out[:, 1, 1] = sigma_m**2
        return out
    if missing := [c for c in COVARIANCE[:2] if c not in present]:
        both = " and ".join(COVARIANCE[:2])
        raise ValueError(f"`{present[0]}` must come with {both}; got no {missing[0]} in {path}.")
    out[:, 0, 0], out[:, 1, 1] = read_numbers(table, path, COVARIANCE[:2]).T
    if COVARIANCE[2] in present:
        out[:, 0, 1] = out[:, 1, 0] = read_numbers(table, path, COVARIANCE[2:])[:, 0]
    bad = np.flatnonzero(~((out[:, 0, 0] > 0) & (np.linalg.det(out) > 0))) if len(out) else np.empty(0, int)
    if bad.size:
        raise ValueError(
            f"`east_var_m2`, `north_var_m2` and `east_north_cov_m2` must form a positive covariance; got "
            f"{out[bad[0], [0, 1, 0], [0, 1, 1]].tolist()} in row {int(bad[0]) + 2} of {path}."
        )
    return out
