"""Judge a design by derived quantities and the limits of ``data/calibration/design_limits.toml``."""

import math
from collections.abc import Collection, Mapping
from dataclasses import asdict, dataclass
from functools import cache
from typing import Any, Literal, get_args

from glintrack.case.design import Case
from glintrack.case.quantities import (
    CITY_SPEED_M_S,
    cost_quantities,
    light_quantities,
    machine_memory_bytes,
    motion_quantities,
    optics_quantities,
    view_quantities,
)
from glintrack.core.units import format_duration, format_number
from glintrack.io.toml import read_toml
from glintrack.track.calibration import calibration_file

Group = Literal["view", "sensor", "motion", "cost"]
GROUPS: tuple[Group, ...] = get_args(Group)


@dataclass(frozen=True)
class Judgement:
    """One derived quantity of a case, and whether it is good.

    Parameters
    ----------
    name, label, group
        Name in the table of limits, words for it, and what it is about.
    value, unit
        Value in its SI unit or as a share, and the unit of `text`; infinite if nothing limits a time.
    answer
        ``good``, ``doubtful`` or ``bad``.
    good
        Range of good values.
    reason
        What a value out of that range means and what changes it; empty for a good one.
    """

    name: str
    label: str
    group: Group
    value: float
    unit: str
    answer: Literal["good", "doubtful", "bad"]
    good: str
    reason: str = ""

    @property
    def text(self) -> str:
        """Value with its unit, to three significant digits."""
        return _format(self.value, self.unit)

    def record(self) -> dict[str, Any]:
        """Values by name, for JSON: None for an infinite or unknown value."""
        return asdict(self) | {"value": self.value if math.isfinite(self.value) else None, "text": self.text}


def assess_case(
    case: Case, groups: Collection[Group] = GROUPS, fastest_m_s: float = CITY_SPEED_M_S
) -> list[Judgement]:
    """Judge a case by its keys alone, without a simulation.

    Parameters
    ----------
    case
        The design. Geometry is that over level ground at the stare point.
    groups
        What to judge: ``view``, ``sensor``, ``motion`` and ``cost``.
    fastest_m_s
        Speed of the fastest vehicles. [m s⁻¹]

    Returns
    -------
    One judgement for each quantity, in the order of the table of limits.

    Raises
    ------
    ValueError
        If a file that the sensor names cannot be read.
    """
    found = view_quantities(case) if "view" in groups else {}
    if "sensor" in groups:
        found |= optics_quantities(case) | light_quantities(case)
    if "motion" in groups:
        found |= motion_quantities(case, fastest_m_s)
    if "cost" in groups:
        found |= cost_quantities(case)
    return [_judge(name, limits, found[name]) for name, limits in _read_limits().items() if name in found]


def bad_reasons(case: Case) -> list[str]:
    """Reasons for which a case should not be simulated as it is; empty for most cases."""
    return [one.reason for one in assess_case(case) if one.answer == "bad"]


@cache
def _read_limits() -> Mapping[str, Mapping[str, Any]]:
    return read_toml(calibration_file("design_limits"), "limits")


def _judge(name: str, limits: Mapping[str, Any], value: float) -> Judgement:
    unit, (low, high), (least, most) = limits["unit"], limits["good"], limits["usable"]
    answer, reason = "good", ""
    if not low <= value <= high:
        answer = "doubtful" if least <= value <= most else "bad"
        sentence = limits["high" if value > high or "low" not in limits else "low"]
        reason = sentence.format(value=_format(value, unit), number=format_number(value))
    bounds = [_format(bound, unit) for bound in (low, high)]
    good = f"{bounds[0].split()[0]} to {bounds[1]}"
    if low == 0 or math.isinf(high):
        good = f"≥ {bounds[0]}" if math.isinf(high) else f"≤ {bounds[1]}"
    return Judgement(
        name=name,
        label=limits["label"],
        group=limits["group"],
        value=value,
        unit=unit,
        answer=answer,
        good=good,
        reason=reason,
    )


def _format(value: float, unit: str) -> str:
    if not math.isfinite(value):
        return "no limit" if value > 0 else "not known"
    if unit == "time":
        return format_duration(value)
    if unit == "memory":
        return f"{format_number(1e-9 * value * (machine_memory_bytes() or 0))} GB"
    number = format_number(100 * value if unit == "%" else value)
    return f"{number}°" if unit == "°" else f"{number} {unit}".strip()
