"""Report of a study: all tables that its design allows, their figures, and requirements by point."""

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from glintrack.io import atomic, images
from glintrack.metrics.requirement import Assessment, Requirement, assess
from glintrack.study import analysis
from glintrack.study.comparisons import aa_test, all_contrasts, design_contrasts, rank_agreement
from glintrack.study.design import flat
from glintrack.study.folder import VIEW, read_results, select_finished_replicates
from glintrack.study.intervals import units
from glintrack.study.plan import FIELD_KEYS
from glintrack.study.text_tables import CHANNEL_WORDS, CHANNELS, NAMES, RANKED_BY, RESPONSES

SEED = 0  # of the bootstrap, for reproducible reports
_SPREAD = ("latin-hypercube", "sobol")  # designs with a surrogate
_MIN_RANK_CORRELATION = 0.4  # between an axis and the view, not by chance in forty flights
_MAX_FIELD_CHANGE = 0.02  # by rounding to whole superpixels
_MAX_PAIRED_AXES = 6  # with a table of interactions
_INTERVAL = "95 % interval"
_UPPER = ["top", "right"]  # sides of a diagram without a frame


def write_report(
    result: str | Path, results: tuple[pd.DataFrame, Mapping[str, Any]] | None = None
) -> tuple[Path, dict[str, pd.DataFrame]]:
    """Analyse a study's folder and write ``report/`` in it.

    Parameters
    ----------
    result
        The folder.
    results
        Return value of `read_results`, if it has been read.

    Returns
    -------
    The folder, and its tables by name: ``points``, ``effects``, ``interactions``, ``sobol``, ``pareto``,
    ``contrasts``, ``ranks``, ``aa_test``, ``surrogate``, ``surrogate_check``, ``views``, ``froc``, as far as
    the design allows them.

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
        texts = {name: column.astype(str) for name, column in found.items() if column.dtype == object}
        atomic.write_bytes(folder / f"{name}.parquet", found.assign(**texts).to_parquet(index=False))
    for name, figure in figures(tables).items():
        images.write_figure(folder / f"{name}.png", figure, dpi=200)
        images.write_figure(folder / f"{name}.pdf", figure)
    return folder, tables


def analyse(table: pd.DataFrame, source: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """All tables that a study's design allows, by name; see `write_report`."""
    table = select_finished_replicates(table)
    done = _select_finished(table)
    axes, design = list(source["axes"]), source["design"]["design"]
    channels = [name for name in CHANNELS if name in set(done["channel"])]
    responses = [name for name in RESPONSES if name in done and done[name].notna().any()]
    varied = [axis for axis in axes if done[axis].nunique() > 1]
    even_in_log = log_axes(source)
    points = len(set(table["point"] // max(table["replicate"].nunique(), 1)))
    out: dict[str, list[pd.DataFrame]] = {}

    def add(name: str, found: pd.DataFrame, channel: str, response: str) -> None:
        if len(found):
            labelled = pd.DataFrame({"channel": channel, "response": response, **found})
            out.setdefault(name, []).append(labelled)

    for channel in channels:
        for response in responses:
            named = (channel, response)
            add("points", analysis.point_scores(table, axes, response, channel, _rng()), *named)
            for under in source["design"].get("ranked_under", ()) if response in RANKED_BY else ():
                if table.loc[table["channel"] == channel, response].notna().any():
                    add("ranks", rank_agreement(table, axes, under, response, channel, _rng()), *named)
            if not varied:
                continue
            found, rng = units(table, varied, response, channel), _rng()
            add("effects", analysis.effects(found, rng), *named)
            if 2 <= len(varied) <= _MAX_PAIRED_AXES and design != "one-at-a-time":
                both = analysis.effects(found, rng, interactions=True)
                add("interactions", both[both["axis"].str.contains("×")], *named)
            if design in _SPREAD:
                surfaces, check = analysis.surrogates(done, varied, response, channel, even_in_log)
                add("surrogate", surfaces, *named)
                add("surrogate_check", check, *named)
            if design == "saltelli" and len(found.points) == points:
                add("sobol", analysis.sobol_indices(found, axes, rng), *named)
    tables = {name: pd.concat(parts, ignore_index=True) for name, parts in out.items()}
    tables["pareto"] = _pareto(done, axes, channels)
    contrasts = design_contrasts(source["design"], axes)
    tables["contrasts"] = all_contrasts(table, axes, responses, contrasts, SEED)
    if responses:
        tests = aa_test(table, axes, responses[0], channels, _rng())
        tables["aa_test"] = tests.assign(response=responses[0])
    tables |= {"views": views(table, varied), "froc": analysis.froc(table, axes)}
    return {name: found for name, found in tables.items() if len(found)}


def log_axes(source: Mapping[str, Any]) -> list[str]:
    """Axes of a study that are even in the logarithm."""
    spans = flat(source["design"].get("axes", {}))
    return [name for name, span in spans.items() if isinstance(span, dict) and span.get("log")]


def response_surfaces(
    table: pd.DataFrame, source: Mapping[str, Any]
) -> dict[tuple[str, str], analysis.ResponseSurface]:
    """Response surfaces of a sampled study by score and channel; empty for another design."""
    if source["design"]["design"] not in _SPREAD:
        return {}
    done = _select_finished(select_finished_replicates(table))
    varied = [axis for axis in source["axes"] if done[axis].nunique() > 1]
    pairs = [(name, c) for name in RESPONSES if name in done for c in CHANNELS if c in set(done["channel"])]
    fits = {pair: analysis.fit_scores(done, varied, *pair, log_axes(source)) for pair in pairs}
    return {pair: surface for pair, surface in fits.items() if surface is not None}


def _rng() -> np.random.Generator:
    return np.random.default_rng(SEED)


def _select_finished(table: pd.DataFrame) -> pd.DataFrame:
    done = table[table["status"] == "finished"]
    if done.empty:
        raise ValueError(f"`result` must hold finished cases; got none of {len(table)} rows finished.")
    return done


def check_points(
    table: pd.DataFrame, source: Mapping[str, Any], requirement: Requirement
) -> tuple[str, list[tuple[str, Assessment]]]:
    """Channel of a requirement, and its check at each point of the design.

    Raises
    ------
    ValueError
        If no case is finished, or the study lacks the score or the channel.
    """
    table = select_finished_replicates(table)
    done = _select_finished(table)
    requirement.check_channel([str(name) for name in dict.fromkeys(done["channel"])])
    means = done.groupby("channel", sort=False)["completeness"].mean()
    channel = requirement.channel or str(means.idxmax())
    found = analysis.point_scores(table, list(source["axes"]), requirement.score, channel, _rng())
    flights = len(set(done["replicate"]))
    return channel, [
        (row["point"], assess(requirement, row["score"], row["low"], row["high"], flights))
        for row in found.to_dict("records")
    ]


def _pareto(done: pd.DataFrame, axes: Sequence[str], channels: Sequence[str]) -> pd.DataFrame:
    """Mean purity, completeness and data rate of each design, and whether it is on the Pareto front."""
    scores = ["purity", "completeness", "data_rate_mbit_s"]
    means = done.groupby([*axes, "channel"], sort=False)[scores].mean().reset_index()
    for gain in ("purity", "completeness"):
        front = pd.Series(False, index=means.index)
        for channel in channels:
            mine = means["channel"] == channel
            part = means[mine]
            front[mine] = analysis.pareto_front(part["data_rate_mbit_s"].to_numpy(), part[gain].to_numpy())
        means[f"{gain}_front"] = front
    return means


def views(table: pd.DataFrame, varied: Sequence[str]) -> pd.DataFrame:
    """Ground sample distance and window at each level of the axes that change them.

    Where every flight differs in all axes, as in a sampled design, those correlated with the view.
    """
    parts, sampled = [], set(analysis.continuous_axes(table[list(varied)]))
    for axis in varied if set(VIEW) <= set(table) else ():
        ranks = table[[axis, *VIEW]].rank().corr().loc[axis, list(VIEW)].abs()
        if axis in analysis.CHANCE or (axis in sampled and not ranks.max() >= _MIN_RANK_CORRELATION):
            continue
        # the others at their first values, else one axis passes for another's in a one-at-a-time design
        others = [other for other in varied if other != axis]
        first = table.loc[(table[others] == table[others].iloc[0]).all(axis=1)]
        of = first if first[axis].nunique() == table[axis].nunique() else table
        means = of.groupby(axis, sort=False)[list(VIEW)].mean()
        if ((means.max() - means.min()) > 1e-6 * means.max()).any():
            parts.append(means.reset_index(names="level").astype({"level": str}).assign(axis=axis))
    return pd.concat(parts, ignore_index=True)[["axis", "level", *VIEW]] if parts else pd.DataFrame()


def view_notes(views: pd.DataFrame) -> list[str]:
    """Sentence for each axis that changes the view of the ground."""
    notes = []
    for axis, of in views.groupby("axis", sort=False):
        low, high = of[list(VIEW)].min(), of[list(VIEW)].max()
        changes = []
        for column, text in (("gsd_across_m", "an element {} m across"), ("window_km2", "the array {} km²")):
            ends = f"{low[column]:.3g}", f"{high[column]:.3g}"
            if ends[0] != ends[1]:
                changes.append(text.format(" to ".join(ends)))
        note = f"`{axis}` changes the view too: {', '.join(changes)}"
        if high["window_km2"] - low["window_km2"] > _MAX_FIELD_CHANGE * high["window_km2"]:
            fixed = " (`constraints.constant_field = true` fixes the field)" if axis in FIELD_KEYS else ""
            note += f": a smaller part of the window has fewer of its vehicles{fixed}"
        notes.append(note)
    return notes


def figures(tables: Mapping[str, pd.DataFrame]) -> dict[str, Figure]:
    """Figures of the tables, by name."""
    out: dict[str, Figure] = {}
    draw = {
        "effects": _draw_effects,
        "contrasts": _draw_contrasts,
        "surrogate": _draw_surrogate,
        "sobol": _draw_sobol,
    }
    for name, function in draw.items():
        found = tables.get(name, pd.DataFrame(columns=["response"]))
        for response in RESPONSES:
            mine = found[found["response"] == response]
            if len(mine):
                out[f"{name}_{response}"] = function(mine, NAMES[response])
    if tables["pareto"]["data_rate_mbit_s"].nunique() > 1:
        out["pareto"] = _draw_pareto(tables["pareto"])
    if "froc" in tables:
        out["froc"] = _draw_froc(tables["froc"])
    return out


def _draw_intervals(rows: pd.DataFrame, xlabel: str) -> Figure:
    """Values with intervals: a line for each ``label``, a colour for each ``group``."""
    labels, groups = list(dict.fromkeys(rows["label"])), list(dict.fromkeys(rows["group"]))
    figure = Figure(figsize=(7.2, 1.2 + (0.22 + 0.06 * len(groups)) * len(labels)), layout="constrained")
    ax = figure.add_subplot()
    styles = {CHANNEL_WORDS[name]: style for name, style in CHANNELS.items()}
    for k, group in enumerate(groups):
        part = rows[rows["group"] == group]
        y = [labels.index(label) + 0.6 * ((k + 0.5) / len(groups) - 0.5) for label in part["label"]]
        value = part["value"].to_numpy()
        ends = np.abs(part[["low", "high"]].to_numpy() - value[:, None]).T
        colour, marker = styles.get(group, (f"C{k % 10}", "s"))
        ax.errorbar(value, y, xerr=ends, fmt=marker, color=colour, markersize=4, linewidth=1.2, label=group)
    ax.axvline(0, color="black", linewidth=0.6)
    ax.set_yticks(range(len(labels)), [text if len(text) < 60 else f"{text[:57]}…" for text in labels])
    ax.set_ylim(len(labels) - 0.5, -0.5)
    ax.tick_params(axis="y", labelsize=7)
    ax.spines[_UPPER].set_visible(False)
    figure.supxlabel(xlabel, fontsize=10)  # wider than the axis may be
    if len(groups) > 1:
        figure.legend(frameon=False, fontsize=8, loc="outside upper right")
    return figure


def _draw_effects(mine: pd.DataFrame, score: str) -> Figure:
    rows = mine.assign(label=mine["axis"] + ": " + mine["level"], group=mine["channel"].map(CHANNEL_WORDS))
    return _draw_intervals(rows.rename(columns={"effect": "value"}), f"change of {score} ({_INTERVAL})")


def _draw_contrasts(mine: pd.DataFrame, score: str) -> Figure:
    points = [re.sub(r"\b\w+\.(?=[a-z])", "", point) for point in mine["point"]]  # keys by their last part
    single = mine["contrast"].nunique() == len(mine)
    rows = mine.assign(label=mine["contrast"] if single else points, group=mine["contrast"])
    return _draw_intervals(rows.rename(columns={"effect": "value"}), f"change of {score} ({_INTERVAL})")


def _draw_sobol(mine: pd.DataFrame, score: str) -> Figure:
    parts = []
    for name, text in (("first", "first order"), ("total", "total")):
        columns = {name: "value", f"{name}_low": "low", f"{name}_high": "high", "axis": "label"}
        part = mine[["channel", *columns]].rename(columns=columns)
        parts.append(part.assign(group=part["channel"].map(CHANNEL_WORDS) + f", {text}"))
    return _draw_intervals(pd.concat(parts), f"share of the variance of {score} ({_INTERVAL})")


def _draw_surrogate(mine: pd.DataFrame, score: str) -> Figure:
    """Prediction along each axis with an interval of 90 %, the others at the middle of their ranges."""
    axes = list(dict.fromkeys(mine["axis"]))
    figure = Figure(figsize=(1.4 + 2.6 * len(axes), 3.2), layout="constrained")
    panels = figure.subplots(1, len(axes), sharey=True, squeeze=False)[0]
    for panel, axis in zip(panels, axes, strict=True):
        for channel, part in mine[mine["axis"] == axis].groupby("channel", sort=False):
            colour, _ = CHANNELS[str(channel)]
            panel.plot(part["value"], part["predicted"], color=colour, label=channel)
            ends = part["low"], part["high"]
            panel.fill_between(part["value"], *ends, color=colour, alpha=0.15, linewidth=0)
        panel.set_xlabel(axis)
        panel.spines[_UPPER].set_visible(False)
    panels[0].set_ylabel(f"{score}\nof a flight (90 %)")
    panels[0].legend(frameon=False, fontsize=8)
    return figure


def _draw_pareto(found: pd.DataFrame) -> Figure:
    """Purity and completeness against data rate, with the Pareto front as a line."""
    figure = Figure(figsize=(7.2, 3.4), layout="constrained")
    for ax, gain in zip(figure.subplots(1, 2), ("purity", "completeness"), strict=True):
        for channel, part in found.sort_values("data_rate_mbit_s").groupby("channel", sort=False):
            colour, marker = CHANNELS[str(channel)]
            ax.plot(part["data_rate_mbit_s"], part[gain], marker, color=colour, markersize=4, alpha=0.35)
            front = part[part[f"{gain}_front"]]
            style = {"color": colour, "marker": marker, "markersize": 6, "markeredgecolor": "black"}
            ax.step(front["data_rate_mbit_s"], front[gain], where="post", label=f"{channel}, front", **style)
        ax.set(xlabel=NAMES["data_rate_mbit_s"], ylabel=NAMES[gain])
        ax.spines[_UPPER].set_visible(False)
    ax.legend(frameon=False, fontsize=8)
    return figure


def _draw_froc(found: pd.DataFrame) -> Figure:
    """Completeness against false tracks per frame: colour by group, line by channel."""
    figure = Figure(figsize=(7.2, 4.0), layout="constrained")
    ax, groups = figure.add_subplot(), list(dict.fromkeys(found["group"]))
    colours = matplotlib.colormaps["viridis"](np.linspace(0, 0.9, len(groups)))
    lines = dict(zip(CHANNELS, ("--", "-", ":"), strict=True))
    ordered = found.sort_values("false_per_frame")
    for (group, channel), part in ordered.groupby(["group", "channel"], sort=False):
        style = {"color": colours[groups.index(group)], "linestyle": lines[str(channel)], "markersize": 3}
        label = f"{channel}, {group}" if group else str(channel)
        marker = CHANNELS[str(channel)][1]
        ax.plot(part["false_per_frame"], part["completeness"], marker=marker, label=label, **style)
    ax.set(xlabel=NAMES["false_per_frame"], ylabel=NAMES["completeness"])
    ax.spines[_UPPER].set_visible(False)
    ax.legend(frameon=False, fontsize=6, loc="center left", bbox_to_anchor=(1, 0.5))
    return figure
