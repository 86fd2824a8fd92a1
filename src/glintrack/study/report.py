"""The report of a study: every table that its design allows as CSV, and their figures."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportCallIssue=false, reportArgumentType=false
# pyright: reportGeneralTypeIssues=false, reportReturnType=false, reportOperatorIssue=false, reportIndexIssue=false

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from glintrack.io import atomic, pictures
from glintrack.study.analysis import effects, pareto_front, point_scores, roc, sobol_indices
from glintrack.study.contrasts import all_contrasts, asked_contrasts
from glintrack.study.design import flat
from glintrack.study.figures import figures
from glintrack.study.intervals import units
from glintrack.study.nulls import relabelled
from glintrack.study.plan import FIELD_KEYS
from glintrack.study.ranks import rank_agreement
from glintrack.study.scores import CHANNELS, RANKED_BY, RESPONSES
from glintrack.study.surrogate import CHANCE, continuous, surrogates
from glintrack.study.table import VIEW, flown, read_results

_SPREAD = ("latin-hypercube", "sobol")  # designs that a surrogate is fitted to
_SURROGATE = ("surrogate", "surrogate_check")
_FOLLOWS = 0.4  # rank correlation that forty flights hardly show by chance
_SAME_FIELD = 0.02  # whole superpixels leave so much
_MOST_PAIRS = 6  # axes of which every pair is fitted; more make tables nobody reads
SEED = 0  # of the bootstrap, so that a report says the same each time


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
    ``contrasts``, ``ranks``, ``nulls``, ``surrogate``, ``surrogate_check``, ``views``, ``roc``, those that
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
        pictures.write_figure(folder / f"{name}.png", figure, dpi=200)
        pictures.write_figure(folder / f"{name}.pdf", figure)
    return folder, tables


def analyse(table: pd.DataFrame, source: Mapping[str, Any]) -> dict[str, pd.DataFrame]:
    """Every table that a study's design allows, by name; see `write_report`."""
    table = flown(table)
    done = table[table["status"] == "finished"]
    if done.empty:
        raise ValueError(f"`result` must hold finished cases, got none of {len(table)} rows finished")
    axes, design = list(source["axes"]), source["design"]["design"]
    channels = [m for m in CHANNELS if m in set(done["channel"])]
    responses = [name for name in RESPONSES if name in done]
    responses = [name for name in responses if done[name].notna().any()]
    varied = [axis for axis in axes if done[axis].nunique() > 1]
    spans = flat(source["design"].get("axes", {}))
    even_in_log = [name for name, span in spans.items() if isinstance(span, dict) and span.get("log")]
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
            if design in _SPREAD:
                for name, part in zip(
                    _SURROGATE, surrogates(done, varied, response, channel, even_in_log), strict=True
                ):
                    _add(out, name, part, named)
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
    for response in responses[:1]:
        dealt = relabelled(table, axes, response, channels, np.random.default_rng(SEED))
        if len(dealt):
            tables["nulls"] = dealt.assign(response=response)
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
