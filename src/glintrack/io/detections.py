"""Tables of detections, tracks and truth from CSV files, with one clear sentence for each fault.

Columns carry their unit in the name.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.io.tables import read_csv
from glintrack.io.untrusted import MAX_CELL_M, MAX_COORDINATE_M

PLACE = ("east_m", "north_m")
COVARIANCE = ("east_var_m2", "north_var_m2", "east_north_cov_m2")
# what answers instead of measuring
NO_FEATURE = ("track_id", "vehicle_id", "truth_id", "id", "frame", "label", "class")
FASTEST_M_S = 1e6
_SEPARATORS = ";\t|"
_OFTEN = 0.2  # of all rows time falls: it may well be another column
# of a column, in other people's files
_OTHER_NAMES = {
    "time_s": ("t", "time", "timestamp", "t_s", "seconds"),
    "east_m": ("x", "east", "easting", "x_m", "easting_m"),
    "north_m": ("y", "north", "northing", "y_m", "northing_m"),
    "track_id": ("id", "track", "trackid"),
    "vehicle_id": ("id", "vehicle", "object_id", "gt_id"),
}
LONGEST_S = 1e11  # three thousand years: seconds since 1970 fit


@dataclass(frozen=True)
class DetectionTable:
    """Detections of all epochs, in the order of the file.

    Parameters
    ----------
    time_s
        Of each row, never falling. [s]
    position, covariance
        East and north. [m, m²]
    features
        NaN where a detection has none.
    feature_names
        Columns they come from.
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


def _as_degrees(position: Array) -> bool:
    """Whether all positions lie within a metre, not at the origin, and could be longitude and latitude."""
    within = np.ptp(position, axis=0).max() < 1.0
    middle = np.abs(position.mean(axis=0))
    return bool(within and middle.min() > 1.0 and middle[0] <= 180 and middle[1] <= 90)


def read_detections(
    path: Path, sigma_m: float = 0.5, feature_names: tuple[str, ...] | None = None
) -> DetectionTable:
    """Detections from a CSV file.

    Parameters
    ----------
    path
        Columns ``time_s, east_m, north_m``; perhaps ``east_var_m2, north_var_m2, east_north_cov_m2``; every
        other column of numbers is a feature, except those that name an answer (`NO_FEATURE`).
    sigma_m
        Standard deviation of each coordinate where the file holds no variances. [m]
    feature_names
        Which columns are features; None takes all there are.

    Raises
    ------
    ValueError
        In one sentence: the column or row, what it must be, and what came.
    """
    if not 0 < sigma_m <= MAX_CELL_M:
        raise ValueError(f"`sigma_m` must be greater than 0 and at most {MAX_CELL_M:g} m, got {sigma_m:g}")
    table = _read(path, "detections", ("time_s", *PLACE))
    position = _finite(table, path, PLACE)
    time_s = _finite(table, path, ("time_s",))[:, 0]
    if np.abs(time_s).max(initial=0) > LONGEST_S:
        raise ValueError(f"`time_s` must be seconds within ±{LONGEST_S:g}, got others in {path}")
    fall = np.flatnonzero(np.diff(time_s) < 0)
    if fall.size:
        k = int(fall[0])
        other = "is time_s the column of times? " if len(fall) > _OFTEN * len(time_s) else ""
        raise ValueError(
            f"`time_s` must not go backwards, got {time_s[k + 1]:g} after {time_s[k]:g} in row {k + 3} "
            f"of {path} ({other}sort the rows by time)"
        )
    far = np.flatnonzero(np.abs(position).max(axis=1, initial=0) > MAX_COORDINATE_M)
    if far.size:
        raise ValueError(
            f"`east_m` and `north_m` must be metres within ±{MAX_COORDINATE_M:g}, got "
            f"{position[far[0]].tolist()} in row {int(far[0]) + 2} of {path}"
        )
    if len(position) > 1 and _as_degrees(position):
        raise ValueError(
            f"`east_m` and `north_m` must be metres, got numbers that look like degrees in {path}: all "
            f"within {np.ptp(position, axis=0).max():.2g} m of each other (project them first)"
        )
    others = [c for c in table.columns if c not in ("time_s", *PLACE, *COVARIANCE, *NO_FEATURE)]
    names = tuple(others) if feature_names is None else feature_names
    missing = [n for n in names if n not in table.columns]
    if missing:
        known = _brief(", ".join(map(str, table.columns)))
        raise ValueError(f"`features` must name columns of {path}, got {missing[0]!r} (it has {known})")
    features = _numbers(table, path, names)
    features[~np.isfinite(features)] = np.nan
    return DetectionTable(time_s, position, _covariance(table, path, sigma_m), features, names)


def read_tracks(path: Path) -> xr.Dataset:
    """Rows of tracks from a CSV file with at least ``time_s, track_id, east_m, north_m``."""
    return _moving_points(path, "tracks", "track_id")


def read_truth(path: Path) -> xr.Dataset:
    """Rows of truth from a CSV file with at least ``time_s, vehicle_id, east_m, north_m``.

    Without ``east_speed_m_s`` and ``north_speed_m_s`` the speeds are the differences between a vehicle's own
    positions. ``visible_fraction`` and ``inside`` are kept, the latter 0 or 1.
    """
    rows = _moving_points(path, "truth", "vehicle_id")
    table = _read(path, "truth", ())
    if "visible_fraction" in table:
        seen = _finite(table, path, ("visible_fraction",))[:, 0]
        if seen.size and (seen.min() < 0 or seen.max() > 1):
            raise ValueError(
                f"`visible_fraction` must lie within 0 to 1, got {seen.min():g} to {seen.max():g} in {path}"
            )
        rows = rows.assign(visible_fraction=("row", seen))
    if "inside" in table:
        inside = _finite(table, path, ("inside",))[:, 0]
        if not np.isin(inside, (0, 1)).all():
            raise ValueError(f"`inside` must hold 0 or 1, got others in {path}")
        rows = rows.assign(inside=("row", inside > 0))
    return rows


def _moving_points(path: Path, name: str, ident: str) -> xr.Dataset:
    table = _read(path, name, ("time_s", ident, *PLACE))
    values = _finite(table, path, ("time_s", ident, *PLACE))
    far = np.flatnonzero(np.abs(values[:, 2:]).max(axis=1, initial=0) > MAX_COORDINATE_M)
    if far.size:
        raise ValueError(
            f"`east_m` and `north_m` must be metres within ±{MAX_COORDINATE_M:g}, got "
            f"{values[far[0], 2:].tolist()} in row {int(far[0]) + 2} of {path}"
        )
    if np.abs(values[:, 0]).max(initial=0) > LONGEST_S:
        raise ValueError(f"`time_s` must be seconds within ±{LONGEST_S:g}, got others in {path}")
    ids = values[:, 1]
    wrong = (ids != np.rint(ids)) | (ids < 0) | (ids >= 2**53)
    if wrong.any():
        stray = ids[wrong][0]
        raise ValueError(f"`{ident}` must hold whole numbers from 0 to 2⁵³, got {stray:g} in {path}")
    twice = pd.DataFrame(values[:, :2]).duplicated()
    if twice.any():
        k = int(np.flatnonzero(twice)[0])
        raise ValueError(
            f"`{ident}` must appear once an epoch, got {ids[k]:g} again at {values[k, 0]:g} s "
            f"in row {k + 2} of {path}"
        )
    speeds = ("east_speed_m_s", "north_speed_m_s")
    given = all(c in table for c in speeds)
    velocity = _finite(table, path, speeds) if given else _differences(values)
    fast = ~(np.abs(velocity) <= FASTEST_M_S).all(axis=1)
    if fast.any():
        raise ValueError(
            f"`{ident}` must move by at most {FASTEST_M_S:g} m/s, got {ids[fast][0]:g} faster at "
            f"{values[fast][0, 0]:g} s in {path}"
        )
    columns = dict(zip(("time_s", ident, "east", "north"), values.T, strict=True))
    columns[ident] = ids.astype(np.int64)
    columns["east_speed"], columns["north_speed"] = velocity[:, 0], velocity[:, 1]
    return xr.Dataset({key: ("row", column) for key, column in columns.items()})


def _differences(values: Float[Array, "row 4"]) -> Float[Array, "row 2"]:
    """Central differences of each id's own positions; 0 for an id that appears once. [m s⁻¹]"""
    velocity = np.zeros((len(values), 2))
    order = np.lexsort((values[:, 0], values[:, 1]))
    for mine in np.split(order, np.flatnonzero(np.diff(values[order, 1])) + 1):
        if len(mine) > 1:
            with np.errstate(all="ignore"):  # what becomes of times too close is refused
                velocity[mine] = np.gradient(values[mine, 2:], values[mine, 0], axis=0)
    return velocity


def _read(path: Path, name: str, required: tuple[str, ...]) -> pd.DataFrame:
    table = read_csv(path, name, most_bytes=None)
    missing = [c for c in required if c not in table.columns]
    if missing:
        there = [str(c) for c in table.columns]
        raise ValueError(
            f"`{name}` must have the columns {', '.join(required)}, got no {', '.join(missing)} in {path} "
            f"(it has {_brief(', '.join(there))}{_remedy(missing, there)})"
        )
    return table


def _remedy(missing: Sequence[str], there: Sequence[str]) -> str:
    """What to do about columns of other names, other separators, or degrees."""
    if len(there) == 1 and any(sign in there[0] for sign in _SEPARATORS):
        return "; separate the columns by commas"
    lower = {name.strip().lower(): name for name in there}
    if any(name.startswith(("lon", "lat")) for name in lower):
        return "; project them into metres first"
    known = {want: lower[own] for want in missing for own in _names_of(want) if own in lower}
    return f"; rename {', '.join(f'{own} to {want}' for want, own in known.items())}" if known else ""


def _names_of(column: str) -> tuple[str, ...]:
    """What others call a column; itself last, which is taken first, in capitals perhaps."""
    return (*_OTHER_NAMES.get(column, ()), column)


def _brief(text: str) -> str:
    return text if len(text) <= 200 else f"{text[:199]}…"


def _numbers(table: pd.DataFrame, path: Path, columns: tuple[str, ...]) -> Float[Array, "row column"]:
    out = np.empty((len(table), len(columns)))
    for k, column in enumerate(columns):
        try:
            numbers = np.asarray(pd.to_numeric(table[column], errors="coerce"), dtype=float)
        except (OverflowError, TypeError) as error:
            raise ValueError(f"`{column}` must hold numbers that fit, got {error} in {path}") from error
        words = np.flatnonzero(np.isnan(numbers) & table[column].notna().to_numpy())
        if words.size:
            row = int(words[0])
            came = _brief(repr(table[column].iloc[row]))
            raise ValueError(f"`{column}` must hold numbers, got {came} in row {row + 2} of {path}")
        out[:, k] = numbers
    return out


def _finite(table: pd.DataFrame, path: Path, columns: tuple[str, ...]) -> Float[Array, "row column"]:
    out = _numbers(table, path, columns)
    stray = np.argwhere(~np.isfinite(out))
    if stray.size:
        row, column = stray[0]
        raise ValueError(
            f"`{columns[column]}` must be finite, got {out[row, column]:g} in row {row + 2} of {path} "
            f"(leave the row out)"
        )
    return out


def _covariance(table: pd.DataFrame, path: Path, sigma_m: float) -> Float[Array, "row 2 2"]:
    present = [c for c in COVARIANCE if c in table.columns]
    out = np.zeros((len(table), 2, 2))
    if not present:
        out[:, 0, 0] = out[:, 1, 1] = sigma_m**2
        return out
    if not set(COVARIANCE[:2]) <= set(present):
        both = " and ".join(COVARIANCE[:2])
        missing = next(c for c in COVARIANCE[:2] if c not in present)
        raise ValueError(f"`{present[0]}` must come with {both}, got no {missing} in {path}")
    out[:, 0, 0], out[:, 1, 1] = _finite(table, path, COVARIANCE[:2]).T
    if COVARIANCE[2] in present:
        out[:, 0, 1] = out[:, 1, 0] = _finite(table, path, COVARIANCE[2:])[:, 0]
    bad = np.flatnonzero(~((out[:, 0, 0] > 0) & (np.linalg.det(out) > 0))) if len(out) else np.empty(0, int)
    if bad.size:
        raise ValueError(
            f"`east_var_m2`, `north_var_m2` and `east_north_cov_m2` must form a positive covariance, got "
            f"{out[bad[0], [0, 1, 0], [0, 1, 1]].tolist()} in row {int(bad[0]) + 2} of {path}"
        )
    return out
