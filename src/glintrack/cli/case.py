"""``glintrack case``: what cases there are, whether one is valid, and what its keys mean."""

import json
import sys
from collections.abc import Mapping, Sequence
from typing import Annotated

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

from glintrack.case.check import assess
from glintrack.case.design import Case
from glintrack.case.packaged import find_case, list_cases, list_studies
from glintrack.cli.options import CaseArgument, OutsidePathsOption, command_app
from glintrack.core.designs import Key, keys_of, suggest_name, tables_of
from glintrack.flight import check_recorded, check_waypoints
from glintrack.scene import build_scene
from glintrack.sensor import build_sensor

_WIDTH = 160  # of tables that go into a file
_TOP = "case"  # keys in no table
app = command_app("List the packaged cases, check a case file, or print all its keys.")


@app.command("list")
def show_cases() -> None:
    """List the packaged cases and studies."""
    console = Console(soft_wrap=True, highlight=False)
    console.print(f"cases, for glintrack run: {', '.join(list_cases())}")
    console.print(f"studies, for glintrack study: {', '.join(list_studies())}")


@app.command()
def check(case: CaseArgument, allow_outside_paths: OutsidePathsOption = False) -> None:
    """Say whether a case and the files it names are valid, and what it amounts to, without flying it."""
    path = find_case(case)
    design = Case.from_toml(path, allow_outside_paths)
    flight = design.flight
    build_sensor(design.sensor, design.atmosphere.wavelength_um)
    if flight.kind == "waypoints":
        check_waypoints(flight)
    console = Console(soft_wrap=True, highlight=False)
    if design.scene.uses_files or design.scene.panels:
        with console.status("building the city …"):
            recording_duration_s = build_scene(design.scene).duration_s
    else:
        recording_duration_s = design.scene.recording_duration_s
    check_recorded(flight, recording_duration_s)
    console.print(
        f"{path} is a valid case: {flight.frames} frames at {flight.rate_hz:g} Hz over {design.scene.city}",
        markup=False,
    )
    about = assess(design)
    for line in about.lines():
        console.print(f"  {line}", markup=False)
    for warning in about.warnings:
        console.print(f"warning: {warning}", markup=False)


@app.command()
def schema(
    table: Annotated[
        str | None,
        typer.Argument(help="One table or key: sensor, sensor.optics, sensor.pitch_um [default: the tables]"),
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Every key of every table")] = False,
    as_json: Annotated[bool, typer.Option("--json", help="The JSON Schema instead of tables")] = False,
) -> None:
    """List the tables of a case; of a table, print every key with its unit, range, default and meaning."""
    if as_json:
        print(json.dumps(Case.model_json_schema(), indent=2))
        return
    console = Console(width=None if sys.stdout.isatty() else _WIDTH)
    tables = dict(keys_of(Case))
    if table is None and not everything:
        _print_tables(console, tables)
        return
    if table == _TOP:
        _print_keys(console, "", tables[""])
        return
    chosen = {name: keys for name, keys in tables.items() if table is None or _lies_in(name, table)}
    if table is not None and not chosen:
        chosen = {name: [key for key in keys if key.name == table] for name, keys in tables.items()}
    if not any(chosen.values()):
        known = (_TOP, *filter(None, tables), *(key.name for keys in tables.values() for key in keys))
        raise ValueError(f"`table` must be one of a case, got {table} ({suggest_name(str(table), known)})")
    for name, keys in chosen.items():
        if keys:
            _print_keys(console, name, keys)


def _lies_in(name: str, table: str) -> bool:
    return name == table or name.startswith(f"{table}.")


def _print_tables(console: Console, tables: Mapping[str, Sequence[Key]]) -> None:
    """A line a table: what it holds and how many keys."""
    about = {"": "Name, seed and channels"} | dict(tables_of(Case))
    shown = Table(box=SIMPLE, expand=False)
    for heading in ("table", "keys", "what"):
        shown.add_column(heading, justify="right" if heading == "keys" else "left")
    for name, keys in tables.items():
        shown.add_row(Text(f"[{name}]" if name else _TOP), str(len(keys)), Text(about.get(name, "")))
    console.print(shown)
    console.print("glintrack case schema TABLE prints its keys, --all every one", markup=False)


def _print_keys(console: Console, name: str, keys: Sequence[Key]) -> None:
    title = Text(f"[{name}]" if name else _TOP)
    shown = Table(title=title, title_justify="left", box=SIMPLE, expand=True)
    for heading, share in (("key", 4), ("unit", 1), ("range", 3), ("default", 3), ("meaning", 8)):
        whole = heading in ("key", "unit")  # a key that is cut cannot be copied
        shown.add_column(heading, ratio=None if whole else share, overflow="fold", no_wrap=whole)
    for key in keys:
        own = key.name.removeprefix(f"{name}.")
        shown.add_row(*(Text(cell) for cell in (own, key.unit, key.kind, key.default, key.meaning)))
    console.print(shown)
