"""Intervals of a study: scores by point and unit, estimates and their significance.

Every interval is over *units*, which all cases share: replicates if there are at least eight; else, for
scores over time, equal blocks of the flight. Cases stay paired, as they see the same traffic at one time: an
estimate takes only the units in which each of its cases has a score.
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
import warnings
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
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
        if series and len(replicates) < FEW_UNITS:  # else whole flights: blocks are not independent
            series = np.array(series, dtype=float)
            split = np.array_split(series, min(PARTS, len(series)))
            parts = np.array([np.nanmean(p) if np.isfinite(p).any() else np.nan for p in split])
        blocks[place[index], order[replicate]] = parts
    width = max((len(b) for b in blocks.values()), default=1)
    values = np.full((len(points), len(replicates), width), np.nan)
    for (k, r), parts in blocks.items():
        values[k, r, : len(parts)] = parts
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
    used = np.abs(fit) > _ROUNDING * np.abs(fit).max(axis=1, keepdims=True)
    missing = used.astype(float) @ ~np.isfinite(values) > 0
    each = np.where(missing, np.nan, np.where(used, fit, 0.0) @ np.nan_to_num(values))
    count = (~missing).sum(axis=1)
    drawn = mean_draws(each, rng)
    middle = _round_to_zero(drawn[0], values)
    if len(drawn) > 1:
        of = interval(drawn[1:], count)
        return Estimates(middle, *of, _p_max_t(middle, drawn[1:], count))
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # of a single unit, or none
        spread = np.nanstd(each, axis=1, ddof=1) / np.sqrt(count)
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
    """Means over all units, then over each draw of a bootstrap, if each point has enough units or none."""
    there = np.isfinite(values)
    held = there.sum(axis=1)
    count = values.shape[1]
    weights = np.ones((1, count))
    if held.any() and held[held > 0].min() >= FEW_UNITS:
        weights = np.concatenate([weights, rng.multinomial(count, np.full(count, 1 / count), DRAWS)])
    total = weights @ there.T
    return (weights @ np.where(there, values, 0).T) / np.where(total > 0, total, np.nan)


def interval(draws: Float[Array, "draw *out"], count: Int[Array, "out"] | None = None) -> tuple[Array, Array]:
    """Percentile interval of draws; NaN where they do not differ.

    Parameters
    ----------
    draws
        Draws of a bootstrap.
    count
        Number of units of each, to expand its interval to Student's width; else plain percentiles.
    """
    tail = (1 - CONFIDENCE) / 2
    with warnings.catch_warnings(), np.errstate(invalid="ignore", divide="ignore"):
        warnings.simplefilter("ignore", RuntimeWarning)  # of an estimate without any draw
        if count is None:
            low, high = np.nanquantile(draws, [tail, 1 - tail], axis=0)
        else:
            wide = stats.norm.sf(np.sqrt(count / (count - 1)) * stats.t.isf(tail, count - 1))
            ends = [np.nanquantile(d, [t, 1 - t]) for d, t in zip(draws.T, np.nan_to_num(wide), strict=True)]
            low, high = np.array(ends).T
    same = ~(high - low > _ROUNDING * np.maximum(np.abs(high), 1))
    return np.where(same, np.nan, low), np.where(same, np.nan, high)


def _p_max_t(value: Float[Array, "out"], draws: Float[Array, "draw out"], count: Int[Array, "out"]) -> Array:
    """Share of draws with a largest deviate about the estimates beyond that of each estimate about zero.

    The estimate's t is Student's: it is converted to the normal deviate of the same tail.
    """
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # of an estimate without any draw
        spread = np.nanstd(draws, axis=0, ddof=1)
    spread = np.where(spread > _ROUNDING * np.maximum(np.abs(value), 1), spread, np.nan)
    with np.errstate(invalid="ignore", divide="ignore"):
        largest = np.nan_to_num(np.abs(draws - value) / spread).max(axis=1)
        t = np.abs(value) / (spread * np.sqrt(count / (count - 1)))
    deviate = stats.norm.isf(stats.t.sf(t, count - 1))
    reached = (largest[:, None] >= deviate[None]).sum(axis=0)
    return np.where(np.isfinite(t), (1 + reached) / (1 + len(draws)), np.nan)
