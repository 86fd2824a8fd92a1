"""Intervals of a study: scores by point and unit, estimates and their significance.

Every interval is over *units*, which all cases share: replicates if there are at least eight; else, for
scores over time, equal blocks of the flight. Cases stay paired, as they see the same traffic at one time.
Intervals are expanded percentiles of a bootstrap [Hesterberg 2015], of Student's width for normal scores;
with fewer than eight units Student's own. Successive blocks are correlated, so that intervals from a single
flight are too narrow.

The significance of many rows of one table is tested together by the largest |t| [Westfall and Young 1993]:
`Estimates.p_max_t`.

References
----------
Hesterberg, Am. Stat. 69, 371 (2015). Westfall and Young, Resampling-Based Multiple Testing (Wiley, 1993).
"""

import json
import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from glintrack.core.arrays import Array
from glintrack.metrics.requirement import CONFIDENCE, PARTS

DRAWS = 4000
FEW_UNITS = 8  # below which the coverage of a bootstrap is under 90 %
_ROUNDING = 1e-12


@dataclass(frozen=True)
class Units:
    """Score by point of the design and by unit of the bootstrap.

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
        raise ValueError(f"`response` must be a score of the study; got {response!r}.")
    replicates = sorted(set(table["replicate"]))
    order = {r: k for k, r in enumerate(replicates)}
    # points of one design row differ in the replicate only
    row = mine["point"] // max(len(replicates), 1)
    points = mine[list(axes)].set_axis(row.to_numpy())
    points = points[~points.index.duplicated()]
    place = {index: k for k, index in enumerate(points.index)}
    blocks: dict[tuple[int, int], Array] = {}
    for index, replicate, mean, text in zip(
        row, mine["replicate"], mine[response], mine["over_time"], strict=True
    ):
        series = json.loads(text).get(response)
        parts = np.array([mean], dtype=float)
        if series:
            series = np.array(series, dtype=float)
            split = np.array_split(series, min(PARTS, len(series)))
            parts = np.array([np.nanmean(p) if np.isfinite(p).any() else np.nan for p in split])
        blocks[place[index], order[replicate]] = parts
    width = max((len(b) for b in blocks.values()), default=1)
    values = np.full((len(points), len(replicates), width), np.nan)
    for (k, r), parts in blocks.items():
        values[k, r, : len(parts)] = parts
    if len(replicates) >= FEW_UNITS:  # whole flights are drawn: their blocks are not independent
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # a replicate without any score stays NaN
            values = np.nanmean(values, axis=2, keepdims=True)
    return Units(points.reset_index(drop=True), values.reshape(len(points), -1))


@dataclass(frozen=True)
class Estimates:
    """Linear combinations of points' means over units.

    Parameters
    ----------
    value
        Estimates over all units.
    low, high
        Interval of 95 %; NaN where units do not differ, as with a single one.
    p_max_t
        Probability that chance alone would give any of them so large a |t|; NaN where there is no interval.
    """

    value: Float[Array, "out"]
    low: Float[Array, "out"]
    high: Float[Array, "out"]
    p_max_t: Float[Array, "out"]

    def to_frame(self) -> pd.DataFrame:
        """Columns ``effect``, ``low``, ``high``, ``p_max_t``."""
        return pd.DataFrame(vars(self)).rename(columns={"value": "effect"})


def estimate(
    fit: Float[Array, "out point"], values: Float[Array, "point unit"], rng: np.random.Generator
) -> Estimates:
    """Linear combinations of the points' means over units, with their intervals.

    Parameters
    ----------
    fit
        Weights of the points in each combination.
    values
        Scores; NaN where there is none.
    rng
        Random generator of the bootstrap.
    """
    if values.shape[1] >= FEW_UNITS:
        drawn, count = mean_draws(values, rng) @ fit.T, values.shape[1]
        of = interval(drawn[1:], count)
        return Estimates(_round_to_zero(drawn[0], values), *of, _p_max_t(drawn[0], drawn[1:], count))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # a point without any score stays NaN
        middle = _round_to_zero(fit @ np.nanmean(values, axis=1), values)
    each = fit @ values[:, np.isfinite(values).all(axis=0)]
    count = each.shape[1]
    if count < 2:
        none = np.full(len(middle), np.nan)
        return Estimates(middle, none, none, none)
    spread = each.std(axis=1, ddof=1) / math.sqrt(count)
    differs = spread > _ROUNDING * np.maximum(np.abs(middle), 1)
    spread = np.where(differs, spread, np.nan)
    reach = stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1) * spread
    # Bonferroni's bound: so few units give no joint distribution to draw from
    p = np.minimum(2 * stats.t.sf(np.abs(middle) / spread, count - 1) * differs.sum(), 1)
    return Estimates(middle, middle - reach, middle + reach, p)


def _round_to_zero(of: Float[Array, "out"], values: Float[Array, "point unit"]) -> Float[Array, "out"]:
    """Estimates, with 0 for rounding errors of the scores."""
    largest = np.nanmax(np.abs(values), initial=0.0)
    return np.where(np.abs(of) <= _ROUNDING * largest, 0.0, of)


def mean_draws(values: Float[Array, "point unit"], rng: np.random.Generator) -> Float[Array, "draw point"]:
    """Means over all units, then over each draw of a bootstrap, if there are enough units."""
    count = values.shape[1]
    if count < FEW_UNITS:
        return np.nanmean(values, axis=1)[None]
    drawn = rng.multinomial(count, np.full(count, 1 / count), DRAWS)
    weights = np.concatenate([np.ones((1, count)), drawn])
    there = np.isfinite(values)
    total = weights @ there.T
    with np.errstate(invalid="ignore"):
        return (weights @ np.where(there, values, 0).T) / np.where(total > 0, total, np.nan)


def interval(draws: Float[Array, "draw *out"], count: int | None = None) -> tuple[Array, Array]:
    """Percentile interval of draws; NaN where they do not differ.

    Parameters
    ----------
    draws
        Draws of a bootstrap.
    count
        Number of units, to expand the interval to Student's width; else plain percentiles.
    """
    tail = (1 - CONFIDENCE) / 2
    if count is not None:
        tail = stats.norm.sf(math.sqrt(count / (count - 1)) * stats.t.isf(tail, count - 1))
    with np.errstate(invalid="ignore"):
        low, high = np.nanquantile(draws, [tail, 1 - tail], axis=0)
    same = ~(high - low > _ROUNDING * np.maximum(np.abs(high), 1))
    return np.where(same, np.nan, low), np.where(same, np.nan, high)


def _p_max_t(value: Float[Array, "out"], draws: Float[Array, "draw out"], count: int) -> Array:
    """Share of draws with a largest deviate about the estimates beyond that of each estimate about zero.

    The estimate's t is Student's: it is converted to the normal deviate of the same tail.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of an estimate without any draw
        spread = np.nanstd(draws, axis=0, ddof=1)
    spread = np.where(spread > _ROUNDING * np.maximum(np.abs(value), 1), spread, np.nan)
    with np.errstate(invalid="ignore"):
        largest = np.nan_to_num(np.abs(draws - value) / spread).max(axis=1)
    t = np.abs(value) / (spread * math.sqrt(count / (count - 1)))
    deviate = stats.norm.isf(stats.t.sf(t, count - 1))
    reached = (largest[:, None] >= deviate[None]).sum(axis=0)
    return np.where(np.isfinite(t), (1 + reached) / (1 + len(draws)), np.nan)
