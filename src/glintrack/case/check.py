"""Judge a design by derived quantities and the limits of ``data/calibration/design_limits.toml``."""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any, Literal, get_args

from glintrack.case import quantities
from glintrack.case.design import Case
from glintrack.case.fitted_range import OPPOSITE, fitted_quantities
from glintrack.core.units import format_duration, format_number
from glintrack.io.toml import read_toml
from glintrack.track.calibration import calibration_file

Group = Literal["view", "sensor", "motion", "cost", "tracker"]
GROUPS: tuple[Group, ...] = get_args(Group)
Answer = Literal["good", "not stated", "doubtful", "bad"]
ANSWERS: tuple[Answer, ...] = get_args(Answer)  # from best to worst


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
        ``good``, ``doubtful`` or ``bad``; ``not stated`` if the case leaves out what it follows from.
    good
        Range of good values.
    reason
        What a value out of that range means and what changes it; empty for a good one.
    view
        ``first``, ``middle`` or ``last`` frame, if that has the worst value; empty if one view has them all.
    keys
        Keys of the case that change a value that is not good, after ``+`` to raise or ``-`` to lower them.
    """

    name: str
    label: str
    group: Group
    value: float
    unit: str
    answer: Answer
    good: str
    reason: str = ""
    view: str = ""
    keys: tuple[str, ...] = ()

    @property
    def text(self) -> str:
        """Value with its unit, to three significant digits."""
        return _format(self.value, self.unit)

    @property
    def rank(self) -> int:
        """Index of the answer in `ANSWERS`, where ``not stated`` counts as ``good``."""
        return 0 if self.answer == "not stated" else ANSWERS.index(self.answer)

    def record(self) -> dict[str, Any]:
        """Values by name, for JSON: None for an infinite or unknown value."""
        return asdict(self) | {"value": self.value if math.isfinite(self.value) else None, "text": self.text}


def assess_case(
    case: Case, groups: Collection[Group] = GROUPS, fastest_m_s: float = quantities.CITY_SPEED_M_S
) -> list[Judgement]:
    """Judge a case by its keys alone, without a simulation.

    Where the view changes along the flight, each quantity has the worst value of the first, middle and last
    frame.

    Parameters
    ----------
    case
        The design. Geometry is that over level ground at the stare point.
    groups
        What to judge: ``view``, ``sensor``, ``motion``, ``cost`` and ``tracker``.
    fastest_m_s
        Speed of the fastest vehicles. [m s⁻¹]

    Returns
    -------
    One judgement for each quantity, in the order of the table of limits, and then those of the tracker.

    Raises
    ------
    ValueError
        If a file that the sensor names cannot be read.
    """
    limits = {**_read_limits()}
    optics = quantities.optics_quantities(case) if "sensor" in groups else {}
    found: dict[str, list[Judgement]] = {}
    for view, seen in quantities.views(case).items():
        values = quantities.view_quantities(seen) if "view" in groups else {}
        if "sensor" in groups:
            values |= optics | quantities.light_quantities(seen)
        for name, of in fitted_quantities(seen).items() if "tracker" in groups else ():
            values[name] = of.value
            limits[name] = {**limits[name], "good": of.good, "fitted": of.fitted}
        for name, value in values.items():
            found.setdefault(name, []).append(_judge(name, limits[name], value, view))
    others = quantities.motion_quantities(case, fastest_m_s) if "motion" in groups else {}
    others |= quantities.cost_quantities(case) if "cost" in groups else {}
    found |= {name: [_judge(name, limits[name], value)] for name, value in others.items()}
    judged = [_worst(found[name], limits[name]) for name in limits if name in found]
    if "jitter_rms_urad" not in case.flight.model_fields_set:
        reason = "the line of sight is simulated without jitter (`flight.jitter_rms_urad`)"
        judged = [
            replace(one, answer="not stated", reason=reason)
            if (one.name, one.answer) == ("platform_blur_elements", "good")
            else one
            for one in judged
        ]
    return _add_remedies(judged)


@cache
def _read_limits() -> Mapping[str, Mapping[str, Any]]:
    return read_toml(calibration_file("design_limits"), "limits")


def _judge(name: str, limits: Mapping[str, Any], value: float, view: str = "") -> Judgement:
    unit, (low, high), (least, most) = limits["unit"], limits["good"], limits["usable"]
    answer, reason, keys = "good", "", ()
    if not low <= value <= high:
        answer = "doubtful" if least <= value <= most else "bad"
        side = "high" if value > high or "low" not in limits else "low"
        fitted = " to ".join(_format(one, unit) for one in dict.fromkeys(limits.get("fitted", ())))
        reason = limits[side].format(value=_format(value, unit), number=format_number(value), fitted=fitted)
        keys = tuple(limits.get(f"{side}_keys", ()))
    bounds = [_format(bound, unit) for bound in (low, high)]
    good = f"{bounds[0].removesuffix(unit).strip()} to {bounds[1]}"
    if low <= 0 or math.isinf(high):
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
        view=view,
        keys=keys,
    )


def _worst(judged: Sequence[Judgement], limits: Mapping[str, Any]) -> Judgement:
    """Judgement of the view with the worst value; without a view if all have one value."""
    low, high = limits["good"]

    def excess(one: Judgement) -> float:
        below = low / one.value if one.value > 0 else math.inf
        return max(below if low > 0 else 0.0, one.value / high if high > 0 else 0.0)

    worst = max(judged, key=lambda one: (one.rank, excess(one)))
    same = all(math.isclose(one.value, worst.value, rel_tol=0.01) for one in judged)
    return replace(worst, view="") if same else worst


def _add_remedies(judged: Sequence[Judgement]) -> list[Judgement]:
    """End each reason with the keys that change it, without those that a limit needs the other way."""
    asked = {key for one in judged for key in one.keys if one.group != "tracker"}
    out = []
    for one in judged:
        keys = tuple(key for key in one.keys if OPPOSITE[key[0]] + key[1:] not in asked)
        words = [f"{'raise' if key[0] == '+' else 'lower'} `{key[1:]}`" for key in keys]
        words = ", ".join(words[:-1]) + " or " * (len(words) > 1) + words[-1] if words else ""
        if one.keys and not keys:
            words = "its keys make another quantity worse"
        out.append(replace(one, keys=keys, reason=": ".join(filter(None, (one.reason, words)))))
    return out


def _format(value: float, unit: str) -> str:
    if not math.isfinite(value):
        return "no limit" if value > 0 else "not known"
    if unit == "time":
        return format_duration(value)
    if unit == "memory":
        return f"{format_number(1e-9 * value * (quantities.machine_memory_bytes() or 0))} GB"
    number = format_number(100 * value if unit == "%" else value)
    return f"{number}°" if unit == "°" else f"{number} {unit}".strip()
