"""Comparisons of designs: contrasts, agreement of ranks (Kendall's τ), and A/A tests of intervals."""

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
from glintrack.study.design import CHANNEL, Axis, Contrast, Level, StudyDesign
from glintrack.study.intervals import FEW_UNITS, estimate, interval, mean_draws, units

DOLP_LESS_PAN = Contrast(label="DoLP less pan", of={CHANNEL: "dolp"}, against={CHANNEL: "pan"})
AA_TESTS = 20
MIN_RANKED_DESIGNS = 3  # of two designs, τ is 1 or −1


def check_contrasts(design: StudyDesign, axes: Sequence[Axis]) -> None:
    """Check that the contrasts of a study name values of its axes.

    Raises
    ------
    ValueError
        In one sentence: the contrast, and the names that it must have.
    """
    known: dict[str, list[Level]] = {axis.name: list(axis.labels) for axis in axes}
    known[CHANNEL] = list(GROUPS)
    for contrast in design.contrasts:
        for name, level in [*contrast.of.items(), *contrast.against.items()]:
            if level not in known.get(name, []):
                raise ValueError(
                    f"`contrasts of {contrast.label!r}` must name values of the study's axes; got {name} = "
                    f"{level!r}. Known: {known.get(name) or sorted(known)}."
                )


def design_contrasts(design: Mapping[str, Any], axes: Sequence[str]) -> tuple[Contrast, ...]:
    """Contrasts of a study's design in its results.

    Raises
    ------
    ValueError
        If one is not valid, or names no axis of the study.
    """
    contrasts = tuple(validate_design(Contrast, one) for one in design.get("contrasts", ()))
    for contrast in contrasts:
        if unknown := set(contrast.of) - {CHANNEL, *axes}:
            raise ValueError(f"`contrasts` must name axes of the study; got {sorted(unknown)}.")
    return contrasts


def contrast_scores(
    table: pd.DataFrame, axes: Sequence[str], response: str, contrast: Contrast, rng: np.random.Generator
) -> pd.DataFrame:
    """Difference of a score between the sides of a contrast, at each point of all other axes.

    Parameters
    ----------
    table, axes
        Results of the study, and all its axes.
    response
        The score.
    contrast
        The contrast.
    rng
        Random generator of the bootstrap.

    Returns
    -------
    ``point`` (its label), ``effect``, ``low``, ``high``, ``p_max_t``; the last row, ``all``, is the mean over
    points with a score, and the only one of a single point. Empty where either side has no finished case.
    """
    left = [axis for axis in axes if axis not in contrast.of]
    of = _side(table, left, response, dict(contrast.of))
    against = _side(table, left, response, dict(contrast.against))
    common = [key for key in of if key in against]
    if not common:
        return pd.DataFrame()
    difference = np.stack([of[key] - against[key] for key in common])
    scored = np.isfinite(difference).any(axis=1)
    mean = (scored / max(scored.sum(), 1))[None]
    each = len(common) > 1  # one point is its own mean
    found = estimate(np.vstack([np.eye(len(common)), mean]) if each else mean, difference, rng)
    base = table.sort_values("point")[left]
    names = [*labels(pd.DataFrame(common, columns=left), base), "all"] if each else ["all"]
    return pd.DataFrame({"point": names}).join(found.to_frame())


def _side(
    table: pd.DataFrame, left: Sequence[str], response: str, levels: dict[str, Level]
) -> dict[tuple, Float[Array, "unit"]]:
    """Score of each point by unit, by the levels of the other axes; empty without a finished case."""
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
    table: pd.DataFrame, axes: Sequence[str], responses: Sequence[str], listed: Sequence[Contrast], seed: int
) -> pd.DataFrame:
    """Every listed contrast in each score; DoLP less pan if none is listed.

    Returns
    -------
    ``contrast``, ``response`` and the columns of `contrast_scores`.
    """
    parts = []
    for contrast in listed or (DOLP_LESS_PAN,):
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
        Results of the study.
    axes
        All axes; designs are the points of the others.
    under
        The axis, such as detector, tracker or city.
    response, channel
        The score by which designs are ranked.
    rng
        Random generator of the bootstrap.

    Returns
    -------
    ``under``, ``first``, ``second``, ``designs`` (their number), ``tau``, ``low``, ``high``; empty with fewer
    than three designs in common.
    """
    others, found, rows = [axis for axis in axes if axis != under], {}, []
    for level in dict.fromkeys(table[under]):
        of = units(table[table[under] == level], others, response, channel)
        found[level] = dict(zip(map(tuple, of.points.astype(object).to_numpy()), of.values, strict=True))
    for (first, a), (second, b) in itertools.combinations(found.items(), 2):
        common = [key for key in a if key in b and np.isfinite(a[key] + b[key]).any()]
        if len(common) < MIN_RANKED_DESIGNS:
            continue
        values = np.concatenate([[a[key] for key in common], [b[key] for key in common]])
        values = values[:, np.isfinite(values).all(axis=0)]  # units that all designs share
        if not values.size:
            continue
        tau = _agreement(mean_draws(values, rng))
        low, high = interval(tau[1:]) if len(tau) > 1 else _jackknife_interval(values)
        designs = {"under": under, "first": str(first), "second": str(second), "designs": len(common)}
        rows.append({**designs, "tau": tau[0], "low": float(low), "high": float(high)})
    return pd.DataFrame(rows)


def _agreement(means: Float[Array, "draw point"]) -> Float[Array, "draw"]:
    """Kendall's τ of the first half of the points with the second."""
    half = means.shape[1] // 2
    return kendall_tau(means[:, :half], means[:, half:])


def _jackknife_interval(values: Float[Array, "point unit"]) -> tuple[float, float]:
    """Student's interval of τ from the jackknife, for few units; NaN for a single unit."""
    if values.shape[1] < 2:
        return np.nan, np.nan

    def tau(chosen: Sequence[int]) -> float:
        return float(_agreement(values[:, list(chosen)].mean(axis=1)[None])[0])

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
    """Compare designs with themselves, to check the coverage of a study's intervals (A/A test).

    The flights of one design are divided into two random halves and paired as two designs would be. Only
    traffic and noise differ, so that an interval of 95 % excludes 0 once in twenty. Whole flights are used,
    as blocks of one flight are correlated.

    Parameters
    ----------
    table, axes
        Results of the study, and all its axes.
    response, channels
        The score, and its channels.
    rng
        Random generator of the halves and the bootstrap.

    Returns
    -------
    ``channel``, ``point``, ``effect``, ``low``, ``high``, ``excludes`` (whether the interval excludes 0) of
    twenty tests, one design and channel after the other; empty with fewer than eight replicates.
    """
    if table["replicate"].nunique() < FEW_UNITS:
        return pd.DataFrame()
    designs, base = [], table.sort_values("point")[list(axes)]
    for channel in channels:
        found = units(table, axes, response, channel)
        for name, score in zip(labels(found.points, base), found.values, strict=True):
            if np.isfinite(score).sum() >= FEW_UNITS:
                designs.append(({"channel": channel, "point": name}, score[np.isfinite(score)]))
    rows = []
    for k in range(AA_TESTS if designs else 0):
        named, score = designs[k % len(designs)]
        half = len(score) // 2
        mixed = rng.permutation(score)
        of = estimate(np.eye(1), (mixed[:half] - mixed[half : 2 * half])[None], rng)
        row = {"effect": float(of.value[0]), "low": float(of.low[0]), "high": float(of.high[0])}
        rows.append({**named, **row, "excludes": row["low"] > 0 or row["high"] < 0})
    return pd.DataFrame(rows)
