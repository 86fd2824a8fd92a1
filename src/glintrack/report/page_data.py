"""Data of the report page as plain values: the first screen, rows packed small, curves as lists.

The loss budget of the first screen is that of the channel that speaks in the verdict. Where the flight
measured none, its bars are the scores: held of all movers, of the visible ones, and custody.
"""

import base64
import math
from dataclasses import dataclass

import numpy as np
import xarray as xr

from glintrack import metrics
from glintrack.bounds import STAGE_LABELS
from glintrack.core.arrays import Array
from glintrack.core.records import Extent
from glintrack.results.figures.frame import round_length
from glintrack.results.read import SCORE_LABELS, Result
from glintrack.results.verdict import (
    CHANNEL_WORDS,
    budget_frames,
    select_channel,
    stage_shares,
    sun_angles_deg,
    view_facts,
)

SPECTRA_PER_TRACK = 6
MOST_SPECTRA = 6_000
_FINE = 32_000  # steps of a track's brightest radiance: finer than any noise
_CURVES = ("completeness", "purity", "false_tracks", "should", "valid", "queries_asked", "queries_served")
_SCORE_BARS = ("completeness", "completeness_visible", "custody")
_BAR_SHARE = 0.3  # of the window's width that the scale bar takes at most
_ARROW = 7.0  # length of the sun's arrow, of a plan 100 wide


@dataclass(frozen=True)
class BudgetBar:
    """One stage: its words, its share of 100 vehicles, and whether it ends the loss budget."""

    label: str
    per_hundred: float
    last: bool = False


def budget_bars(result: Result) -> tuple[str, list[BudgetBar]]:
    """Caption and bars of the channel that speaks; nothing without scores."""
    name = select_channel(result.scores)
    if name is None or result.tree is None:
        return "", []
    stages = stage_shares(result.tree).get(name, {})
    if len(stages) > 1:
        bars = [
            BudgetBar(STAGE_LABELS.get(r, r.replace("_", " ")), 100 * share) for r, share in stages.items()
        ]
        caption = f"Of 100 moving vehicles, {CHANNEL_WORDS.get(name, name)}, on {budget_frames(result.tree)}"
    else:
        of = result.scores[name]
        told = {key: of[key] for key in _SCORE_BARS if math.isfinite(of.get(key, math.nan))}
        bars = [BudgetBar(SCORE_LABELS[key], 100 * value) for key, value in told.items()]
        caption = f"Of 100 vehicles, {CHANNEL_WORDS.get(name, name)}"
    return caption, [*bars[:-1], *(BudgetBar(b.label, b.per_hundred, last=True) for b in bars[-1:])]


def facts(result: Result) -> dict[str, str]:
    """Case and what was flown, by name; the case alone where its design cannot be read."""
    return {"case": result.name} | (view_facts(result.case) if result.case is not None else {})


def sun_azimuth_deg(result: Result) -> float | None:
    """Where one looks to see the sun, clockwise from north; None where the design cannot be read. [°]"""
    return None if result.case is None else sun_angles_deg(result.case)[1]


def plan(extent_m: Extent, azimuth_deg: float | None, picture: str = "") -> dict:
    """The window seen from above, 100 units wide: its height, the scale bar, and where the sun stands.

    Parameters
    ----------
    extent_m
        West, south, east, north. [m]
    azimuth_deg
        Of the sun. [°]
    picture
        Address of a picture of the window, if there is one.
    """
    wide, high = extent_m[2] - extent_m[0], extent_m[3] - extent_m[1]
    bar_m = round_length(_BAR_SHARE * wide)
    sun = None
    if azimuth_deg is not None:  # the arrow points to where the sun stands
        towards = math.radians(azimuth_deg)
        sun = {"x": f"{_ARROW * math.sin(towards):.2f}", "y": f"{-_ARROW * math.cos(towards):.2f}",
               "degrees": f"{azimuth_deg:.0f}"}  # fmt: skip
    return {
        "picture": picture,
        "said": f"The window, {wide:.0f} m × {high:.0f} m, north up",
        "high": f"{100 * high / wide:.2f}",
        "bar_label": f"{bar_m:g} m",
        "bar": f"{100 * bar_m / wide:.2f}",
        "sun": sun,
    }


def page_data(result: Result) -> dict:
    """Everything the page's program draws.

    Rows are in order of time, ``per`` of them at each of ``times_s``; positions are in decimetres from the
    middle of ``extent_m``. Columns are base64 of little-endian numbers, see `packed`.
    """
    tree = result.tree
    names = result.channels
    times_s = _times(result, names)
    extent = _extent(result)
    out = {
        "name": result.name,
        "times_s": _numbers(times_s),
        "extent_m": list(extent),
        "channels": {},
        "truth": None,
        "vehicles": {},
    }
    if tree is None:
        return out
    middle = (0.5 * (extent[0] + extent[2]), 0.5 * (extent[1] + extent[3]))
    paints = _paints(tree)
    out["vehicles"] = {str(k): v for k, v in paints.items()}
    out["truth"] = _truth_rows(_dataset(tree, "truth"), times_s, middle, extent)
    for name in names:
        out["channels"][name] = _channel(tree, name, times_s, middle, paints)
    return out


def packed(values: Array, kind: str) -> dict:
    """Numbers as base64 of ``kind`` (``u1 u2 i2 i4 f4``, little-endian), clipped to its range."""
    dtype = np.dtype(f"<{kind}")
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        values = np.clip(np.round(np.nan_to_num(values)), limits.min, limits.max)
    return {"kind": kind, "data": base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode()}


def _channel(tree: xr.DataTree, name: str, times_s: Array, middle: tuple, paints: dict) -> dict:
    node = _dataset(tree, name)
    rows = _dataset(tree, f"{name}/tracks")
    queries = _dataset(tree, f"{name}/queries")
    quality = _dataset(tree, f"{name}/quality")
    count = rows.sizes.get("row", 0)
    out = {
        "curves": {k: _numbers(node[k].values) for k in _CURVES if k in node},
        "scores": {k: _number(node.attrs[k]) for k in SCORE_LABELS if k in node.attrs},
        "tracks": _track_rows(rows, times_s, middle),
        "counts": {
            "tracks": len(np.unique(rows["track_id"].values)) if count else 0,
            "rows": count,
            "queries": queries.sizes.get("row", 0),
        },
        "queries": _query_rows(queries, times_s, middle),
        "quality": {
            k: {"values": _numbers(quality[k].values), "units": _shown_units(quality[k])}
            for k in map(str, quality.data_vars)
        },
        "spectra": _spectra(queries, times_s, paints),
        "roc": _roc(_dataset(tree, f"{name}/roc"), node),
    }
    return out


def _shown_units(values: xr.DataArray) -> str:
    """Units as a reader writes them."""
    units = str(values.attrs.get("units", "1"))
    return units if units == "1" else units.replace("um-1", "µm-1").replace("-1", "⁻¹").replace("-2", "⁻²")


def _roc(swept: xr.Dataset, node: xr.Dataset) -> dict | None:
    """Points (false tracks a frame, completeness, words) of a swept threshold, and the flight's own."""
    if not {"completeness", "false_per_epoch", "purity"} <= set(swept.data_vars):
        return None
    columns = ("threshold", "completeness", "false_per_epoch", "purity")
    key = str(swept["threshold"].attrs.get("key", "threshold"))
    table = [list(row) for row in zip(*(_numbers(swept[c].values) for c in columns), strict=True)]
    flown = [_number(node.attrs.get(k, math.nan)) for k in ("false_per_epoch", "completeness")]
    points = [
        [false, completeness, f"{key} {threshold:g}"]
        for threshold, completeness, false, _ in table
        if completeness is not None and false is not None
    ]
    return {"points": points, "table": table, "key": key, "flown": flown if None not in flown else None}


def _track_rows(rows: xr.Dataset, times_s: Array, middle: tuple) -> dict:
    if not rows.sizes.get("row"):
        return {"count": 0}
    rows, per = _in_time(rows, times_s)
    nothing = np.full(rows.sizes["row"], -1)
    get = {k: rows[k].values if k in rows else nothing for k in ("vehicle_id", "valid", "false", "coasted")}
    flags = (get["coasted"] > 0) * 1 + (get["valid"] > 0) * 2 + (get["false"] > 0) * 4
    return {
        "count": rows.sizes["row"],
        "per": per,
        "id": _whole(rows["track_id"].values),
        "vehicle": _whole(get["vehicle_id"]),
        "flags": packed(flags, "u1"),
        **_places(rows, middle),
        "vx": packed(100 * rows["east_speed"].values, "i2"),
        "vy": packed(100 * rows["north_speed"].values, "i2"),
    }


def _truth_rows(truth: xr.Dataset, times_s: Array, middle: tuple, extent: tuple) -> dict:
    """Vehicles inside the area; ``flags`` 1 for moving, 2 for seen to a quarter at least."""
    if not truth.sizes.get("row"):
        return {"count": 0, "vehicles": 0}
    rows = truth.isel(row=np.flatnonzero(metrics.is_in_window(truth, extent)))
    rows, per = _in_time(rows, times_s)
    moving, seen = metrics.is_moving(rows), metrics.is_visible(rows)
    return {
        "count": rows.sizes["row"],
        "vehicles": len(np.unique(rows["vehicle_id"].values)),
        "per": per,
        "id": _whole(rows["vehicle_id"].values),
        "flags": packed(moving * 1 + seen * 2, "u1"),
        **_places(rows, middle),
    }


def _query_rows(queries: xr.Dataset, times_s: Array, middle: tuple) -> dict:
    if not queries.sizes.get("row"):
        return {"count": 0}
    queries, per = _in_time(queries, times_s)
    return {
        "count": queries.sizes["row"],
        "per": per,
        "id": _whole(queries["track_id"].values),
        **_places(queries, middle),
    }


def _spectra(queries: xr.Dataset, times_s: Array, paints: dict[int, str]) -> dict:
    """A few spectra of each track, and mean and spread of all spectra measured on each paint.

    The mean of a paint takes every served query whose track was on a vehicle of that paint.
    """
    if not queries.sizes.get("row"):
        return {"wavelength_nm": [], "tracks": {}, "classes": {}}
    radiance, ids = queries["radiance"].values, queries["track_id"].values
    when = _index(times_s, queries["time_s"].values)
    chosen: dict[str, dict] = {}
    left = MOST_SPECTRA
    for track in np.unique(ids[ids >= 0]):
        mine = np.flatnonzero(ids == track)
        picks = mine[np.unique(np.linspace(0, len(mine) - 1, SPECTRA_PER_TRACK).round().astype(int))][:left]
        left -= len(picks)
        top = float(np.nanmax(np.abs(radiance[picks]), initial=1e-9))
        chosen[str(int(track))] = {
            "t": when[picks].tolist(),
            "step": top / _FINE,
            "values": packed(radiance[picks].ravel() * (_FINE / top), "i2"),
        }
    paint = np.array([paints.get(int(v), "") for v in queries["vehicle_id"].values], dtype=object)
    classes = {}
    for name in sorted(set(paint.tolist()) - {""}):
        of = radiance[paint == name]
        classes[name] = {
            "count": len(of),
            "mean": _numbers(np.nanmean(of, axis=0)),
            "spread": _numbers(np.nanstd(of, axis=0)),
        }
    return {
        "wavelength_nm": _numbers(1e3 * queries["wavelength"].values),
        "tracks": chosen,
        "classes": classes,
    }


def _places(rows: xr.Dataset, middle: tuple) -> dict:
    """Positions in decimetres; a city up to 6.5 km across fits two bytes."""
    x, y = 10 * (rows["east"].values - middle[0]), 10 * (rows["north"].values - middle[1])
    return {"x": _whole(x), "y": _whole(y)}


def _whole(values: Array) -> dict:
    """Whole numbers in two bytes if they fit, else in four."""
    return packed(values, "i2" if np.abs(values).max(initial=0) < 2**15 - 1 else "i4")


def _in_time(rows: xr.Dataset, times_s: Array) -> tuple[xr.Dataset, dict]:
    """Rows in order of time, and how many there are at each."""
    when = _index(times_s, rows["time_s"].values)
    counts = np.bincount(when, minlength=len(times_s))
    return rows.isel(row=np.argsort(when, kind="stable")), packed(counts, "i4")


def _paints(tree: xr.DataTree) -> dict[int, str]:
    vehicles = _dataset(tree, "vehicles")
    if "paint" not in vehicles:
        return {}
    return dict(
        zip(vehicles["vehicle"].values.tolist(), map(str, vehicles["paint"].values.tolist()), strict=True)
    )


def _times(result: Result, names: list[str]) -> Array:
    for name in names:
        node = _dataset(result.tree, name)
        if "time" in node:
            return node["time"].values.astype(float)
    return np.array(result.film.get("times_s", []), dtype=float)


def _extent(result: Result) -> Extent:
    """West, south, east, north of the ground grid, or of the truth where no film says. [m]"""
    if result.film:
        return Extent(*result.film["extent_m"])
    truth = _dataset(result.tree, "truth")
    if not truth.sizes.get("row"):
        return Extent(-1.0, -1.0, 1.0, 1.0)
    x, y = truth["east"].values, truth["north"].values
    return Extent(float(x.min()), float(y.min()), float(x.max()) + 1.0, float(y.max()) + 1.0)


def _index(times_s: Array, time_s: Array) -> Array:
    """Index of the nearest time of each row."""
    if len(times_s) == 0:
        return np.zeros(len(time_s), int)
    edges = 0.5 * (times_s[1:] + times_s[:-1])
    return np.searchsorted(edges, time_s.astype(float))


def _dataset(tree: xr.DataTree | None, path: str) -> xr.Dataset:
    """A group of the result, empty where it is missing."""
    try:
        node = None if tree is None else tree[path]
    except KeyError:
        node = None
    return node.to_dataset(inherit=False) if isinstance(node, xr.DataTree) else xr.Dataset()


def _numbers(values) -> list:
    """Six significant digits; None for what is not finite."""
    return [_number(v) for v in np.asarray(values, dtype=float).ravel().tolist()]


def _number(value) -> float | None:
    return float(f"{float(value):.6g}") if math.isfinite(float(value)) else None
