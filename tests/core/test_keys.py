"""Keys of all tables: each described once, each number finite and in a stated range, or refused."""

import math
from collections.abc import Iterator
from typing import Any

import pytest

from glintrack.case.design import Case
from glintrack.core.designs import Design, keys_of, kind_of, unit_of, validate_design
from glintrack.devices import EtalonDesign, MicromirrorDesign, WireGridDesign
from glintrack.devices.optical_constants import MetalDesign
from glintrack.io.photographs import CameraFile, PoseFile
from glintrack.scene.materials import MaterialDesign
from glintrack.sensor.lens import LensDesign
from glintrack.study import StudyDesign

# what a case and each file that it or a command names is made of; tables inside them are found by walking
FILES = (
    Case,
    StudyDesign,
    LensDesign,
    MaterialDesign,
    WireGridDesign,
    EtalonDesign,
    MicromirrorDesign,
    MetalDesign,
    CameraFile,
    PoseFile,
)


def tables(model: type[Design] = Design) -> Iterator[type[Design]]:
    """Every design of the package that has been loaded."""
    for one in model.__subclasses__():
        if one.__module__.startswith("glintrack."):
            yield one
        yield from tables(one)


def numbers(given: dict[str, Any], around: dict[str, Any] | None = None):
    """(JSON schema of a number, maker of a value with that number in it) for every number of a key."""
    given = {**(around or {}), **given}
    limits = {k: v for k, v in given.items() if "imum" in k}
    for part in given.get("anyOf", ()):
        yield from numbers(part, limits)
    fixed = given.get("prefixItems", ())
    for k, part in enumerate(fixed):
        rest = [_within(one) for one in fixed]
        for number, make in numbers(part):
            yield number, lambda bad, k=k, rest=rest, make=make: [*rest[:k], make(bad), *rest[k + 1 :]]
    if isinstance(given.get("items"), dict):
        for number, make in numbers(given["items"]):
            yield number, lambda bad, make=make: [make(bad)]
    if isinstance(given.get("additionalProperties"), dict):
        for number, make in numbers(given["additionalProperties"]):
            yield number, lambda bad, make=make: {"4": make(bad)}
    if given.get("type") in ("number", "integer"):
        yield given, lambda bad: bad


def _within(given: dict[str, Any]):
    low, high = (given.get(k, given.get(f"exclusive{k.capitalize()}", 0.0)) for k in ("minimum", "maximum"))
    return (low + high) / 2


def low_and_high(number: dict[str, Any]) -> tuple[float, float]:
    low = number.get("minimum", number.get("exclusiveMinimum", -math.inf))
    return low, number.get("maximum", number.get("exclusiveMaximum", math.inf))


def bad_numbers(number: dict[str, Any]):
    """What a key must refuse: no number, one of 300 or 400 digits, one just beyond each end of its range."""
    yield from (math.nan, math.inf, -math.inf, 1e308, -1e308, 10**400, -(10**400))
    low, high = low_and_high(number)
    whole = number["type"] == "integer"
    if math.isfinite(low):
        beyond = low - (1 if whole else 1e-6 * (high - low))
        yield low if "exclusiveMinimum" in number else beyond
    if math.isfinite(high):
        beyond = high + (1 if whole else 1e-6 * (high - low))
        yield high if "exclusiveMaximum" in number else beyond


TABLES = sorted(set(tables()), key=lambda one: f"{one.__module__}.{one.__name__}")
NUMBERS = [
    (table, field.alias or name, number, make)
    for table in TABLES
    for given in [table.model_json_schema()["properties"]]
    for name, field in table.model_fields.items()
    for number, make in numbers(given[field.alias or name])
]


def test_every_key_of_every_table_is_described():
    bare = [
        key.name
        for file in (Case, StudyDesign)
        for _, keys in keys_of(file)
        for key in keys
        if not key.meaning
    ]
    assert bare == []


def test_every_number_has_a_finite_range():
    open_ended = [
        f"{table.__name__}.{key}"
        for table, key, number, _ in NUMBERS
        if not -math.inf < low_and_high(number)[0] < low_and_high(number)[1] < math.inf
    ]
    assert open_ended == []


def test_every_table_of_a_file_is_walked():
    assert {*FILES} <= {*TABLES}
    assert len(TABLES) > 35 and len(NUMBERS) > 250


@pytest.mark.parametrize("table", TABLES, ids=lambda table: table.__name__)
def test_no_number_outside_its_range_gets_into_a_table(table):
    """Each is refused in one sentence that begins with its key, wherever in a list or a table it stands."""
    taken, unnamed = [], []
    for key, number, make in ((k, n, m) for t, k, n, m in NUMBERS if t is table):
        for bad in bad_numbers(number):
            try:
                validate_design(table, {key: make(bad)})
            except ValueError as error:
                about = [line for line in str(error).splitlines() if key in line.split(" must ")[0]]
                if len(about) != 1 or len(about[0]) > 400 or "got" not in about[0]:
                    unnamed.append((key, bad, str(error)))
            else:
                taken.append((key, bad))
    assert taken == [] and unnamed == []


@pytest.mark.parametrize(
    "text",
    [
        "[sensor.auto_exposure]\nlongest_ms = inf",
        "[sensor.optics.zernike_rms_nm]\n4 = nan",
        "[sensor]\nlayout = [[0.0, 1e308], [45.0, 90.0]]",
        "[[scene.panels]]\nmaterial = 'panel_20'\neast_m = 1e308\nnorth_m = 0.0",
        "[atmosphere]\nstreams = 1" + 400 * "0",
        "[atmosphere]\nwavelengths_um = [0.4, nan]",
        "[track.initiation]\nconfirm_score = nan",
        "[bound]\nfalse_per_frame = -inf",
    ],
)
def test_a_file_is_refused_in_one_sentence_that_names_the_whole_key(tmp_path, text):
    path = tmp_path / "case.toml"
    path.write_text(text, encoding="utf-8")
    table, _, line = text.strip("[").replace("]]", "]").partition("]\n")
    key = next(part.split(" = ")[0] for part in line.splitlines() if "material" not in part)
    with pytest.raises(ValueError, match=rf"^`{table}\S*{key}\S*` must .* got ") as caught:
        Case.from_toml(path)
    assert len(str(caught.value).splitlines()) == 1 and len(str(caught.value)) < 400


def test_units_follow_the_names():
    names = ("pitch_um", "turn_rate_deg_s", "speed_m_s", "clutter_density_m2", "area_min_m2", "frames")
    assert [unit_of(n) for n in names] == ["µm", "°/s", "m/s", "1/m²", "m²", ""]


def test_kinds_in_words():
    assert kind_of({"type": "number", "minimum": 0, "exclusiveMaximum": 1}) == "≥ 0, < 1"
    assert kind_of({"anyOf": [{"type": "integer", "minimum": 1}, {"type": "null"}]}) == "whole ≥ 1"
    assert kind_of({"enum": ["a", "b"]}) == "a | b"
    assert kind_of({"type": "array", "items": {"type": "string"}}) == "list of text"
    assert (
        kind_of({"type": "array", "prefixItems": [{"type": "number"}, {"type": "number"}]}) == "2 of number"
    )
