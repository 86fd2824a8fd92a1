"""Designs: what a user decides about one part of a case, as a frozen model that checks itself.

A fault is one sentence that names the key, the requirement, what came and the remedy. Several faults are told
at once, one a line.
"""

import ast
import difflib
import inspect
import json
import re
import textwrap
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Self, TypeVar

from pydantic import (
    BaseModel,
    ConfigDict,
    GetJsonSchemaHandler,
    ValidationError,
    ValidationInfo,
    field_validator,
)
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema, PydanticKnownError

from glintrack.core.units import unit_of

Model = TypeVar("Model", bound=BaseModel)
DEEPEST = 64  # tables in each other, or parts of a dotted key; none of ours lies a tenth as deep
# words of other programs for ours, by which a key begins
_ALIKE = {
    "alt": ("height", "altitude"), "altitude": ("height",), "elevation": ("height",), "z": ("height",),
    "lat": ("latitude",), "lng": ("longitude",), "lon": ("longitude",), "yaw": ("heading",),
    "x": ("east", "easting"), "y": ("north", "northing"), "east": ("easting",), "north": ("northing",),
    "width": ("columns",), "height": ("rows", "altitude"), "f": ("focal",), "pixel": ("pitch",),
    "fps": ("rate",), "haze": ("aerosol",), "duration": ("frames",),
}  # fmt: skip
_A_SLIP = 0.8  # likeness of two words, above which one is taken for the other misspelt
_NO_NUMBERS = ("float_parsing", "float_type", "int_parsing", "int_type")  # of pydantic's faults
_NUMBER = re.compile(r"\s*[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?\s*")  # as a text
_LIMITS = ("greater_than", "less_than")  # of pydantic's faults, how those of numbers out of range begin
_CHOICE = re.compile(r"`[^`]+` must be (?:one of )?(?P<known>.+), got '(?P<got>[^']{1,60})'")  # of words
_PLAIN = (
    dict.fromkeys(("model_type", "dict_type"), "a table")
    | dict.fromkeys(("tuple_type", "list_type"), "a list")
    | dict.fromkeys(("bool_type", "bool_parsing"), "true or false")
)  # by pydantic's faults
_FEW = re.compile(r"(?:Tuple|List) should have (.+) after validation, not \d+")
_MOST_FAULTS, _MOST_TRIED = 10, 1000  # that are told; that are put into words


class Design(BaseModel):
    """Base of every table of a case.

    It is frozen, knows its keys, takes only finite numbers, and the text under a field describes it.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    @classmethod
    def __get_pydantic_json_schema__(cls, core: CoreSchema, handler: GetJsonSchemaHandler) -> JsonSchemaValue:
        """The schema with the text under each field.

        Read here alone: pydantic would read the source of every design at each start, a tenth of a second.
        """
        schema = handler(core)
        described = handler.resolve_ref_schema(schema)["properties"]
        for name, text in _texts_under_fields(cls).items():
            described[cls.model_fields[name].alias or name]["description"] = text
        return schema

    @field_validator("*", mode="before")
    @classmethod
    def _a_number(cls, value: Any, info: ValidationInfo) -> Any:
        """A truth value and a text are no number, though pydantic takes them for what they look like."""
        taken = types_of(cls, info.field_name or "")
        if (isinstance(value, str) and taken <= {int, float}) or (isinstance(value, bool) and taken == {int}):
            raise PydanticKnownError("float_type" if float in taken else "int_type")
        if isinstance(value, str) and taken == {bool}:
            raise PydanticKnownError("bool_type")
        return value

    def replace(self, changes: Mapping[str, Any]) -> Self:
        """The same design with other values of some keys, all of it checked again.

        Parameters
        ----------
        changes
            Key to value; a dotted key reaches into a table: ``{"sensor.pitch_um": 8.5}``.

        Raises
        ------
        ValueError
            For an unknown key (the nearest is offered) or a value out of range; every fault at once.
        """
        return validate_design(type(self), with_changes(self, changes))

    def explicit_values(self) -> dict[str, Any]:
        """The values that are not left to their defaults."""
        return {
            name: getattr(self, name) for name in type(self).model_fields if name in self.model_fields_set
        }


def types_of(model: type[BaseModel], name: str) -> set[Any]:
    """Types that a field takes, beside none; no types for a name that is no field's."""
    if name not in model.model_fields:
        return set()
    annotation = model.model_fields[name].annotation
    return set(typing.get_args(annotation) or (annotation,)) - {types.NoneType}


def _texts_under_fields(model: type[BaseModel]) -> dict[str, str]:
    """What stands as a string after each field of a design and of its bases."""
    texts: dict[str, str] = {}
    for base in reversed(model.__mro__):
        if not issubclass(base, Design) or base is Design:
            continue
        (written,) = ast.parse(textwrap.dedent(inspect.getsource(base))).body
        assert isinstance(written, ast.ClassDef)
        for field, text in pairwise(written.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr):
                texts[ast.unparse(field.target)] = inspect.cleandoc(ast.literal_eval(text.value))
    return texts


def validate_design(model: type[Model], values: Mapping[str, Any]) -> Model:
    """Build a design from plain values.

    Raises
    ------
    ValueError
        With a sentence for each fault (see `describe`).
    """
    try:
        return model.model_validate(values)
    except ValidationError as error:
        raise ValueError(describe(error, model)) from error


def describe(error: ValidationError, model: type[BaseModel]) -> str:
    """The faults of a validation error, a sentence and a line each."""
    sentences: dict[tuple, str] = {}
    faults = error.errors(include_url=False)
    for fault in faults[:_MOST_TRIED]:
        # a value that fits none of several types is one fault, not one a type
        sentences.setdefault(_named(model, fault["loc"]), _with_hint(_sentence(fault, model)))
    for path in list(sentences):  # a list is at fault by what is at fault in it
        for outer in range(1, len(path)):
            sentences.pop(path[:outer], None)
    told = list(dict.fromkeys(sentences.values()))
    beyond = len(told) + max(len(faults) - _MOST_TRIED, 0) - _MOST_FAULTS
    more = [f"and {beyond} more fault{'s' if beyond > 1 else ''}"] if beyond > 0 else []
    return "\n".join([*(_short_sentence(one) for one in told[:_MOST_FAULTS]), *more])


def suggest_name(name: str, known: Iterable[str]) -> str:
    """A hint at the known name that is most like a wrong one, or at all of them."""
    known = sorted(known)
    near = _alike(name, known) or difflib.get_close_matches(name, known, n=1)
    return f"did you mean `{near[0]}`?" if near else f"known are {', '.join(known)}"


def suggest_close_name(name: str, known: Iterable[str]) -> str:
    """A hint at the known name that is most like a wrong one, or none where no one is."""
    hint = suggest_name(name, known)
    return hint if hint.startswith("did you mean") else ""


def _alike(name: str, known: list[str]) -> list[str]:
    """Known names that a wrong one is a slip of, or that begin like it or as another program would say it."""
    begun = [other for other in known if _begun(other) == _begun(name)]
    return (
        difflib.get_close_matches(name, known, n=1, cutoff=_A_SLIP)
        or difflib.get_close_matches(name, begun, n=1, cutoff=0.0)
        or [other for other in known if other.split("_")[0] in _ALIKE.get(name.split("_")[0], ())]
    )


def _nearest_key(name: str, path: tuple[str | int, ...], model: type[BaseModel]) -> str:
    """A hint at a key of the table that a path leads to; or of another, where only that has one like it."""
    own = fields_at(model, path)
    if _alike(name, own):
        return suggest_name(name, own)
    keys = [key for key in _keys_of(model) if _alike(name, [key[-1]])]
    keys.sort(key=lambda key: (-difflib.SequenceMatcher(None, key[-1], name).ratio(), len(key)))
    return f"did you mean `{'.'.join(keys[0])}`?" if keys else suggest_name(name, own)


def _begun(name: str) -> str:
    """The first word of a key, of one or many."""
    return name.split("_")[0].removesuffix("s")


def _keys_of(model: type[BaseModel], path: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Paths of all keys that are no tables."""
    for name, field in model.model_fields.items():
        inner, here = model_in(field.annotation), (*path, field.alias or name)
        if inner is None:
            yield here
        elif len(here) < DEEPEST:
            yield from _keys_of(inner, here)


def fields_at(model: type[BaseModel], path: Iterable[str | int]) -> list[str]:
    """Names that a table within a design may hold; none where the path leads to no table."""
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
    """The table that a field holds, alone or in a list."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    if typing.get_origin(annotation) in (tuple, list, typing.Union, types.UnionType, typing.Annotated):
        return next(filter(None, map(model_in, typing.get_args(annotation))), None)
    return None


def with_changes(value: Any, changes: Mapping[str, Any]) -> dict[str, Any]:
    """Plain values of a table with the changes put in; the check tells what is no table."""
    values: dict[str, Any] = value.explicit_values() if isinstance(value, Design) else dict(value)
    inner: dict[str, dict[str, Any]] = {}
    for key, changed in changes.items():
        head, _, rest = key.partition(".")
        if key.count(".") > DEEPEST:
            raise ValueError(f"`{key[:60]}…` must name a key of a table, got one nested too deeply")
        if rest:
            inner.setdefault(head, {})[rest] = changed
        else:
            values[head] = changed
    for head, own in inner.items():
        present = values.get(head, getattr(value, head, {}))
        values[head] = with_changes(present if isinstance(present, (Design, Mapping)) else {}, own)
    return values


def _named(model: type[BaseModel], path: tuple[str | int, ...]) -> tuple[str | int, ...]:
    """The part of a fault's path that names a key, without the types that pydantic tried."""
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


def _sentence(fault, model: type[BaseModel]) -> str:
    path = tuple(part if isinstance(part, int) else _short_name(part) for part in fault["loc"])
    key = ".".join(str(part) for part in path)
    if fault["type"] == "extra_forbidden":
        hint = _nearest_key(str(path[-1]), path[:-1], model)
        return f"`{key}` must be a known key, got an unknown one ({hint})"
    if fault["type"] == "missing":
        return f"`{key}` must be given, got only {', '.join(map(str, fault['input'])) or 'an empty table'}"
    message = fault["msg"].removeprefix("Value error, ")
    if fault["type"] == "value_error":
        tables = [str(part) for k, part in enumerate(path) if fields_at(model, path[: k + 1])]
        while tables and message.startswith(f"`{tables[-1]}."):  # it names its table itself
            tables.pop()
        named = not message.startswith("`") or (path and message.startswith(f"`{path[0]}."))
        return message if named or not tables else f"`{'.'.join(tables)}.{message[1:]}"
    requirement: str = _PLAIN.get(fault["type"]) or message.removeprefix("Input should be ")
    requirement = _FEW.sub(r"a list of \1", requirement)
    if fault["type"] in _NO_NUMBERS:
        unit = unit_of(str(path[-1]))
        requirement = f"{'a whole number' if 'int' in fault['type'] else 'a number'}{unit and f' in {unit}'}"
        if _NUMBER.fullmatch(str(fault["input"])):
            requirement += ", without quotes"
        elif unit and re.search(r"\d", str(fault["input"])):
            requirement += ", without its unit"
    key, got = ".".join(str(part) for part in _named(model, path)), _short(fault["input"])
    if fault["type"].startswith(_LIMITS) and (unit := unit_of(str(path[-1]))):
        requirement, got = f"{requirement} {unit}", f"{got} {unit}"
    return f"`{key}` must be {requirement}, got {got}"


def _with_hint(sentence: str) -> str:
    """A fault, with the choice that a wrong word is most like, where the requirement lists words."""
    found = _CHOICE.fullmatch(sentence)
    if found is None:
        return sentence
    words = [word.strip("'") for word in re.split(r", | or ", found["known"])]
    words = [word for word in words if re.fullmatch(r"[\w-]+", word)]
    hint = suggest_close_name(found["got"], words) if len(words) > 1 else ""
    return f"{sentence} ({hint})" if hint else sentence


def _short_sentence(text: str) -> str:
    return text if len(text) <= 600 else f"{text[:400]} … {text[-150:]}"


def _short_name(name: str) -> str:
    return name if len(name) <= 100 else f"{name[:99]}…"


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 100 else f"{text[:97]}…"


_OWN_NAME = re.compile(r"; (?:the |one )?``\[+[\w.]+\]+``(?: table)?(?: of a case)?")
_LIMIT_WORDS = {
    "minimum": "≥ {:g}",
    "exclusiveMinimum": "> {:g}",
    "maximum": "≤ {:g}",
    "exclusiveMaximum": "< {:g}",
}


@dataclass(frozen=True)
class Key:
    """One key of a design.

    Parameters
    ----------
    name
        Dotted, as in a case.
    unit
        By the name's ending; empty for what has none.
    kind
        What it takes, in words, with its range.
    default
        As TOML would have it; empty where there is none.
    meaning
        The text under the field.
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
        given = schema["properties"][shown]
        nested = model_in(field.annotation)
        if nested is not None:
            inner.append((f"{table}{shown}.", nested))
            if field.annotation is nested:
                continue  # a table has no value of its own; a list of them has
        default = "" if field.is_required() else _short_default(given.get("default"))
        meaning = " ".join(given.get("description", "").split())
        own.append(Key(f"{table}{shown}", unit_of(name), kind_of(given), default, meaning))
    if own:
        yield table[:-1], own
    for path, nested in inner:
        yield from keys_of(nested, path)


def tables_of(model: type[BaseModel], table: str = "") -> Iterator[tuple[str, str]]:
    """Tables of a design in the order of `keys_of`, each with the first sentence of what it holds."""
    if table:
        said = " ".join((model.__doc__ or "").split("\n\n")[0].split())
        yield table[:-1], _OWN_NAME.sub("", said).rstrip(".")
    for name, field in model.model_fields.items():
        nested = model_in(field.annotation)
        if nested is not None:
            yield from tables_of(nested, f"{table}{field.alias or name}.")


def kind_of(given: dict[str, Any]) -> str:
    """What a key takes by its JSON schema, in words, with its range."""
    if "$ref" in given:
        return "table"
    if "enum" in given:
        return " | ".join(str(value) for value in given["enum"])
    if "const" in given:
        return str(given["const"])
    if "anyOf" in given:
        outer = {name: given[name] for name in _LIMIT_WORDS if name in given}
        kinds = [kind_of({**outer, **one}) for one in given["anyOf"] if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(kinds))
    limits = ", ".join(text.format(given[key]) for key, text in _LIMIT_WORDS.items() if key in given)
    kind = given.get("type", "value")
    if kind == "array":
        items = given.get("items") or next(iter(given.get("prefixItems", [])), {})
        count = f"{len(given['prefixItems'])} of " if "prefixItems" in given else "list of "
        return f"{count}{kind_of(items)}"
    if kind == "object":
        inner = given.get("additionalProperties")
        return f"table of {kind_of(inner)}" if isinstance(inner, dict) else "table"
    words = {"number": "", "integer": "whole", "boolean": "true | false", "string": "text"}
    return f"{words.get(kind, kind)} {limits}".strip() or "number"


def _short_default(value: Any) -> str:
    text = "" if value is None else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 40 else f"{text[:39]}…"
