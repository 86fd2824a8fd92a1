"""Which parameter of a study matters: each axis by its largest effect on vehicles held per km²."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import math
from collections.abc import Mapping, Sequence

import pandas as pd

from glintrack.study.scores import BESIDE, CHANNEL_NAMES, NAMES, headline

SURE = 0.05  # of `p_max_t`
_ROUNDING = 1e-9


def ranked(tables: Mapping[str, pd.DataFrame], by: Sequence[str] = ("axis",)) -> pd.DataFrame:
    """The largest effect of each axis on the headline, the largest axis first; those told from chance lead.

    Parameters
    ----------
    tables
        Of a report.
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
    best = mine.groupby(list(by), sort=False).head(1).drop(columns=["size", "response"])
    keys = ["channel", "axis", "level"]
    for name in BESIDE:
        other = found[found["response"] == name][[*keys, "effect"]].rename(columns={"effect": name})
        best = best.merge(other, on=keys, how="left")
    return best.reset_index(drop=True)


def answer(tables: Mapping[str, pd.DataFrame]) -> str:
    """Which parameter matters most, by how much and how surely; what is held, where none was varied."""
    rows = ranked(tables)
    if rows.empty:
        return _held(tables["points"]) if "points" in tables else ""
    name = NAMES[headline(tables["effects"])]
    said = []
    for row in rows[rows["sure"]].to_dict("records"):
        more = f"{row['effect']:+.3g} {name} ({row['low']:+.3g} to {row['high']:+.3g})"
        said.append(
            f"`{row['axis']}`, {row['level']}: {more} in {CHANNEL_NAMES.get(row['channel'], row['channel'])}"
        )
    unsure = [f"`{axis}`" for axis in rows[~rows["sure"]]["axis"]]
    lead = "Most matters " if rows["axis"].nunique() > 1 else ""  # of one axis there is no most
    first = f"{lead}{said[0]}." if said else _unsure(rows, name)
    parts = [first, *(["Then " + "; ".join(said[1:]) + "."] if len(said) > 1 else [])]
    if unsure and said:
        parts.append(f"Not told from chance, all taken together: {', '.join(unsure)}.")
    return " ".join([*parts, *_contrasts(tables), *_nulls(tables)])


def _contrasts(tables: Mapping[str, pd.DataFrame]) -> list[str]:
    """What the study holds against what, in the mean of its points."""
    if "contrasts" not in tables:
        return []
    found = tables["contrasts"]
    response = headline(found)
    mine = found[(found["response"] == response) & (found["point"] == "all")]
    return [
        f"{row['contrast'][:1].upper()}{row['contrast'][1:]}: {row['effect']:+.3g} {NAMES[response]} "
        f"({row['low']:+.3g} to {row['high']:+.3g}{', told from chance' if row['p_max_t'] < SURE else ''})."
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
    """The largest effect, where none is told from chance."""
    row = rows.iloc[0]
    effect = f"`{row['axis']}`, {row['level']}: {row['effect']:+.3g} {name}"
    if rows["axis"].nunique() == 1:
        return f"Not told from chance: {effect}."
    return f"No axis is told from chance; the largest effect is that of {effect}."


def _held(points: pd.DataFrame) -> str:
    """The best point of a study that varies nothing, or whose design determines no effects."""
    response = headline(points)
    mine = points[(points["response"] == response) & points["score"].notna()]
    if mine.empty:
        return ""
    best = mine.loc[mine["score"].idxmax()]
    sure = f" ({best['low']:.3g} to {best['high']:.3g})" if math.isfinite(best["low"]) else ""
    point = "" if best["point"] == "base" else f" of {best['point']}"
    channel = CHANNEL_NAMES.get(best["channel"], best["channel"])
    return f"Most{point}: {best['score']:.3g} {NAMES[response]}{sure} in {channel}."
