"""Whether designs keep their ranks under another detector, tracker or city: Kendall's τ."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import itertools
from collections.abc import Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy import stats

from glintrack.core.arrays import Array
from glintrack.metrics.requirement import CONFIDENCE
from glintrack.study.axes import Axis
from glintrack.study.design import StudyDesign
from glintrack.study.intervals import interval, mean_draws, units

FEWEST_DESIGNS = 3  # of two, τ is 1 or −1


def check_ranked(design: StudyDesign, axes: Sequence[Axis]) -> None:
    """Refuse ranks under what the study does not vary.

    Raises
    ------
    ValueError
        In one sentence, with the axes there are.
    """
    known = [axis.name for axis in axes]
    for name in design.ranked_under:
        if name not in known:
            raise ValueError(f"`ranked_under` must name axes of the study ({', '.join(known)}), got {name!r}")


def rank_agreement(
    table: pd.DataFrame,
    axes: Sequence[str],
    under: str,
    response: str,
    channel: str,
    rng: np.random.Generator,
) -> pd.DataFrame:
    """Kendall's τ between the ranks of the same designs under two values of an axis, for each two values.

    Parameters
    ----------
    table
        Of the study's results.
    axes
        All of them; designs are the points of the others.
    under
        The axis, such as detector, tracker or city.
    response, channel
        The score by which designs are ranked.
    rng
        Of the bootstrap.

    Returns
    -------
    ``under``, ``first``, ``second``, ``designs`` (how many), ``tau``, ``low``, ``high``; empty with fewer
    than three designs in common.
    """
    others = [axis for axis in axes if axis != under]
    found = {
        level: units(table[table[under] == level], others, response, channel).by_levels()
        for level in dict.fromkeys(table[under])
    }
    rows = []
    for (first, a), (second, b) in itertools.combinations(found.items(), 2):
        common = [key for key in a if key in b]
        if len(common) < FEWEST_DESIGNS:
            continue
        values = np.concatenate([[a[key] for key in common], [b[key] for key in common]])
        tau = _agreement(mean_draws(values, rng))
        low, high = interval(tau[1:]) if len(tau) > 1 else _of_few(values)
        rows.append((under, str(first), str(second), len(common), tau[0], float(low), float(high)))
    columns = ["under", "first", "second", "designs", "tau", "low", "high"]
    return pd.DataFrame(rows, columns=columns)


def _agreement(means: Float[Array, "draw point"]) -> Float[Array, "draw"]:
    """τ of the first half of the points with the second."""
    half = means.shape[1] // 2
    return kendall_tau(means[:, :half], means[:, half:])


def _of_few(values: Float[Array, "point unit"]) -> tuple[float, float]:
    """Interval of τ of units too few to draw from: Student's, of the jackknife; NaN for a single unit."""
    values = values[:, np.isfinite(values).any(axis=0)]
    count = values.shape[1]
    if count < 2:
        return np.nan, np.nan
    kept = ~np.eye(count, dtype=bool)
    left_out = _agreement(np.stack([np.nanmean(values[:, one], axis=1) for one in kept]))
    tau = float(_agreement(np.nanmean(values, axis=1)[None])[0])
    spread = np.sqrt((count - 1) / count * ((left_out - left_out.mean()) ** 2).sum())
    reach = stats.t.ppf(0.5 + CONFIDENCE / 2, count - 1) * spread
    return max(tau - reach, -1.0), min(tau + reach, 1.0)


def kendall_tau(a: Float[Array, "*draw n"], b: Float[Array, "*draw n"]) -> Float[Array, "*draw"]:
    """Kendall's τ_b of pairs of scores: 1 for one order, −1 for the opposite, NaN where all are equal."""
    i, j = np.triu_indices(a.shape[-1], 1)
    one, two = np.sign(a[..., i] - a[..., j]), np.sign(b[..., i] - b[..., j])
    untied = np.sqrt(np.abs(one).sum(axis=-1) * np.abs(two).sum(axis=-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (one * two).sum(axis=-1) / untied
