"""Judge a design by derived quantities and the limits of ``data/calibration/design_limits.toml``.

Rules and models of the tracker have ranges in which they were fitted, also in ``data/calibration``. A value
outside them is doubtful.
"""

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cache
from typing import Any, Literal, NamedTuple, get_args

from glintrack.case import quantities
from glintrack.case.design import Case
from glintrack.core.units import format_duration, format_number
from glintrack.io.toml import read_toml
from glintrack.track.calibration import calibration_file, read_calibration
from glintrack.track.detect.binning import binning_factor

Group = Literal["view", "sensor", "motion", "cost", "tracker"]
GROUPS: tuple[Group, ...] = get_args(Group)
Answer = Literal["good", "not stated", "doubtful", "bad"]
ANSWERS: tuple[Answer, ...] = get_args(Answer)  # from best to worst
# a calibration holds for that much more or less than it was fitted at: a share, or an angle
_MARGIN, _MARGIN_DEG = 0.25, 10.0
OPPOSITE = {"+": "-", "-": "+"}  # to raise or to lower a key


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
        name=name, label=limits["label"], group=limits["group"], value=value, unit=unit, answer=answer,
        good=good, reason=reason, view=view, keys=keys,
    )  # fmt: skip


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


def describe_initiation(case: Case) -> str:
    """Line with the rules of confirmation and coasting that are in use, for detections with ratios."""
    initiation = case.track.effective(True).initiation
    rules = initiation.in_use
    least = (
        (f"over {rules.confirm_min_age_s:g} s or more", rules.confirm_min_age_s),
        (f"over {rules.confirm_travel_m:g} m or more", rules.confirm_travel_m),
        (f"at {rules.confirm_speed_m_s:g} m/s or more", rules.confirm_speed_m_s),
    )
    hits = f"detections in {rules.confirm_hits} of {rules.confirm_window} frames"
    return (
        f"tracker: a track is confirmed by {', '.join([hits, *(text for text, value in least if value)])} "
        f"(rules {initiation.rules!r}, `track.reporting.method` = {case.track.reporting.method!r}). "
        f"Without detections it ends after {initiation.coast_s:g} s, that of a stopped vehicle after "
        f"{rules.stopped_coast_s:g} s"
    )


def describe_array(case: Case) -> str:
    """Line on the elements of the array, their polarizers, and the channels that are tracked."""
    sensor = case.sensor
    layout = sensor.layout if isinstance(sensor.layout, str) else "given angles"
    polarizers = f"polarizers {sensor.polarizer!r}" if sensor.has_stokes else "no polarizers"
    mirror = ", a micromirror in each superpixel" if sensor.has_mirror else ""
    return f"array: mosaic {layout!r}, {polarizers}{mirror}. Tracked channels: {', '.join(case.channels)}"


def detector_binning(case: Case) -> int:
    """Elements along one that the detector sees. [1]"""
    is_fine = case.track.detect.detector != "median-motion"
    return binning_factor(quantities.ground_view(case)[0][0]) if is_fine else 1


def describe_binning(case: Case) -> list[str]:
    """Line on the elements that the detector averages, if they are finer than its fitted range."""
    factor = detector_binning(case)
    gsd_m = factor * quantities.ground_view(case)[0][0]
    line = f"detector: means of {factor} × {factor} elements of a kind, with a ground sample distance of "
    return [f"{line}{format_number(gsd_m)} m"] if factor > 1 else []


class FittedQuantity(NamedTuple):
    """Value of a quantity in a case, the range that all models were fitted in, and the good range."""

    value: float
    fitted: tuple[float, float]
    good: tuple[float, float]


def fitted_quantities(case: Case) -> dict[str, FittedQuantity]:
    """Quantities of a case for which detector and tracker have a fitted range, by name."""
    design = case.track.effective(True)
    detector = design.detect.detector.replace("auto", "mosaic")  # which it is in a case
    ranges = [read_calibration(detector.replace("-", "_")).valid]
    if design.reporting.uses_existence:
        ranges += [read_calibration(name).valid for name in ("existence", "existence_smoothed")]
    if design.initiation.flow_velocity:
        ranges.append(read_calibration("flow").valid)
    ranges += [read_calibration("initiation").valid[design.initiation.rules]]
    values = {"rate_hz": case.flight.rate_hz, "max_speed_m_s": design.detect.max_speed_m_s}
    if design.reporting.effective_lag_s:
        values["lag_s"] = design.reporting.lag_s
    if case.flight.kind != "waypoints":
        values["gsd_m"] = detector_binning(case) * quantities.ground_view(case)[0][0]
        values["off_nadir_deg"] = quantities.off_nadir_deg(case)
    found = {}
    for name, value in values.items():
        if fitted := [of[name] for of in ranges if name in of]:
            low, high = max(map(min, fitted)), min(map(max, fitted))
            good = (low / (1 + _MARGIN), high / (1 - _MARGIN))
            if name == "off_nadir_deg":
                good = (low - _MARGIN_DEG, high + _MARGIN_DEG)
            found[f"fitted_{name}"] = FittedQuantity(value, (min(low, high), max(low, high)), good)
    if detectors := [of["detector"] == detector for of in ranges if "detector" in of]:
        share = sum(detectors) / len(detectors)
        found["fitted_detector"] = FittedQuantity(share, (1.0, 1.0), (1.0, math.inf))
    return found
