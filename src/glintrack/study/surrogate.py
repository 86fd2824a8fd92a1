"""Surrogate of a sampled study: a quadratic response surface that predicts a flight between those flown.

y = β₀ + Σ βᵢ xᵢ + Σ βᵢⱼ xᵢ xⱼ + e by least squares, with each x from −1 to 1 over what was flown and the
error e of single flights: traffic, noise, and what the surface misses. The interval of a new flight is
Student's,

ŷ ± t(n − p) s √(1 + xᵀ(XᵀX)⁻¹x),

for n flights and p coefficients. How often it holds flights that had no part in the fit is counted by folds.

References
----------
Box and Draper, Response Surfaces, Mixtures, and Ridge Analyses (Wiley, 2007), Section 3.
"""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false

import itertools
import math
from collections.abc import Container, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Float, Int
from scipy import stats

from glintrack.core.arrays import Array

LEVEL = 0.90  # of a prediction
FOLDS = 10
PLACES = 9  # along each axis
_FEWEST_LEVELS = 8  # of an axis that is taken as continuous
CHANCE = ("seed", "scene.seed", "flight.start_s")  # what differs between flights of one design
_SPARE = 1.5  # flights for each coefficient


@dataclass(frozen=True)
class Surface:
    """A fitted response surface.

    Parameters
    ----------
    axes, low, high, log
        Of the axes: name, least and largest value flown, and whether x is even in the logarithm.
    quadratic
        Whether squares and products are terms; straight lines alone if not.
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
        """Score of a new flight at each place, and the ends of the interval that holds it.

        Parameters
        ----------
        at
            Values of the axes.
        level
            How often a new flight lies within, 0 to 1.
        """
        x = _terms(_scaled(at, self.low, self.high, self.log), self.quadratic)
        middle = x @ self.coefficients
        leverage = (np.linalg.solve(self.root.T, x.T) ** 2).sum(axis=0)
        reach = stats.t.ppf(0.5 + level / 2, self.freedom) * self.sigma * np.sqrt(1 + leverage)
        return middle, middle - reach, middle + reach


def continuous(points: pd.DataFrame) -> list[str]:
    """The axes with numbers of so many values that a surface over them makes sense; seeds are chance."""
    return [
        str(name)
        for name in points
        if name not in CHANCE
        and pd.api.types.is_numeric_dtype(points[name])
        and not pd.api.types.is_bool_dtype(points[name])
        and points[name].nunique() > _FEWEST_LEVELS
    ]


def fit_surface(
    axes: Sequence[str],
    at: Float[Array, "flight axis"],
    score: Float[Array, "flight"],
    even_in_log: Container[str] = (),
) -> Surface | None:
    """The surface by least squares: of squares and products if flights are enough, else of straight lines.

    Parameters
    ----------
    axes, at, score
        Names of the axes, their values in each flight, and what it scored.
    even_in_log
        Axes whose x is even in the logarithm of their values.

    Returns
    -------
    None where flights are too few for straight lines, or do not determine them.
    """
    low, high = at.min(axis=0), at.max(axis=0)
    log = tuple(name in even_in_log for name in axes)
    for quadratic in (True, False):
        x = _terms(_scaled(at, low, high, log), quadratic)
        flights, terms = x.shape
        if flights < _SPARE * terms or np.linalg.matrix_rank(x) < terms:
            continue
        q, root = np.linalg.qr(x)
        coefficients = np.linalg.solve(root, q.T @ score)
        freedom = flights - terms
        sigma = math.sqrt(((score - x @ coefficients) ** 2).sum() / freedom)
        return Surface(tuple(axes), low, high, log, quadratic, coefficients, root, sigma, freedom)
    return None


def held_out(
    axes: Sequence[str],
    at: Float[Array, "flight axis"],
    score: Float[Array, "flight"],
    design: Int[Array, "flight"],
    even_in_log: Container[str] = (),
) -> Float[Array, "flight 3"]:
    """Each flight beside what flights of other designs predict of it; NaN where those fit no surface.

    Parameters
    ----------
    axes, at, score, even_in_log
        As of `fit_surface`.
    design
        Which design each flew: replicates are left out together, a tenth of the designs at a time. Some
        lie a little outside of what the others flew.

    Returns
    -------
    Predicted, and the ends of its interval.
    """
    out = np.full((len(score), 3), np.nan)
    for fold in range(FOLDS):
        mine = design % FOLDS == fold
        surface = fit_surface(axes, at[~mine], score[~mine], even_in_log)
        if surface is not None and mine.any():
            out[mine] = np.stack(surface.predict(at[mine]), axis=-1)
    return out


def surrogates(
    done: pd.DataFrame, axes: Sequence[str], response: str, channel: str, even_in_log: Container[str] = ()
) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Surrogate of one score in one channel, and how well it predicts.

    Parameters
    ----------
    done
        Finished rows of a study's table.
    axes
        All that were varied; those that are not continuous are not told apart, and so widen the intervals.
    response, channel
        The score.
    even_in_log
        As of `fit_surface`.

    Returns
    -------
    ``axis``, ``value``, ``predicted``, ``low``, ``high`` of a flight along each axis, with the others in the
    middle of what was flown; and one row of ``flights``, ``terms``, ``spread`` (standard deviation of the
    score), ``error`` (root mean square of what is predicted of flights left out), ``held`` (share of them in
    their intervals), ``held_low``, ``held_high`` (Clopper and Pearson's interval of 95 %). Both empty without
    enough flights.
    """
    mine = done[(done["channel"] == channel) & np.isfinite(done[response].to_numpy(dtype=float))]
    names = continuous(mine[list(axes)])
    at, score = mine[names].to_numpy(dtype=float), mine[response].to_numpy(dtype=float)
    surface = fit_surface(names, at, score, even_in_log) if names else None
    of = mine["point"].to_numpy() // max(mine["replicate"].nunique(), 1)
    left = held_out(names, at, score, of, even_in_log) if surface is not None else np.empty((0, 3))
    if surface is None or not np.isfinite(left).all():
        return pd.DataFrame(), pd.DataFrame()
    lines = pd.concat([_along(surface, k) for k in range(len(names))], ignore_index=True)
    inside = (score >= left[:, 1]) & (score <= left[:, 2])
    sure = stats.binomtest(int(inside.sum()), len(inside)).proportion_ci(0.95)
    told = {
        "flights": len(score),
        "terms": len(surface.coefficients),
        "spread": float(score.std(ddof=1)),
        "error": float(np.sqrt(np.mean((score - left[:, 0]) ** 2))),
        "held": float(inside.mean()),
        "held_low": float(sure.low),
        "held_high": float(sure.high),
    }
    return lines, pd.DataFrame([told])


def _along(surface: Surface, axis: int) -> pd.DataFrame:
    """Predictions along one axis, the others in the middle."""
    at = np.tile(_middle(surface), (PLACES, 1))
    ends = surface.low[axis], surface.high[axis]
    at[:, axis] = np.geomspace(*ends, PLACES) if surface.log[axis] else np.linspace(*ends, PLACES)
    predicted, low, high = surface.predict(at)
    columns = {
        "axis": surface.axes[axis],
        "value": at[:, axis],
        "predicted": predicted,
        "low": low,
        "high": high,
    }
    return pd.DataFrame(columns)


def _middle(surface: Surface) -> Float[Array, "axis"]:
    even, geometric = (surface.low + surface.high) / 2, np.sqrt(np.abs(surface.low * surface.high))
    return np.where(surface.log, geometric, even)


def _scaled(
    at: Float[Array, "n axis"], low: Float[Array, "axis"], high: Float[Array, "axis"], log: Sequence[bool]
) -> Float[Array, "n axis"]:
    """Each value from −1 at the least to 1 at the largest that was flown."""
    with np.errstate(divide="ignore", invalid="ignore"):  # of axes that are not even in the logarithm
        at, low, high = (np.where(log, np.log(v), v) for v in (at, low, high))
    return 2 * (at - low) / (high - low) - 1


def _terms(x: Float[Array, "n axis"], quadratic: bool) -> Float[Array, "n term"]:
    pairs = itertools.combinations_with_replacement(range(x.shape[1]), 2) if quadratic else ()
    return np.stack([np.ones(len(x)), *x.T, *(x[:, i] * x[:, j] for i, j in pairs)], axis=-1)
