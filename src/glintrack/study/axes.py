"""Axes of a study and the points at which a design asks for them."""

import itertools
import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float
from pydantic import ConfigDict, Field
from scipy.stats import qmc

from glintrack.core.arrays import Array
from glintrack.core.designs import Design, validated
from glintrack.study.design import StudyDesign, flat

Level = bool | int | float | str
_COLUMNS = {"point", "replicate", "case", "channel", "status", "over_time", "completeness", "purity"}


class Range(Design):
    """An axis of all values between two, for sampled designs."""

    model_config = ConfigDict(populate_by_name=True)

    low: float = Field(alias="from", ge=-1e15, le=1e15, description="First value")
    high: float = Field(alias="to", ge=-1e15, le=1e15, description="Last value")
    log: bool = Field(default=False, description="Even in the logarithm")
    integer: bool = Field(default=False, description="Whole numbers only")


@dataclass(frozen=True)
class Axis:
    """One thing that a study varies.

    Parameters
    ----------
    name
        The case's key, or a name of the study's own if each value sets several keys.
    labels, keys
        What each value is called, and the keys it sets; empty for a range.
    span
        The range, where the axis has one.
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
        if self.span.integer:
            value: float = min(int(low) + int(place * (int(high) - int(low) + 1)), int(high))
        elif self.span.log:
            value = low * (high / low) ** place
        else:
            value = low + place * (high - low)
        return value, {self.name: value}

    @property
    def ends(self) -> tuple[tuple[Level, dict[str, Any]], ...]:
        """Every value of a list, first and last of a range: what has to be valid before anything flies."""
        if self.span is None:
            return tuple(zip(self.labels, self.keys, strict=True))
        return self.at(0.0), self.at(1.0)


def build_axes(design: StudyDesign) -> tuple[Axis, ...]:
    """The axes of a study.

    Raises
    ------
    ValueError
        If one has no values, repeats one, sets a key that another sets too, or has a range where the design
        needs a list.
    """
    axes = tuple(_axis(name, value) for name, value in flat(design.axes).items())
    owner: dict[str, str] = {}
    for axis in axes:
        if axis.name in _COLUMNS:
            raise ValueError(f"`axes` must not be named as a column of the results is, got `{axis.name}`")
        for key in {key for _, keys in axis.ends for key in keys}:
            if key in owner:
                raise ValueError(
                    f"`axes.{axis.name}` must not set `{key}`, which `axes.{owner[key]}` sets too"
                )
            owner[key] = axis.name
        if axis.span is not None and design.design in ("one-at-a-time", "factorial"):
            raise ValueError(
                f"`axes.{axis.name}` must be a list of values for design = {design.design!r}, got a range"
            )
    return axes


def _axis(name: str, value: Any) -> Axis:
    if isinstance(value, dict):
        try:
            span = validated(Range, value)
        except ValueError as error:
            raise ValueError(re.sub("^`", f"`axes.{name}.", str(error), flags=re.MULTILINE)) from error
        if not span.low < span.high or (span.log and span.low <= 0):
            raise ValueError(
                f"`axes.{name}` must rise from `from` to `to`{', above 0' if span.log else ''}, got "
                f"{span.low:g} to {span.high:g}"
            )
        return Axis(name, span=span)
    if not isinstance(value, list) or not value:
        raise ValueError(f"`axes.{name}` must be a list of values or {{ from = …, to = … }}, got {value!r}")
    if all(isinstance(v, dict) for v in value):
        if any("label" not in v or len(v) < 2 for v in value):
            raise ValueError(
                f"`axes.{name}` must give each table a `label` and keys of the case, got {value}"
            )
        labels = tuple(str(v["label"]) for v in value)
        keys = tuple(flat({k: v for k, v in table.items() if k != "label"}) for table in value)
    else:
        labels = tuple(v if isinstance(v, (bool, int, float, str)) else str(v) for v in value)
        if any(isinstance(v, dict) for v in value) or len({_kind(v) for v in labels}) > 1:
            raise ValueError(f"`axes.{name}` must hold values of one type, got {value}")
        keys = tuple({name: v} for v in value)
    if len(set(labels)) != len(labels):
        raise ValueError(f"`axes.{name}` must hold each value once, got {list(labels)}")
    return Axis(name, labels, keys)


def _kind(value: Level) -> type:
    return float if isinstance(value, (int, float)) and not isinstance(value, bool) else type(value)


def unit_points(design: StudyDesign, axes: tuple[Axis, ...]) -> Float[Array, "point axis"]:
    """Where a design asks for its axes, each in the unit interval.

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
