"""Writes the pages that follow from the program itself: keys of a case, commands, labelled arrays."""

import json
from collections.abc import Iterator
from math import isfinite
from pathlib import Path

from pydantic import BaseModel

from glintrack.cli.app import load_program
from glintrack.config import Case
from glintrack.schema import SCHEMAS
from glintrack.study import StudyDesign

_RANGES = {"minimum": "≥ {}", "exclusiveMinimum": "> {}", "maximum": "≤ {}", "exclusiveMaximum": "< {}"}


def setup(app) -> dict:
    """Write the pages before anything is read."""
    app.connect("builder-inited", lambda app: write_pages(Path(app.srcdir) / "reference"))
    return {"parallel_read_safe": True}


def write_pages(folder: Path) -> None:
    """``case.md``, ``commands.md`` and ``arrays.md``; one that says the same already is left alone."""
    pages = {"case.md": _case_page(), "commands.md": _commands_page(), "arrays.md": _arrays_page()}
    for name, lines in pages.items():
        text, path = "\n".join(lines) + "\n", folder / name
        if not path.exists() or path.read_text(encoding="utf-8") != text:
            path.write_text(text, encoding="utf-8")


def _case_page() -> Iterator[str]:
    yield "# Keys of a case"
    yield ""
    yield (
        "Every key of a case file (TOML), from the program itself; `glintrack case schema` prints the same "
        "as JSON. Keys carry their unit: `_deg`, `_m`, `_um`, `_ms`, `_hz`. What is left out has its default."
    )
    yield from _keys(Case, "", "The case")
    yield from _keys(StudyDesign, "", "A study")


def _keys(model: type[BaseModel], table: str, title: str) -> Iterator[str]:
    """A heading and a table of keys, then those of the tables inside."""
    schema = model.model_json_schema()
    definitions, inner = schema.get("$defs", {}), []
    yield from ("", f"## {title}", "", "| key | value | default | meaning |", "| --- | --- | --- | --- |")
    for name, field in model.model_fields.items():
        nested = field.annotation
        if isinstance(nested, type) and issubclass(nested, BaseModel):
            inner.append((f"{table}{name}.", nested))
            continue
        given = schema["properties"][name]
        default = f"`{_short(given['default'])}`" if "default" in given else ""
        yield _row(f"`{table}{name}`", _kind(given, definitions), default, given.get("description", ""))
    for path, nested in inner:
        yield from _keys(nested, path, f"`[{path[:-1]}]`")


def key_lines(model: type[BaseModel]) -> Iterator[str]:
    """A design's keys as a list in reStructuredText."""
    schema = model.model_json_schema()
    for name, given in schema.get("properties", {}).items():
        default = f", by default ``{_short(given['default'])}``" if "default" in given else ""
        kind = _kind(given, {}).replace("`", "``")
        meaning = " ".join(given.get("description", "").split())
        yield f"* ``{name}``: {kind}{default}. {meaning}"


def _kind(given: dict, definitions: dict) -> str:
    """What a key takes, in words, with its range."""
    if "$ref" in given:
        return f"table ({given['$ref'].rsplit('/', 1)[-1]})"
    if "enum" in given:
        return " or ".join(f"`{value}`" for value in given["enum"])
    if "const" in given:
        return f"`{given['const']}`"
    if "anyOf" in given:
        kinds = [_kind(one, definitions) for one in given["anyOf"] if one.get("type") != "null"]
        return " or ".join(dict.fromkeys(kinds))
    ranges = ", ".join(text.format(given[key]) for key, text in _RANGES.items() if key in given)
    kind = {"array": "list", "object": "table"}.get(given.get("type", ""), given.get("type", "value"))
    if kind == "list" and isinstance(given.get("items"), dict):
        kind = f"list of {_kind(given['items'], definitions)}"
    return f"{kind} {ranges}".strip()


def _commands_page() -> Iterator[str]:
    yield "# Commands"
    yield ""
    yield "What `--help` says of each, in one place."
    yield from _command(load_program(), "glintrack")


def _command(command, path: str) -> Iterator[str]:
    """One command, or those of a group, by name."""
    if getattr(command, "commands", None):
        for name in sorted(command.commands):
            yield from _command(command.commands[name], f"{path} {name}")
        return
    yield from ("", f"## {path}", "", (command.help or "").strip(), "")
    shown = [p for p in command.params if p.name != "help" and not getattr(p, "hidden", False)]
    if shown:
        yield from ("| | default | |", "| --- | --- | --- |")
    for parameter in shown:
        argument = parameter.param_type_name == "argument"
        names = [parameter.name.upper()] if argument else [*parameter.opts, *parameter.secondary_opts]
        default = parameter.default
        unsaid = default in (None, False, "", (), []) or callable(default)
        said = "" if unsaid else f"`{_short(default)}`"
        yield _row(", ".join(f"`{n}`" for n in names), said, getattr(parameter, "help", None) or "")


def _arrays_page() -> Iterator[str]:
    yield "# Labelled arrays"
    yield ""
    yield (
        "What crosses a border between stages: xarray Datasets, checked by `glintrack.schema.check`. Dims "
        "are in order; NaN marks missing data where it is allowed."
    )
    for name, variables in SCHEMAS.items():
        yield from ("", f"## `{name}`", "", "| variable | dims | unit | range | NaN |")
        yield "| --- | --- | --- | --- | --- |"
        for variable, must in variables.items():
            nan = "allowed" if must.nan_allowed else ""
            limits = _limits(must.lowest, must.highest)
            yield _row(f"`{variable}`", ", ".join(must.dims), must.units, limits, nan)


def _limits(low: float, high: float) -> str:
    if isfinite(low) and isfinite(high):
        return f"{low:g} to {high:g}"
    return f"≥ {low:g}" if isfinite(low) else f"≤ {high:g}" if isfinite(high) else ""


def _short(value: object) -> str:
    """A default as TOML would have it, not too long."""
    text = "none" if value is None else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:57] + "…"


def _row(*cells: str) -> str:
    return "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |"
