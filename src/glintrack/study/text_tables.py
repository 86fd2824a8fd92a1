"""What a study found, in words: names of scores, the most important axis, and tables of text.

The channel that holds most speaks for an axis, as in a run's verdict: what helps a weaker one may not help
the design.
"""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import pandas as pd

from glintrack.bounds import STAGE_LABELS
from glintrack.study.intervals import FEW_UNITS

MAX_P = 0.05  # of `p_max_t`, for an effect that is significant
_ROUNDING = 1e-9

RESPONSES = (
    "held_per_km2",
    "completeness",
    "completeness_visible",
    "custody",
    "purity",
    "identity_switches",
    "false_per_km2",
    "false_per_epoch",
    "stage_known_background",
    "stage_predicted_background",
    "stage_detector",
)  # the headline first
SHORT = {
    "false_per_km2": "false/km²",
    "completeness_visible": "of visible: tracker",
    "stage_known_background": "of all: background known",
    "stage_detector": "of all: detector",
}
RANKED_BY = ("held_per_km2", "completeness_visible", "custody")  # what designs are ranked by
# told beside the headline: its price first
BESIDE = ("false_per_km2", "completeness_visible", "stage_known_background", "stage_detector")
_EXPLAINING = ("completeness_visible", "custody", "stage_known_background", "stage_predicted_background")
NAMES = {
    "held_per_km2": "vehicles held per km²",
    "custody": "custody",
    "false_per_km2": "false tracks per km²",
    "completeness": "completeness, of all moving vehicles",
    "completeness_visible": "completeness, of visible moving vehicles",
    "purity": "track purity",
    "identity_switches": "identity switches of a flight",
    "false_per_epoch": "false tracks a frame",
    "data_rate_mbit_s": "data rate [Mbit/s]",
    **{
        f"stage_{stage}": f"loss budget, of all moving vehicles: {words}"
        for stage, words in STAGE_LABELS.items()
    },
}
CHANNELS = {
    "pan": ("tab:gray", "o"),
    "dolp": ("tab:blue", "s"),
    "all": ("tab:green", "^"),
}
CHANNEL_NAMES = {"pan": "pan", "dolp": "DoLP", "all": "all elements"}


def headline(table: pd.DataFrame) -> str:
    """The first of `RESPONSES` that a table of effects has."""
    return next(name for name in RESPONSES if name in set(table["response"]))


def importance(tables: Mapping[str, pd.DataFrame], by: Sequence[str] = ("axis",)) -> pd.DataFrame:
    """The largest effect of each axis on the headline, the largest axis first; those beyond chance lead.

    Parameters
    ----------
    tables
        Of a report. By axis alone, the channel that holds most over its ``points`` speaks where it has
        effects, else the one of the largest.
    by
        Of what the largest each is told: ``axis``, or ``axis`` and ``channel``.

    Returns
    -------
    ``axis``, ``level``, ``channel``, ``effect``, ``low``, ``high``, ``significant`` (whether chance
    alone gives any effect of that channel so large a |t| less often than 5 times of 100), and the effects
    on `BESIDE` of the same level and channel; empty without effects.
    """
    found = tables.get("effects")
    if found is None or found.empty:
        return pd.DataFrame()
    response = headline(found)
    mine = found[(found["response"] == response) & found["effect"].notna()].copy()
    mine.loc[mine["effect"].abs() < _ROUNDING, "effect"] = 0.0
    mine["significant"] = mine["p_max_t"] < MAX_P
    mine["size"] = mine["effect"].abs()
    mine = mine.sort_values(["significant", "size"], ascending=False, kind="stable")
    if "channel" not in by:
        speaks = mine["channel"] == _holds_most(tables)
        mine = mine[speaks | ~mine["axis"].isin(mine.loc[speaks, "axis"])]
    best = mine.groupby(list(by), sort=False).head(1).drop(columns=["size", "response"])
    keys = ["channel", "axis", "level"]
    for name in BESIDE:
        other = found[found["response"] == name][[*keys, "effect"]].rename(columns={"effect": name})
        best = best.merge(other, on=keys, how="left")
    return best.reset_index(drop=True)


def answer(tables: Mapping[str, pd.DataFrame]) -> str:
    """Which parameter matters most, by how much, how surely and at what price; or what is held."""
    rows = importance(tables)
    if rows.empty:
        return _best_point(tables["points"]) if "points" in tables else ""
    name = NAMES[headline(tables["effects"])]
    significant = rows[rows["significant"]]
    said = [
        f"`{row['axis']}`, {row['level']}: {row['effect']:+.3g} {name} {_interval(row)} in {_channel(row)}"
        for row in significant.to_dict("records")
    ]
    several = rows["axis"].nunique() > 1
    contrasts_and_tests = [*_contrasts(tables), *_aa_test(tables)]
    if not said:
        row = rows.iloc[0]
        effect = f"`{row['axis']}`, {row['level']}: {row['effect']:+.3g} {name}"
        first = (
            f"No axis changes it beyond chance; the largest effect is that of {effect}."
            if several
            else f"Not beyond chance: {effect}."
        )
        return " ".join([first, *contrasts_and_tests])
    if not several:
        said[0] += _other_channels(tables, rows.iloc[0])
    parts = [f"{'Most matters ' if several else ''}{said[0]}."]
    if len(said) > 1:
        parts.append("Then " + "; ".join(said[1:]) + ".")
    others = [f"`{axis}`" for axis in rows[~rows["significant"]]["axis"]]
    if others:
        parts.append(f"Not beyond chance, all taken together: {', '.join(others)}.")
    return " ".join([*parts, *contrasts_and_tests])


def _holds_most(tables: Mapping[str, pd.DataFrame]) -> str | None:
    """The channel that holds most in the mean of all designs; None without points."""
    if "points" not in tables:
        return None
    points = tables["points"]
    mine = points[(points["response"] == headline(points)) & points["score"].notna()]
    return None if mine.empty else str(mine.groupby("channel")["score"].mean().idxmax())


def _other_channels(tables: Mapping[str, pd.DataFrame], change: pd.Series) -> str:
    """What the same change does in the other channels."""
    found = tables["effects"]
    mine = found[
        (found["response"] == headline(found))
        & (found["axis"] == change["axis"])
        & (found["level"] == change["level"])
        & (found["channel"] != change["channel"])
        & found["effect"].notna()
    ]
    return "".join(
        f", {row['effect']:+.3g} {_interval(row)} in {_channel(row)}" for row in mine.to_dict("records")
    )


def _interval(row: Mapping[str, Any]) -> str:
    significant = row["significant"] if "significant" in row else row["p_max_t"] < MAX_P
    price = row.get("false_per_km2", math.nan)
    cost = f"; {price:+.3g} {NAMES['false_per_km2']}" if math.isfinite(price) else ""
    return f"({row['low']:+.3g} to {row['high']:+.3g}{', beyond chance' if significant else ''}{cost})"


def _channel(row: Mapping[str, Any]) -> str:
    return CHANNEL_NAMES.get(row["channel"], row["channel"])


def _contrasts(tables: Mapping[str, pd.DataFrame]) -> list[str]:
    """Contrasts of the study, in the mean of its points."""
    if "contrasts" not in tables:
        return []
    found = tables["contrasts"]
    response = headline(found)
    mine = found[(found["response"] == response) & (found["point"] == "all")]
    return [
        f"{row['contrast'][:1].upper()}{row['contrast'][1:]}: {row['effect']:+.3g} {NAMES[response]} "
        f"{_interval(row)}."
        for row in mine.to_dict("records")
        if math.isfinite(row["low"])
    ]


def _aa_test(tables: Mapping[str, pd.DataFrame]) -> list[str]:
    """How often a design seems to differ from itself."""
    if "aa_test" not in tables:
        return []
    found = tables["aa_test"]
    differ = int(found["excludes"].sum())
    return [
        f"Of {len(found)} comparisons of a design with itself {differ} seem to differ; with correct "
        "intervals it is one or two."
    ]


def _best_point(points: pd.DataFrame) -> str:
    """The best point of a study that varies nothing, or whose design determines no effects."""
    response = headline(points)
    mine = points[(points["response"] == response) & points["score"].notna()]
    if mine.empty:
        return ""
    best = mine.loc[mine["score"].idxmax()]
    sure = f" ({best['low']:.3g} to {best['high']:.3g})" if math.isfinite(best["low"]) else ""
    point = "" if best["point"] == "base" else f" of {best['point']}"
    return f"Most{point}: {best['score']:.3g} {NAMES[response]}{sure} in {_channel(best.to_dict())}."


@dataclass(frozen=True)
class TextTable:
    """A table of text, for the screen and the page alike.

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


def contrast_tables(found: pd.DataFrame) -> list[TextTable]:
    """Each contrast point by point, in the headline and the scores that explain it; * is beyond chance."""
    first = headline(found)
    there = set(found["response"])
    shown = [name for name in (first, *_EXPLAINING) if name in there]
    out = []
    for contrast, mine in found.groupby("contrast", sort=False):
        by = {(row["point"], row["response"]): row for row in mine.to_dict("records")}
        points = list(dict.fromkeys(mine["point"]))
        rows = tuple((point, *(_cell(by.get((point, name))) for name in shown)) for point in points)
        heads = ("where", *(SHORT.get(name, NAMES[name]) for name in shown))
        out.append(TextTable(f"{contrast} (95 % interval; * beyond chance among its rows)", heads, rows))
    return out


def ranks_table(found: pd.DataFrame) -> TextTable:
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
    return TextTable("do the designs keep their ranks? (1: all, 0: by chance)", heads, rows, words=3)


def surrogate_table(found: pd.DataFrame) -> TextTable:
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
    return TextTable("what a response surface predicts of flights left out of it", heads, rows, words=2)


def _cell(row: dict | None) -> str:
    if row is None or not math.isfinite(row["effect"]):
        return "–"
    style = "{:+.1f}" if "per_" in row["response"] else "{:+.3f}"  # counts, or shares
    effect = row["effect"] if abs(row["effect"]) > _ROUNDING else 0.0
    sure = " *" if row["p_max_t"] < MAX_P else ""
    return f"{style.format(effect)}{_ends(row, style)}{sure}"


def _ends(row: dict, style: str) -> str:
    if not math.isfinite(row["low"]):
        return ""
    return f" ({style.format(row['low'])} … {style.format(row['high'])})"
