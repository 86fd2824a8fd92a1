"""Analysis of a study: effects and interactions, Sobol indices, Pareto front, FROC, and a surrogate.

The surrogate of a sampled study is a quadratic response surface that predicts the score of a flight:

y = β₀ + Σ βᵢ xᵢ + Σ βᵢⱼ xᵢ xⱼ + e by least squares, with each x from −1 to 1 over the range of the study and
the error e of single flights from traffic, noise and misfit. The interval of a new flight is Student's,

ŷ ± t(n − p) s √(1 + xᵀ(XᵀX)⁻¹x),

for n flights and p coefficients. Its coverage is counted by cross-validation.

References
----------
Box and Draper, Response Surfaces, Mixtures, and Ridge Analyses (Wiley, 2007), Section 3.
"""

import itertools
import math
from collections.abc import Container, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float, Int
from scipy import stats

from glintrack.core.arrays import Array
from glintrack.study.intervals import DRAWS, Units, estimate, interval, units

LEVEL = 0.90  # of a prediction
FOLDS = 10
PLACES = 9  # along each axis
CHANCE = ("seed", "scene.seed", "flight.start_s")  # keys that differ between flights of one design
_MIN_LEVELS = 8  # of a continuous axis
_MIN_FLIGHTS_PER_TERM = 1.5


def effects(found: Units, rng: np.random.Generator, interactions: bool = False) -> pd.DataFrame:
    """Estimate main effects: change of the score from an axis's first value to each other, or over a range.

    Parameters
    ----------
    found
        Values of one score.
    rng
        Random generator of the bootstrap.
    interactions
        Whether to fit products of two axes too; main effects are then those at the first values of all other
        axes.

    Returns
    -------
    ``axis``, ``level``, ``effect``, ``low``, ``high``, ``p_max_t`` of the coefficients of a least-squares
    fit; empty if the design does not determine them. In a full factorial these are the differences of
    marginal means, in a one-at-a-time design those from the base.
    """
    scored = np.isfinite(found.values).any(axis=1)
    points, values = found.points[scored], found.values[scored]
    regressors = _regressors(points)
    if interactions:
        regressors += [
            _Regressor(f"{a.axis} × {b.axis}", f"{a.level} and {b.level}", a.column * b.column)
            for a, b in itertools.combinations(regressors, 2)
            if a.axis != b.axis
        ]
    design = np.column_stack([np.ones(len(points)), *(one.column for one in regressors)])
    if not regressors or np.linalg.matrix_rank(design) < design.shape[1]:
        return pd.DataFrame(columns=["axis", "level", "effect", "low", "high", "p_max_t"])
    of = estimate(np.linalg.pinv(design)[1:], values, rng)
    named = pd.DataFrame([(one.axis, one.level) for one in regressors], columns=["axis", "level"])
    return named.join(of.to_frame())


class _Regressor(NamedTuple):
    """Column of the least-squares fit, and the axis and change of its coefficient."""

    axis: str
    level: str
    column: Array


def _regressors(points: pd.DataFrame) -> list[_Regressor]:
    """Dummies of each value but the first of an axis with few values; the place in the range of others."""
    out = []
    for axis in points:
        column = points[axis]
        levels = list(dict.fromkeys(column))
        if _is_numeric(column) and len(levels) > max(8, len(points) // 4):
            low, high = float(column.min()), float(column.max())
            place = (column.to_numpy(dtype=float) - low) / (high - low)
            out.append(_Regressor(str(axis), f"{low:.4g} to {high:.4g}", place))
            continue
        for level in levels[1:]:
            out.append(
                _Regressor(str(axis), f"{level} against {levels[0]}", (column == level).to_numpy(dtype=float))
            )
    return out


def _is_numeric(column: pd.Series) -> bool:
    return pd.api.types.is_numeric_dtype(column) and not pd.api.types.is_bool_dtype(column)


def sobol_indices(found: Units, axes: Sequence[str], rng: np.random.Generator) -> pd.DataFrame:
    """First-order and total Sobol indices of a Saltelli design: shares of the score's variance.

    Parameters
    ----------
    found
        Values in the order of `design.unit_points`: A, B, then A with each axis from B.
    axes
        All axes that were varied.
    rng
        Random generator of the bootstrap, which draws samples here, not units.

    Returns
    -------
    ``axis``, ``first``, ``first_low``, ``first_high``, ``total``, ``total_low``, ``total_high``.

    Notes
    -----
    `scipy.stats.sobol_indices` has the same estimators, but takes a power of two of samples only, which a
    study with a failed case has not, and its bootstrap takes no generator.

    References
    ----------
    Saltelli et al., Comput. Phys. Commun. 181, 259 (2010), Table 2: (b) first order, (f) total (Jansen).
    """
    width = len(axes) + 2
    y = np.nanmean(found.values, axis=1)
    if len(y) % width:
        raise ValueError(f"`study` must have all its points finished for Sobol indices; got {len(y)}.")
    y = y.reshape(-1, width)
    y = y[np.isfinite(y).all(axis=1)]
    y = y - y[:, :2].mean()  # the estimators' error grows with the mean
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
    """Return True for each design that no other equals at lower cost, or exceeds at no higher cost."""
    cost, gain = np.asarray(cost, dtype=float), np.asarray(gain, dtype=float)
    no_dearer = cost[None] <= cost[:, None]
    no_worse = gain[None] >= gain[:, None]
    better = (cost[None] < cost[:, None]) | (gain[None] > gain[:, None])
    return np.isfinite(cost + gain) & ~(no_dearer & no_worse & better).any(axis=1)


def point_scores(
    table: pd.DataFrame, axes: Sequence[str], response: str, channel: str, rng: np.random.Generator
) -> pd.DataFrame:
    """Score of each finished point of a design.

    Returns
    -------
    ``point`` (its label), ``score``, ``low``, ``high``.
    """
    found = units(table, axes, response, channel)
    of = estimate(np.eye(len(found.points)), found.values, rng)
    names = labels(found.points, table.sort_values("point")[list(axes)])
    return pd.DataFrame({"point": names, "score": of.value, "low": of.low, "high": of.high})


def labels(points: pd.DataFrame, all_points: pd.DataFrame | None = None) -> list[str]:
    """Label of each point: the level of a single axis, or its differences from the first of all, ``base``."""
    rows = points.to_dict("records")
    first = (points if all_points is None else all_points).head(1).to_dict("records")
    if points.shape[1] == 1:  # one axis, or the labels of a list
        return [str(next(iter(row.values()))) for row in rows]
    changes = [", ".join(f"{k} = {v}" for k, v in row.items() if v != first[0][k]) for row in rows]
    return [label or "base" for label in changes]


def froc(
    table: pd.DataFrame, axes: Sequence[str], swept: str = "track.reporting.max_false_share"
) -> pd.DataFrame:
    """Completeness against false tracks over a threshold, one curve for each group of other levels.

    Returns
    -------
    ``group``, ``channel``, the threshold, ``false_per_frame``, ``completeness``, means over replicates,
    along each curve by rising threshold; empty if the study does not vary the threshold.
    """
    if swept not in axes:
        return pd.DataFrame(columns=["group", "channel", swept, "false_per_frame", "completeness"])
    done = table[table["status"] == "finished"].copy()
    others = [axis for axis in axes if axis != swept]
    done["group"] = [", ".join(f"{a} = {row[a]}" for a in others) for row in done.to_dict("records")]
    scores = ["false_per_frame", "completeness"]
    return done.groupby(["group", "channel", swept], sort=True)[scores].mean().reset_index()


@dataclass(frozen=True)
class ResponseSurface:
    """Fitted response surface.

    Parameters
    ----------
    axes, low, high, log
        Names of the axes, their ranges, and whether x is even in the logarithm.
    quadratic
        Whether squares and products are terms.
    coefficients, root, sigma, freedom
        β; R of X = QR; standard deviation s of a flight about the surface; n − p.
    """

    axes: tuple[str, ...]
    low: Float[Array, "axis"]
    high: Float[Array, "axis"]
    log: tuple[bool, ...]
    quadratic: bool
    coefficients: Float[Array, "term"]
    root: Float[Array, "term term"]
    sigma: float
    freedom: int

    def predict(self, at: Float[Array, "n axis"], level: float = LEVEL) -> tuple[Array, Array, Array]:
        """Score of a new flight at each place, and its prediction interval.

        Parameters
        ----------
        at
            Values of the axes.
        level
            Coverage of the interval, 0 to 1.
        """
        x = _terms(at, (self.low, self.high), self.log, self.quadratic)
        middle = x @ self.coefficients
        leverage = (np.linalg.solve(self.root.T, x.T) ** 2).sum(axis=0)
        reach = stats.t.ppf(0.5 + level / 2, self.freedom) * self.sigma * np.sqrt(1 + leverage)
        return middle, middle - reach, middle + reach

    def to_values(self) -> dict[str, Any]:
        """Plain values for a page's program; ``whitening`` is R⁻ᵀ, and ``reach`` t s of `LEVEL`."""
        return {
            "quadratic": self.quadratic,
            "coefficients": self.coefficients.tolist(),
            "whitening": np.linalg.inv(self.root).T.tolist(),
            "reach": float(stats.t.ppf(0.5 + LEVEL / 2, self.freedom) * self.sigma),
        }

    def along(self, axis: int) -> pd.DataFrame:
        """Predictions along one axis, the others at the middle of their ranges."""
        even, geometric = (self.low + self.high) / 2, np.sqrt(np.abs(self.low * self.high))
        at = np.tile(np.where(self.log, geometric, even), (PLACES, 1))
        space = np.geomspace if self.log[axis] else np.linspace
        at[:, axis] = space(self.low[axis], self.high[axis], PLACES)
        predicted, low, high = self.predict(at)
        columns = {"value": at[:, axis], "predicted": predicted, "low": low, "high": high}
        return pd.DataFrame({"axis": self.axes[axis], **columns})


def _terms(
    at: Float[Array, "n axis"], ends: tuple[Array, Array], log: Sequence[bool], quadratic: bool
) -> Float[Array, "n term"]:
    """Terms of the surface, with each axis from −1 to 1 between the ends."""
    with np.errstate(divide="ignore", invalid="ignore"):  # of axes that are not even in the logarithm
        at, low, high = (np.where(log, np.log(v), v) for v in (at, *ends))
    x = 2 * (at - low) / (high - low) - 1
    pairs = itertools.combinations_with_replacement(range(x.shape[1]), 2) if quadratic else ()
    return np.stack([np.ones(len(x)), *x.T, *(x[:, i] * x[:, j] for i, j in pairs)], axis=-1)


def continuous_axes(points: pd.DataFrame) -> list[str]:
    """Axes with numbers of enough values for a surface; without seeds."""
    return [
        str(name)
        for name in points
        if name not in CHANCE and _is_numeric(points[name]) and points[name].nunique() > _MIN_LEVELS
    ]


def fit_surface(
    axes: Sequence[str],
    at: Float[Array, "flight axis"],
    score: Float[Array, "flight"],
    even_in_log: Container[str] = (),
) -> ResponseSurface | None:
    """Fit a surface by least squares: with squares and products if there are enough flights, else linear.

    Parameters
    ----------
    axes, at, score
        Names of the axes, their values in each flight, and its score.
    even_in_log
        Axes with x even in the logarithm of their values.

    Returns
    -------
    None if the flights do not determine a linear surface.
    """
    low, high = at.min(axis=0), at.max(axis=0)
    log = tuple(name in even_in_log for name in axes)
    for quadratic in (True, False):
        x = _terms(at, (low, high), log, quadratic)
        flights, terms = x.shape
        if flights < _MIN_FLIGHTS_PER_TERM * terms or np.linalg.matrix_rank(x) < terms:
            continue
        q, root = np.linalg.qr(x)
        coefficients = np.linalg.solve(root, q.T @ score)
        freedom = flights - terms
        sigma = math.sqrt(((score - x @ coefficients) ** 2).sum() / freedom)
        return ResponseSurface(
            tuple(axes), low, high, log, quadratic, coefficients, root=root, sigma=sigma, freedom=freedom
        )
    return None


def cross_validate(
    axes: Sequence[str],
    at: Float[Array, "flight axis"],
    score: Float[Array, "flight"],
    design: Int[Array, "flight"],
    even_in_log: Container[str] = (),
) -> Float[Array, "flight 3"]:
    """Prediction of each flight, and its interval, from flights of other designs; NaN without a surface.

    Parameters
    ----------
    axes, at, score, even_in_log
        As for `fit_surface`.
    design
        Number of each flight's design: replicates are left out together, a tenth of the designs at a time.
    """
    out = np.full((len(score), 3), np.nan)
    for fold in range(FOLDS):
        mine = design % FOLDS == fold
        surface = fit_surface(axes, at[~mine], score[~mine], even_in_log)
        if surface is not None and mine.any():
            out[mine] = np.stack(surface.predict(at[mine]), axis=-1)
    return out


def fit_scores(
    done: pd.DataFrame, axes: Sequence[str], response: str, channel: str, even_in_log: Container[str] = ()
) -> ResponseSurface | None:
    """Fit a surface to one score in one channel; parameters as for `surrogates`."""
    mine = _select_scores(done, response, channel)
    names = continuous_axes(mine[list(axes)])
    at, score = mine[names].to_numpy(dtype=float), mine[response].to_numpy(dtype=float)
    return fit_surface(names, at, score, even_in_log) if names else None


def _select_scores(done: pd.DataFrame, response: str, channel: str) -> pd.DataFrame:
    return done[(done["channel"] == channel) & np.isfinite(done[response].to_numpy(dtype=float))]


def surrogates(
    done: pd.DataFrame, axes: Sequence[str], response: str, channel: str, even_in_log: Container[str] = ()
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Surrogate of one score in one channel, and its cross-validation.

    Parameters
    ----------
    done
        Finished rows of a study's table.
    axes
        All axes that were varied; those that are not continuous widen the intervals.
    response, channel
        The score.
    even_in_log
        As for `fit_surface`.

    Returns
    -------
    ``axis``, ``value``, ``predicted``, ``low``, ``high`` of a flight along each axis, with the others at the
    middle of their ranges; and one row of ``flights``, ``terms``, ``spread`` (standard deviation of the
    score), ``error`` (root mean square of the predictions), ``coverage`` of their intervals,
    ``coverage_low``, ``coverage_high`` (Clopper and Pearson's interval of 95 %). Both empty without enough
    flights.
    """
    mine = _select_scores(done, response, channel)
    surface = fit_scores(done, axes, response, channel, even_in_log)
    if surface is None:
        return pd.DataFrame(), pd.DataFrame()
    names = surface.axes
    at, score = mine[list(names)].to_numpy(dtype=float), mine[response].to_numpy(dtype=float)
    design = mine["point"].to_numpy() // max(done["replicate"].nunique(), 1)
    predicted, low, high = cross_validate(names, at, score, design, even_in_log).T
    if not np.isfinite(predicted).all():
        return pd.DataFrame(), pd.DataFrame()
    inside = (score >= low) & (score <= high)
    interval_95 = stats.binomtest(int(inside.sum()), len(inside)).proportion_ci(0.95)
    check = {
        "flights": len(score),
        "terms": len(surface.coefficients),
        "spread": float(score.std(ddof=1)),
        "error": float(np.sqrt(np.mean((score - predicted) ** 2))),
        "coverage": float(inside.mean()),
        "coverage_low": float(interval_95.low),
        "coverage_high": float(interval_95.high),
    }
    lines = pd.concat([surface.along(k) for k in range(len(names))], ignore_index=True)
    return lines, pd.DataFrame([check])
