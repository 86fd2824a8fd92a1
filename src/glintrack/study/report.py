"""The report of a study: every table that its design allows, their figures, and requirements by point."""

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

from glintrack.io import atomic, images
from glintrack.metrics.requirement import Judged, Requirement, judge
from glintrack.study.analysis import (
    CHANCE,
    continuous,
    effects,
    pareto_front,
    point_scores,
    roc,
    sobol_indices,
    surrogates,
)
from glintrack.study.comparisons import aa_test, all_contrasts, asked_contrasts, rank_agreement
from glintrack.study.design import flat
from glintrack.study.folder import VIEW, finished_replicates, read_results
from glintrack.study.intervals import units
from glintrack.study.plan import FIELD_KEYS
from glintrack.study.text_tables import CHANNEL_NAMES, CHANNELS, NAMES, RANKED_BY, RESPONSES

SEED = 0  # of the bootstrap, so that a report says the same each time
_SPREAD = ("latin-hypercube", "sobol")  # designs that a surrogate is fitted to
_FOLLOWS = 0.4  # rank correlation that forty flights hardly show by chance
_SAME_FIELD = 0.02  # whole superpixels leave so much
_MOST_PAIRS = 6  # axes of which every pair is fitted; more make tables nobody reads


def write_report(
    result: str | Path, results: tuple[pd.DataFrame, Mapping[str, Any]] | None = None
) -> tuple[Path, dict[str, pd.DataFrame]]:
    """Analyse a study's folder and write ``report/`` in it.

    Parameters
    ----------
    result
        The folder.
    results
        What `read_results` gives of it, where that is at hand; else it is read.

    Returns
    -------
    The folder, and its tables by name: ``points``, ``effects``, ``interactions``, ``sobol``, ``pareto``,
    ``contrasts``, ``ranks``, ``aa_test``, ``surrogate``, ``surrogate_check``, ``views``, ``roc``, those that
    the design allows.

    Raises
    ------
    ValueError
        If there are no results, or none is finished.
    """
    table, source = read_results(result) if results is None else results
    tables = analyse(table, source)
    folder = Path(result) / "report"
    folder.mkdir(exist_ok=True)
    for name, found in tables.items():
        atomic.write_text(folder / f"{name}.csv", found.to_csv(index=False, float_format="%.6g"))
        words = {name: column.astype(str) for name, column in found.items() if column.dtype == object}
        atomic.write_bytes(folder / f"{name}.parquet", found.assign(**words).to_parquet(index=False))
    for name, figure in figures(tables).items():
        images.write_figure(folder / f"{name}.png", figure, dpi=200)
        images.write_figure(folder / f"{name}.pdf", figure)
    return folder, tables


def analyse(table: pd.DataFrame, source: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Every table that a study's design allows, by name; see `write_report`."""
    table = finished_replicates(table)
    done = _finished(table)
    axes, design = list(source["axes"]), source["design"]["design"]
    channels = [name for name in CHANNELS if name in set(done["channel"])]
    responses = [name for name in RESPONSES if name in done and done[name].notna().any()]
    varied = [axis for axis in axes if done[axis].nunique() > 1]
    spans = flat(source["design"].get("axes", {}))
    even_in_log = [name for name, span in spans.items() if isinstance(span, dict) and span.get("log")]
    points = len(set(table["point"] // max(table["replicate"].nunique(), 1)))
    out: dict[str, list[pd.DataFrame]] = {}

    def add(name: str, found: pd.DataFrame, channel: str, response: str) -> None:
        if len(found):
            labelled = pd.DataFrame({"channel": channel, "response": response, **found})
            out.setdefault(name, []).append(labelled)

    for channel in channels:
        for response in responses:
            named = (channel, response)
            add("points", point_scores(table, axes, response, channel, _rng()), *named)
            for under in source["design"].get("ranked_under", ()) if response in RANKED_BY else ():
                if table.loc[table["channel"] == channel, response].notna().any():
                    add("ranks", rank_agreement(table, axes, under, response, channel, _rng()), *named)
            if not varied:
                continue
            found, rng = units(table, varied, response, channel), _rng()
            add("effects", effects(found, rng), *named)
            if 2 <= len(varied) <= _MOST_PAIRS and design != "one-at-a-time":
                both = effects(found, rng, interactions=True)
                add("interactions", both[both["axis"].str.contains("×")], *named)
            if design in _SPREAD:
                surfaces, check = surrogates(done, varied, response, channel, even_in_log)
                add("surrogate", surfaces, *named)
                add("surrogate_check", check, *named)
            if design == "saltelli" and len(found.points) == points:
                add("sobol", sobol_indices(found, axes, rng), *named)
    tables = {name: pd.concat(parts, ignore_index=True) for name, parts in out.items()}
    tables["pareto"] = _pareto(done, axes, channels)
    tables["contrasts"] = all_contrasts(table, axes, responses, asked_contrasts(source["design"], axes), SEED)
    if responses:
        tests = aa_test(table, axes, responses[0], channels, _rng())
        tables["aa_test"] = tests.assign(response=responses[0])
    tables |= {"views": views(table, varied), "roc": roc(table, axes)}
    return {name: found for name, found in tables.items() if len(found)}


def _rng() -> np.random.Generator:
    return np.random.default_rng(SEED)


def _finished(table: pd.DataFrame) -> pd.DataFrame:
    """Rows of finished cases.

    Raises
    ------
    ValueError
        If there are none.
    """
    done = table[table["status"] == "finished"]
    if done.empty:
        raise ValueError(f"`result` must hold finished cases, got none of {len(table)} rows finished")
    return done


def judge_points(
    table: pd.DataFrame, source: Mapping[str, Any], requirement: Requirement
) -> tuple[str, list[tuple[str, Judged]]]:
    """The channel that is judged, and each point of the design in words with what its flights say.

    Raises
    ------
    ValueError
        If no case is finished, or the study lacks the score or the channel.
    """
    table = finished_replicates(table)
    done = _finished(table)
    channels = [str(name) for name in dict.fromkeys(done["channel"])]
    requirement.check_channel(channels)
    held = {name: float(done.loc[done["channel"] == name, "completeness"].mean()) for name in channels}
    channel = requirement.channel or max(held, key=lambda name: held[name])
    found = point_scores(table, list(source["axes"]), requirement.score, channel, _rng())
    flights = len(set(done["replicate"]))
    rows = zip(found["point"], found["score"], found["low"], found["high"], strict=True)
    return channel, [(name, judge(requirement, value, low, high, flights)) for name, value, low, high in rows]


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


def views(table: pd.DataFrame, varied: Sequence[str]) -> pd.DataFrame:
    """Ground sample distance and window at each level of the axes that change them.

    Where every flight differs in all axes, as in a sampled design, those that the view follows in rank.
    """
    parts = []
    spread = set(continuous(table[list(varied)]))
    for axis in varied if set(VIEW) <= set(table) else ():
        if axis in CHANCE or (axis in spread and _follows(table, axis) < _FOLLOWS):
            continue
        # the others at their first values, else one axis passes for another's in a one-at-a-time design
        others = [other for other in varied if other != axis]
        first = table.loc[(table[others] == table[others].iloc[0]).all(axis=1)]
        of = first if first[axis].nunique() == table[axis].nunique() else table
        means = of.groupby(axis, sort=False)[list(VIEW)].mean()
        if ((means.max() - means.min()) > 1e-6 * means.max()).any():
            parts.append(means.reset_index(names="level").astype({"level": str}).assign(axis=axis))
    return pd.concat(parts, ignore_index=True)[["axis", "level", *VIEW]] if parts else pd.DataFrame()


def _follows(table: pd.DataFrame, axis: str) -> float:
    """Largest |ρ| of Spearman's between an axis and what of the ground is seen."""
    ranks = table[[axis, *VIEW]].rank()
    return float(np.nanmax(np.abs(ranks.corr().loc[axis, list(VIEW)].to_numpy()), initial=0.0))


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
            hold = " (`constraints.constant_field = true` holds the field)" if axis in FIELD_KEYS else ""
            notes[-1] += f": who sees less of the window holds fewer of its vehicles{hold}"
    return notes


def figures(tables: Mapping[str, pd.DataFrame]) -> dict[str, Figure]:
    """Figures of the tables, by name."""
    out: dict[str, Figure] = {}
    show = {
        "effects": _show_effects,
        "contrasts": _show_contrasts,
        "surrogate": _show_surrogate,
        "sobol": _show_sobol,
    }
    for name, draw in show.items():
        found = tables.get(name, pd.DataFrame(columns=["response"]))
        for response in RESPONSES:
            mine = found[found["response"] == response]
            if len(mine):
                out[f"{name}_{response}"] = draw(mine, NAMES[response])
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


def _intervals(ax: Axes, rows: pd.DataFrame, y: np.ndarray, colour: str, marker: str, label: str) -> None:
    """Draw effects and their intervals at heights ``y``."""
    value, low, high = (rows[name].to_numpy() for name in ("effect", "low", "high"))
    there = np.isfinite(low)
    ax.hlines(y[there], low[there], high[there], color=colour, linewidth=1.2)
    ax.plot(value, y, marker, color=colour, markersize=4, label=label, linestyle="none")


def _show_effects(mine: pd.DataFrame, score: str) -> Figure:
    """Each effect with its interval, one channel above the other, zero drawn through."""
    there = [m for m in CHANNELS if m in set(mine["channel"])]
    rows = list(dict.fromkeys(zip(mine["axis"], mine["level"], strict=True)))
    figure, ax = _panel(6.6, 1.0 + 0.34 * len(rows))
    place = {row: k for k, row in enumerate(rows)}
    for k, channel in enumerate(there):
        part = mine[mine["channel"] == channel]
        shift = 0.2 * (k - 0.5 * (len(there) - 1))
        at = [place[row] + shift for row in zip(part["axis"], part["level"], strict=True)]
        _intervals(ax, part, np.array(at), *CHANNELS[channel], CHANNEL_NAMES.get(channel, channel))
    ax.axvline(0, color="black", linewidth=0.6)
    ax.set_yticks(range(len(rows)), [f"{axis}: {level}" for axis, level in rows], fontsize=8)
    ax.set_ylim(len(rows) - 0.5, -0.5)
    figure.supxlabel(f"change of {score} (95 % interval)", fontsize=10)  # wider than the axis may be
    figure.legend(frameon=False, fontsize=8, ncols=len(there), loc="outside upper right")
    return figure


def _show_contrasts(mine: pd.DataFrame, score: str) -> Figure:
    """Each contrast at each point, one below the other, zero drawn through; keys by their last part."""
    figure, ax = _panel(7.6, 1.4 + 0.22 * len(mine))
    y = np.arange(len(mine))
    for k, name in enumerate(dict.fromkeys(mine["contrast"])):
        here = (mine["contrast"] == name).to_numpy()
        _intervals(ax, mine[here], y[here], f"C{k % 10}", "s", str(name))
    ax.axvline(0, color="black", linewidth=0.6)
    names = [re.sub(r"\b\w+\.(?=[a-z])", "", point) for point in mine["point"]]
    if mine["contrast"].nunique() == len(mine):  # one point each: they say what they are
        names = list(mine["contrast"])
    else:
        figure.legend(frameon=False, fontsize=8, loc="outside upper left")
    ax.set_yticks(y, [name if len(name) < 60 else f"{name[:57]}…" for name in names], fontsize=7)
    ax.set_ylim(len(mine) - 0.5, -0.5)
    figure.supxlabel(f"change of {score} (95 % interval)", fontsize=10)
    return figure


def _show_surrogate(mine: pd.DataFrame, score: str) -> Figure:
    """What a flight is predicted to score along each axis, with an interval of 90 %; others in the middle."""
    axes = list(dict.fromkeys(mine["axis"]))
    figure = Figure(figsize=(1.4 + 2.6 * len(axes), 3.2), layout="constrained")
    panels = figure.subplots(1, len(axes), sharey=True, squeeze=False)[0]
    for panel, axis in zip(panels, axes, strict=True):
        for channel, part in mine[mine["axis"] == axis].groupby("channel", sort=False):
            colour, _ = CHANNELS[str(channel)]
            panel.plot(part["value"], part["predicted"], color=colour, label=channel)
            panel.fill_between(
                part["value"], part["low"], part["high"], color=colour, alpha=0.15, linewidth=0
            )
        panel.set_xlabel(axis)
        panel.spines[["top", "right"]].set_visible(False)
    panels[0].set_ylabel(f"{score} of a flight (90 %)")
    panels[0].legend(frameon=False, fontsize=8)
    return figure


def _show_sobol(mine: pd.DataFrame, score: str) -> Figure:
    """First-order and total index of each axis."""
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
            ax.bar(x, value, 0.18, color=CHANNELS[channel][0], alpha=alpha, label=label)
            ax.errorbar(x, value, ends, fmt="none", ecolor="black", elinewidth=0.8)
    ax.set_xticks(range(len(axes)), axes, fontsize=8)
    ax.set_ylabel(f"share of variance of {score}")
    ax.legend(frameon=False, fontsize=8)
    return figure


def _show_pareto(found: pd.DataFrame) -> Figure:
    """Purity and completeness against data rate, the front joined."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    for ax, gain in zip(figure.subplots(1, 2), ("purity", "completeness"), strict=True):
        for channel in dict.fromkeys(found["channel"]):
            part = found[found["channel"] == channel].sort_values("data_rate_mbit_s")
            colour, marker = CHANNELS[channel]
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
    lines = dict(zip(CHANNELS, ("--", "-", ":", "-."), strict=True))
    for (group, channel), part in found.groupby(["group", "channel"], sort=False):
        part = part.sort_values("false_per_epoch")
        style = {"color": colours[groups.index(group)], "linestyle": lines[str(channel)], "markersize": 3}
        marker = CHANNELS[str(channel)][1]
        label = f"{channel}, {group}" if group else str(channel)
        ax.plot(part["false_per_epoch"], part["completeness"], marker=marker, label=label, **style)
    ax.set(xlabel=NAMES["false_per_epoch"], ylabel=NAMES["completeness"])
    ax.legend(frameon=False, fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure
