"""Findings of an optimization: answer, Pareto front, what limits it, what would have to change, certainty."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.figure import Figure
from pydantic import Field
from scipy import stats

from glintrack.core.arrays import Array
from glintrack.core.designs import Design, validate_design
from glintrack.io import atomic, images
from glintrack.io.untrusted import read_json
from glintrack.metrics.requirement import SHARES, Assessment, Requirement, assess
from glintrack.study.analysis import LEVEL, pareto_front
from glintrack.study.design import Axis, Level
from glintrack.study.intervals import estimate
from glintrack.study.optimize.search import Outcome, feasibility, inverse_transform
from glintrack.study.optimize.spec import Optimization, is_ordered
from glintrack.study.text_tables import TextTable

RESULT = "optimization.json"
_RELAXED = (0.05, 0.1, 0.2)  # shares of the limit
_MAX_FRONT = 12
_LEAST = 0.01  # probability of a design of the front
_AT_END = 0.02  # of an axis's range
Number = Annotated[float, Field(ge=-1e15, le=1e15)]
Whole = Annotated[int, Field(ge=-(10**15), le=10**15)]
Share = Annotated[float, Field(ge=0, le=1)]
INTERVAL_DEVIATE = float(stats.norm.ppf(0.5 + LEVEL / 2))


class Predictor(Design):
    """Prediction of a score from the levels of a design, for the page's program."""

    label: str
    """Score and channel."""
    logarithmic: bool
    """Whether the Gaussian process is of log(1 + score)."""
    process: dict[str, Any]
    """Plain values of the Gaussian process."""


class FrontDesign(Design):
    """Design of the Pareto front with its cost and its probability to meet all requirements."""

    design: str
    cost: Number
    probability: Share


class SliderAxis(Design):
    """Axis of a design with its range or its values."""

    name: str
    low: Number | None = None
    high: Number | None = None
    log: bool = False
    integer: bool = False
    labels: tuple[bool | Whole | Number | str, ...] = ()
    ordered: bool = False
    value: bool | Whole | Number | str
    """Level of the answer's design."""


class OptimizationResult(Design):
    """Findings of an optimization; the file ``optimization.json`` of its folder."""

    answer: str = Field(pattern="^(yes|no|undecided)$", description="Whether a design is confirmed")
    cost: Number = Field(description="Cost of the confirmed or most promising design")
    sentences: tuple[str, ...] = Field(description="Answer, limit, change and certainty")
    front: tuple[FrontDesign, ...] = Field(description="Designs with cost and probability")
    tables: tuple[TextTable, ...]
    axes: tuple[SliderAxis, ...]
    predictors: tuple[Predictor, ...]


def build_result(setup: Optimization, outcome: Outcome) -> OptimizationResult:
    """Build the findings of a search."""
    labels = requirement_labels(setup)
    front = _front(setup, outcome)
    changes = _relaxations(setup, outcome, labels)
    rows = tuple((one.design, f"{one.cost:.4g}", _share(one.probability)) for one in front)
    title = "Pareto front of cost and of the probability to meet all requirements"
    tables = [
        _requirements_table(setup, outcome, labels),
        TextTable(title, ("design", "cost", "probability"), rows, words=1),
    ]
    if changes is not None:
        tables.append(changes)
    return OptimizationResult(
        answer=outcome.answer,
        cost=float(setup.problem.cost[outcome.design]),
        sentences=tuple(_sentences(setup, outcome, labels, changes)),
        front=tuple(front),
        tables=tuple(tables),
        axes=tuple(_slider(axis, setup.levels[outcome.design][axis.name]) for axis in setup.axes),
        predictors=tuple(
            Predictor(label=label, logarithmic=requirement.score not in SHARES, process=process.to_values())
            for label, requirement, process in zip(
                labels, setup.problem.requirements, outcome.processes, strict=True
            )
        ),
    )


def write_result(folder: Path, result: OptimizationResult) -> None:
    """Write ``optimization.json``, and the Pareto front as CSV and picture into ``report/``."""
    atomic.write_text(folder / RESULT, result.model_dump_json(indent=1) + "\n")
    (folder / "report").mkdir(exist_ok=True)
    front = pd.DataFrame([one.model_dump() for one in result.front], columns=[*FrontDesign.model_fields])
    atomic.write_text(folder / "report" / "front.csv", front.to_csv(index=False, float_format="%.6g"))
    if len(front):
        figure = _draw_front(front, result)
        images.write_figure(folder / "report" / "front.png", figure, dpi=200)
        images.write_figure(folder / "report" / "front.pdf", figure)
    else:
        for ending in ("png", "pdf"):
            (folder / "report" / f"front.{ending}").unlink(missing_ok=True)


def read_result(folder: Path) -> OptimizationResult | None:
    """Read ``optimization.json``; None if a study's folder has none.

    Raises
    ------
    ValueError
        If it cannot be read.
    """
    if not (folder / RESULT).is_file():
        return None
    return validate_design(OptimizationResult, read_json(folder / RESULT, RESULT))


def requirement_labels(setup: Optimization) -> list[str]:
    """Text of each requirement with its condition."""
    pairs = zip(setup.problem.requirements, setup.conditions, strict=True)
    return [f"{requirement}{f' ({condition})' if condition else ''}" for requirement, condition in pairs]


def describe_design(levels: Mapping[str, Level]) -> str:
    """Levels of a design, numbers with four digits."""
    texts = (f"{v:.4g}" if isinstance(v, float) else str(v) for v in levels.values())
    return ", ".join(f"{name} = {text}" for name, text in zip(levels, texts, strict=True))


def _slider(axis: Axis, value: Level) -> SliderAxis:
    if axis.span is None:
        return SliderAxis(name=axis.name, labels=axis.labels, ordered=is_ordered(axis), value=value)
    return SliderAxis(name=axis.name, value=value, **axis.span.model_dump())


def _of_requirements(setup: Optimization, outcome: Outcome) -> Float[Array, "candidate requirement"]:
    return feasibility(setup.problem.requirements, outcome.processes, setup.problem.places)


def _confirmation(setup: Optimization, outcome: Outcome, k: int) -> Assessment | None:
    """Assess a requirement with the confirming cities alone; None without a confirmation."""
    seen = outcome.observations
    mine = (seen.design == outcome.design) & np.isin(seen.city, outcome.confirming)
    scores = seen.scores[mine, k]
    if np.isfinite(scores).sum() < 2:
        return None
    of = estimate(np.eye(1), scores[None], np.random.default_rng(0))
    return assess(setup.problem.requirements[k], float(of.value[0]), float(of.low[0]), float(of.high[0]))


def _requirements_table(setup: Optimization, outcome: Outcome, labels: Sequence[str]) -> TextTable:
    """Prediction and confirming simulations of each requirement at the answer's design."""
    place = setup.problem.places[outcome.design][None]
    predictions, confirmations = [], []
    probable = _of_requirements(setup, outcome)[outcome.design]
    for k, requirement in enumerate(setup.problem.requirements):
        middle, sd = outcome.processes[k].predict(place)
        ends = np.array([-1, 0, 1]) * sd * INTERVAL_DEVIATE
        low, value, high = inverse_transform(requirement, middle + ends)
        fresh, said = _confirmation(setup, outcome, k), "–"
        if fresh is not None:
            said = f"{fresh.value:.3g} ({fresh.low:.3g} to {fresh.high:.3g}), met: {fresh.answer}"
        predictions.append(f"{value:.3g} ({low:.3g} to {high:.3g})")
        confirmations.append(said)
    rows = tuple(zip(labels, predictions, map(_share, probable), confirmations, strict=True))
    heads = ("requirement", "score (90 % interval)", "probability", "unseen cities alone (95 % interval)")
    return TextTable("the design's scores, means over cities", heads, rows, words=2)


def _share(probability: float) -> str:
    return "> 0.99" if probability > 0.99 else "< 0.01" if probability < 0.01 else f"{probability:.2f}"


def _front(setup: Optimization, outcome: Outcome) -> list[FrontDesign]:
    """Designs that no other beats in cost and probability, evenly spread."""
    cost, probable = setup.problem.cost, np.round(outcome.feasibility, 4)
    front = np.flatnonzero(pareto_front(cost, probable) & (probable >= _LEAST))
    front = front[np.argsort(cost[front])]
    if len(front) > _MAX_FRONT:
        front = front[np.unique(np.linspace(0, len(front) - 1, _MAX_FRONT).round().astype(int))]
    return [
        FrontDesign(
            design=describe_design(setup.levels[k]), cost=float(cost[k]), probability=float(probable[k])
        )
        for k in front
    ]


def _relaxations(setup: Optimization, outcome: Outcome, labels: Sequence[str]) -> TextTable | None:
    """Predicted cheapest cost under weaker limits of the requirement that limits the design."""
    problem, each = setup.problem, _of_requirements(setup, outcome)
    k = int(each[outcome.design].argmin())
    rows = []
    for share in (0.0, *_RELAXED):
        requirement = _relax(problem.requirements[k], share)
        own = feasibility([requirement], outcome.processes[k : k + 1], problem.places)[:, 0]
        probable = np.delete(each, k, axis=1).prod(axis=1) * own
        met = probable >= problem.probability
        cost = f"{problem.cost[met].min():.4g}" if met.any() else "none"
        limit = labels[k] if share == 0 else labels[k].replace(str(problem.requirements[k]), str(requirement))
        rows.append((limit, cost))
    if len({cost for _, cost in rows}) == 1:
        return None
    return TextTable("cheapest cost if one limit were weaker (predicted)", ("limit", "cost"), tuple(rows))


def _relax(requirement: Requirement, share: float) -> Requirement:
    factor = 1 - share if requirement.at_least else 1 + share
    limit = float(f"{requirement.limit * factor:.3g}") if share else requirement.limit
    return Requirement(requirement.score, requirement.at_least, limit, requirement.channel)


def _sentences(
    setup: Optimization, outcome: Outcome, labels: Sequence[str], changes: TextTable | None
) -> list[str]:
    """State answer, what limits it, what would have to change, and how certain it is."""
    problem, chosen = setup.problem, outcome.design
    design, cost = describe_design(setup.levels[chosen]), f"{problem.cost[chosen]:.4g}"
    each = _of_requirements(setup, outcome)[chosen]
    k = int(each.argmin())
    first = {
        "yes": f"Yes: the cheapest confirmed design costs {cost}: {design}.",
        "no": f"No: no design in the ranges meets the requirements; the nearest costs {cost}: {design}.",
        "undecided": f"Undecided: no design is confirmed; the most promising costs {cost}: {design}.",
    }[outcome.answer]
    limits = [f"`{labels[k]}` limits it: its probability is {_share(each[k])}"]
    limits += [f"`{name}` is at the end of its range" for name in _at_end(setup, chosen)]
    out = [first, f"{'; '.join(limits)}."]
    weaker = [] if changes is None else [(limit, c) for limit, c in changes.rows[1:] if c != "none"]
    if changes is not None and weaker and weaker[-1][1] != changes.rows[0][1]:
        out.append(f"With `{weaker[-1][0]}` a design of cost {weaker[-1][1]} would do (predicted).")
    elif outcome.answer != "yes":
        out.append("No weaker limit within 20 % would change that: widen the ranges of the axes.")
    seen = outcome.observations
    counts = f"{len(seen.design) * problem.runs} simulations over {len(set(seen.city.tolist()))} cities"
    certain = f"The probability that it meets all requirements is {_share(outcome.feasibility[chosen])}"
    cities = len(outcome.confirming)
    fresh = f", with {cities} cities that the search had not used" if cities else ", not confirmed"
    needed = "" if outcome.answer == "yes" else f"; a confirmation needs {problem.sure_probability:.3g}"
    return [*out, f"{certain}{fresh} ({counts}){needed}."]


def _at_end(setup: Optimization, design: int) -> list[str]:
    """Axes whose level is at an end of its range."""
    found = []
    for axis in setup.axes:
        if axis.span is not None:
            low, high, value = axis.span.low, axis.span.high, float(setup.levels[design][axis.name])
            if min(value - low, high - value) < _AT_END * (high - low):
                found.append(axis.name)
    return found


def _draw_front(front: pd.DataFrame, result: OptimizationResult) -> Figure:
    figure = Figure(figsize=(5.2, 3.4), layout="constrained")
    ax = figure.add_subplot()
    ax.step(front["cost"], front["probability"], where="post", marker="o", markersize=4, color="tab:blue")
    colour = {"yes": "tab:green", "no": "tab:red", "undecided": "tab:orange"}[result.answer]
    word = {"yes": "confirmed", "no": "nearest", "undecided": "most promising"}[result.answer]
    ax.axvline(result.cost, color=colour, linewidth=1, label=f"{word} design")
    ax.set(xlabel="cost", ylabel="probability of meeting all requirements", ylim=(0, 1.03))
    ax.spines[["top", "right"]].set_visible(False)
    ax.legend(frameon=False, fontsize=8, loc="lower right")
    return figure
