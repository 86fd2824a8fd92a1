"""Contrasts and ranks of a study as tables of words, for the screen and the page alike."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import pandas as pd

from glintrack.study.intervals import FEW_UNITS
from glintrack.study.matters import SURE
from glintrack.study.scores import NAMES, SHORT, headline

_ROUNDING = 1e-9
_BESIDE = ("completeness_visible", "custody", "rung_known_background", "rung_predicted_background")


@dataclass(frozen=True)
class Told:
    """A table in words.

    Parameters
    ----------
    title
        What it says.
    heads
        Of its columns.
    rows
        Their cells.
    words
        Columns, from the first, that hold words and not numbers.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int = 1


def narrow_intervals(table: pd.DataFrame, source: Mapping[str, Any]) -> str:
    """Where the intervals of a few flights come from, and that they are too narrow; else nothing."""
    count = int(table.loc[table["status"] == "finished", "replicate"].nunique())
    if count >= FEW_UNITS:
        return ""
    of = "one flight of each design" if count == 1 else f"{count} flights of each design"
    alike = "" if source["design"].get("replicates") or count == 1 else ", over one city and traffic"
    return (
        f"Intervals: of {of}{alike}, each flight's time in six blocks. Blocks follow each other and are "
        f"alike, so that these are too narrow; for a decision fly {FEW_UNITS} `replicates`."
    )


def contrast_tables(found: pd.DataFrame) -> list[Told]:
    """Each contrast point by point, in the headline and the scores that explain it; * is beyond chance."""
    first = headline(found)
    there = set(found["response"])
    shown = [name for name in (first, *_BESIDE) if name in there]
    out = []
    for contrast, mine in found.groupby("contrast", sort=False):
        by = {(row["point"], row["response"]): row for row in mine.to_dict("records")}
        points = list(dict.fromkeys(mine["point"]))
        rows = tuple((point, *(_cell(by.get((point, name))) for name in shown)) for point in points)
        heads = ("where", *(SHORT.get(name, NAMES[name]) for name in shown))
        out.append(Told(f"{contrast} (95 % interval; * beyond chance among its rows)", heads, rows))
    return out


def ranks_table(found: pd.DataFrame) -> Told:
    """Kendall's τ between the ranks of the same designs under two values of an axis."""
    heads = ("under", "ranked by", "in", "designs", "Kendall's τ")
    rows = tuple(
        (
            f"{row['under']}: {row['first']} and {row['second']}",
            NAMES[row["response"]],
            row["channel"],
            str(row["designs"]),
            f"{row['tau']:.2f}{_ends(row, '{:.2f}')}",
        )
        for row in found.to_dict("records")
    )
    return Told("do the designs keep their ranks? (1: all, 0: by chance)", heads, rows, words=3)


def surrogate_table(found: pd.DataFrame) -> Told:
    """How well each surrogate predicts flights that had no part in it."""
    heads = ("score", "in", "flights", "spread", "error", "in their 90 % interval")
    rows = tuple(
        (
            NAMES[row["response"]],
            row["channel"],
            str(row["flights"]),
            f"{row['spread']:.3g}",
            f"{row['error']:.3g}",
            f"{row['held']:.2f} ({row['held_low']:.2f} … {row['held_high']:.2f})",
        )
        for row in found.to_dict("records")
    )
    return Told("what a response surface predicts of flights left out of it", heads, rows, words=2)


def _cell(row: dict | None) -> str:
    if row is None or not math.isfinite(row["effect"]):
        return "–"
    style = "{:+.1f}" if "per_" in row["response"] else "{:+.3f}"  # counts, or shares
    effect = row["effect"] if abs(row["effect"]) > _ROUNDING else 0.0
    sure = " *" if row["p_max_t"] < SURE else ""
    return f"{style.format(effect)}{_ends(row, style)}{sure}"


def _ends(row: dict, style: str) -> str:
    if not math.isfinite(row["low"]):
        return ""
    return f" ({style.format(row['low'])} … {style.format(row['high'])})"
