"""Comparisons of designs: contrasts, agreement of ranks (Kendall's τ), and A/A tests of intervals."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import itertools
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from glintrack.bounds.evidence import GROUPS
from glintrack.core.arrays import Array
from glintrack.core.designs import validate_design
from glintrack.metrics.requirement import jackknife
from glintrack.study.analysis import labels
from glintrack.study.design import Axis, Contrast, Level, StudyDesign
from glintrack.study.intervals import FEW_UNITS, estimated, interval, mean_draws, units

CHANNEL = "channel"
DOLP_LESS_PAN = Contrast(label="DoLP less pan", of={CHANNEL: "dolp"}, against={CHANNEL: "pan"})
AA_TESTS = 20
MIN_RANKED_DESIGNS = 3  # of two designs, τ is 1 or −1


def check_contrasts(design: StudyDesign, axes: Sequence[Axis]) -> None:
    """Refuse a contrast whose sides name what the study does not vary, or not the same axes.

    Raises
    ------
    ValueError
        In one sentence: which contrast, and what it must name.
    """
    known: dict[str, list[Level]] = {
        CHANNEL: list(GROUPS),
        **{axis.name: list(axis.labels) for axis in axes},
    }
    for contrast in design.contrasts:
        where = f"contrasts of {contrast.label!r}"
        _check_sides(contrast)
        for side in (contrast.of, contrast.against):
            for name, level in side.items():
                if level not in known.get(name, []):
                    raise ValueError(
                        f"`{where}` must name values of the study's axes, got {name} = {level!r} "
                        f"(of {known.get(name) or sorted(known)})"
                    )


def _check_sides(contrast: Contrast) -> None:
    """Refuse sides that leave different axes open, whose points would have no partners."""
    if set(contrast.of) != set(contrast.against) or CHANNEL not in contrast.of:
        raise ValueError(
            f"`contrasts of {contrast.label!r}` must name `channel` and the same axes in `of` and `against`, "
            f"got {sorted(contrast.of)} and {sorted(contrast.against)}"
        )


def asked_contrasts(design: Mapping[str, Any], axes: Sequence[str]) -> tuple[Contrast, ...]:
    """The contrasts of a study's design as its results hold it.

    Raises
    ------
    ValueError
        If what stands there is none, or names no axis of the study.
    """
    asked = tuple(validate_design(Contrast, one) for one in design.get("contrasts", ()))
    for contrast in asked:
        _check_sides(contrast)
        unknown = set(contrast.of) - {CHANNEL, *axes}
        if unknown:
            raise ValueError(f"`contrasts` must name axes of the study, got {sorted(unknown)}")
    return asked


def contrast_scores(
    table: pd.DataFrame, axes: Sequence[str], response: str, contrast: Contrast, rng: np.random.Generator
) -> pd.DataFrame:
    """Difference of a score between the sides of a contrast, at each point of the axes that neither names.

    Parameters
    ----------
    table, axes
        Results of the study, and all its axes.
    response
        The score.
    contrast
        Its sides, checked.
    rng
        Random generator of the bootstrap.

    Returns
    -------
    ``point`` (what it differs in from the first one, ``base``), ``effect``, ``low``, ``high``, ``p_max_t``;
    the last row, ``all``, is the mean over points, and the only one where there is a single point. Empty
    where either side has no finished case.
    """
    left = [axis for axis in axes if axis not in contrast.of]
    of = _side(table, left, response, dict(contrast.of))
    against = _side(table, left, response, dict(contrast.against))
    common = [key for key in of if key in against]
    if not common:
        return pd.DataFrame()
    difference = np.stack([of[key] - against[key] for key in common])
    mean = np.full((1, len(common)), 1 / len(common))
    each = len(common) > 1  # one point is its own mean
    found = estimated(np.vstack([np.eye(len(common)), mean]) if each else mean, difference, rng)
    names = [*labels(pd.DataFrame(common, columns=left)), "all"] if each else ["all"]
    return pd.DataFrame({"point": names}).join(found.table())


def _side(
    table: pd.DataFrame, left: Sequence[str], response: str, levels: dict[str, Level]
) -> dict[tuple, Float[Array, "unit"]]:
    """Each point's score by unit, by the levels of what one side leaves open; empty if nothing is scored."""
    channel = str(levels.pop(CHANNEL))
    mine = table
    for name, level in levels.items():
        mine = mine[mine[name] == level]
    done = mine[(mine[CHANNEL] == channel) & (mine["status"] == "finished")]
    if done.empty or done[response].isna().all():
        return {}
    found = units(mine, left, response, channel)
    return dict(zip(found.points.itertuples(index=False, name=None), found.values, strict=True))


def all_contrasts(
    table: pd.DataFrame, axes: Sequence[str], responses: Sequence[str], asked: Sequence[Contrast], seed: int
) -> pd.DataFrame:
    """Every contrast that a study asks for, in each score; DoLP less pan where it asks for none.

    Returns
    -------
    ``contrast``, ``response`` and the columns of `contrast_scores`.
    """
    parts = []
    for contrast in asked or (DOLP_LESS_PAN,):
        for response in responses:
            found = contrast_scores(table, axes, response, contrast, np.random.default_rng(seed))
            if len(found):
                parts.append(pd.DataFrame({"contrast": contrast.label, "response": response, **found}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


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
        if len(common) < MIN_RANKED_DESIGNS:
            continue
        values = np.concatenate([[a[key] for key in common], [b[key] for key in common]])
        tau = _agreement(mean_draws(values, rng))
        low, high = interval(tau[1:]) if len(tau) > 1 else _of_few(values)
        designs = {"under": under, "first": str(first), "second": str(second), "designs": len(common)}
        rows.append({**designs, "tau": tau[0], "low": float(low), "high": float(high)})
    return pd.DataFrame(rows)


def _agreement(means: Float[Array, "draw point"]) -> Float[Array, "draw"]:
    """τ of the first half of the points with the second."""
    half = means.shape[1] // 2
    return kendall_tau(means[:, :half], means[:, half:])


def _of_few(values: Float[Array, "point unit"]) -> tuple[float, float]:
    """Interval of τ of units too few to draw from: Student's, of the jackknife; NaN for a single unit."""
    values = values[:, np.isfinite(values).any(axis=0)]
    if values.shape[1] < 2:
        return np.nan, np.nan

    def tau(kept: Sequence[int]) -> float:
        return float(_agreement(np.nanmean(values[:, list(kept)], axis=1)[None])[0])

    _, low, high = jackknife(tau, values.shape[1])
    return max(low, -1.0), min(high, 1.0)


def kendall_tau(a: Float[Array, "*draw n"], b: Float[Array, "*draw n"]) -> Float[Array, "*draw"]:
    """Kendall's τ_b of pairs of scores: 1 for one order, −1 for the opposite, NaN where all are equal."""
    i, j = np.triu_indices(a.shape[-1], 1)
    one, two = np.sign(a[..., i] - a[..., j]), np.sign(b[..., i] - b[..., j])
    untied = np.sqrt(np.abs(one).sum(axis=-1) * np.abs(two).sum(axis=-1))
    with np.errstate(invalid="ignore", divide="ignore"):
        return (one * two).sum(axis=-1) / untied


def aa_test(
    table: pd.DataFrame, axes: Sequence[str], response: str, channels: Sequence[str], rng: np.random.Generator
) -> pd.DataFrame:
    """Compare designs with themselves, to see whether a study's intervals hold what they promise (A/A test).

    The flights of one design are dealt into two halves by chance and paired as two designs would be. Nothing
    differs but traffic and noise, so that an interval of 95 % may exclude 0 once in twenty. Only whole
    flights are dealt: blocks of one flight are not independent, and in another order they would look so.

    Parameters
    ----------
    table, axes
        Results of the study, and all its axes.
    response, channels
        The score, and where it is taken.
    rng
        Random generator of the halves and the bootstrap.

    Returns
    -------
    ``channel``, ``point``, ``effect``, ``low``, ``high``, ``excludes`` (whether the interval excludes 0) of
    twenty tests, one design and channel after the other; empty with fewer than eight replicates.
    """
    if table["replicate"].nunique() < FEW_UNITS:
        return pd.DataFrame()
    designs = []
    for channel in channels:
        found = units(table, axes, response, channel)
        for name, score in zip(labels(found.points), found.values, strict=True):
            if np.isfinite(score).sum() >= FEW_UNITS:
                designs.append(({"channel": channel, "point": name}, score[np.isfinite(score)]))
    rows = []
    for k in range(AA_TESTS if designs else 0):
        named, score = designs[k % len(designs)]
        half = len(score) // 2
        dealt = rng.permutation(score)
        of = estimated(np.eye(1), (dealt[:half] - dealt[half : 2 * half])[None], rng)
        row = {"effect": float(of.value[0]), "low": float(of.low[0]), "high": float(of.high[0])}
        rows.append({**named, **row, "excludes": row["low"] > 0 or row["high"] < 0})
    return pd.DataFrame(rows)
