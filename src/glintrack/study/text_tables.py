"""Which parameter of a study matters: each axis by its largest effect on vehicles held per km².

The channel that holds most speaks, as in a run's verdict: what helps a weaker one may not help the design.
"""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from glintrack.study.scores import BESIDE, CHANNEL_NAMES, NAMES, headline

SURE = 0.05  # of `p_max_t`
_ROUNDING = 1e-9


def ranked(tables: Mapping[str, pd.DataFrame], by: Sequence[str] = ("axis",)) -> pd.DataFrame:
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
    ``axis``, ``level``, ``channel``, ``effect``, ``low``, ``high``, ``sure`` (whether chance alone gives any
    effect of that channel so large a |t| less often than 5 times of 100), and the effects on `report.BESIDE`
    of the same level and channel; empty without effects.
    """
    found = tables.get("effects")
    if found is None or found.empty:
        return pd.DataFrame()
    response = headline(found)
    mine = found[(found["response"] == response) & found["effect"].notna()].copy()
    mine.loc[mine["effect"].abs() < _ROUNDING, "effect"] = 0.0
    mine["sure"] = mine["p_max_t"] < SURE
    mine["size"] = mine["effect"].abs()
    mine = mine.sort_values(["sure", "size"], ascending=False, kind="stable")
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
    rows = ranked(tables)
    if rows.empty:
        return _held(tables["points"]) if "points" in tables else ""
    name = NAMES[headline(tables["effects"])]
    said = [
        f"`{row['axis']}`, {row['level']}: {row['effect']:+.3g} {name} {_interval(row)} in {_channel(row)}"
        for row in rows[rows["sure"]].to_dict("records")
    ]
    if said and rows["axis"].nunique() == 1:
        said[0] += _other_channels(tables, rows.iloc[0])
    unsure = [f"`{axis}`" for axis in rows[~rows["sure"]]["axis"]]
    lead = "Most matters " if rows["axis"].nunique() > 1 else ""  # of one axis there is no most
    first = f"{lead}{said[0]}." if said else _unsure(rows, name)
    parts = [first, *(["Then " + "; ".join(said[1:]) + "."] if len(said) > 1 else [])]
    if unsure and said:
        parts.append(f"Not beyond chance, all taken together: {', '.join(unsure)}.")
    return " ".join([*parts, *_contrasts(tables), *_nulls(tables)])


def _holds_most(tables: Mapping[str, pd.DataFrame]) -> str | None:
    """The channel that holds most in the mean of all designs; None without points."""
    if "points" not in tables:
        return None
    points = tables["points"]
    mine = points[(points["response"] == headline(points)) & points["score"].notna()]
    return None if mine.empty else str(mine.groupby("channel")["score"].mean().idxmax())


def _other_channels(tables: Mapping[str, pd.DataFrame], told: pd.Series) -> str:
    """What the same change does in the other channels."""
    found = tables["effects"]
    mine = found[
        (found["response"] == headline(found))
        & (found["axis"] == told["axis"])
        & (found["level"] == told["level"])
        & (found["channel"] != told["channel"])
        & found["effect"].notna()
    ]
    return "".join(
        f", {row['effect']:+.3g} {_interval(row | {'sure': row['p_max_t'] < SURE})} in {_channel(row)}"
        for row in mine.to_dict("records")
    )


def _interval(row: Mapping[str, Any]) -> str:
    price = row.get("false_per_km2", math.nan)
    cost = f"; {price:+.3g} {NAMES['false_per_km2']}" if math.isfinite(price) else ""
    return f"({row['low']:+.3g} to {row['high']:+.3g}{', beyond chance' if row['sure'] else ''}{cost})"


def _channel(row: Mapping[str, Any]) -> str:
    return CHANNEL_NAMES.get(row["channel"], row["channel"])


def _contrasts(tables: Mapping[str, pd.DataFrame]) -> list[str]:
    """What the study holds against what, in the mean of its points."""
    if "contrasts" not in tables:
        return []
    found = tables["contrasts"]
    response = headline(found)
    mine = found[(found["response"] == response) & (found["point"] == "all")]
    return [
        f"{row['contrast'][:1].upper()}{row['contrast'][1:]}: {row['effect']:+.3g} {NAMES[response]} "
        f"{_interval(row | {'sure': row['p_max_t'] < SURE})}."
        for row in mine.to_dict("records")
        if math.isfinite(row["low"])
    ]


def _nulls(tables: Mapping[str, pd.DataFrame]) -> list[str]:
    """How often a design held against itself seems to differ."""
    if "nulls" not in tables:
        return []
    found = tables["nulls"]
    differ = int(found["excludes"].sum())
    return [
        f"Of {len(found)} designs held against themselves under other labels {differ} seem to differ; honest "
        "intervals let one or two."
    ]


def _unsure(rows: pd.DataFrame, name: str) -> str:
    """The largest effect, where none is beyond chance."""
    row = rows.iloc[0]
    effect = f"`{row['axis']}`, {row['level']}: {row['effect']:+.3g} {name}"
    if rows["axis"].nunique() == 1:
        return f"Not beyond chance: {effect}."
    return f"No axis changes it beyond chance; the largest effect is that of {effect}."


def _held(points: pd.DataFrame) -> str:
    """The best point of a study that varies nothing, or whose design determines no effects."""
    response = headline(points)
    mine = points[(points["response"] == response) & points["score"].notna()]
    if mine.empty:
        return ""
    best = mine.loc[mine["score"].idxmax()]
    sure = f" ({best['low']:.3g} to {best['high']:.3g})" if math.isfinite(best["low"]) else ""
    point = "" if best["point"] == "base" else f" of {best['point']}"
    return f"Most{point}: {best['score']:.3g} {NAMES[response]}{sure} in {_channel(best.to_dict())}."
