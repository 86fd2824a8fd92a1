"""``glintrack case``: what cases there are, whether one is valid, and what its keys mean."""

import json
from typing import Annotated

import typer
from rich.console import Console

from glintrack.cli.options import CaseArgument, command_app
from glintrack.config import Case, find_case, list_cases, list_studies
from glintrack.flight import check_waypoints
from glintrack.sensor import build_sensor

app = command_app("List the packaged cases, check a case file, or print all its keys.")


@app.command("list")
def show_cases() -> None:
    """List the packaged cases and studies."""
    console = Console(soft_wrap=True, highlight=False)
    console.print(f"cases, for glintrack run: {', '.join(list_cases())}")
    console.print(f"studies, for glintrack study: {', '.join(list_studies())}")


@app.command()
def check(case: CaseArgument) -> None:
    """Say whether a case file, its sensor and its waypoints are valid, without flying it."""
    path = find_case(case)
    design = Case.from_toml(path)
    flight = design.flight
    build_sensor(design.sensor, design.atmosphere.wavelength_um)
    if flight.kind == "waypoints":
        check_waypoints(flight)
    Console().print(
        f"{path} is a valid case: {flight.frames} frames at {flight.rate_hz:g} Hz over {design.scene.city}",
        soft_wrap=True,
    )


@app.command()
def schema(
    as_json: Annotated[bool, typer.Option("--json", help="The JSON Schema instead of a table")] = False,
) -> None:
    """Print every key of a case."""
    print(json.dumps(Case.model_json_schema(), indent=2))
