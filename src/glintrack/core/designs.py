"""Designs: the part of a case that describes one stage, as a frozen pydantic model that checks itself.

An error is one sentence with the key, the requirement, what was found and a remedy. All errors of a design
are reported together, one on a line.
"""

import difflib
import json
import re
import types
import typing
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from typing import Any, Self, TypeVar

from pydantic import BaseModel, ConfigDict, ValidationError, ValidationInfo, field_validator
from pydantic_core import PydanticKnownError

from glintrack.core.installation import read_data
from glintrack.core.units import number_hint, unit_of

Model = TypeVar("Model", bound=BaseModel)
MAX_DEPTH = 64  # of nested tables, and of dotted keys
_WORDS = read_data("words.toml")
_SYNONYMS: Mapping[str, Sequence[str]] = _WORDS["keys"]  # other programs' for ours
_MISSPELT = 0.8  # similarity of two words, above which one is the other misspelt
_REQUIREMENTS: Mapping[str, str] = _WORDS["requirements"]
_COUNT = re.compile(r"(Tuple|List|Dictionary) should have (.+) after validation, not \d+")
_CHOICE = re.compile(r"`[^`]+` must be (?:one of )?(?P<known>.+); got '(?P<got>[^']{1,60})'\.")
_MAX_ERRORS, _MAX_READ = 10, 1000  # that are reported, and of which sentences are made


class Design(BaseModel):
    """Base of every table of a case: frozen, without unknown keys, with finite numbers only."""

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, use_attribute_docstrings=True)

    @field_validator("*", mode="before")
    @classmethod
    def _refuse_disguised_number(cls, value: Any, info: ValidationInfo) -> Any:
        """Refuse texts and truth values for numbers, which pydantic would convert."""
        taken = types_of(cls, info.field_name or "")
        if (isinstance(value, str) and taken <= {int, float}) or (isinstance(value, bool) and taken == {int}):
            raise PydanticKnownError("float_type" if float in taken else "int_type")
        if isinstance(value, str) and taken == {bool}:
            raise PydanticKnownError("bool_type")
        return value

    def replace(self, changes: Mapping[str, Any]) -> Self:
        """Return the design with other values of some keys, checked again.

        Parameters
        ----------
        changes
            Key to value; a dotted key reaches into a table: ``{"sensor.pitch_um": 8.5}``.

        Raises
        ------
        ValueError
            For unknown keys (the nearest is suggested) and values out of range, all together.
        """
        return validate_design(type(self), with_changes(self, changes))

    def explicit_values(self) -> dict[str, Any]:
        """Values that are not left to their defaults."""
        return {k: getattr(self, k) for k in type(self).model_fields if k in self.model_fields_set}


def refuse_ignored(
    design: Design,
    uses: Mapping[tuple[str, tuple[Any, ...]], Sequence[str]],
    allowed: Mapping[str, Any] | None = None,
) -> None:
    """Refuse keys that have no effect with the choices of a design, unless they have their defaults.

    Parameters
    ----------
    design
        A table of a case.
    uses
        (Choice, its values that use some keys) to these keys. An empty tuple is all values but the default.
    allowed
        Key to a second value that is always accepted.
    """
    for (choice, values), keys in uses.items():
        chosen = attrgetter(choice)(design)
        if chosen in values or (not values and chosen != _default_of(design, choice)):
            continue
        for key in keys:
            found = attrgetter(key)(design)
            if found not in (_default_of(design, key), (allowed or {}).get(key)):
                known = " or ".join(map(repr, values))
                other = f"{choice} = {known}" if values else f"Another value of {choice}"
                raise ValueError(
                    f"`{key}` must be left out with {choice} = {chosen!r}, which ignores it; got {found!r}. "
                    f"{other} uses it."
                )


def _default_of(design: Design, key: str) -> Any:
    table, _, name = key.rpartition(".")
    return type(attrgetter(table)(design) if table else design).model_fields[name].default


def types_of(model: type[BaseModel], name: str) -> set[Any]:
    """Types that a field accepts, without None; empty if there is no such field."""
    if name not in model.model_fields:
        return set()
    annotation = model.model_fields[name].annotation
    return set(typing.get_args(annotation) or (annotation,)) - {types.NoneType}


def validate_design(model: type[Model], values: Mapping[str, Any]) -> Model:
    """Build a design from plain values.

    Raises
    ------
    ValueError
        With a sentence for each error (see `describe`).
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ValueError(describe(error, model)) from error


def describe(error: ValidationError, model: type[BaseModel]) -> str:
    """Describe the errors of a validation, one sentence on each line."""
    sentences: dict[tuple, str] = {}
    errors = [one for one in error.errors(include_url=False) if one["type"] != "default_factory_not_called"]
    for one in errors[:_MAX_READ]:
        # a value that fits none of several types is one error, not one for each type
        sentences.setdefault(_key_path(model, one["loc"]), _suggest_choice(_sentence(one, model)))
    for path in list(sentences):  # an error of a list is that of its items
        for outer in range(1, len(path)):
            sentences.pop(path[:outer], None)
    found = list(dict.fromkeys(sentences.values()))
    beyond = len(found) + max(len(errors) - _MAX_READ, 0) - _MAX_ERRORS
    shown = [text if len(text) <= 600 else f"{text[:400]} … {text[-150:]}" for text in found[:_MAX_ERRORS]]
    return "\n".join([*shown, *([f"and {beyond} more error{'s' * (beyond > 1)}"] if beyond > 0 else [])])


def suggest_name(name: str, known: Iterable[str]) -> str:
    """Suggest the known name that is most like a wrong one, or list all of them."""
    known = sorted(known)
    near = _similar_names(name, known) or difflib.get_close_matches(name, known, n=1)
    return f"Did you mean `{near[0]}`?" if near else f"Known: {', '.join(known)}."


def _similar_names(name: str, known: list[str]) -> list[str]:
    """Known names that a wrong one misspells, or that begin like it or with a synonym."""

    def first_word(text: str) -> str:
        return text.split("_")[0].removesuffix("s")

    same_start = [other for other in known if first_word(other) == first_word(name)]
    return (
        difflib.get_close_matches(name, known, n=1, cutoff=_MISSPELT)
        or difflib.get_close_matches(name, same_start, n=1, cutoff=0.0)
        or [other for other in known if other.split("_")[0] in _SYNONYMS.get(name.split("_")[0], ())]
    )


def _suggest_key(name: str, path: tuple[str | int, ...], model: type[BaseModel]) -> str:
    """Suggest a key of the table that a path leads to, or of another if only that has a similar one."""
    own = fields_at(model, path)
    if _similar_names(name, own):
        return suggest_name(name, own)
    keys = [key for key in _all_keys(model) if _similar_names(name, [key[-1]])]
    keys.sort(key=lambda key: (-difflib.SequenceMatcher(None, key[-1], name).ratio(), len(key)))
    return f"Did you mean `{'.'.join(keys[0])}`?" if keys else suggest_name(name, own)


def _suggest_choice(sentence: str) -> str:
    """Add the choice that a wrong word is most like, if the requirement lists words."""
    found = _CHOICE.fullmatch(sentence)
    words = re.split(r", | or ", found["known"]) if found else []
    words = [word.strip("'") for word in words if re.fullmatch(r"'?[\w-]+'?", word)]
    hint = suggest_name(found["got"], words) if found and len(words) > 1 else ""
    return f"{sentence} {hint}" if hint.startswith("Did you mean") else sentence


def _all_keys(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths of all keys that are no tables."""
    for name, field in model.model_fields.items():
        inner, here = model_in(field.annotation), (*path, field.alias or name)
        if inner is None:
            yield here
        elif len(here) < MAX_DEPTH:
            yield from _all_keys(inner, here)


def fields_at(model: type[BaseModel], path: Iterable[str | int]) -> list[str]:
    """Names that a table within a design may hold; empty if the path leads to no table."""
    for part in path:
        if isinstance(part, int):
            continue
        field = model.model_fields.get(part)
        inner = None if field is None else model_in(field.annotation)
        if inner is None:
            return []
        model = inner
    return [field.alias or name for name, field in model.model_fields.items()]


def model_in(annotation: Any) -> type[BaseModel] | None:
    """Table that a field holds, alone or in a list."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if typing.get_origin(annotation) in (tuple, list, typing.Union, types.UnionType, typing.Annotated):
        return next(filter(None, map(model_in, typing.get_args(annotation))), None)
    return None


def with_changes(value: Any, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values of a table with changes; the validation reports what is no table."""
    values: dict[str, Any] = value.explicit_values() if isinstance(value, Design) else dict(value)
    inner: dict[str, dict[str, Any]] = {}
    for key, changed in changes.items():
        head, _, rest = key.partition(".")
        if key.count(".") > MAX_DEPTH:
            raise ValueError(f"`{key[:60]}…` must name a key of a table; got one nested too deeply.")
        if rest:
            inner.setdefault(head, {})[rest] = changed
        else:
            values[head] = changed
    for head, own in inner.items():
        present = values.get(head, getattr(value, head, {}))
        values[head] = with_changes(present if isinstance(present, (Design, Mapping)) else {}, own)
    return values


def _key_path(model: type[BaseModel], path: tuple[str | int, ...]) -> tuple[str | int, ...]:
    """Part of an error's path that names a key, without the types that pydantic tried."""
    out: list[str | int] = []
    table: type[BaseModel] | None = model
    for part in path:
        if isinstance(part, int) or part.isdigit():
            out.append(part)
        elif table is not None:
            out.append(part)
            field = table.model_fields.get(part)
            table = None if field is None else model_in(field.annotation)
    return tuple(out)


def _sentence(error, model: type[BaseModel]) -> str:
    """Describe one error: key, requirement with its unit, and what was found."""
    path = tuple(part if isinstance(part, int) else _shorten(part) for part in error["loc"])
    key, kind = ".".join(str(part) for part in path), error["type"]
    if kind == "extra_forbidden":
        hint = _suggest_key(str(path[-1]), path[:-1], model)
        return f"`{key}` must be a known key; got an unknown one. {hint}"
    if kind == "missing":
        return f"`{key}` must be given; got only {', '.join(map(str, error['input'])) or 'an empty table'}."
    message = error["msg"].removeprefix("Value error, ")
    if kind == "value_error":
        tables = [str(part) for k, part in enumerate(path) if fields_at(model, path[: k + 1])]
        while tables and message.startswith(f"`{tables[-1]}."):  # it names its table itself
            tables.pop()
        has_key = not message.startswith("`") or (path and message.startswith(f"`{path[0]}."))
        return message if has_key or not tables else f"`{'.'.join(tables)}.{message[1:]}"
    key = ".".join(str(part) for part in _key_path(model, path))
    return describe_value(error, key, unit_of(str(path[-1])) if path else "")


def describe_value(error, key: str, unit: str) -> str:
    """Describe a value that a key or an option cannot have: requirement with its unit, value, remedy."""
    kind, value = error["type"], error["input"]
    is_limit = kind.startswith(("greater_than", "less_than"))
    got = _shorten(str(value) if is_limit else repr(value))
    requirement = _REQUIREMENTS.get(kind) or _COUNT.sub(
        lambda found: f"a {'table' if found[1] == 'Dictionary' else 'list'} of {found[2]}",
        error["msg"].removeprefix("Input should be "),
    )
    if unit and is_limit:
        requirement, got = f"{requirement} {unit}", f"{got} {unit}"
    elif unit and kind.startswith(("float_", "int_")):
        requirement = f"{requirement} in {unit}"
    return f"`{key}` must be {requirement}; got {got}.{number_hint(value)}"


def _shorten(text: str, length: int = 100) -> str:
    return text if len(text) <= length else f"{text[: length - 1]}…"


_OWN_NAME = re.compile(r"; (?:the |one )?``\[+[\w.]+\]+``(?: table)?(?: of a case)?")
_LIMIT_WORDS: Mapping[str, str] = _WORDS["limits"]
_TYPE_WORDS = {"number": "", "integer": "whole", "boolean": "true | false", "string": "text"}


@dataclass(frozen=True)
class Key:
    """One key of a design.

    Parameters
    ----------
    name
        Dotted, as in a case.
    unit
        Unit that the name ends in; may be empty.
    kind
        Type and range of its values.
    default
        Default as in TOML; empty if there is none.
    meaning
        Description of the field.
    """

    name: str
    unit: str
    kind: str
    default: str
    meaning: str


def keys_of(model: type[BaseModel], table: str = "") -> Iterator[tuple[str, list[Key]]]:
    """Tables of a design in order, each with its keys; the first is the design's own."""
    schema = model.model_json_schema()
    own: list[Key] = []
    inner: list[tuple[str, type[BaseModel]]] = []
    for name, field in model.model_fields.items():
        shown = field.alias or name
        about = schema["properties"][shown]
        nested = model_in(field.annotation)
        if nested is not None:
            inner.append((f"{table}{shown}.", nested))
            if field.annotation is nested:
                continue  # a table has no value of its own; a list of them has
        default = about.get("default")
        text = json.dumps(default, ensure_ascii=False, default=str) if default is not None else ""
        text = "derived" if field.default_factory else text
        meaning = " ".join(about.get("description", "").split())
        own.append(Key(f"{table}{shown}", unit_of(name), kind_of(about), _shorten(text, 40), meaning))
    if own:
        yield table[:-1], own
    for path, nested in inner:
        yield from keys_of(nested, path)


def tables_of(model: type[BaseModel], table: str = "") -> Iterator[tuple[str, str]]:
    """Tables of a design in the order of `keys_of`, each with the first sentence of its docstring."""
    if table:
        said = " ".join((model.__doc__ or "").split("\n\n")[0].split())
        yield table[:-1], _OWN_NAME.sub("", said).rstrip(".")
    for name, field in model.model_fields.items():
        nested = model_in(field.annotation)
        if nested is not None:
            yield from tables_of(nested, f"{table}{field.alias or name}.")


def kind_of(schema: dict[str, Any]) -> str:
    """Type and range of a key's values in words, from its JSON schema."""
    if "$ref" in schema:
        return "table"
    if "enum" in schema or "const" in schema:
        return " | ".join(map(str, schema.get("enum", [schema.get("const")])))
    if "anyOf" in schema:
        outer = {name: schema[name] for name in _LIMIT_WORDS if name in schema}
        kinds = [kind_of({**outer, **one}) for one in schema["anyOf"] if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(kinds))
    limits = ", ".join(text.format(schema[key]) for key, text in _LIMIT_WORDS.items() if key in schema)
    kind = schema.get("type", "value")
    if kind == "array":
        items = schema.get("items") or next(iter(schema.get("prefixItems", [])), {})
        count = f"{len(schema['prefixItems'])} of " if "prefixItems" in schema else "list of "
        return f"{count}{kind_of(items)}"
    if kind == "object":
        inner = schema.get("additionalProperties")
        return f"table of {kind_of(inner)}" if isinstance(inner, dict) else "table"
    return f"{_TYPE_WORDS.get(kind, kind)} {limits}".strip() or "number"
