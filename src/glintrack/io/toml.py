"""TOML in and out: cases, designs and provenance."""

import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tomli_w
from pydantic import BaseModel

from glintrack.core.designs import DEEPEST
from glintrack.io.untrusted import check_file, plain

_LARGEST_BYTES = 2_000_000  # a study that lists 50,000 cases is smaller


def read_toml(path: str | Path, name: str) -> dict[str, Any]:
    """Read a TOML file into plain values; ``name`` says what the file is in the error.

    Raises
    ------
    ValueError
        If the file cannot be read, is too large for what it is, is not UTF-8 or not TOML.
    """
    path = check_file(path, name, _LARGEST_BYTES)
    try:
        text = path.read_bytes().decode("utf-8-sig")
    except OSError as error:
        raise ValueError(f"`{name}` must be a readable TOML file, got {path} ({error.strerror})") from error
    except UnicodeDecodeError as error:
        raise ValueError(f"`{name}` must be UTF-8 text, got {path} with a byte that is not") from error
    try:
        values = tomllib.loads(text)
    except ValueError as error:  # of numbers of more than 4300 digits too, which are no fault of the format
        raise ValueError(f"`{name}` must be valid TOML, got {path}: {plain(error, 200)}") from error
    except RecursionError as error:
        raise ValueError(f"`{name}` must be valid TOML, got {path}, nested too deeply") from error
    if _is_deep(values):
        raise ValueError(f"`{name}` must hold tables at most {DEEPEST} deep, got {path}, nested too deeply")
    return values


def _is_deep(values: Any) -> bool:
    """Whether tables or lists lie in each other more than `DEEPEST` deep."""
    layer = [values]
    for _ in range(DEEPEST):
        tables = [one.values() if isinstance(one, dict) else one for one in layer]
        layer = [one for table in tables for one in table if isinstance(one, (dict, list))]
        if not layer:
            return False
    return True


def to_toml(values: BaseModel | Mapping[str, Any]) -> str:
    """A design, or plain values, as TOML with every key written out; what is None is left out."""
    if isinstance(values, BaseModel):
        values = values.model_dump(mode="json", exclude_none=True)
    return tomli_w.dumps(values)


def toml_value(text: str) -> Any:
    """One value as TOML writes it; a bare word is taken as a string."""
    try:
        return tomllib.loads(f"value = {text}")["value"]
    except (ValueError, RecursionError):
        return text.strip()
