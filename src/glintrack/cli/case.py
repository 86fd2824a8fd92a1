"""``glintrack case``: list cases, check one, and print the meaning of its keys."""

import json
import math
import re
import sys
from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
from rich.box import SIMPLE
from rich.console import Console
from rich.table import Table
from rich.text import Text

from glintrack.case.advice import conclude
from glintrack.case.area import describe_window
from glintrack.case.build import check_place
from glintrack.case.check import ANSWERS, Judgement, assess_case
from glintrack.case.data_sheet import Filters, Polarizers, case_text
from glintrack.case.design import Case
from glintrack.case.fitted_range import describe_array, describe_binning, describe_initiation
from glintrack.case.niirs import describe_niirs
from glintrack.case.packaged import find_case, list_cases, list_studies
from glintrack.case.quantities import CITY_SPEED_M_S, describe_time, fastest_speed_m_s
from glintrack.cli import options as cli
from glintrack.core.designs import Key, keys_of, suggest_name, tables_of
from glintrack.flight import check_recorded, check_waypoints
from glintrack.io.atomic import write_text
from glintrack.scene import build_scene
from glintrack.sensor import build_sensor
from glintrack.sensor.derivation import derived_values

_FILE_WIDTH = 160  # of tables that go into a file [character]
_TOP = "case"  # keys in no table
app = cli.command_app("Make a case from a data sheet, check a case file, list cases, or print the keys.")


@app.command("list")
def show_cases() -> None:
    """List the packaged cases and studies."""
    print(f"cases, for glintrack run: {', '.join(list_cases())}")
    print(f"studies, for glintrack study: {', '.join(list_studies())}")


@app.command()
def check(
    case: cli.CaseArgument,
    frames: cli.FramesOption = None,
    as_json: Annotated[bool, cli.option("Print the judgements as JSON", "--json")] = False,
    allow_outside_paths: cli.OutsidePathsOption = False,
) -> None:
    """Validate a case and the files it names, and judge its derived quantities: good, doubtful or bad.

    The exit code is 0 without a bad quantity, 1 with one, and 2 if the case is not valid.
    """
    path = find_case(case)
    design = cli.limit_frames(Case.from_toml(path, allow_outside_paths), frames)
    flight = design.flight
    build_sensor(design.sensor, design.atmosphere.wavelength_um)
    if flight.kind == "waypoints":
        check_waypoints(flight)
    console = Console(stderr=True) if as_json else cli.open_console()
    recording_duration_s, fastest_m_s = design.scene.recording_duration_s, CITY_SPEED_M_S
    if design.scene.uses_files or design.scene.panels or design.scene.city == "braunschweig":
        with cli.show_wait(console, "building the city"):
            city = build_scene(design.scene)
        check_place(design.atmosphere, city)
        recording_duration_s, fastest_m_s = city.duration_s, fastest_speed_m_s(city, flight)
    check_recorded(flight, recording_duration_s)
    judgements = assess_case(design, fastest_m_s=fastest_m_s)
    count = Counter(one.answer for one in judgements)
    if as_json:
        print(json.dumps([one.record() for one in judgements], indent=2, ensure_ascii=False))
    else:
        length = f"{flight.frames} frames at {flight.rate_hz:g} Hz"
        console.print(f"{path} is a valid case: {length} over the city {design.scene.city}")
        print_judgements(console, judgements)
        for line in (
            *(f"derived: {value}" for value in derived_values(design.sensor).values()),
            describe_niirs(design),
            describe_window(design),
            describe_array(design),
            *describe_binning(design),
            describe_initiation(design),
            describe_time(design),
            ", ".join(f"{count[answer]} {answer}" for answer in ANSWERS if count[answer]),
        ):
            console.print(line)
        worst = max(judgements, key=lambda one: one.rank).answer
        forced = ". `glintrack run` simulates it with --force only" if count["bad"] else ""
        console.print(f"conclusion: {worst}. {conclude(design, judgements, fastest_m_s)}{forced}.")
    if count["bad"]:
        raise typer.Exit(cli.EXIT_CODES["no"])


def print_judgements(console: Console, judgements: Sequence[Judgement]) -> None:
    """Print a table of judgements, and below it the reasons of those that are not good."""
    headings = ["quantity", "value", "judgement", "good is"]
    if any(one.view for one in judgements):
        headings[1] = "value, frame"
    rows = [(one.label, f"{one.text} {one.view}".strip(), one.answer, one.good) for one in judgements]
    console.print(cli.make_table(None, headings, rows, left=4))
    for one in judgements:
        if one.reason:
            console.print(f"{one.answer}{f' ({one.view} frame)' if one.view else ''}: {one.reason}")


@app.command()
def new(
    file: Annotated[Path, cli.argument("Case file to write, .toml; it must not exist")],
    altitude: Annotated[float, cli.option("Height of the lens above the ground [m]")],
    rate: Annotated[float, cli.option("Frame rate [Hz]", min=0.001, max=1000)],
    pixels: Annotated[str | None, cli.option("Size of the array", metavar="COLUMNSxROWS")] = None,
    pitch: Annotated[float | None, cli.option("Spacing of the elements [µm]")] = None,
    focal_length: Annotated[float | None, cli.option("Focal length [mm]")] = None,
    f_number: Annotated[float | None, cli.option("F-number [default: 5.6]")] = None,
    off_nadir: Annotated[float, cli.option("Angle of the line of sight from nadir [°]")] = 0.0,
    polarizers: Annotated[
        Polarizers | None, cli.option("Mosaic: four angles, or the paper's [default: none]")
    ] = None,
    filters: Annotated[Filters | None, cli.option("Colour filters on the array [default: none]")] = None,
    sensor: Annotated[str, cli.option("Array of `glintrack sensor list`, for --pixels and --pitch")] = "",
    lens: Annotated[str, cli.option("Lens of `glintrack sensor list`, instead of --focal-length")] = "",
) -> None:
    """Write a case from the data sheet of a camera; what the sheet leaves out is derived and stated.

    glintrack case new mycam.toml --pixels 2048x2048 --pitch 3.45 --focal-length 100 --altitude 2000 --rate 5
    """
    cli.check_output(file, ".toml", option="file")
    if file.exists():
        raise ValueError(f"`file` must not exist yet; got {file}. Choose another name.")
    size = re.fullmatch(r"(\d{1,6}) ?[x×X*] ?(\d{1,6})", pixels or "1x1")
    if size is None:
        raise ValueError(f"`--pixels` must be COLUMNSxROWS, as 2048x2048; got {pixels}.")
    flight = {"altitude_m": altitude, "off_nadir_deg": off_nadir, "rate_hz": rate}
    camera: dict[str, float | None] = {
        "pitch_um": pitch,
        "focal_length_mm": focal_length,
        "f_number": f_number,
    }
    if pixels:
        camera |= {"columns": int(size[1]), "rows": int(size[2])}
    text = case_text(file.stem, flight, camera, polarizers, sensor, lens, filters)
    write_text(file, text)
    print(*(line[2:] for line in text.splitlines()[1:] if line.startswith("# ")), sep="\n")
    if 0 < off_nadir <= math.pi / 2:
        print(
            f"note: `--off-nadir` is in degrees: {off_nadir:g}° is nearly straight down "
            f"({off_nadir:g} rad would be {math.degrees(off_nadir):.3g}°)"
        )
    print(f"wrote {file}; `glintrack case check {file}` judges it, `glintrack run {file}` simulates it")


@app.command()
def schema(
    table: Annotated[str | None, cli.argument("Table or key, as sensor.pitch_um [default: tables]")] = None,
    everything: Annotated[bool, cli.option("Print every key of every table", "--all")] = False,
    as_json: Annotated[bool, cli.option("Print the JSON Schema instead of tables", "--json")] = False,
) -> None:
    """List the tables of a case, or print the keys of a table with unit, range, default and meaning."""
    if as_json:
        print(json.dumps(Case.model_json_schema(), indent=2))
        return
    console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
    tables = dict(keys_of(Case))
    if table is None and not everything:
        about = {"": "Name, seed and channels"} | dict(tables_of(Case))
        rows = [
            (Text(f"[{name}]" if name else _TOP), Text(about.get(name, "")), str(len(keys)))
            for name, keys in tables.items()
        ]
        console.print(cli.make_table(None, ("table", "content", "keys"), rows, left=2))
        console.print("glintrack case schema TABLE prints its keys, --all those of every table")
        return
    if table == _TOP:
        chosen = {"": tables[""]}
    elif table is None:
        chosen = tables
    else:
        chosen = {n: keys for n, keys in tables.items() if n == table or n.startswith(f"{table}.")}
        chosen = chosen or {n: [key for key in keys if key.name == table] for n, keys in tables.items()}
    if not any(chosen.values()):
        known = (_TOP, *filter(None, tables), *(key.name for keys in tables.values() for key in keys))
        raise ValueError(f"`table` must be one of a case; got {table}. {suggest_name(str(table), known)}")
    for name, keys in chosen.items():
        if keys:
            _print_keys(console, name, keys)


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
