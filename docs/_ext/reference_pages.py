"""Writes the pages that follow from the program itself: keys of a case, commands, labelled arrays."""

import json
from collections.abc import Iterator
from math import isfinite
from pathlib import Path

from pydantic import BaseModel

from glintrack.case.design import Case
from glintrack.cli.app import load_program
from glintrack.core.designs import keys_of
from glintrack.core.schema import SCHEMAS
from glintrack.study import StudyDesign
from glintrack.study.optimize import OptimizationDesign


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
        "in a terminal. What is left out has its default."
    )
    yield from _keys(Case, "The case")
    yield from _keys(StudyDesign, "A study")
    yield from _keys(OptimizationDesign, "An optimization")


def _keys(model: type[BaseModel], title: str) -> Iterator[str]:
    """Yield a heading and a table of a design's own keys, then those of the tables inside."""
    for table, keys in keys_of(model):
        heading = f"`[{table}]`" if table else title
        yield from ("", f"## {heading}", "", "| key | unit | value | default | meaning |")
        yield "| --- | --- | --- | --- | --- |"
        for key in keys:
            default = f"`{key.default}`" if key.default else ""
            yield _row(f"`{key.name}`", key.unit, key.kind, default, key.meaning)


def key_lines(model: type[BaseModel]) -> Iterator[str]:
    """Write a design's own keys as a list in reStructuredText."""
    for table, keys in keys_of(model):
        for key in () if table else keys:
            unit = f" [{key.unit}]" if key.unit else ""
            default = f", by default ``{key.default}``" if key.default else ""
            yield f"* ``{key.name}``{unit}: {key.kind}{default}. {key.meaning}"


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
        "What crosses a border between stages: xarray Datasets, checked by `core.schema.check`. Dims "
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
    """Write a default as in TOML, not too long."""
    text = "none" if value is None else json.dumps(value, ensure_ascii=False, default=str)
    return text if len(text) <= 60 else text[:57] + "…"


def _row(*cells: str) -> str:
    return "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |"
