"""Figures of a study's tables that a paper could print."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

import re
from collections.abc import Mapping

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from glintrack.study.scores import CHANNEL_NAMES, CHANNELS, NAMES, RESPONSES


def figures(tables: Mapping[str, pd.DataFrame]) -> dict[str, Figure]:
    """Figures of the tables, by name."""
    out: dict[str, Figure] = {}
    for response in RESPONSES:
        if "effects" in tables and response in set(tables["effects"]["response"]):
            out[f"effects_{response}"] = _show_effects(tables["effects"], response)
        if "contrasts" in tables and response in set(tables["contrasts"]["response"]):
            out[f"contrasts_{response}"] = _show_contrasts(tables["contrasts"], response)
        if "surrogate" in tables and response in set(tables["surrogate"]["response"]):
            out[f"surrogate_{response}"] = _show_surrogate(tables["surrogate"], response)
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
    _intervals(ax, value, low, high, y, *CHANNELS[channel], CHANNEL_NAMES.get(channel, channel))


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
    there = [m for m in CHANNELS if m in set(mine["channel"])]
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
    ax.set_ylim(len(rows) - 0.5, -0.5)
    figure.supxlabel(
        f"change of {NAMES[response]} (95 % interval)", fontsize=10
    )  # wider than the axis may be
    figure.legend(frameon=False, fontsize=8, ncols=len(there), loc="outside upper right")
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
    if mine["contrast"].nunique() == len(mine):  # one point each: they say what they are
        names = list(mine["contrast"])
    else:
        figure.legend(frameon=False, fontsize=8, loc="outside upper left")
    ax.set_yticks(y, [name if len(name) < 60 else f"{name[:57]}…" for name in names], fontsize=7)
    ax.set_ylim(len(mine) - 0.5, -0.5)
    figure.supxlabel(f"change of {NAMES[response]} (95 % interval)", fontsize=10)
    return figure


def _show_surrogate(found: pd.DataFrame, response: str) -> Figure:
    """What a flight is predicted to score along each axis, with an interval of 90 %; others in the middle."""
    mine = found[found["response"] == response]
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
    panels[0].set_ylabel(f"{NAMES[response]} of a flight (90 %)")
    panels[0].legend(frameon=False, fontsize=8)
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
            ax.bar(x, value, 0.18, color=CHANNELS[channel][0], alpha=alpha, label=label)
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
