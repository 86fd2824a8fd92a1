"""The cases of a study, each checked before the first one flies, and named by their content and source.

A version number stays the same while its source is edited, so that names of cases count the source as well.
"""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from pydantic import ValidationError

from glintrack.case.design import Case, read_case
from glintrack.case.packaged import PACKAGED_CASES, find_case
from glintrack.core.designs import DEEPEST
from glintrack.core.installation import VERSION
from glintrack.core.schema import MIN_SCORED_S
from glintrack.flight import FlightDesign
from glintrack.io.atomic import content_hash
from glintrack.io.untrusted import is_file
from glintrack.metrics.requirement import LEAST_FRAMES, short
from glintrack.sensor import SensorDesign
from glintrack.study.comparisons import check_contrasts
from glintrack.study.design import (
    MOST_CASES,
    Axis,
    Constraints,
    Level,
    StudyDesign,
    build_axes,
    flat,
    read_study,
    unit_points,
)

FORMAT = 1  # of a study's folder: raise it whenever an older program could not read it
FIELD_KEYS = ("sensor.pitch_um", "sensor.focal_length_mm")  # whose change `constant_field` makes up for
DECIDE_SCORES = ("embreex", "eclipse-sumo", "sasktran2")
_PACKAGE = Path(__file__).parents[1]
# what shows results, or runs cases, and has no part in what a case scores; all else has, also what is new
_SHOWS_ONLY = ("cli", "results/figures", "report", "study", "data/cases", "data/page")
_FLIES = ("study/workers.py",)


@dataclass(frozen=True)
class Point:
    """One row of a study's design: which values, which replicate, and the case that flies it."""

    index: int
    replicate: int
    levels: Mapping[str, Level]
    case_key: str


@dataclass(frozen=True)
class Plan:
    """A whole study, ready to be run.

    Parameters
    ----------
    design
        As read.
    axes
        What is varied; none for an explicit list.
    points
        Rows of the design in its own order; several may share a case.
    cases
        By the hash of their content.
    key
        Hash of all of it: two plans of one key ask for the same.
    """

    design: StudyDesign
    axes: tuple[Axis, ...]
    points: tuple[Point, ...]
    cases: Mapping[str, Case]
    key: str

    def first(self, replicates: int) -> "Plan":
        """The same plan with no cases but those of its first replicates."""
        keys = {point.case_key for point in self.points if point.replicate < replicates}
        return replace(self, cases={key: case for key, case in self.cases.items() if key in keys})


def read_plan(path: str | Path, allow_outside_paths: bool = False) -> Plan:
    """Read a study's file and lay out its cases; see `build_plan`. The base case is looked for beside it.

    Parameters
    ----------
    path
        TOML file.
    allow_outside_paths
        Whether the base case and the files that cases name may lie elsewhere than in the study's folder and
        below: as of `Case.from_toml`.
    """
    path = Path(path)
    design = read_study(path)
    beside = path.parent / design.case
    base = beside if is_file(beside) else find_case(design.case)
    inside = None if allow_outside_paths else (path.parent, PACKAGED_CASES)
    if inside is not None and not any(base.resolve().is_relative_to(one.resolve()) for one in inside):
        raise ValueError(
            f"`case` must name a file in the study's folder or below, got {design.case} "
            "(--allow-outside-paths allows others)"
        )
    return build_plan(design, base, inside)


def build_plan(design: StudyDesign, base: Path, inside: Sequence[Path] | None = None) -> Plan:
    """Every case of a study, validated.

    Parameters
    ----------
    design
        Axes, design, replicates and constraints.
    base
        The base case; file names in the study are meant from where it lies.
    inside
        As of `Case.from_values`.

    Raises
    ------
    ValueError
        In one sentence: which axis, value or combination is no valid case, and why.
    """
    axes = build_axes(design)
    values = read_case(base)
    values = _with_keys({**values, "name": design.name}, flat(design.base), "base")
    _refuse_bound_keys(design, axes)
    check_contrasts(design, axes)
    rules = _Rules(design.constraints, base.parent, inside)
    # the base itself has to be valid, and its pitch and focal length are those of its rows and columns
    rules = replace(rules, element_rad=_constrained(values, rules).sensor.ifov_rad)
    _check_axes(values, axes, rules)
    rows = _rows(design, axes)
    if len(rows) * len(design.replicate_keys) > MOST_CASES:
        raise ValueError(f"`axes` must make at most {MOST_CASES} cases, got {len(rows)} points")
    points, cases = [], {}
    for levels, keys in rows:
        for replicate, own in enumerate(design.replicate_keys):
            table = _with_keys(_with_keys(values, keys, "axes"), own, "replicates")
            try:
                case = _constrained(table, rules, keys | flat(own))
            except ValueError as error:
                where = ", ".join(f"{name} = {level}" for name, level in levels.items())
                raise ValueError(f"{error} (in the case with {where or own})") from error
            key = case_key(case)
            cases.setdefault(key, case)
            points.append(Point(len(points), replicate, levels, key))
    content = {"points": [(p.replicate, dict(p.levels), p.case_key) for p in points], "design": design.design}
    return Plan(design, axes, tuple(points), cases, _digest(content))


def _rows(design: StudyDesign, axes: tuple[Axis, ...]) -> list[tuple[dict[str, Level], dict[str, Any]]]:
    """Labels and keys of each point."""
    rows: list[tuple[dict[str, Level], dict[str, Any]]] = []
    for index, table in enumerate(design.cases):
        keys = flat(table)
        label = str(keys.pop("label", index))
        rows.append(({"label": label}, keys))
    for places in unit_points(design, axes) if axes else ():
        levels, keys = {}, {}
        for axis, place in zip(axes, places.tolist(), strict=True):
            levels[axis.name], own = axis.at(place)
            keys |= own
        rows.append((levels, keys))
    return rows


def _check_axes(values: dict, axes: tuple[Axis, ...], rules: "_Rules") -> None:
    """Each value of each axis by itself: a wrong key or type is told with the axis's name."""
    for axis in axes:
        for label, keys in axis.ends:
            try:
                _constrained(_with_keys(values, keys, f"axes.{axis.name}"), rules, keys)
            except ValueError as error:
                if "known key" in str(error) or not _depends_on_others(error):
                    raise ValueError(f"{error} (axis `{axis.name}`, value {label!r})") from error


def _depends_on_others(error: ValueError) -> bool:
    """Whether several keys disagree, which another axis's value may mend; checked again case by case."""
    return not isinstance(error.__cause__, ValidationError) or any(
        fault["type"] == "value_error" for fault in error.__cause__.errors()
    )


def _refuse_bound_keys(design: StudyDesign, axes: tuple[Axis, ...]) -> None:
    limits = design.constraints
    bound = {
        "flight.altitude_m": limits.slant_range_m is not None,
        "flight.frames": limits.duration_s is not None,
        "flight.rate_hz": limits.rate_is_clock,
    }
    given = {key for axis in axes for _, keys in axis.ends for key in keys}
    given |= {key for table in (*design.cases, *design.replicate_keys) for key in flat(table)}
    for key, is_bound in bound.items():
        if is_bound and key in given:
            raise ValueError(
                f"`{key}` must not be varied where a constraint sets it, got both (see constraints)"
            )


def _with_keys(values: dict[str, Any], keys: Mapping[str, Any], source: str) -> dict[str, Any]:
    """Nested values with some dotted keys replaced; the given ones stay as they are."""
    out = dict(values)
    for key, value in keys.items():
        if key.count(".") > DEEPEST:
            raise ValueError(f"`{source}` must name a key of the case, got `{key[:60]}…`, nested too deeply")
        head, _, rest = key.partition(".")
        if not rest:
            out[head] = value
            continue
        inner = out.get(head, {})
        if not isinstance(inner, dict):
            raise ValueError(f"`{source}` must name a key of the case, got `{key}`, and `{head}` is no table")
        out[head] = _with_keys(inner, {rest: value}, source)
    return out


@dataclass(frozen=True)
class _Rules:
    """What every case of a study obeys."""

    limits: Constraints
    folder: Path
    inside: Sequence[Path] | None = None
    element_rad: float | None = None


def _constrained(values: dict[str, Any], rules: _Rules, varied: Iterable[str] = ()) -> Case:
    """The case of plain values after its constraints, given the keys that an axis or a replicate sets."""
    keys: dict[str, Any] = {}
    limits = rules.limits
    try:
        flight = FlightDesign.model_validate(values.get("flight", {}))
        sensor = SensorDesign.model_validate(values.get("sensor", {}))
    except ValidationError:  # told in full by the whole case
        return Case.from_values(values, rules.folder, rules.inside)
    if limits.slant_range_m is not None:
        keys["flight.altitude_m"] = limits.slant_range_m * math.cos(math.radians(flight.off_nadir_deg))
    rate_hz = sensor.clock_hz if limits.rate_is_clock else flight.rate_hz
    if limits.rate_is_clock:
        keys["flight.rate_hz"] = rate_hz
    if limits.duration_s is not None:
        keys["flight.frames"] = max(round(limits.duration_s * rate_hz), 1)
    counted = {"sensor.rows", "sensor.columns"} & set(varied)  # who sets the count gives up the field
    if limits.constant_field and rules.element_rad is not None and not counted:
        keys |= _field_kept(sensor, rules.element_rad)
    return Case.from_values(_with_keys(values, keys, "constraints"), rules.folder, rules.inside)


def _field_kept(sensor: SensorDesign, element_rad: float) -> dict[str, Any]:
    """Rows and columns that see what the given ones see with the base's elements, as whole superpixels."""
    side, share = len(sensor.superpixel), element_rad / sensor.ifov_rad
    return {
        f"sensor.{name}": side * max(round(getattr(sensor, name) * share / side), 1)
        for name in ("rows", "columns")
    }


def field_notes(plan: Plan) -> list[str]:
    """A sentence for each axis that makes the array see more or less of the window, before it is flown."""
    if plan.design.constraints.constant_field:
        return []
    return [
        f"`{axis.name}` changes the field as well: who sees less of the window holds fewer of its vehicles "
        "(`constraints.constant_field = true` lets rows and columns follow)"
        for axis in plan.axes
        if len({_field_of(axis, keys) for keys in axis.keys}) > 1 or (axis.span and axis.name in FIELD_KEYS)
    ]


def _field_of(axis: Axis, keys: Mapping[str, Any]) -> tuple:
    """What a value of an axis says of the field; nothing where it sets rows and columns itself."""
    return () if {"sensor.rows", "sensor.columns"} & set(keys) else tuple(keys.get(key) for key in FIELD_KEYS)


def length_notes(plan: Plan) -> list[str]:
    """A sentence if flights are so short that they say nothing of a tracker, before they are flown."""
    flights = (case.flight for case in plan.cases.values())
    brief = next((one for one in flights if short(one.frames, (one.frames - 1) / one.rate_hz)), None)
    if brief is None:
        return []
    length = f"{brief.frames} frame{'s' if brief.frames > 1 else ''} at {brief.rate_hz:g} Hz"
    return [
        f"a flight of {length} says little of a tracker: the ground is learnt first, then tracks are begun "
        f"(`flight.frames`; {LEAST_FRAMES} frames and {MIN_SCORED_S:g} s at least)"
    ]


def case_key(case: Case) -> str:
    """Hash of all that decides a case's result, and of the program's version and source; not of its name.

    A file counts by what is in it, not by where it lies, so that every host gives the same name.
    """
    content = case.model_dump(mode="json", exclude={"name"})
    return _digest({"case": without_paths(content), "glintrack": VERSION, "source": source_key()})


def without_paths(value: Any) -> Any:
    """Plain values with the content's hash in place of each file named by its whole path."""
    if isinstance(value, dict):
        return {key: without_paths(v) for key, v in value.items()}
    if isinstance(value, list):
        return [without_paths(v) for v in value]
    if isinstance(value, str) and Path(value).is_absolute() and is_file(Path(value)):
        return {"sha256": content_hash(Path(value).read_bytes())}
    return value


def _digest(content: Any) -> str:
    return content_hash(json.dumps(content, sort_keys=True), 20)


@lru_cache(maxsize=1)
def source_key() -> str:
    """Hash of the source, data and packages that decide a case's scores: other code has other results."""
    shown = {path for pattern in _SHOWS_ONLY for path in _PACKAGE.glob(pattern)}
    parts = [path for path in _PACKAGE.iterdir() if path not in shown]
    parts += [_PACKAGE / name for name in _FLIES]
    return digest(parts, DECIDE_SCORES, shown)[:20]


def digest(parts: Iterable[str | Path], packages: Iterable[str], without: Iterable[Path] = ()) -> str:
    """Hash of files' names and contents, and of packages' versions.

    Parameters
    ----------
    parts
        Files and folders of this package; of a folder all that is in it. A file that is named counts.
    packages
        Distributions; one that is not installed counts as such.
    without
        Files and folders in them that are left out.
    """
    left_out = set(without)
    found: list[str | bytes] = []
    for part in sorted(_PACKAGE / one for one in parts):
        for file in sorted(part.rglob("*")) if part.is_dir() else [part]:
            if not file.is_file() or "__pycache__" in file.parts:
                continue
            if file != part and left_out & {file, *file.parents}:
                continue
            found.append(f"{file.relative_to(_PACKAGE).as_posix()} ")
            found.append(bytes.fromhex(content_hash(file.read_bytes())))
    for name in packages:
        try:
            found.append(f"{name} {version(name)}")
        except PackageNotFoundError:
            found.append(f"no {name}")
    return content_hash(found)
