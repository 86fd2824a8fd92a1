"""Nulls: one design held against itself under other labels, to see whether a study's intervals are honest.

The flights of one design are dealt into two halves by chance and paired as two designs would be. Nothing
differs but traffic and noise, so that an interval of 95 % may exclude 0 once in twenty. Only whole flights
are dealt: blocks of one flight are not independent, and in another order they would look so.
"""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false

from collections.abc import Sequence

import numpy as np
import pandas as pd

from glintrack.study.analysis import labels
from glintrack.study.intervals import FEW_UNITS, estimated, units

NULLS = 20


def relabelled(
    table: pd.DataFrame, axes: Sequence[str], response: str, channels: Sequence[str], rng: np.random.Generator
) -> pd.DataFrame:
    """Twenty differences of designs and themselves, one design and channel after the other.

    Parameters
    ----------
    table
        Of the study's results.
    axes
        All of them.
    response, channels
        The score, and where it is taken.
    rng
        Of the labels.

    Returns
    -------
    ``channel``, ``point``, ``effect``, ``low``, ``high``, ``excludes`` (whether the interval excludes 0);
    empty with fewer than eight replicates.
    """
    if table["replicate"].nunique() < FEW_UNITS:
        return pd.DataFrame()
    found = [(channel, units(table, axes, response, channel)) for channel in channels]
    designs = [
        (channel, name, score[np.isfinite(score)])
        for channel, of in found
        for name, score in zip(labels(of.points), of.values, strict=True)
    ]
    designs = [design for design in designs if len(design[2]) >= FEW_UNITS]
    rows = []
    for k in range(NULLS if designs else 0):
        channel, name, score = designs[k % len(designs)]
        half = len(score) // 2
        dealt = rng.permutation(score)
        of = estimated(np.eye(1), (dealt[:half] - dealt[half : 2 * half])[None], rng)
        low, high = float(of.low[0]), float(of.high[0])
        rows.append((channel, name, float(of.value[0]), low, high, low > 0 or high < 0))
    return pd.DataFrame(rows, columns=["channel", "point", "effect", "low", "high", "excludes"])
