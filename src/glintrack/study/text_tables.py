"""Findings of a study as text: names of scores, the most important axis, and tables.

The importance of an axis is that in the channel with the highest score, as in a run's verdict.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import pandas as pd

from glintrack.bounds import STAGE_LABELS
from glintrack.core.installation import read_data
from glintrack.core.schema import CHANNEL_WORDS
from glintrack.study.intervals import FEW_UNITS

MAX_P = 0.05  # of `p_max_t`, for an effect that is significant
_ROUNDING = 1e-9
_DASH = "–"

_WORDS = read_data("page", "scores.toml")
RESPONSES: tuple[str, ...] = tuple(_WORDS["responses"])  # the headline first
SHORT: Mapping[str, str] = _WORDS["short"]
RANKED_BY = ("tracked_per_km2", "completeness_visible", "custody")  # scores by which designs are ranked
# scores shown with the headline
_CONTEXT = ("false_per_km2", "completeness_visible", "stage_known_background", "stage_detector")
_EXPLAINING = ("completeness_visible", "custody", "stage_known_background", "stage_predicted_background")
NAMES: Mapping[str, str] = _WORDS["study"] | {
    f"stage_{stage}": f"loss budget, of all moving vehicles: {label}" for stage, label in STAGE_LABELS.items()
}
CHANNELS = {"pan": ("tab:gray", "o"), "dolp": ("tab:blue", "s"), "all": ("tab:green", "^")}


def headline(table: pd.DataFrame) -> str:
    """First of `RESPONSES` in a table of effects."""
    return next(name for name in RESPONSES if name in set(table["response"]))


def importance(tables: Mapping[str, pd.DataFrame], by: Sequence[str] = ("axis",)) -> pd.DataFrame:
    """Largest effect of each axis on the headline, significant and large ones first.

    Parameters
    ----------
    tables
        Tables of a report. By axis alone, effects are those of the channel with the highest mean of its
        ``points``, if it has any, else of the channel with the largest effect.
    by
        Groups with one effect each: ``axis``, or ``axis`` and ``channel``.

    Returns
    -------
    ``axis``, ``level``, ``channel``, ``effect``, ``low``, ``high``, ``significant`` (whether chance alone
    gives any effect of that channel so large a |t| with a probability below 0.05), and the effects of the
    same level and channel on other scores; empty without effects.
    """
    found = tables.get("effects")
    if found is None or found.empty:
        return pd.DataFrame()
    mine = found[(found["response"] == headline(found)) & found["effect"].notna()].copy()
    mine.loc[mine["effect"].abs() < _ROUNDING, "effect"] = 0.0
    mine["significant"] = mine["p_max_t"] < MAX_P
    mine["size"] = mine["effect"].abs()
    mine = mine.sort_values(["significant", "size"], ascending=False, kind="stable")
    if "channel" not in by and "points" in tables:
        points = tables["points"]
        points = points[(points["response"] == headline(points)) & points["score"].notna()]
        means = points.groupby("channel")["score"].mean()
        of_best = mine["channel"] == (means.idxmax() if len(means) else None)
        mine = mine[of_best | ~mine["axis"].isin(mine.loc[of_best, "axis"])]
    largest = mine.groupby(list(by), sort=False).head(1).drop(columns=["size", "response"])
    for name in _CONTEXT:
        keys = ["channel", "axis", "level"]
        other = found[found["response"] == name][[*keys, "effect"]].rename(columns={"effect": name})
        largest = largest.merge(other, on=keys, how="left")
    return largest.reset_index(drop=True)


def answer(tables: Mapping[str, pd.DataFrame]) -> str:
    """Most important parameter with its effect and interval; the best design without effects."""
    rows = importance(tables)
    if rows.empty:
        return _describe_best_point(tables["points"]) if "points" in tables else ""
    name = NAMES[headline(tables["effects"])]
    changes = [f"`{r['axis']}`, {r['level']}: {r['effect']:+.3g} {name}" for r in rows.to_dict("records")]
    significant = rows[rows["significant"]].to_dict("records")
    effects = [
        f"{change} {_interval(row)} in {_channel(row)}"
        for change, row in zip(changes, significant, strict=False)  # which come first
    ]
    several, parts = rows["axis"].nunique() > 1, []
    if not effects:
        first = "No significant effect; the largest is" if several else "Not significant:"
        parts = [f"{first} {changes[0]}."]
    elif not several:
        parts = [f"{effects[0]}{_same_change_elsewhere(tables, rows.iloc[0])}."]
    else:
        parts = [f"Most important: {effects[0]}."]
        parts += [f"Then {'; '.join(effects[1:])}."] if len(effects) > 1 else []
        others = [f"`{axis}`" for axis in rows[~rows["significant"]]["axis"]]
        parts += [f"Not significant among all effects: {', '.join(others)}."] if others else []
    if "contrasts" in tables:  # in the mean of all points
        found = tables["contrasts"]
        response = headline(found)
        for row in found[(found["response"] == response) & (found["point"] == "all")].to_dict("records"):
            if math.isfinite(row["low"]):
                label = f"{row['contrast'][:1].upper()}{row['contrast'][1:]}"
                parts.append(f"{label}: {row['effect']:+.3g} {NAMES[response]} {_interval(row)}.")
    if "aa_test" in tables:
        tests = tables["aa_test"]
        parts.append(
            f"{int(tests['excludes'].sum())} of {len(tests)} comparisons of a design with itself seem to "
            "differ; one or two are expected of correct intervals."
        )
    return " ".join(parts)


def _same_change_elsewhere(tables: Mapping[str, pd.DataFrame], change: pd.Series) -> str:
    """Effects of the same change in the other channels."""
    found = tables["effects"]
    same = (found["axis"] == change["axis"]) & (found["level"] == change["level"])
    same &= (found["response"] == headline(found)) & (found["channel"] != change["channel"])
    rows = found[same & found["effect"].notna()].to_dict("records")
    return "".join(f", {row['effect']:+.3g} {_interval(row)} in {_channel(row)}" for row in rows)


def _interval(row: Mapping[str, Any]) -> str:
    significant = row["significant"] if "significant" in row else row["p_max_t"] < MAX_P
    false = row.get("false_per_km2", math.nan)
    cost = f"; {false:+.3g} {NAMES['false_per_km2']}" if math.isfinite(false) else ""
    return f"({row['low']:+.3g} to {row['high']:+.3g}{', significant' if significant else ''}{cost})"


def _channel(row: Mapping[str, Any]) -> str:
    return CHANNEL_WORDS.get(row["channel"], row["channel"])


def _describe_best_point(points: pd.DataFrame) -> str:
    """Best point of a study without effects."""
    response = headline(points)
    mine = points[(points["response"] == response) & points["score"].notna()]
    if mine.empty:
        return ""
    best = mine.loc[mine["score"].idxmax()]
    interval = f" ({best['low']:.3g} to {best['high']:.3g})" if math.isfinite(best["low"]) else ""
    point = "" if best["point"] == "base" else f" of {best['point']}"
    return f"Highest{point}: {best['score']:.3g} {NAMES[response]}{interval} in {_channel(best.to_dict())}."


class StudyHeadline(NamedTuple):
    """One number and three sentences about a study; code is between backticks."""

    number: str
    words: str
    best: str
    matters: str
    others: str


def study_headline(tables: Mapping[str, pd.DataFrame]) -> StudyHeadline | None:
    """Largest effect of a study in one number, or its best score without effects; None without scores."""
    if "points" not in tables or not (best := _describe_best_point(tables["points"])):
        return None
    rows = importance(tables)
    if rows.empty:
        number, _, words = best.partition(": ")[2].partition(" ")
        return StudyHeadline(number, words, best, "Only one design was compared.", "None.")
    records, name = rows.to_dict("records"), NAMES[headline(tables["effects"])]
    first, known = records[0], math.isfinite(records[0]["low"])
    interval = f" (95 % interval {first['low']:+.3g} to {first['high']:+.3g})" if known else ""
    significant = [f"`{row['axis']}`" for row in records if row["significant"]]
    rest = [f"`{row['axis']}`" for row in records if not row["significant"]]
    if "contrasts" in tables:
        found = tables["contrasts"]
        found = found[(found["response"] == headline(found)) & (found["point"] == "all")]
        significant += list(found.loc[found["p_max_t"] < MAX_P, "contrast"])
    return StudyHeadline(
        number=f"{first['effect']:+.3g}".replace("-", "−"),
        words=f"{name} by `{first['axis']}`: {first['level']}{interval}, in {_channel(first)}"
        + ("" if first["significant"] else "; not significant"),
        best=best,
        matters=f"Significant: {', '.join(significant)}." if significant else "No change is significant.",
        others=f"Not significant: {', '.join(rest)}."
        if rest
        else "Every parameter has a significant effect.",
    )


def narrow_intervals(table: pd.DataFrame, source: Mapping[str, Any]) -> str:
    """Warning that intervals of a few flights are too narrow; else empty."""
    count = int(table.loc[table["status"] == "finished", "replicate"].nunique())
    if count >= FEW_UNITS:
        return ""
    of = "one flight of each design" if count == 1 else f"{count} flights of each design"
    alike = "" if source["design"].get("replicates") or count == 1 else ", over one city and traffic"
    return (
        f"Intervals are from {of}{alike}, each divided into six blocks of time. Successive blocks are "
        f"correlated: these intervals are too narrow. Simulate {FEW_UNITS} `replicates` for a decision."
    )


@dataclass(frozen=True)
class TextTable:
    """Table of text, for the terminal and the page.

    Parameters
    ----------
    title
        Title of the table.
    heads
        Headings of its columns.
    rows
        Cells.
    words
        Number of the first columns that contain words and not numbers.
    """

    title: str
    heads: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    words: int = 1


def importance_table(tables: Mapping[str, pd.DataFrame], by: Sequence[str] = ("axis",)) -> TextTable | None:
    """Largest effect of each axis, with its effects on other scores; None without effects."""
    found = importance(tables, by)
    if found.empty:
        return None
    others = [name for name in _CONTEXT if found[name].notna().any()]
    rows = tuple(
        (
            *(str(row[name]) for name in ("axis", "level")),
            _channel(row),
            f"{row['effect']:+.3g}",
            f"{row['low']:+.3g} … {row['high']:+.3g}{' *' * row['significant']}"
            if math.isfinite(row["low"])
            else _DASH,
            *(f"{row[name]:+.3g}" if math.isfinite(row[name]) else _DASH for name in others),
        )
        for row in found.to_dict("records")
    )
    title = f"largest change of {NAMES[headline(tables['effects'])]} by {' and '.join(by)} (* significant)"
    heads = ("axis", "change", "in", "effect", "95 % interval", *(SHORT[name] for name in others))
    return TextTable(title, heads, rows, words=3)


def points_table(points: pd.DataFrame) -> TextTable:
    """Headline and other scores of each design and channel."""
    names = [n for n in (headline(points), *_CONTEXT) if n in set(points["response"])]
    scores = points.pivot_table(index=["point", "channel"], columns="response", values="score", sort=False)
    rows = tuple(
        (
            str(index[0]),
            CHANNEL_WORDS.get(index[1], index[1]),
            *(f"{row[n]:.3g}" if math.isfinite(row[n]) else _DASH for n in names),
        )
        for index, row in zip(scores.index, scores.reindex(columns=names).to_dict("records"), strict=True)
    )
    return TextTable("each design", ("design", "in", *(SHORT.get(n, NAMES[n]) for n in names)), rows, words=2)


def comparison_tables(tables: Mapping[str, pd.DataFrame]) -> list[TextTable]:
    """Tables of contrasts, agreement of ranks, and predictions of surrogates, if there are any."""
    out = contrast_tables(tables["contrasts"]) if "contrasts" in tables else []
    if "ranks" in tables:
        rows = tuple(
            (
                f"{row['under']}: {row['first']} and {row['second']}",
                NAMES[row["response"]],
                _channel(row),
                str(row["designs"]),
                f"{row['tau']:.2f}{_ends(row, '{:.2f}')}",
            )
            for row in tables["ranks"].to_dict("records")
        )
        heads = ("under", "ranked by", "in", "designs", "Kendall's τ")
        out.append(TextTable("agreement of ranks (1: the same order, 0: random)", heads, rows, words=3))
    if "surrogate_check" in tables:
        rows = tuple(
            (
                NAMES[row["response"]],
                _channel(row),
                str(row["flights"]),
                *(f"{row[name]:.3g}" for name in ("spread", "error")),
                f"{row['coverage']:.2f} ({row['coverage_low']:.2f} … {row['coverage_high']:.2f})",
            )
            for row in tables["surrogate_check"].to_dict("records")
        )
        heads = ("score", "in", "flights", "spread", "error", "in their 90 % interval")
        out.append(TextTable("cross-validation of the response surface", heads, rows, words=2))
    return out


def contrast_tables(found: pd.DataFrame) -> list[TextTable]:
    """Table of each contrast by point, in the headline and the scores that explain it."""
    present = set(found["response"])
    names = [name for name in (headline(found), *_EXPLAINING) if name in present]
    out = []
    for contrast, mine in found.groupby("contrast", sort=False):
        by = {(row["point"], row["response"]): row for row in mine.to_dict("records")}
        points = list(dict.fromkeys(mine["point"]))
        rows = tuple((point, *(_cell(by.get((point, name))) for name in names)) for point in points)
        heads = ("where", *(SHORT.get(name, NAMES[name]) for name in names))
        out.append(TextTable(f"{contrast} (95 % interval; * significant among its rows)", heads, rows))
    return out


def _cell(row: dict | None) -> str:
    if row is None or not math.isfinite(row["effect"]):
        return _DASH
    style = "{:+.1f}" if "per_" in row["response"] else "{:+.3f}"  # counts, or shares
    effect = row["effect"] if abs(row["effect"]) > _ROUNDING else 0.0
    return f"{style.format(effect)}{_ends(row, style)}{' *' if row['p_max_t'] < MAX_P else ''}"


def _ends(row: dict, style: str) -> str:
    if not math.isfinite(row["low"]):
        return ""
    return f" ({style.format(row['low'])} … {style.format(row['high'])})"
