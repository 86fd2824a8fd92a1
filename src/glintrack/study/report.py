"""The report of a study: tables as CSV and figures that a paper could print."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from glintrack.bound import RUNG_WORDS
from glintrack.io import atomic, pictures
from glintrack.study.analysis import effects, pareto_front, point_scores, roc, sobol_indices
from glintrack.study.contrasts import all_contrasts, asked_contrasts
from glintrack.study.intervals import units
from glintrack.study.ranks import rank_agreement
from glintrack.study.table import VIEW, read_results

RESPONSES = (
    "held_per_km2",
    "completeness",
    "completeness_visible",
    "custody",
    "purity",
    "false_per_km2",
    "false_per_epoch",
    "rung_known_background",
    "rung_predicted_background",
    "rung_detector",
)  # the headline first
SHORT = {
    "completeness_visible": "visible",
    "rung_known_background": "background known",
    "rung_detector": "detector",
}
RANKED_BY = ("held_per_km2", "completeness_visible", "custody")  # what designs are ranked by
BESIDE = ("completeness_visible", "rung_known_background", "rung_detector")  # told beside the headline
_HOLDS_FIELD = ("sensor.pitch_um", "sensor.focal_length_mm")  # whose change constant_field makes up for
NAMES = {
    "held_per_km2": "vehicles held per km²",
    "custody": "custody",
    "false_per_km2": "false tracks per km²",
    "completeness": "completeness",
    "completeness_visible": "completeness of visible vehicles",
    "purity": "track purity",
    "false_per_epoch": "false tracks a frame",
    "data_rate_mbit_s": "data rate [Mbit/s]",
    **{f"rung_{rung}": f"ladder: {words}" for rung, words in RUNG_WORDS.items()},
}
_CHANNELS = {
    "pan": ("tab:gray", "o"),
    "dolp": ("tab:blue", "s"),
    "all": ("tab:green", "^"),
}
_SAME_FIELD = 0.02  # whole superpixels leave so much
_MOST_PAIRS = 6  # axes of which every pair is fitted; more make tables nobody reads
SEED = 0  # of the bootstrap, so that a report says the same each time


def write_report(result: str | Path) -> tuple[Path, dict[str, pd.DataFrame]]:
    """Analyse a study's folder and write ``report/`` in it.

    Returns
    -------
    The folder, and its tables by name: ``points``, ``effects``, ``interactions``, ``sobol``, ``pareto``,
    ``contrasts``, ``ranks``, ``views``, ``roc``, those that the design allows.

    Raises
    ------
    ValueError
        If there are no results, or none is finished.
    """
    table, source = read_results(result)
    tables = analyse(table, source)
    folder = Path(result) / "report"
    folder.mkdir(exist_ok=True)
    for name, found in tables.items():
        atomic.write_text(folder / f"{name}.csv", found.to_csv(index=False, float_format="%.6g"))
    for name, figure in figures(tables).items():
        pictures.write_figure(folder / f"{name}.png", figure, dpi=200)
        pictures.write_figure(folder / f"{name}.pdf", figure)
    return folder, tables


def analyse(table: pd.DataFrame, source: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Every table that a study's design allows, by name; see `write_report`."""
    done = table[table["status"] == "finished"]
    if done.empty:
        raise ValueError(f"`result` must hold finished cases, got none of {len(table)} rows finished")
    axes, design = list(source["axes"]), source["design"]["design"]
    channels = [m for m in _CHANNELS if m in set(done["channel"])]
    responses = [name for name in RESPONSES if name in done]
    responses = [name for name in responses if done[name].notna().any()]
    varied = [axis for axis in axes if done[axis].nunique() > 1]
    out: dict[str, list[pd.DataFrame]] = {}
    for channel in channels:
        for response in responses:
            found = units(table, varied, response, channel) if varied else None
            if found is None:
                continue
            named = {"channel": channel, "response": response}
            rng = np.random.default_rng(SEED)
            _add(out, "effects", effects(found, rng), named)
            if 2 <= len(varied) <= _MOST_PAIRS and design != "one-at-a-time":
                both = effects(found, rng, interactions=True)
                _add(out, "interactions", both[both["axis"].str.contains("×")], named)
            if design == "saltelli" and len(found.points) == len(set(table["point"] // _replicates(table))):
                _add(out, "sobol", sobol_indices(found, axes, rng), named)
    tables = {name: pd.concat(parts, ignore_index=True) for name, parts in out.items()}
    scored = [
        point_scores(table, axes, r, m, np.random.default_rng(SEED)).assign(channel=m, response=r)
        for m in channels
        for r in responses
    ]
    if scored:
        tables["points"] = pd.concat(scored, ignore_index=True)
    tables["pareto"] = _pareto(done, axes, channels)
    held = all_contrasts(table, axes, responses, asked_contrasts(source["design"], axes), SEED)
    if len(held):
        tables["contrasts"] = held
    ranks = _ranks(table, source, channels)
    if len(ranks):
        tables["ranks"] = ranks
    seen = views(table, varied)
    if len(seen):
        tables["views"] = seen
    curves = roc(table, axes)
    return tables | ({"roc": curves} if len(curves) else {})


def _ranks(table: pd.DataFrame, source: Mapping[str, Any], channels: Sequence[str]) -> pd.DataFrame:
    """Agreement of the designs' ranks under each axis that the study names, by the headline and its likes."""
    parts = [
        rank_agreement(table, source["axes"], under, response, channel, np.random.default_rng(SEED)).assign(
            channel=channel, response=response
        )
        for under in source["design"].get("ranked_under", ())
        for channel in channels
        for response in RANKED_BY
        if response in table and table.loc[table["channel"] == channel, response].notna().any()
    ]
    return pd.concat(parts, ignore_index=True) if parts else pd.DataFrame()


def headline(table: pd.DataFrame) -> str:
    """The first of `RESPONSES` that a table of effects has."""
    return next(name for name in RESPONSES if name in set(table["response"]))


def views(table: pd.DataFrame, varied: Sequence[str]) -> pd.DataFrame:
    """Ground sample distance and window at each level of the axes that change them."""
    parts = []
    for axis in varied if set(VIEW) <= set(table) else ():
        # the others at their first values, else one axis passes for another's in a one-at-a-time design
        others = [other for other in varied if other != axis]
        first = table.loc[(table[others] == table[others].iloc[0]).all(axis=1)]
        of = first if first[axis].nunique() == table[axis].nunique() else table
        means = of.groupby(axis, sort=False)[list(VIEW)].mean()
        if ((means.max() - means.min()) > 1e-6 * means.max()).any():
            parts.append(means.reset_index(names="level").astype({"level": str}).assign(axis=axis))
    return pd.concat(parts, ignore_index=True)[["axis", "level", *VIEW]] if parts else pd.DataFrame()


def view_notes(views: pd.DataFrame) -> list[str]:
    """One sentence for each axis that changes what of the ground is seen."""
    notes = []
    for axis, of in views.groupby("axis", sort=False):
        least, most = of[list(VIEW)].min(), of[list(VIEW)].max()
        said = []
        for column, words in (("gsd_across_m", "an element {} m across"), ("window_km2", "the array {} km²")):
            ends = f"{least[column]:.3g}", f"{most[column]:.3g}"
            if ends[0] != ends[1]:
                said.append(words.format(" to ".join(ends)))
        notes.append(f"`{axis}` changes the view too: {', '.join(said)}")
        if most["window_km2"] - least["window_km2"] > _SAME_FIELD * most["window_km2"]:
            hold = " (`constraints.constant_field = true` holds the field)" if axis in _HOLDS_FIELD else ""
            notes[-1] += f": who sees less of the window holds fewer of its vehicles{hold}"
    return notes


def _replicates(table: pd.DataFrame) -> int:
    return max(len(set(table["replicate"])), 1)


def _add(
    out: dict[str, list[pd.DataFrame]], name: str, found: pd.DataFrame, named: Mapping[str, str]
) -> None:
    if len(found):
        out.setdefault(name, []).append(pd.DataFrame({**named, **found}))


def _pareto(done: pd.DataFrame, axes: Sequence[str], channels: Sequence[str]) -> pd.DataFrame:
    """Mean purity and completeness of each design, its data rate, and whether another beats it."""
    kept = ["purity", "completeness", "data_rate_mbit_s"]
    means = done.groupby([*axes, "channel"], sort=False)[kept].mean().reset_index()
    for gain in ("purity", "completeness"):
        front = pd.Series(False, index=means.index)
        for channel in channels:
            mine = means["channel"] == channel
            part = means[mine]
            front[mine] = pareto_front(part["data_rate_mbit_s"].to_numpy(), part[gain].to_numpy())
        means[f"{gain}_front"] = front
    return means


def figures(tables: Mapping[str, pd.DataFrame]) -> dict[str, Figure]:
    """Figures of the tables, by name."""
    out: dict[str, Figure] = {}
    for response in RESPONSES:
        if "effects" in tables and response in set(tables["effects"]["response"]):
            out[f"effects_{response}"] = _show_effects(tables["effects"], response)
        if "contrasts" in tables and response in set(tables["contrasts"]["response"]):
            out[f"contrasts_{response}"] = _show_contrasts(tables["contrasts"], response)
        if "sobol" in tables and response in set(tables["sobol"]["response"]):
            out[f"sobol_{response}"] = _show_sobol(tables["sobol"], response)
    if tables["pareto"]["data_rate_mbit_s"].nunique() > 1:
        out["pareto"] = _show_pareto(tables["pareto"])
    if "roc" in tables:
        out["roc"] = _show_roc(tables["roc"])
    return out


def _panel(width_in: float, height_in: float) -> tuple[Figure, Axes]:
    figure = Figure(figsize=(width_in, height_in), layout="constrained")
    ax = figure.add_subplot()
    ax.spines[["top", "right"]].set_visible(False)
    return figure, ax


def _bars(
    ax: Axes, value: np.ndarray, low: np.ndarray, high: np.ndarray, y: np.ndarray, channel: str
) -> None:
    _intervals(ax, value, low, high, y, *_CHANNELS[channel], channel)


def _intervals(
    ax: Axes,
    value: np.ndarray,
    low: np.ndarray,
    high: np.ndarray,
    y: np.ndarray,
    colour: str,
    marker: str,
    label: str | None = None,
) -> None:
    there = np.isfinite(low)
    ax.hlines(y[there], low[there], high[there], color=colour, linewidth=1.2)
    ax.plot(value, y, marker, color=colour, markersize=4, label=label, linestyle="none")


def _show_effects(found: pd.DataFrame, response: str) -> Figure:
    """Each effect with its interval, one channel above the other, zero drawn through."""
    mine = found[found["response"] == response]
    there = [m for m in _CHANNELS if m in set(mine["channel"])]
    rows = list(dict.fromkeys(zip(mine["axis"], mine["level"], strict=True)))
    figure, ax = _panel(6.6, 1.0 + 0.34 * len(rows))
    place = {row: k for k, row in enumerate(rows)}
    for k, channel in enumerate(there):
        part = mine[mine["channel"] == channel]
        shift = 0.2 * (k - 0.5 * (len(there) - 1))
        at = [place[row] + shift for row in zip(part["axis"], part["level"], strict=True)]
        _bars(ax, *(part[c].to_numpy() for c in ("effect", "low", "high")), np.array(at), channel)
    ax.axvline(0, color="black", linewidth=0.6)
    ax.set_yticks(range(len(rows)), [f"{axis}: {level}" for axis, level in rows], fontsize=8)
    ax.margins(y=0.01)
    ax.invert_yaxis()
    ax.set_xlabel(f"change of {NAMES[response]} (95 % interval)")
    ax.legend(frameon=False, fontsize=8)
    return figure


def _show_contrasts(found: pd.DataFrame, response: str) -> Figure:
    """Each contrast at each point, one below the other, zero drawn through; keys by their last part."""
    mine = found[found["response"] == response]
    figure, ax = _panel(7.6, 1.4 + 0.22 * len(mine))
    y = np.arange(len(mine))
    for k, name in enumerate(dict.fromkeys(mine["contrast"])):
        here = (mine["contrast"] == name).to_numpy()
        value, low, high = (mine.loc[here, c].to_numpy() for c in ("effect", "low", "high"))
        _intervals(ax, value, low, high, y[here], f"C{k % 10}", "s", name)
    ax.axvline(0, color="black", linewidth=0.6)
    names = [re.sub(r"\b\w+\.(?=[a-z])", "", point) for point in mine["point"]]
    ax.set_yticks(y, [name if len(name) < 60 else f"{name[:57]}…" for name in names], fontsize=7)
    ax.margins(y=0.01)
    figure.legend(frameon=False, fontsize=8, loc="outside upper left")
    ax.invert_yaxis()
    ax.set_xlabel(f"change of {NAMES[response]} (95 % interval)")
    return figure


def _show_sobol(found: pd.DataFrame, response: str) -> Figure:
    """First-order and total index of each axis."""
    mine = found[found["response"] == response]
    figure, ax = _panel(6.6, 3.4)
    axes = list(dict.fromkeys(mine["axis"]))
    groups = list(dict.fromkeys(mine["channel"]))
    for k, channel in enumerate(groups):
        part = mine[mine["channel"] == channel]
        for j, (name, alpha) in enumerate((("first", 1.0), ("total", 0.45))):
            x = np.arange(len(axes)) + 0.2 * (2 * k + j) - 0.1 * (2 * len(groups) - 1)
            value = part[name].to_numpy()
            ends = np.abs(np.stack([part[f"{name}_low"], part[f"{name}_high"]]) - value)
            label = f"{channel}, {'first order' if name == 'first' else 'total'}"
            ax.bar(x, value, 0.18, color=_CHANNELS[channel][0], alpha=alpha, label=label)
            ax.errorbar(x, value, ends, fmt="none", ecolor="black", elinewidth=0.8)
    ax.set_xticks(range(len(axes)), axes, fontsize=8)
    ax.set_ylabel(f"share of variance of {NAMES[response]}")
    ax.legend(frameon=False, fontsize=8)
    return figure


def _show_pareto(found: pd.DataFrame) -> Figure:
    """Purity and completeness against data rate, the front joined."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    for ax, gain in zip(figure.subplots(1, 2), ("purity", "completeness"), strict=True):
        for channel in dict.fromkeys(found["channel"]):
            part = found[found["channel"] == channel].sort_values("data_rate_mbit_s")
            colour, marker = _CHANNELS[channel]
            ax.plot(part["data_rate_mbit_s"], part[gain], marker, color=colour, markersize=4, alpha=0.35)
            front = part[part[f"{gain}_front"]]
            style = {
                "color": colour,
                "marker": marker,
                "markeredgecolor": "black",
                "label": f"{channel}, front",
            }
            ax.step(front["data_rate_mbit_s"], front[gain], "-", where="post", markersize=6, **style)
        ax.set(xlabel=NAMES["data_rate_mbit_s"], ylabel=NAMES[gain])
        ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize=8)
    return figure


def _show_roc(found: pd.DataFrame) -> Figure:
    """Completeness against false tracks a frame, a curve each group: colour by group, line by channel."""
    figure, ax = _panel(7.2, 4.0)
    groups = list(dict.fromkeys(found["group"]))
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(groups)))
    lines = dict(zip(_CHANNELS, ("--", "-", ":", "-."), strict=True))
    for (group, channel), part in found.groupby(["group", "channel"], sort=False):
        part = part.sort_values("false_per_epoch")
        style = {"color": colours[groups.index(group)], "linestyle": lines[str(channel)], "markersize": 3}
        marker = _CHANNELS[str(channel)][1]
        label = f"{channel}, {group}" if group else str(channel)
        ax.plot(part["false_per_epoch"], part["completeness"], marker=marker, label=label, **style)
    ax.set(xlabel=NAMES["false_per_epoch"], ylabel=NAMES["completeness"])
    ax.legend(frameon=False, fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure
