"""Data of the report page as plain values: first screen, rows in base64, curves as lists.

The loss budget of the first screen is that of the channel in the verdict. Without one, its bars are the
completeness of each channel. Both are shares of all moving vehicles.
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
from glintrack.results.read import SCORE_LABELS, Result, dataset_at
from glintrack.results.verdict import CHANNEL_WORDS, budget_frames, select_channel, stage_shares

SPECTRA_PER_TRACK = 6
MAX_SPECTRA = 6_000
_FINE = 32_000  # steps of a track's brightest radiance
_CURVES = ("completeness", "purity", "false_tracks", "should", "valid", "queries_asked", "queries_served")
_BAR_SHARE = 0.3  # maximum length of the scale bar, of the window's width
_ARROW = 7.0  # length of the sun's arrow, of a plan 100 wide


@dataclass(frozen=True)
class BudgetBar:
    """Stage or channel with its label, its share of 100 moving vehicles, and whether it is the answer."""

    key: str
    label: str
    per_hundred: float
    last: bool = False


def budget_bars(result: Result) -> tuple[str, list[BudgetBar]]:
    """Caption and bars of the channel in the verdict, or of all channels without a loss budget."""
    name = select_channel(result.scores)
    if name is None or result.tree is None:
        return "", []
    stages = stage_shares(result.tree).get(name, {})
    if len(stages) > 1:
        labels = {stage: STAGE_LABELS.get(stage, stage.replace("_", " ")) for stage in stages}
        caption = (
            f"Loss budget of {CHANNEL_WORDS.get(name, name)}: of 100 moving vehicles, how many are left at "
            f"each stage. Measured on {budget_frames(result.tree)} only, so its last row can differ from the "
            "headline."
        )
        answer = list(stages)[-1]
    else:
        stages = {k: of.get("completeness", math.nan) for k, of in result.scores.items()}
        stages = {k: share for k, share in stages.items() if math.isfinite(share)}
        labels = {k: CHANNEL_WORDS.get(k, k) for k in stages}
        caption = "Of 100 moving vehicles, how many each channel tracks"
        answer = name
    return caption, [BudgetBar(k, labels[k], 100 * share, k == answer) for k, share in stages.items()]


def plan(extent_m: Extent, azimuth_deg: float | None, picture: str = "") -> dict:
    """Plan of the window, 100 units wide, with scale bar and direction of the sun.

    Parameters
    ----------
    extent_m
        West, south, east, north. [m]
    azimuth_deg
        Azimuth of the sun, clockwise from north. [°]
    picture
        Address of a picture of the window, if there is one.
    """
    wide, high = extent_m[2] - extent_m[0], extent_m[3] - extent_m[1]
    bar_m = round_length(_BAR_SHARE * wide)
    sun = None
    if azimuth_deg is not None:
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
    """Collect the data for the page's program.

    Rows are in order of time, ``per`` of them at each of ``times_s``; positions are in decimetres from the
    middle of ``extent_m``. Columns are base64 of little-endian numbers, see `encode`.
    """
    tree, extent = result.tree, _extent(result)
    times_s = np.array(result.film.get("times_s", []), dtype=float)
    for name in result.channels:
        times_s = dataset_at(tree, name)["time"].values.astype(float)
    out = {"name": result.name, "times_s": _numbers(times_s), "extent_m": list(extent)}
    out |= {"channels": {}, "truth": None, "vehicles": {}}
    if tree is None:
        return out
    middle = (0.5 * (extent[0] + extent[2]), 0.5 * (extent[1] + extent[3]))
    vehicles, paints = dataset_at(tree, "vehicles"), {}
    if "paint" in vehicles:
        names = map(str, vehicles["paint"].values.tolist())
        paints = dict(zip(vehicles["vehicle"].values.tolist(), names, strict=True))
    out["vehicles"] = {str(k): v for k, v in paints.items()}
    out["truth"] = _truth_rows(dataset_at(tree, "truth"), times_s, middle, extent)
    for name in result.channels:
        out["channels"][name] = _channel(tree, name, times_s, middle, paints)
    return out


def encode(values: Array, kind: str) -> dict:
    """Encode numbers as base64 of ``kind`` (``u1 u2 i2 i4 f4``, little-endian), clipped to its range."""
    dtype = np.dtype(f"<{kind}")
    if dtype.kind in "iu":
        limits = np.iinfo(dtype)
        values = np.clip(np.round(np.nan_to_num(values)), limits.min, limits.max)
    return {"kind": kind, "data": base64.b64encode(np.ascontiguousarray(values, dtype).tobytes()).decode()}


def _channel(tree: xr.DataTree, name: str, times_s: Array, middle: tuple, paints: dict) -> dict:
    node = dataset_at(tree, name)
    rows, queries, quality = (dataset_at(tree, f"{name}/{of}") for of in ("tracks", "queries", "quality"))
    count = rows.sizes.get("row", 0)
    return {
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
            k: {"values": _numbers(quality[k].values), "units": _format_units(quality[k])}
            for k in map(str, quality.data_vars)
        },
        "spectra": _spectra(queries, times_s, paints),
        "froc": _froc(dataset_at(tree, f"{name}/froc"), node),
    }


def _format_units(values: xr.DataArray) -> str:
    units = str(values.attrs.get("units", "1"))
    return units if units == "1" else units.replace("um-1", "µm-1").replace("-1", "⁻¹").replace("-2", "⁻²")


def _froc(swept: xr.Dataset, node: xr.Dataset) -> dict | None:
    """Points (false tracks per frame, completeness, label) of a threshold, and the flight's own."""
    if not {"completeness", "false_per_frame", "purity"} <= set(swept.data_vars):
        return None
    columns = ("threshold", "completeness", "false_per_frame", "purity")
    key = str(swept["threshold"].attrs.get("key", "threshold"))
    table = [list(row) for row in zip(*(_numbers(swept[c].values) for c in columns), strict=True)]
    own = [_number(node.attrs.get(k, math.nan)) for k in ("false_per_frame", "completeness")]
    points = [
        [false, completeness, f"{key} {threshold:g}"]
        for threshold, completeness, false, _ in table
        if completeness is not None and false is not None
    ]
    return {"points": points, "table": table, "key": key, "own": own if None not in own else None}


def _track_rows(rows: xr.Dataset, times_s: Array, middle: tuple) -> dict:
    if not rows.sizes.get("row"):
        return {"count": 0}
    rows, per = _in_time(rows, times_s)
    nothing = np.full(rows.sizes["row"], -1)
    get = {k: rows[k].values if k in rows else nothing for k in ("vehicle_id", "valid", "false", "status")}
    coasts = np.isin(get["status"], ["coasted", "stopped"])
    flags = coasts * 1 + (get["valid"] > 0) * 2 + (get["false"] > 0) * 4
    return {
        "count": rows.sizes["row"],
        "per": per,
        "id": _integers(rows["track_id"].values),
        "vehicle": _integers(get["vehicle_id"]),
        "flags": encode(flags, "u1"),
        **_places(rows, middle),
        "vx": encode(100 * rows["east_speed_m_s"].values, "i2"),
        "vy": encode(100 * rows["north_speed_m_s"].values, "i2"),
    }


def _truth_rows(truth: xr.Dataset, times_s: Array, middle: tuple, extent: tuple) -> dict:
    """Vehicles in the scored area; ``flags`` 1 for moving, 2 for visible."""
    if not truth.sizes.get("row"):
        return {"count": 0, "vehicles": 0}
    marked = truth["inside"].values if "inside" in truth else metrics.is_in_area(truth, extent)
    rows = truth.isel(row=np.flatnonzero(marked))
    rows, per = _in_time(rows, times_s)
    moving, seen = metrics.is_moving(rows), metrics.is_visible(rows)
    return {
        "count": rows.sizes["row"],
        "vehicles": len(np.unique(rows["vehicle_id"].values)),
        "per": per,
        "id": _integers(rows["vehicle_id"].values),
        "flags": encode(moving * 1 + seen * 2, "u1"),
        **_places(rows, middle),
    }


def _query_rows(queries: xr.Dataset, times_s: Array, middle: tuple) -> dict:
    if not queries.sizes.get("row"):
        return {"count": 0}
    queries, per = _in_time(queries, times_s)
    return {
        "count": queries.sizes["row"],
        "per": per,
        "id": _integers(queries["track_id"].values),
        **_places(queries, middle),
    }


def _spectra(queries: xr.Dataset, times_s: Array, paints: dict[int, str]) -> dict:
    """Select a few spectra of each track, and compute mean and spread of all spectra of each paint."""
    if not queries.sizes.get("row"):
        return {"wavelength_nm": [], "tracks": {}, "classes": {}}
    radiance, ids = queries["radiance"].values, queries["track_id"].values
    when = _index(times_s, queries["time_s"].values)
    chosen: dict[str, dict] = {}
    left = MAX_SPECTRA
    for track in np.unique(ids[ids >= 0]):
        mine = np.flatnonzero(ids == track)
        picks = mine[np.unique(np.linspace(0, len(mine) - 1, SPECTRA_PER_TRACK).round().astype(int))][:left]
        left -= len(picks)
        top = float(np.nanmax(np.abs(radiance[picks]), initial=1e-9))
        chosen[str(int(track))] = {
            "t": when[picks].tolist(),
            "step": top / _FINE,
            "values": encode(radiance[picks].ravel() * (_FINE / top), "i2"),
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
    """Positions in decimetres."""
    x, y = 10 * (rows["east_m"].values - middle[0]), 10 * (rows["north_m"].values - middle[1])
    return {"x": _integers(x), "y": _integers(y)}


def _integers(values: Array) -> dict:
    """Integers in two bytes if they fit, else in four."""
    return encode(values, "i2" if np.abs(values).max(initial=0) < 2**15 - 1 else "i4")


def _in_time(rows: xr.Dataset, times_s: Array) -> tuple[xr.Dataset, dict]:
    """Rows in order of time, and their number at each time."""
    when = _index(times_s, rows["time_s"].values)
    counts = np.bincount(when, minlength=len(times_s))
    return rows.isel(row=np.argsort(when, kind="stable")), encode(counts, "i4")


def _extent(result: Result) -> Extent:
    """West, south, east, north of the ground grid, or of the truth without a film. [m]"""
    if result.film:
        return Extent(*result.film["extent_m"])
    truth = dataset_at(result.tree, "truth")
    if not truth.sizes.get("row"):
        return Extent(-1.0, -1.0, 1.0, 1.0)
    x, y = truth["east_m"].values, truth["north_m"].values
    return Extent(float(x.min()), float(y.min()), float(x.max()) + 1.0, float(y.max()) + 1.0)


def _index(times_s: Array, time_s: Array) -> Array:
    """Index of the nearest time of each row."""
    if len(times_s) == 0:
        return np.zeros(len(time_s), int)
    edges = 0.5 * (times_s[1:] + times_s[:-1])
    return np.searchsorted(edges, time_s.astype(float))


def _numbers(values) -> list:
    """Numbers with six significant digits; None if not finite."""
    return [_number(v) for v in np.asarray(values, dtype=float).ravel().tolist()]


def _number(value) -> float | None:
    return float(f"{float(value):.6g}") if math.isfinite(float(value)) else None
