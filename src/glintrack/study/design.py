"""File of a study: base case, axes named by the case's keys, and the points of a design."""

import itertools
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import numpy as np
from jaxtyping import Float
from pydantic import ConfigDict, Field, field_validator, model_validator
from scipy.stats import qmc

from glintrack.case.packaged import PACKAGED_CASES
from glintrack.core.arrays import Array
from glintrack.core.designs import Design, validate_design
from glintrack.io.toml import read_toml

CHANNEL = "channel"
SAMPLED = ("latin-hypercube", "sobol", "saltelli")
POWERS_OF_TWO = ("sobol", "saltelli")
MAX_CASES = 100_000
_OF_CASES = {"like", "channels", "scene", "atmosphere", "flight", "sensor", "track"}
_Seed = Annotated[int, Field(ge=0, le=2**63 - 1)]
Level = bool | int | float | str
_COLUMNS = {"point", "replicate", "case", "channel", "status", "over_time", "completeness", "purity"}


class Constraints(Design):
    """Keys that follow from other keys in every case; the ``[constraints]`` table of a study."""

    slant_range_m: float | None = Field(
        default=None, ge=200, le=50000, description="Altitude follows the off-nadir angle at this slant range"
    )
    duration_s: float | None = Field(
        default=None, gt=0, le=1e5, description="Frames follow the frame rate, for flights of one length"
    )
    at_max_frame_rate: bool = Field(default=False, description="Fly at sensor.max_frame_rate_hz")
    constant_field: bool = Field(
        default=False,
        description="Rows and columns follow pitch and focal length, for one field, unless an axis sets them",
    )


class Contrast(Design):
    """Difference of two designs or channels, reported at each point of all other axes."""

    label: str = Field(min_length=1, max_length=80, description="What the difference is called")
    of: dict[str, Any] = Field(description="`channel` and values of axes")
    against: dict[str, Any] = Field(description="The same keys with the values that are taken away")

    @field_validator("of", "against")
    @classmethod
    def _plain_values(cls, side: dict[str, Any]) -> dict[str, Any]:
        """Side with dotted keys."""
        levels = flat(side)
        for name, level in levels.items():
            if not isinstance(level, (bool, int, float, str)):
                raise ValueError(f"`{name}` must be one value of its axis; got {level!r:.60}.")
        return levels

    @model_validator(mode="after")
    def _check_sides(self) -> Self:
        """Sides with different axes would have points without partners."""
        if set(self.of) != set(self.against) or CHANNEL not in self.of:
            raise ValueError(
                f"`contrasts of {self.label!r}` must name `channel` and the same axes in `of` and `against`; "
                f"got {sorted(self.of)} and {sorted(self.against)}."
            )
        return self


class StudyDesign(Design):
    """Trade study: its cases and their simulation; the file of ``glintrack study``."""

    name: str = Field(default="study", min_length=1, max_length=80)
    """Name of the study's folder and pictures."""
    case: str = Field(default="quickstart", description="Base case: a file next to the study, or packaged")
    design: Literal["one-at-a-time", "factorial", "latin-hypercube", "sobol", "saltelli", "list"] = Field(
        default="one-at-a-time", description="How the axes are combined"
    )
    samples: int | None = Field(
        default=None, ge=1, le=MAX_CASES, description="Points of a sampled design; Sobol's: a power of two"
    )
    sampling_seed: _Seed = Field(default=0, description="Seed of the scrambled or shuffled points")
    seeds: tuple[_Seed, ...] = Field(default=(), description="Replicates that differ in the case's seed only")
    replicates: tuple[dict[str, Any], ...] = Field(
        default=(), description="Replicates as tables of keys, e.g. seed and flight.start_s"
    )
    retries: int = Field(default=1, ge=0, le=10, description="How often a failed case is tried again")
    base: dict[str, Any] = Field(default={}, description="Keys that differ from the base case throughout")
    axes: dict[str, Any] = Field(default={}, description="Keys with their values, or a range")
    cases: tuple[dict[str, Any], ...] = Field(default=(), description="The cases of design = 'list'")
    constraints: Constraints = Constraints()
    contrasts: tuple[Contrast, ...] = Field(default=(), description="Differences that the report states")
    ranked_under: tuple[str, ...] = Field(
        default=(), description="Axes with ranks of the designs at each value, such as detector or city"
    )

    @field_validator("replicates", mode="before")
    @classmethod
    def _tables(cls, given: Any) -> Any:
        if isinstance(given, int):
            raise ValueError(
                f"`replicates` must be a list of tables, as [{{ scene.seed = 1 }}, …]; got {given}. "
                "For replicates that differ in noise alone, write seeds = [1, 2]."
            )
        return given

    @model_validator(mode="after")
    def _check_design(self) -> Self:
        if (self.design == "list") != bool(self.cases) or (self.design == "list" and self.axes):
            raise ValueError(
                "`cases` must be given with design = 'list' and only then, and `axes` with every other; got "
                f"design = {self.design!r}, {len(self.cases)} cases and {len(self.axes)} axes."
            )
        if self.design != "list" and not self.axes:
            raise ValueError(f"`axes` must name at least one key; got none with design = {self.design!r}.")
        if (self.design in SAMPLED) != (self.samples is not None):
            raise ValueError(
                f"`samples` must be given with {', '.join(SAMPLED)} and only then; got "
                f"{self.samples} with design = {self.design!r}."
            )
        if self.design in POWERS_OF_TWO and self.samples and self.samples & (self.samples - 1):
            raise ValueError(
                f"`samples` must be a power of two for Sobol's points; got {self.samples}. "
                f"Use {1 << (self.samples - 1).bit_length()}."
            )
        if self.seeds and self.replicates:
            raise ValueError("`seeds` must not be given together with `replicates`; got both.")
        known = flat(self.axes)
        for name in self.ranked_under:
            if name not in known:
                raise ValueError(
                    f"`ranked_under` must name axes of the study ({', '.join(known)}); got {name!r}."
                )
        return self

    @property
    def replicate_keys(self) -> tuple[dict[str, Any], ...]:
        """Dotted keys of each replicate; a single replicate without keys by default."""
        if self.seeds:
            return tuple({"seed": seed} for seed in self.seeds)
        return tuple(flat(table) for table in self.replicates) or ({},)


def read_study(path: str | Path) -> StudyDesign:
    """Read the file of a study.

    Raises
    ------
    ValueError
        In one sentence: the fault of the file, a key or a value.
    """
    values = read_toml(path, "study")
    if _OF_CASES & set(values) and not {"axes", "case"} & set(values):
        named = Path(path).stem if Path(path).parent == PACKAGED_CASES else path
        raise ValueError(
            f"`study` must be a study; got the case {named}. Run `glintrack run {named}`. A study "
            "names it as its `case`, and its variations under [axes]."
        )
    return validate_design(StudyDesign, {"name": Path(path).stem, **values})


def flat(table: dict[str, Any], stem: str = "") -> dict[str, Any]:
    """Nested tables as one with dotted keys; a table with ``from`` and ``to`` is a value, a range."""
    out: dict[str, Any] = {}
    for key, value in table.items():
        name = f"{stem}{key}"
        if isinstance(value, dict) and not {"from", "to"} & set(value):
            out |= flat(value, f"{name}.")
        else:
            out[name] = value
    return out


class Range(Design):
    """Axis of all values between two, for sampled designs."""

    model_config = ConfigDict(populate_by_name=True)

    low: float = Field(alias="from", ge=-1e15, le=1e15, description="First value")
    high: float = Field(alias="to", ge=-1e15, le=1e15, description="Last value")
    log: bool = Field(default=False, description="Even in the logarithm")
    integer: bool = Field(default=False, description="Whole numbers only")


@dataclass(frozen=True)
class Axis:
    """Axis of a study.

    Parameters
    ----------
    name
        Key of the case, or a name of the study if each value sets several keys.
    labels, keys
        Label of each value, and the keys that it sets; empty for a range.
    span
        Range of the axis, if it has one.
    """

    name: str
    labels: tuple[Level, ...] = ()
    keys: tuple[dict[str, Any], ...] = ()
    span: Range | None = None

    def at(self, place: float) -> tuple[Level, dict[str, Any]]:
        """Label and keys at a place of the unit interval."""
        if self.span is None:
            index = min(int(place * len(self.labels)), len(self.labels) - 1)
            return self.labels[index], self.keys[index]
        low, high = self.span.low, self.span.high
        if self.span.integer and self.span.log:
            value: float = round(low * (high / low) ** place)
        elif self.span.integer:
            value = min(int(low) + int(place * (int(high) - int(low) + 1)), int(high))
        elif self.span.log:
            value = low * (high / low) ** place
        else:
            value = low + place * (high - low)
        return value, {self.name: value}

    @property
    def ends(self) -> tuple[tuple[Level, dict[str, Any]], ...]:
        """All values of a list, or first and last of a range, for validation."""
        if self.span is None:
            return tuple(zip(self.labels, self.keys, strict=True))
        return self.at(0.0), self.at(1.0)


def build_axes(design: StudyDesign) -> tuple[Axis, ...]:
    """Axes of a study.

    Raises
    ------
    ValueError
        If one has no values or repeats one, if two set one key, or if the design needs a list for a range.
    """
    axes = tuple(_axis(name, value) for name, value in flat(design.axes).items())
    owner: dict[str, str] = {}
    for axis in axes:
        if axis.name in _COLUMNS:
            raise ValueError(f"`axes` must not be named as a column of the results is; got `{axis.name}`.")
        for key in {key for _, keys in axis.ends for key in keys}:
            if key in owner:
                raise ValueError(f"`axes.{axis.name}` must not set `{key}`, as `axes.{owner[key]}` does")
            owner[key] = axis.name
        if axis.span is not None and design.design in ("one-at-a-time", "factorial"):
            raise ValueError(
                f"`axes.{axis.name}` must be a list of values for design = {design.design!r}; got a range."
            )
    return axes


def _axis(name: str, value: Any) -> Axis:
    if isinstance(value, dict):
        try:
            span = validate_design(Range, value)
        except ValueError as error:
            raise ValueError(re.sub("^`", f"`axes.{name}.", str(error), flags=re.MULTILINE)) from error
        if not span.low < span.high or (span.log and span.low <= 0):
            raise ValueError(
                f"`axes.{name}` must rise from `from` to `to`{', above 0' if span.log else ''}; got "
                f"{span.low:g} to {span.high:g}."
            )
        return Axis(name, span=span)
    if not isinstance(value, list) or not value:
        raise ValueError(f"`axes.{name}` must be a list of values or {{ from = …, to = … }}; got {value!r}.")
    if all(isinstance(v, dict) for v in value):
        if any("label" not in v or len(v) < 2 for v in value):
            raise ValueError(f"`axes.{name}` must give each table a `label` and keys of a case; got {value}.")
        labels = tuple(str(v["label"]) for v in value)
        keys = tuple(flat({k: v for k, v in table.items() if k != "label"}) for table in value)
    else:
        labels = tuple(v if isinstance(v, (bool, int, float, str)) else str(v) for v in value)
        kinds = {float if type(v) is int else type(v) for v in labels}
        if any(isinstance(v, dict) for v in value) or len(kinds) > 1:
            raise ValueError(f"`axes.{name}` must hold values of one type; got {value}.")
        keys = tuple({name: v} for v in value)
    if len(set(labels)) != len(labels):
        raise ValueError(f"`axes.{name}` must hold each value once; got {list(labels)}.")
    return Axis(name, labels, keys)


def unit_points(design: StudyDesign, axes: tuple[Axis, ...]) -> Float[Array, "point axis"]:
    """Points of a design, each axis in the unit interval.

    One-at-a-time: all first values, then each axis's others with the rest at their first. Saltelli: for each
    sample A, B, and A with one axis after the other taken from B.

    References
    ----------
    Saltelli et al., Comput. Phys. Commun. 181, 259 (2010), Eq. (b) of Table 2 and Section 3.
    """
    count, rng = len(axes), np.random.default_rng(design.sampling_seed)
    if design.design == "one-at-a-time":
        first = np.array([0.5 / len(axis.labels) for axis in axes])
        rows = [first]
        for k, axis in enumerate(axes):
            for place in _middles(len(axis.labels))[1:]:
                rows.append(np.where(np.arange(count) == k, place, first))
        return np.array(rows)
    if design.design == "factorial":
        return np.array(list(itertools.product(*(_middles(len(axis.labels)) for axis in axes))))
    samples = design.samples or 0
    if design.design == "latin-hypercube":
        return qmc.LatinHypercube(count, rng=rng).random(samples)
    if design.design == "sobol":
        return qmc.Sobol(count, rng=rng).random_base2(int(math.log2(samples)))
    both = qmc.Sobol(2 * count, rng=rng).random_base2(int(math.log2(samples)))
    a, b = both[:, :count], both[:, count:]
    mixed = [np.where(np.arange(count) == k, b, a) for k in range(count)]
    return np.stack([a, b, *mixed], axis=1).reshape(-1, count)


def _middles(values: int) -> Array:
    return (np.arange(values) + 0.5) / values
