"""What stands against what in a study: one light, traffic and noise seen by two designs or two channels."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd
from jaxtyping import Float

from glintrack.bounds.evidence import GROUPS
from glintrack.core.arrays import Array
from glintrack.core.designs import validated
from glintrack.study.analysis import labels
from glintrack.study.axes import Axis, Level
from glintrack.study.design import Contrast, StudyDesign
from glintrack.study.intervals import estimated, units

CHANNEL = "channel"
DOLP_LESS_PAN = Contrast(label="DoLP less pan", of={CHANNEL: "dolp"}, against={CHANNEL: "pan"})


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
        for side in (contrast.of_levels, contrast.against_levels):
            for name, level in side.items():
                if level not in known.get(name, []):
                    raise ValueError(
                        f"`{where}` must name values of the study's axes, got {name} = {level!r} "
                        f"(of {known.get(name) or sorted(known)})"
                    )


def _check_sides(contrast: Contrast) -> None:
    """Refuse sides that leave different axes open, whose points would have no partners."""
    if set(contrast.of_levels) != set(contrast.against_levels) or CHANNEL not in contrast.of_levels:
        raise ValueError(
            f"`contrasts of {contrast.label!r}` must name `channel` and the same axes in `of` and `against`, "
            f"got {sorted(contrast.of_levels)} and {sorted(contrast.against_levels)}"
        )


def contrasted(
    table: pd.DataFrame, axes: Sequence[str], response: str, contrast: Contrast, rng: np.random.Generator
) -> pd.DataFrame:
    """A score of one side less that of the other, at each point of the axes that neither names.

    Parameters
    ----------
    table
        Of the study's results.
    axes
        All of them.
    response
        The score.
    contrast
        Its sides, checked.
    rng
        Of the bootstrap.

    Returns
    -------
    ``point`` (what it differs in from the first one, ``base``), ``effect``, ``low``, ``high``, ``p_max_t``;
    the last row, ``all``, is the mean over points, and the only one where there is a single point. Empty
    where either side has no finished case.
    """
    left = [axis for axis in axes if axis not in contrast.of_levels]
    of = _side(table, left, response, dict(contrast.of_levels))
    against = _side(table, left, response, dict(contrast.against_levels))
    common = [key for key in of if key in against]
    if not common:
        return pd.DataFrame()
    difference = np.stack([of[key] - against[key] for key in common])
    mean = np.full((1, len(common)), 1 / len(common))
    each = len(common) > 1  # one point is its own mean
    found = estimated(np.vstack([np.eye(len(common)), mean]) if each else mean, difference, rng)
    names = [*labels(pd.DataFrame(common, columns=left)), "all"] if each else ["all"]
    return pd.DataFrame(
        {
            "point": names,
            "effect": found.value,
            "low": found.low,
            "high": found.high,
            "p_max_t": found.p_max_t,
        }
    )


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
    ``contrast``, ``response`` and the columns of `contrasted`.
    """
    parts = []
    for contrast in asked or (DOLP_LESS_PAN,):
        for response in responses:
            found = contrasted(table, axes, response, contrast, np.random.default_rng(seed))
            if len(found):
                parts.append(pd.DataFrame({"contrast": contrast.label, "response": response, **found}))
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def asked_contrasts(design: Mapping[str, Any], axes: Sequence[str]) -> tuple[Contrast, ...]:
    """The contrasts of a study's design as its results hold it.

    Raises
    ------
    ValueError
        If what stands there is none, or names no axis of the study.
    """
    asked = tuple(validated(Contrast, one) for one in design.get("contrasts", ()))
    for contrast in asked:
        _check_sides(contrast)
        unknown = set(contrast.of_levels) - {CHANNEL, *axes}
        if unknown:
            raise ValueError(f"`contrasts` must name axes of the study, got {sorted(unknown)}")
    return asked
