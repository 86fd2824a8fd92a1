"""Every key of a design with its unit, range, default and meaning, as `glintrack case schema` shows them."""

import json
import re
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from glintrack.core.designs import model_in
from glintrack.core.units import unit_of

_OWN_NAME = re.compile(r"; (?:the |one )?``\[+[\w.]+\]+``(?: table)?(?: of a case)?")
_LIMITS = {
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
        default = "" if field.is_required() else _short(given.get("default"))
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
        outer = {name: given[name] for name in _LIMITS if name in given}
        kinds = [kind_of({**outer, **one}) for one in given["anyOf"] if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(kinds))
    limits = ", ".join(text.format(given[key]) for key, text in _LIMITS.items() if key in given)
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


def _short(value: Any) -> str:
    text = "" if value is None else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 40 else f"{text[:39]}…"
