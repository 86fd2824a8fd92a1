"""The ``glintrack`` program."""

import json
import sys
from pathlib import Path
from typing import Annotated

import typer
import xarray as xr
from pydantic import ValidationError
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table

from glintrack.cli.atmosphere import atmosphere_app
from glintrack.cli.device import device_app
from glintrack.cli.ortho import ortho
from glintrack.cli.render import render
from glintrack.cli.report import report, video, view
from glintrack.cli.scene import scene_app
from glintrack.cli.sensor import sensor_app
from glintrack.cli.study import study_app
from glintrack.cli.track import follow, score
from glintrack.config import Case, find_case
from glintrack.designs import describe
from glintrack.flight import check_waypoints
from glintrack.io import files
from glintrack.plot import tracks as plot_tracks
from glintrack.results.epoch import Epoch
from glintrack.results.notebook import score_text
from glintrack.results.recorder import Recorder
from glintrack.results.write import write_result
from glintrack.sensor import build_sensor
from glintrack.simulate import simulate

app = typer.Typer(
    help="Will this imaging sensor keep track of the vehicles?",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode="markdown",  # units in brackets, as [m], are markup to "rich" and would vanish
)
case_app = typer.Typer(help="Check a case file, or print the schema of all its keys.", no_args_is_help=True)
app.add_typer(case_app, name="case")
app.add_typer(atmosphere_app, name="atmosphere")
app.add_typer(scene_app, name="scene")
app.add_typer(sensor_app, name="sensor")
app.add_typer(study_app, name="study")
app.command()(ortho)
app.command("track")(follow)
app.command()(score)
app.add_typer(device_app, name="device")
app.command()(render)
app.command()(report)
app.command()(view)
app.command()(video)

_SCORES = {
    "held_per_km2": "held/km²",
    "completeness": "completeness",
    "completeness_visible": "of visible",
    "custody": "custody",
    "false_per_km2": "false/km²",
    "purity": "purity",
    "identity_switches": "switches",
}

CaseArgument = Annotated[
    str, typer.Argument(help="A case file (TOML), or a packaged case by name: quickstart, braunschweig.")
]


def main() -> None:
    """Run the program; bad input is one sentence on stderr and exit code 2."""
    console = Console(stderr=True, soft_wrap=True, highlight=False)
    try:
        app(standalone_mode=True)
    except ValidationError as error:
        console.print(f"glintrack: {describe(error, Case)}", markup=False)
        sys.exit(2)
    except ValueError as error:
        console.print(f"glintrack: {error}", markup=False)
        sys.exit(2)
    except OSError as error:  # a full disk, a folder that may not be written
        console.print(f"glintrack: {error.strerror or error}: {error.filename or 'output'}", markup=False)
        sys.exit(2)
    except KeyboardInterrupt:
        console.print("glintrack: interrupted, nothing written", markup=False)
        sys.exit(130)


@app.command()
def run(
    case: CaseArgument = "quickstart",
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="New folder for the result [default: result-NAME]")
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(min=1, help="Fly only this many frames of the case (at the case's rate, in Hz)"),
    ] = None,
) -> None:
    """Fly a case: city, frames, tracks, scores; writes a result folder. Ctrl-C keeps the frames done."""
    design = Case.from_toml(find_case(case))
    if frames is not None:
        flight = design.flight.model_copy(update={"frames": min(frames, design.flight.frames)})
        design = design.model_copy(update={"flight": flight})
    folder = files.ResultFolder(output or Path(f"result-{design.name}"))
    recorder = Recorder(design)
    console = Console()
    try:
        tree = _fly(design, recorder, console)
        with console.status("tracking again at other thresholds, writing …"):
            write_result(folder.partial, design, tree, recorder)
    except BaseException:
        folder.discard()
        raise
    path = folder.publish()
    _print_scores(console, tree)
    done, asked = tree.attrs["frames_done"], tree.attrs["frames_asked"]
    early = f" (interrupted after {done} of {asked} frames)" if tree.attrs["interrupted"] else ""
    console.print(
        f"wrote {path}{early}: {len(list(files.listing(path)))} files, to look at: glintrack report {path}"
    )


def _fly(design: Case, recorder: Recorder, console: Console) -> xr.DataTree:
    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(f"{design.name}: building", total=design.flight.frames)
        last = design.channels[-1]

        def watch(epoch: Epoch) -> None:
            recorder.watch(epoch)
            if epoch.channel == last:
                tracked = f"{epoch.score.valid.sum()}/{epoch.score.should.sum()} vehicles tracked"
                progress.update(task, advance=1, description=f"{design.name}: {tracked}")

        return simulate(design, watch)


def _print_scores(console: Console, tree: xr.DataTree) -> None:
    table = Table(title="track scores", title_justify="left")
    for heading in ("change in", *_SCORES.values()):
        table.add_column(heading, justify="left" if heading == "change in" else "right")
    for channel in plot_tracks.LOOP_COLOURS:
        if channel in tree.children:
            of = tree[channel].attrs
            table.add_row(channel, *(score_text(float(of[name])) for name in _SCORES))
    console.print(table)
    times = Table(title="wall time", title_justify="left")
    times.add_column("stage")
    times.add_column("ms a frame", justify="right")
    for key, value in ((str(k), v) for k, v in tree.attrs.items()):
        if key.endswith("_ms_per_frame"):
            times.add_row(key.removesuffix("_ms_per_frame"), f"{value:.1f}")
    times.add_row("(build, once)", f"{1e3 * tree.attrs['build_s']:.0f} ms")
    console.print(times)


@case_app.command()
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


@case_app.command()
def schema() -> None:
    """Print the JSON schema of a case: every key with unit, range and default."""
    print(json.dumps(Case.model_json_schema(), indent=2))
