"""File of an optimization: requirements, axes, cost, and the candidates that the search chooses from."""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from jaxtyping import Float
from pydantic import Field, field_validator, model_validator

from glintrack.case.design import Case
from glintrack.case.quantities import data_rate_mbit_s, estimate_cpu_s
from glintrack.core.arrays import Array
from glintrack.core.designs import Design, keys_of, suggest_name, validate_design
from glintrack.io.atomic import content_hash
from glintrack.io.toml import read_toml
from glintrack.metrics.requirement import Requirement, read_requirement
from glintrack.sensor.catalogue import find_item, read_catalogue
from glintrack.study.design import Axis, Constraints, Level, StudyDesign, build_axes, flat, unit_points
from glintrack.study.optimize.search import Problem
from glintrack.study.plan import build_plan, find_base, length_notes

DATA_RATE = "data_rate_mbit_s"
CONDITION, DURATION = "condition", "duration_s"
LENS = "lens"  # axis of the catalogue's lenses
_LENS_KEYS = {"focal_length_mm": "sensor.focal_length_mm", "f_number": "sensor.f_number"}
WORD_DISTANCE = 0.7  # between two values without an order, in ranges of an axis
_MAX_SIMULATIONS = 10_000


class OptimizationDesign(Design):
    """Search for the cheapest design; the file of ``glintrack optimize``."""

    name: str = Field(default="optimization", min_length=1, max_length=80)
    """Name of the folder and pictures."""
    case: str = Field(default="quickstart", description="Base case: a file next to this one, or packaged")
    require: tuple[str, ...] = Field(min_length=1, max_length=8, description="Required scores")
    conditions: tuple[dict[str, Any], ...] = Field(
        default=(), max_length=12, description="Areas and hours: tables of keys with a `label`"
    )
    base: dict[str, Any] = Field(default={}, description="Keys that differ from the base case throughout")
    axes: dict[str, Any] = Field(min_length=1, max_length=8, description="Free keys: ranges, or values")
    constraints: Constraints = Constraints()
    cost: dict[str, Any] = Field(
        default={DATA_RATE: 1.0}, min_length=1, description="Coefficients of keys, summed"
    )
    probability: float = Field(
        default=0.9, ge=0.5, le=0.99, description="Probability of meeting all requirements"
    )
    simulations: int = Field(default=60, ge=1, le=_MAX_SIMULATIONS, description="Budget")
    cities: Annotated[int, Field(ge=2, le=100)] = Field(default=8, description="Cities of the search")
    confirming_cities: int = Field(default=6, ge=2, le=100, description="Unseen cities of a confirmation")
    first_seed: int = Field(default=1, ge=0, le=2**62, description="Seed of the first city")
    durations_s: tuple[Annotated[float, Field(gt=0, le=1e5)], ...] = Field(
        default=(12.0, 24.0), min_length=1, max_length=3, description="Fidelities, rising"
    )
    candidates: int = Field(default=512, ge=16, le=4096, description="Designs to choose from")
    retries: int = Field(default=1, ge=0, le=10, description="How often a failed case is tried again")

    @field_validator("require")
    @classmethod
    def _check_requirements(cls, given: tuple[str, ...]) -> tuple[str, ...]:
        _read_requirements(given)
        return given

    @field_validator("cost")
    @classmethod
    def _check_cost(cls, given: dict[str, Any]) -> dict[str, Any]:
        out = flat(given)
        for key, value in out.items():
            if isinstance(value, bool) or not isinstance(value, (int, float)) or not math.isfinite(value):
                raise ValueError(f"`cost.{key}` must be a finite number; got {value!r:.60}.")
        return out

    @field_validator("conditions")
    @classmethod
    def _check_conditions(cls, given: tuple[dict[str, Any], ...]) -> tuple[dict[str, Any], ...]:
        labels = [str(table.get("label", "")) for table in given]
        if "" in labels or len(set(labels)) < len(labels):
            raise ValueError(f"`conditions` must each have a `label` of its own; got {labels}.")
        for table in given:
            _read_requirements(table.get("require", ()))
        return given

    @model_validator(mode="after")
    def _check_fidelities(self) -> Self:
        if list(self.durations_s) != sorted(set(self.durations_s)):
            raise ValueError(f"`durations_s` must rise; got {list(self.durations_s)}.")
        if self.constraints.duration_s is not None:
            raise ValueError(
                "`constraints.duration_s` must not be given; got both it and `durations_s`, which sets it."
            )
        if self.candidates & (self.candidates - 1):
            raise ValueError(f"`candidates` must be a power of two; got {self.candidates}.")
        return self

    @property
    def conditions_in_use(self) -> list[tuple[str, dict[str, Any], tuple[Requirement, ...]]]:
        """Label, keys and requirements of each condition; one without keys by default."""
        out = []
        for table in self.conditions or ({},):
            own = {k: v for k, v in table.items() if k not in ("label", "require")}
            requirements = _read_requirements(table.get("require", self.require))
            out.append((str(table.get("label", "")), flat(own), requirements))
        return out

    def city(self, number: int) -> dict[str, int]:
        """Keys of a city; those of confirmations begin at ``cities``."""
        return {"seed": self.first_seed + number, "scene.seed": self.first_seed + number}


def _read_requirements(texts: Any) -> tuple[Requirement, ...]:
    """Read requirements, which must not contradict each other."""
    if not isinstance(texts, (list, tuple)) or not all(isinstance(one, str) for one in texts):
        raise ValueError(f"`require` must be a list of texts; got {texts!r:.80}.")
    found = tuple(read_requirement(text, "require") for text in texts)
    for one in found:
        if not one.at_least and one.limit < 0:
            raise ValueError(f"`require` must be possible; got {one}: scores are not below 0.")
        for other in found:
            same = (one.score, one.channel) == (other.score, other.channel)
            if same and one.at_least and not other.at_least and one.limit > other.limit:
                raise ValueError(f"`require` must be possible; got {one} and {other}, which nothing meets.")
    return found


@dataclass(frozen=True)
class Optimization:
    """Candidates of a search, all validated, and what is required of them.

    Parameters
    ----------
    design
        Content of the file.
    base, inside
        As for `study.build_plan`.
    axes, levels, keys
        Axes; and of each candidate its levels, and the keys of the case that these set.
    problem
        Encoded candidates, their costs, and one requirement for each condition and required score.
    conditions
        Label of the condition of each requirement.
    key
        Hash of all that influences the simulations.
    uses_recorded_traffic
        Whether all cities have the same recorded traffic.
    cpu_s
        Rough processor time of a simulation. [s]
    """

    design: OptimizationDesign
    base: Path
    inside: Sequence[Path] | None
    axes: tuple[Axis, ...]
    levels: tuple[Mapping[str, Level], ...]
    keys: tuple[Mapping[str, Any], ...]
    problem: Problem
    conditions: tuple[str, ...]
    key: str
    uses_recorded_traffic: bool = False
    cpu_s: float = 0.0


def study_of(spec: OptimizationDesign, duration_s: float, **more: Any) -> StudyDesign:
    """Build a study with the keys that all candidates share, of simulations of one duration. [s]"""
    shared = spec.model_dump(include={"name", "case", "base", "retries"})
    constraints = spec.constraints.model_dump() | {"duration_s": duration_s}
    return validate_design(StudyDesign, {**shared, "constraints": constraints, **more})


def read_optimization(path: str | Path, allow_outside_paths: bool = False) -> Optimization:
    """Read the file of an optimization, and build and validate all its candidates.

    Parameters
    ----------
    path
        TOML file.
    allow_outside_paths
        Whether the base case and the files of cases may be outside the file's folder.

    Raises
    ------
    ValueError
        In one sentence: the fault of the file, a key or a value.
    """
    path = Path(path)
    design = validate_design(OptimizationDesign, {"name": path.stem, **read_toml(path, "optimization")})
    base, inside = find_base(path, design.case, allow_outside_paths)
    values, prices = _separate_prices(_with_lenses(design.axes))
    study = study_of(design, design.durations_s[-1], design="sobol", samples=design.candidates, axes=values)
    axes = build_axes(study)
    plan = build_plan(study, base, inside)
    if too_short := length_notes(plan):
        raise ValueError(f"`durations_s` must end with a longer duration: {too_short[0]}.")
    places = unit_points(study, axes)
    chosen = list({point.case_key: point.index for point in reversed(plan.points)}.values())[::-1]
    points = [plan.points[k] for k in chosen]
    cases = [plan.cases[point.case_key] for point in points]
    keys = [
        {key: value for axis, place in zip(axes, places[k].tolist(), strict=True)
         for key, value in axis.at(place)[1].items()}
        for k in chosen
    ]  # fmt: skip
    cost = np.array([_cost(design.cost, case) for case in cases])
    for name, of_level in prices.items():
        cost += [of_level.get(str(point.levels[name]), 0.0) for point in points]
    _check_costs(cost)
    conditions = design.conditions_in_use
    labels = tuple(label for label, _, requirements in conditions for _ in requirements)
    content = design.model_dump(mode="json", exclude={"simulations", "retries"})
    return Optimization(
        design=design,
        base=base,
        inside=inside,
        axes=axes,
        levels=tuple(point.levels for point in points),
        keys=tuple(keys),
        problem=Problem(
            places=np.array([encode(axes, point.levels) for point in points]),
            cost=cost,
            requirements=tuple(
                _with_channel(one, cases[0]) for _, _, requirements in conditions for one in requirements
            ),
            probability=design.probability,
            simulations=design.simulations,
            runs=len(conditions),
            cities=design.cities,
            confirming_cities=design.confirming_cities,
            durations_s=design.durations_s,
        ),
        conditions=labels,
        key=content_hash(json.dumps([content, plan.key], sort_keys=True), 20),
        cpu_s=float(np.mean([estimate_cpu_s(case) for case in cases])),
        uses_recorded_traffic=cases[0].scene.uses_recorded_traffic,
    )


def encode(axes: Sequence[Axis], levels: Mapping[str, Level]) -> list[float]:
    """Place of a design for the Gaussian process: a column for each ordered axis, one for each word else."""
    out: list[float] = []
    for axis in axes:
        level = levels[axis.name]
        if axis.span is not None:
            low, high, value = axis.span.low, axis.span.high, float(level)
            if axis.span.log:
                low, high, value = math.log(low), math.log(high), math.log(value)
            out.append((value - low) / (high - low))
        elif is_ordered(axis):
            values = sorted(float(one) for one in axis.labels)
            out.append(values.index(float(level)) / max(len(values) - 1, 1))
        else:
            out += [WORD_DISTANCE * (one == level) for one in axis.labels]
    return out


def is_ordered(axis: Axis) -> bool:
    """Return True if the values of an axis are numbers."""
    return all(isinstance(one, (int, float)) and not isinstance(one, bool) for one in axis.labels)


def _with_lenses(axes: Mapping[str, Any]) -> dict[str, Any]:
    """Axes with the catalogue's focal length and F-number for each lens."""
    names = axes.get(LENS)
    if not isinstance(names, list) or not all(isinstance(name, str) for name in names):
        return dict(axes)
    known = read_catalogue("lenses")
    for name in names:
        if name not in known:
            raise ValueError(
                f"`axes.{LENS}` must name lenses of `glintrack sensor list`; got {name!r}. "
                f"{suggest_name(name, known)}"
            )
    rows = [
        {"label": name} | {key: find_item("lenses", name).figures[of] for of, key in _LENS_KEYS.items()}
        for name in names
    ]
    return {**axes, LENS: rows}


def _separate_prices(axes: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, dict[str, float]]]:
    """Axes without the `cost` of their labelled values, and these costs by axis and label."""
    out, prices = {}, {}
    for name, values in flat(dict(axes)).items():
        if isinstance(values, list) and all(isinstance(one, dict) for one in values):
            for one in values:
                price = one.get("cost", 0.0)
                if isinstance(price, bool) or not isinstance(price, (int, float)) or not math.isfinite(price):
                    raise ValueError(f"`axes.{name}.cost` must be a finite number; got {price!r:.60}.")
                prices.setdefault(name, {})[str(one.get("label"))] = float(price)
            values = [{k: v for k, v in one.items() if k != "cost"} for one in values]
        out[name] = values
    return out, prices


def _cost(coefficients: Mapping[str, float], case: Case) -> float:
    """Sum of coefficients times the case's values."""
    total = 0.0
    for key, coefficient in coefficients.items():
        value: Any = data_rate_mbit_s(case) if key == DATA_RATE else case
        for part in key.split(".") if key != DATA_RATE else ():
            value = getattr(value, part, None) if part in getattr(type(value), "model_fields", ()) else None
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            known = [DATA_RATE, *(one.name for _, keys in keys_of(Case) for one in keys)]
            hint = "" if key in known else f" {suggest_name(key, known)}"
            raise ValueError(f"`cost` must name keys with a number, or {DATA_RATE}; got `{key}`.{hint}")
        total += coefficient * value
    return total


def _check_costs(cost: Float[Array, "candidate"]) -> None:
    if not np.isfinite(cost).all():
        raise ValueError("`cost` must be finite for all designs; got an overflow. Use smaller coefficients.")
    if np.ptp(cost) <= 1e-9 * np.abs(cost).max():
        raise ValueError(
            f"`cost` must differ between designs; got {cost[0]:.3g} for all. Name keys that the axes change."
        )


def _with_channel(requirement: Requirement, case: Case) -> Requirement:
    """Name a channel if none is: all elements if the case has that channel, else its first."""
    if requirement.channel not in (None, *case.channels):
        raise ValueError(
            f"`require` must name a channel of the case ({', '.join(case.channels)}); "
            f"got {requirement.channel!r}."
        )
    default = "all" if "all" in case.channels else case.channels[0]
    return replace(requirement, channel=requirement.channel or default)
