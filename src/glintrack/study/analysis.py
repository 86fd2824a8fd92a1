"""Analysis of a study: effects and interactions, Sobol indices, Pareto front, pan against DoLP, ROC."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import itertools
from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.study.intervals import DRAWS, Estimates, Units, estimated, interval, units

_EFFECT_COLUMNS = ("axis", "level", "effect", "low", "high", "p_max_t")


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
    ``axis``, ``level``, ``effect``, ``low``, ``high``, ``p_max_t`` of the coefficients of a least-squares
    fit; none that the design does not determine. In a full factorial these are the differences of marginal
    means, in a one-at-a-time design those from the base.
    """
    columns, names = _regressors(found.points)
    if interactions:
        columns, names = _with_products(columns, names)
    if not names:
        return pd.DataFrame(columns=_EFFECT_COLUMNS)
    design = np.column_stack([np.ones(len(found.points)), *columns])
    if np.linalg.matrix_rank(design) < design.shape[1]:
        return pd.DataFrame(columns=_EFFECT_COLUMNS)
    of = estimated(np.linalg.pinv(design)[1:], found.values, rng)
    axis, level = zip(*names, strict=True)
    return pd.DataFrame(dict(zip(_EFFECT_COLUMNS, (axis, level, *_columns(of)), strict=True)))


def _columns(of: Estimates) -> tuple[Array, Array, Array, Array]:
    return of.value, of.low, of.high, of.p_max_t


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
        low, high = interval(values[1:])
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
    of = estimated(np.eye(len(found.points)), found.values, rng)
    return pd.DataFrame({"point": labels(found.points), "score": of.value, "low": of.low, "high": of.high})


def labels(points: pd.DataFrame) -> list[str]:
    """What each point differs in from the first one, ``base``; its level where there is a single axis."""
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
