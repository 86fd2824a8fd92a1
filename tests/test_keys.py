"""Keys of a case: each described once, each number finite and in a stated range."""

import math

import pytest

from glintrack.config import Case
from glintrack.designs import model_in
from glintrack.keys import keys_of, kind_of, unit_of
from glintrack.study import StudyDesign


def properties(model, path=""):
    """(dotted key, JSON schema) of every key of every table."""
    schema = model.model_json_schema()
    for name, field in model.model_fields.items():
        nested = model_in(field.annotation)
        if nested is not None:
            yield from properties(nested, f"{path}{name}.")
        else:
            yield f"{path}{name}", schema["properties"][field.alias or name]


def numbers(given):
    """The parts of a key's schema that take a number, with the limits that stand around them."""
    around = {k: v for k, v in given.items() if "imum" in k}
    for part in ("anyOf", "prefixItems"):
        for one in given.get(part, ()):
            yield from numbers({**around, **one})
    for part in ("items", "additionalProperties"):
        if isinstance(given.get(part), dict):
            yield from numbers(given[part])
    if given.get("type") in ("number", "integer"):
        yield given


CASE = dict(properties(Case))
ANY = {"sensor.layout", "atmosphere.wavelengths_um"}  # held by validators
NUMBERS = [name for name, given in CASE.items() if name not in ANY and any(True for _ in numbers(given))]


def test_every_key_of_every_table_is_described():
    bare = [key.name for _, keys in keys_of(Case) for key in keys if not key.meaning]
    assert bare == []
    assert [key.name for _, keys in keys_of(StudyDesign) for key in keys if not key.meaning] == []


def test_every_number_of_a_case_has_a_finite_range():
    open_ended = []
    for name in NUMBERS:
        for number in numbers(CASE[name]):
            low = number.get("minimum", number.get("exclusiveMinimum", -math.inf))
            high = number.get("maximum", number.get("exclusiveMaximum", math.inf))
            if not (math.isfinite(low) and math.isfinite(high) and low < high):
                open_ended.append(name)
    assert open_ended == []


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, 1e308, -1e308])
def test_no_number_outside_its_range_gets_into_a_case(value):
    """Every key with one number: refused in a sentence that names it."""
    scalars = [
        name
        for name in NUMBERS
        if any(n.get("type") == "number" for n in (CASE[name], *CASE[name].get("anyOf", ())))
        and "panels" not in name
    ]
    assert len(scalars) > 80
    for name in scalars:
        with pytest.raises(ValueError, match="must") as caught:
            Case().replace({name: value})
        assert name.rpartition(".")[2] in str(caught.value)


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
