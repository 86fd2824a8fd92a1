"""Cases of a study, all validated before the first simulation, and named by hashes of content and source."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from glintrack.case.check import assess_case
from glintrack.case.design import Case, read_case
from glintrack.case.identity import case_key
from glintrack.case.packaged import PACKAGED_CASES, find_case
from glintrack.core.designs import MAX_DEPTH
from glintrack.core.schema import MIN_SCORED_S
from glintrack.flight import FlightDesign
from glintrack.io.atomic import content_hash
from glintrack.io.untrusted import is_file
from glintrack.metrics.requirement import MIN_FRAMES, is_too_short
from glintrack.sensor import SensorDesign
from glintrack.study import design as designs
from glintrack.study.comparisons import check_contrasts

FORMAT = 1  # of a study's folder, for older programs
FIELD_KEYS = ("sensor.pitch_um", "sensor.focal_length_mm")  # of the field of view
MAX_JUDGED = 20  # designs of a study
Levels = dict[str, designs.Level]


@dataclass(frozen=True)
class Point:
    """Row of a study's design: levels of its axes, replicate, and case."""

    index: int
    replicate: int
    levels: Mapping[str, designs.Level]
    case_key: str


@dataclass(frozen=True)
class Plan:
    """All cases of a study.

    Parameters
    ----------
    design
        Content of the study's file.
    axes
        Axes of the study; none for an explicit list.
    points
        Rows of the design in its order; several may share a case.
    cases
        Cases by the hash of their content.
    key
        Hash of the whole plan.
    """

    design: designs.StudyDesign
    axes: tuple[designs.Axis, ...]
    points: tuple[Point, ...]
    cases: Mapping[str, Case]
    key: str

    def first(self, replicates: int) -> "Plan":
        """Plan with the cases of its first replicates only."""
        keys = {point.case_key for point in self.points if point.replicate < replicates}
        return replace(self, cases={key: case for key, case in self.cases.items() if key in keys})


def read_plan(path: str | Path, allow_outside_paths: bool = False) -> Plan:
    """Read a study's file and build its cases; see `build_plan`. The base case may be in the same folder.

    Parameters
    ----------
    path
        TOML file.
    allow_outside_paths
        Whether the base case and the files of cases may be outside the study's folder, as for
        `Case.from_toml`.
    """
    design = designs.read_study(path)
    return build_plan(design, *find_base(Path(path), design.case, allow_outside_paths))


def find_base(path: Path, case: str, allow_outside_paths: bool) -> tuple[Path, Sequence[Path] | None]:
    """Find the base case that a file names; returns it, and the folders that files must be in, if any."""
    local = path.parent / case
    base = local if is_file(local) else find_case(case)
    inside = None if allow_outside_paths else (path.parent, PACKAGED_CASES)
    if inside is not None and not any(base.resolve().is_relative_to(one.resolve()) for one in inside):
        raise ValueError(
            f"`case` must name a file in the folder of {path.name} or below; got {case}. "
            "--allow-outside-paths allows others."
        )
    return base, inside


def build_plan(design: designs.StudyDesign, base: Path, inside: Sequence[Path] | None = None) -> Plan:
    """Build and validate every case of a study.

    Parameters
    ----------
    design
        Axes, design, replicates and constraints.
    base
        The base case; file names in the study are relative to its folder.
    inside
        As for `Case.from_values`.

    Raises
    ------
    ValueError
        In one sentence: the axis, value or combination that is not a valid case, and the reason.
    """
    axes = designs.build_axes(design)
    values = _with_keys({**read_case(base), "name": design.name}, designs.flat(design.base), "base")
    _check_constraints(design, axes)
    check_contrasts(design, axes)
    rules = _Rules(design.constraints, base.parent, inside)
    # the base itself has to be valid, and its pitch and focal length are those of its rows and columns
    rules = replace(rules, element_rad=_build_case(values, rules).sensor.ifov_rad)
    for axis in axes:  # each value by itself, so that a message names the axis
        for label, keys in axis.ends:
            try:
                _build_case(_with_keys(values, keys, f"axes.{axis.name}"), rules, keys)
            except ValueError as error:
                if "known key" in str(error) or not _depends_on_others(error):
                    raise ValueError(f"{error} This is value {label!r} of axis `{axis.name}`.") from error
    rows = _rows(design, axes)
    if len(rows) * len(design.replicate_keys) > designs.MAX_CASES:
        raise ValueError(f"`axes` must make at most {designs.MAX_CASES} cases; got {len(rows)} points.")
    points, cases = [], {}
    for levels, keys in rows:
        for replicate, own in enumerate(design.replicate_keys):
            table = _with_keys(_with_keys(values, keys, "axes"), own, "replicates")
            try:
                case = _build_case(table, rules, keys | designs.flat(own))
            except ValueError as error:
                where = ", ".join(f"{name} = {level}" for name, level in levels.items())
                raise ValueError(f"{error} This is in the case with {where or own}.") from error
            key = case_key(case)
            cases.setdefault(key, case)
            points.append(Point(len(points), replicate, levels, key))
    content = {"points": [(p.replicate, dict(p.levels), p.case_key) for p in points], "design": design.design}
    return Plan(design, axes, tuple(points), cases, content_hash(json.dumps(content, sort_keys=True), 20))


def _rows(design: designs.StudyDesign, axes: tuple[designs.Axis, ...]) -> list[tuple[Levels, dict[str, Any]]]:
    """Labels and keys of each point."""
    rows: list[tuple[Levels, dict[str, Any]]] = []
    for index, table in enumerate(design.cases):
        keys = designs.flat(table)
        label = str(keys.pop("label", index))
        rows.append(({"label": label}, keys))
    for places in designs.unit_points(design, axes) if axes else ():
        levels, keys = {}, {}
        for axis, place in zip(axes, places.tolist(), strict=True):
            levels[axis.name], own = axis.at(place)
            keys |= own
        rows.append((levels, keys))
    return rows


def _depends_on_others(error: ValueError) -> bool:
    """Return True if several keys disagree, which another axis may correct; each case is checked again."""
    return not isinstance(error.__cause__, ValidationError) or any(
        fault["type"] == "value_error" for fault in error.__cause__.errors()
    )


def _check_constraints(design: designs.StudyDesign, axes: tuple[designs.Axis, ...]) -> None:
    limits = design.constraints
    constrained = {
        "flight.altitude_m": limits.slant_range_m is not None,
        "flight.frames": limits.duration_s is not None,
        "flight.rate_hz": limits.at_max_frame_rate,
    }
    given = {key for axis in axes for _, keys in axis.ends for key in keys}
    given |= {key for table in (*design.cases, *design.replicate_keys) for key in designs.flat(table)}
    for key, is_set in constrained.items():
        if is_set and key in given:
            raise ValueError(
                f"`{key}` must not be varied where a constraint sets it; got both. Leave out one of them."
            )


def _with_keys(values: dict[str, Any], keys: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Nested values with some dotted keys replaced."""
    out = dict(values)
    for key, value in keys.items():
        if key.count(".") > MAX_DEPTH:
            raise ValueError(f"`{source}` must name a key of the case; got `{key[:60]}…`, nested too deeply.")
        head, _, rest = key.partition(".")
        if not rest:
            out[head] = value
            continue
        inner = out.get(head, {})
        if not isinstance(inner, dict):
            raise ValueError(f"`{source}` must name a key of the case; got `{key}`; `{head}` is no table.")
        out[head] = _with_keys(inner, {rest: value}, source)
    return out


@dataclass(frozen=True)
class _Rules:
    """Constraints and folders of all cases of a study."""

    limits: designs.Constraints
    folder: Path
    inside: Sequence[Path] | None = None
    element_rad: float | None = None


def _build_case(values: dict[str, Any], rules: _Rules, varied: Iterable[str] = ()) -> Case:
    """Case from plain values after the constraints; ``varied`` are the keys of axes and replicates."""
    keys: dict[str, Any] = {}
    limits = rules.limits
    try:
        flight = FlightDesign.model_validate(values.get("flight", {}))
        sensor = SensorDesign.model_validate(values.get("sensor", {}))
    except ValidationError:  # reported in full by the whole case
        return Case.from_values(values, rules.folder, rules.inside)
    if limits.slant_range_m is not None:
        keys["flight.altitude_m"] = limits.slant_range_m * math.cos(math.radians(flight.off_nadir_deg))
    rate_hz = sensor.max_frame_rate_hz if limits.at_max_frame_rate else flight.rate_hz
    if limits.at_max_frame_rate:
        keys["flight.rate_hz"] = rate_hz
    if limits.duration_s is not None:
        keys["flight.frames"] = max(round(limits.duration_s * rate_hz), 1)
    counted = {"sensor.rows", "sensor.columns"} & set(varied)
    if limits.constant_field and rules.element_rad is not None and not counted:
        side, share = len(sensor.superpixel), rules.element_rad / sensor.ifov_rad
        for name in ("rows", "columns"):  # that see the field of the base's elements, as whole superpixels
            keys[f"sensor.{name}"] = side * max(round(getattr(sensor, name) * share / side), 1)
    return Case.from_values(_with_keys(values, keys, "constraints"), rules.folder, rules.inside)


def field_notes(plan: Plan) -> list[str]:
    """Sentence for each axis that changes the part of the window in the field."""
    if plan.design.constraints.constant_field:
        return []

    def field_of(keys: Mapping[str, Any]) -> tuple:
        own = {"sensor.rows", "sensor.columns"} & set(keys)
        return () if own else tuple(keys.get(key) for key in FIELD_KEYS)

    return [
        f"`{axis.name}` changes the field too: a smaller part of the window has fewer of its vehicles "
        "(`constraints.constant_field = true` adapts rows and columns)"
        for axis in plan.axes
        if len({field_of(keys) for keys in axis.keys}) > 1 or (axis.span and axis.name in FIELD_KEYS)
    ]


def design_notes(plan: Plan) -> list[str]:
    """Sentence for each quantity that is bad in some designs, which are simulated nevertheless.

    Of many designs `MAX_JUDGED` are judged, evenly spread.
    """
    first = plan.points[0].replicate
    keys = list(dict.fromkeys(point.case_key for point in plan.points if point.replicate == first))
    judged = keys[:: -(-len(keys) // MAX_JUDGED)]
    bad: dict[str, list[str]] = {}
    for key in judged:
        for one in assess_case(plan.cases[key], ("view", "sensor", "motion")):
            if one.answer == "bad":
                bad.setdefault(one.name, []).append(one.reason)
    return [
        f"bad in {len(reasons)} of {len(judged)} designs, which are simulated nevertheless: {reasons[0]}"
        for reasons in bad.values()
    ]


def length_notes(plan: Plan) -> list[str]:
    """Sentence if flights are too short for a tracker."""
    flights = (case.flight for case in plan.cases.values())
    brief = next((one for one in flights if is_too_short(one.frames, (one.frames - 1) / one.rate_hz)), None)
    if brief is None:
        return []
    length = f"{brief.frames} frame{'s' if brief.frames > 1 else ''} at {brief.rate_hz:g} Hz"
    return [
        f"a flight of {length} is too short for a tracker, which learns the background first "
        f"(`flight.frames`; {MIN_FRAMES} frames and {MIN_SCORED_S:g} s at least)"
    ]
