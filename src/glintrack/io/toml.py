"""TOML in and out: cases, designs and provenance."""

import re
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import BaseModel

from glintrack.core.designs import MAX_DEPTH
from glintrack.core.units import number_hint
from glintrack.io.untrusted import plain, read_text

_NUMBER = re.compile(r"^[ \t]*([\w.]+)[ \t]*=[ \t]*([-+]?\d[^\s#]*(?: [^\s#]+)?)[ \t]*(?:#|$)", re.MULTILINE)
_MAX_BYTES = 2_000_000  # a study that lists 50,000 cases is smaller


def read_toml(path: str | Path, name: str) -> dict[str, Any]:
    """Read a TOML file into plain values; error messages call the file ``name``.

    Raises
    ------
    ValueError
        If the file cannot be read, is too large for what it is, is not UTF-8 or not TOML.
    """
    text = read_text(path, name, _MAX_BYTES)
    try:
        values = tomllib.loads(text)
    except ValueError as error:  # of numbers of more than 4300 digits too, which are no fault of the format
        found = next((line for line in _NUMBER.finditer(text) if number_hint(line[2])), None)
        remedy = f" The line is {found[1]} = {found[2]}.{number_hint(found[2])}" if found else ""
        raise ValueError(f"`{name}` must be valid TOML; got {path}: {plain(error, 200)}.{remedy}") from error
    except RecursionError as error:
        raise ValueError(f"`{name}` must be valid TOML; got {path}, nested too deeply.") from error
    if _is_deep(values):
        raise ValueError(f"`{name}` must hold tables at most {MAX_DEPTH} deep; got {path}, nested deeper.")
    return values


def _is_deep(values: Any) -> bool:
    """Return True if tables or lists are nested more than `MAX_DEPTH` deep."""
    layer = [values]
    for _ in range(MAX_DEPTH):
        tables = [one.values() if isinstance(one, dict) else one for one in layer]
        layer = [one for table in tables for one in table if isinstance(one, (dict, list))]
        if not layer:
            return False
    return True


def to_toml(values: BaseModel | Mapping[str, Any]) -> str:
    """TOML text of a design, or of plain values, with every key that is not None."""
    if isinstance(values, BaseModel):
        values = values.model_dump(mode="json", exclude_none=True)
    return tomli_w.dumps(values)


def toml_value(text: str) -> Any:
    """Parse one value of TOML; a bare word is a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text.strip()
