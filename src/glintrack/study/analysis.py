"""Analysis of a study: effects and interactions, Sobol indices, Pareto front, pan against DoLP, ROC.

Every interval is over *units*, which all cases share: replicates, and for scores kept over time the flight's
length in equal blocks. Cases stay paired, as they see the same traffic at one time. It is a percentile
bootstrap where there are enough units to draw from, else Student's: draws from three replicates would never
leave the range of the three. Blocks next to each other are not independent, so that intervals from a single
flight are on the narrow side.
"""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import itertools
import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy import stats

from glintrack.arrays import Array
from glintrack.metrics.requirement import CONFIDENCE, PARTS

DRAWS = 2000
_ROUNDING = 1e-12
FEW_UNITS = 8  # under which a percentile bootstrap holds the truth less than nine times of ten


@dataclass(frozen=True)
class Units:
    """A score by point of the design and by unit that the bootstrap draws.

    Parameters
    ----------
    points
        Design points in order, one row each, with their levels.
    values
        Score of each point in each unit; NaN where there is none.
    """

    points: pd.DataFrame
    values: Float[Array, "point unit"]


def units(table: pd.DataFrame, axes: Sequence[str], response: str, channel: str) -> Units:
    """Score of one channel by point and unit; failed and missing cases are left out."""
    mine = table[(table["channel"] == channel) & (table["status"] == "finished")]
    if response not in mine:
        raise ValueError(f"`response` must be a score of the study, got {response!r}")
    replicates = sorted(set(mine["replicate"]))
    order = {r: k for k, r in enumerate(replicates)}
    # points of one design row differ in the replicate only
    row = mine["point"] // max(len(set(table["replicate"])), 1)
    points = mine[list(axes)].groupby(row.to_numpy()).first()
    place = {index: k for k, index in enumerate(points.index)}
    blocks: dict[tuple[int, int], Array] = {}
    for index, replicate, mean, text in zip(
        row, mine["replicate"], mine[response], mine["over_time"], strict=True
    ):
        series = json.loads(text).get(response)
        parts = [mean] if series is None else _blocks(np.array(series, dtype=float))
        blocks[place[index], order[replicate]] = np.array(parts, dtype=float)
    width = max((len(b) for b in blocks.values()), default=1)
    values = np.full((len(points), len(replicates), width), np.nan)
    for (k, r), parts in blocks.items():
        values[k, r, : len(parts)] = parts
    return Units(points.reset_index(drop=True), values.reshape(len(points), -1))


def _blocks(series: Array) -> list[float]:
    parts = np.array_split(series, min(PARTS, len(series)))
    return [float(np.nanmean(p)) if np.isfinite(p).any() else np.nan for p in parts]


def effects(found: Units, rng: np.random.Generator, interactions: bool = False) -> pd.DataFrame:
    """Main effects: how much the score changes from an axis's first value to each other, or over a range.

    Parameters
    ----------
    found
        Of one score.
    rng
        Of the bootstrap.
    interactions
        Whether products of two axes are fitted too; they then stand beside the main effects, which are those
        at the first values of all other axes.

    Returns
    -------
    ``axis``, ``level``, ``effect``, ``low``, ``high`` of the coefficients of a least-squares fit; none that
    the design does not determine. In a full factorial these are the differences of marginal means, in a
    one-at-a-time design those from the base.
    """
    columns, names = _regressors(found.points)
    if interactions:
        columns, names = _with_products(columns, names)
    if not names:
        return pd.DataFrame(columns=["axis", "level", "effect", "low", "high"])
    design = np.column_stack([np.ones(len(found.points)), *columns])
    if np.linalg.matrix_rank(design) < design.shape[1]:
        return pd.DataFrame(columns=["axis", "level", "effect", "low", "high"])
    effect, low, high = _estimate(np.linalg.pinv(design)[1:], found.values, rng)
    axis, level = zip(*names, strict=True)
    return pd.DataFrame({"axis": axis, "level": level, "effect": effect, "low": low, "high": high})


def _regressors(points: pd.DataFrame) -> tuple[list[Array], list[tuple[str, str]]]:
    """Dummies of each value but the first of an axis with few, the place in its range of one with many."""
    columns, names = [], []
    for axis in points:
        column = points[axis]
        levels = list(dict.fromkeys(column))
        numeric = pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column)
        if numeric and len(levels) > max(8, len(points) // 4):
            low, high = float(column.min()), float(column.max())
            columns.append((column.to_numpy(dtype=float) - low) / (high - low))
            names.append((str(axis), f"{low:.4g} to {high:.4g}"))
            continue
        for level in levels[1:]:
            columns.append((column == level).to_numpy(dtype=float))
            names.append((str(axis), f"{level} against {levels[0]}"))
    return columns, names


def _with_products(
    columns: list[Array], names: list[tuple[str, str]]
) -> tuple[list[Array], list[tuple[str, str]]]:
    more, called = list(columns), list(names)
    for (a, first), (b, second) in itertools.combinations(zip(columns, names, strict=True), 2):
        if first[0] != second[0]:
            more.append(a * b)
            called.append((f"{first[0]} × {second[0]}", f"{first[1]} and {second[1]}"))
    return more, called


def _estimate(
    fit: Float[Array, "out point"], values: Float[Array, "point unit"], rng: np.random.Generator
) -> tuple[Array, Array, Array]:
    """Linear combinations of the points' means over units, with their intervals."""
    if values.shape[1] >= FEW_UNITS:
        drawn = _bootstrap_means(values, rng) @ fit.T
        return drawn[0], *_interval(drawn[1:])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a point without any score stays NaN
        middle = fit @ np.nanmean(values, axis=1)
    each = fit @ values[:, np.isfinite(values).all(axis=0)]
    count = each.shape[1]
    if count < 2:
        return middle, np.full(len(middle), np.nan), np.full(len(middle), np.nan)
    spread = each.std(axis=1, ddof=1) / math.sqrt(count)
    reach = np.where(
        spread > _ROUNDING * np.maximum(np.abs(middle), 1),
        stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1) * spread,
        np.nan,
    )
    return middle, middle - reach, middle + reach


def _bootstrap_means(values: Float[Array, "point unit"], rng: np.random.Generator) -> Array:
    """(1 + draws, point) means over units: of all first, then of each draw."""
    count = values.shape[1]
    drawn = rng.multinomial(count, np.full(count, 1 / count), DRAWS)
    weights = np.concatenate([np.ones((1, count)), drawn])
    there = np.isfinite(values)
    total = weights @ there.T
    with np.errstate(invalid="ignore"):
        return (weights @ np.where(there, values, 0).T) / np.where(total > 0, total, np.nan)


def _interval(draws: Array) -> tuple[Array, Array]:
    """Percentile interval; NaN where draws do not differ, as with a single unit."""
    tail = (1 - CONFIDENCE) / 2
    with np.errstate(invalid="ignore"):
        low, high = np.nanquantile(draws, [tail, 1 - tail], axis=0)
    # what is the same in every draw comes out of the fit with its rounding
    same = ~(high - low > _ROUNDING * np.maximum(np.abs(high), 1))
    return np.where(same, np.nan, low), np.where(same, np.nan, high)


def sobol_indices(found: Units, axes: Sequence[str], rng: np.random.Generator) -> pd.DataFrame:
    """First-order and total indices of a Saltelli design: shares of the score's variance.

    Parameters
    ----------
    found
        In the order of `axes.unit_points`: A, B, then A with each axis from B.
    axes
        All that were varied.
    rng
        Of the bootstrap, which draws samples here, not units.

    Returns
    -------
    ``axis``, ``first``, ``first_low``, ``first_high``, ``total``, ``total_low``, ``total_high``.

    References
    ----------
    Saltelli et al., Comput. Phys. Commun. 181, 259 (2010), Table 2: (b) first order, (f) total (Jansen).
    """
    width = len(axes) + 2
    y = np.nanmean(found.values, axis=1)
    if len(y) % width:
        raise ValueError(f"`study` must have all its points finished for Sobol indices, got {len(y)} of them")
    y = y.reshape(-1, width)
    y = y[np.isfinite(y).all(axis=1)]
    draws = np.concatenate([np.arange(len(y))[None], rng.integers(0, len(y), (DRAWS, len(y)))])
    first, total = [], []
    for k in range(len(axes)):
        a, b, mixed = y[draws, 0], y[draws, 1], y[draws, 2 + k]
        variance = np.concatenate([a, b], axis=1).var(axis=1)
        with np.errstate(invalid="ignore", divide="ignore"):
            first.append((b * (mixed - a)).mean(axis=1) / variance)
            total.append(0.5 * ((a - mixed) ** 2).mean(axis=1) / variance)
    out = {"axis": list(axes)}
    for name, values in (("first", np.array(first).T), ("total", np.array(total).T)):
        low, high = _interval(values[1:])
        out |= {name: values[0], f"{name}_low": low, f"{name}_high": high}
    return pd.DataFrame(out)


def pareto_front(cost: Float[Array, "n"], gain: Float[Array, "n"]) -> Bool[Array, "n"]:
    """Which designs no other beats in both: none costs less and gains as much, or gains more at that cost."""
    cost, gain = np.asarray(cost, dtype=float), np.asarray(gain, dtype=float)
    no_dearer = cost[None] <= cost[:, None]
    no_worse = gain[None] >= gain[:, None]
    better = (cost[None] < cost[:, None]) | (gain[None] > gain[:, None])
    return np.isfinite(cost + gain) & ~(no_dearer & no_worse & better).any(axis=1)


def point_scores(
    table: pd.DataFrame, axes: Sequence[str], response: str, channel: str, rng: np.random.Generator
) -> pd.DataFrame:
    """Score of each finished point of the design, whatever the design.

    Returns
    -------
    ``point`` (its levels, or what it differs in from the first one, ``base``), ``score``, ``low``, ``high``.
    """
    found = units(table, axes, response, channel)
    score, low, high = _estimate(np.eye(len(found.points)), found.values, rng)
    return pd.DataFrame({"point": _labels(found.points), "score": score, "low": low, "high": high})


def channel_gain(
    table: pd.DataFrame, axes: Sequence[str], response: str, rng: np.random.Generator
) -> pd.DataFrame:
    """DoLP's score less pan's, point by point over the same light, traffic and noise, and over all points.

    Returns
    -------
    ``point`` (what it differs in from the first one, ``base``), ``gain``, ``low``, ``high``; the last row,
    ``all``, is the mean over points.
    """
    done = table[table["status"] == "finished"]
    both = set(done["point"][done["channel"] == "pan"]) & set(done["point"][done["channel"] == "dolp"])
    table = table.loc[table["point"].isin(both)]
    pan, dolp = (units(table, axes, response, channel) for channel in ("pan", "dolp"))
    difference = dolp.values - pan.values
    difference = np.vstack([difference, np.nanmean(difference, axis=0)])
    gain, low, high = _estimate(np.eye(len(difference)), difference, rng)
    labels = _labels(pan.points)
    return pd.DataFrame({"point": [*labels, "all"], "gain": gain, "low": low, "high": high})


def _labels(points: pd.DataFrame) -> list[str]:
    rows = points.to_dict("records")
    if points.shape[1] == 1:  # one axis, or the labels of a list: its level says all
        return [str(next(iter(row.values()))) for row in rows]
    told = [", ".join(f"{k} = {v}" for k, v in row.items() if v != rows[0][k]) for row in rows]
    return [label or "base" for label in told]


def roc(table: pd.DataFrame, axes: Sequence[str], swept: str = "track.detect.threshold") -> pd.DataFrame:
    """Completeness against false tracks as a threshold sweeps, one curve for each group of other levels.

    Returns
    -------
    ``group``, ``channel``, the threshold, ``false_per_epoch``, ``completeness``, means over replicates,
    along each curve by rising threshold; empty if the study does not vary the threshold.
    """
    if swept not in axes:
        return pd.DataFrame(columns=["group", "channel", swept, "false_per_epoch", "completeness"])
    done = table[table["status"] == "finished"].copy()
    others = [axis for axis in axes if axis != swept]
    done["group"] = [", ".join(f"{a} = {row[a]}" for a in others) for row in done.to_dict("records")]
    scores = ["false_per_epoch", "completeness"]
    return done.groupby(["group", "channel", swept], sort=True)[scores].mean().reset_index()
