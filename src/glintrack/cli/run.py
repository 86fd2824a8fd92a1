"""``glintrack run``: fly a case."""

import math
import time
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import typer
import xarray as xr
from rich.box import SIMPLE
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.table import Table

from glintrack.bounds import STAGE_LABELS
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.cli.options import CaseArgument, OutsidePathsOption, command_app
from glintrack.cli.progress import WIDTH, Bar
from glintrack.cli.require import RequireOption, tell
from glintrack.cli.warm_up import show_warm_up
from glintrack.core.numba_cache import is_complete
from glintrack.core.parallel import compilation
from glintrack.core.units import format_duration
from glintrack.io.atomic import check_new_folder, listing
from glintrack.io.toml import toml_value
from glintrack.metrics.requirement import Assessment, Requirement, assess_flight, read_requirement
from glintrack.metrics.rows import score_epochs
from glintrack.results.epoch import Epoch
from glintrack.results.figures import LOOP_COLOURS
from glintrack.results.read import Result, score_text
from glintrack.results.recorder import FlightPace
from glintrack.results.run import run as fly
from glintrack.results.verdict import (
    CHANNEL_WORDS,
    accuracy_lines,
    budget_frames,
    select_channel,
    stage_shares,
)

app = command_app()


_STAGES = {"light": "waiting for the next frame's light", "callback": "loss budget, pictures"}
_SCORES = {
    "held_per_km2": "true/km²",
    "completeness": "of all",
    "completeness_visible": "visible",
    "custody": "custody",
    "false_per_km2": "false/km²",
    "purity": "purity",
    "identity_switches": "switches",
}


def read_changes(changes: list[str]) -> dict[str, object]:
    """Keys and values of ``KEY=VALUE``, values as TOML; a bare word is a string."""
    out = {}
    for change in changes:
        key, sign, value = change.partition("=")
        if not sign or not key.strip():
            raise ValueError(f"`--set` must be KEY=VALUE, as sensor.pitch_um=8.5, got {change!r}")
        out[key.strip()] = toml_value(value)
    return out


@app.command()
def run(
    case: CaseArgument = "quickstart",
    output: Annotated[
        Path | None,
        typer.Option(
            "-o",
            "--output",
            help="New folder for the result [default: result-NAME]",
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(min=1, help="Fly only this many frames of the case (their rate stays the case's)"),
    ] = None,
    changes: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Another value of a key of the case, as TOML: --set sensor.pitch_um=8.5; repeatable",
        ),
    ] = None,
    require: RequireOption = None,
    allow_outside_paths: OutsidePathsOption = False,
) -> None:
    """Fly a case: city, frames, tracks, scores; writes a result folder. Ctrl-C keeps the frames done.

    With --require the exit code is 0 if all is met, 1 if something is not, 3 if it is undecided.
    """
    requirements = [read_requirement(text) for text in require or []]
    design = Case.from_toml(find_case(case), allow_outside_paths, read_changes(changes or []))
    if frames is not None:
        whole = design.flight.frames
        if frames > whole:
            warnings.warn(
                f"the case has {whole} frames, which are flown (more: --set flight.frames={frames})",
                stacklevel=2,
            )
        design = design.replace({"flight.frames": min(frames, whole)})
    for one in requirements:
        one.check_channel(design.channels)
    check_new_folder(output or Path(f"result-{design.name}"))
    if not is_complete():
        show_warm_up(Console())
    window: list[tuple[float, float, float, float]] = []
    console = Console()
    columns = (
        TextColumn("{task.description}"),
        BarColumn(WIDTH),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
    )
    pace = FlightPace(design.flight.frames)
    with Bar(console, *columns) as progress:
        task = progress.add_task(f"{design.name}: building", total=design.flight.frames, left="")
        last = design.channels[-1]

        def show(epoch: Epoch) -> None:
            window[:] = [epoch.city.extent_m]
            if epoch.channel == last:
                tracked = f"{epoch.score.valid.sum()}/{epoch.score.should.sum()} vehicles tracked"
                done = epoch.index + 1 == design.flight.frames
                doing = "scoring, writing …" if done else tracked
                pace.add(epoch.index, time.perf_counter() - compilation.seconds)
                left_s = pace.left_s()
                left = "" if left_s is None else f"{format_duration(left_s)} left"
                progress.update(task, advance=1, description=f"{design.name}: {doing}", left=left)

        began = time.perf_counter()
        try:
            result = fly(design, output, show)
        except ValueError:  # nothing was flown: what is wrong is told alone, without a bar
            progress.live.transient = True
            raise
        progress.update(task, left="")
        total_s = time.perf_counter() - began
    assert result.tree is not None
    _conclude(console, result, total_s)
    best = select_channel(result.scores) or last
    tell(console, [(one, _judged(result.tree, one, one.channel or best, window)) for one in requirements])


def _judged(
    tree: xr.DataTree,
    requirement: Requirement,
    channel: str,
    window_m: Sequence[tuple[float, float, float, float]],
) -> Assessment:
    """A requirement by the tracks as they are told; no window where no frame was flown."""
    if not window_m:
        return assess_flight(requirement, [])
    tracks, truth = tree[f"{channel}/tracks"].to_dataset(), tree["truth"].to_dataset()
    return assess_flight(requirement, score_epochs(tracks, truth, window_m[0]))


def _conclude(console: Console, result: Result, total_s: float) -> None:
    """Print times and folder, loss budget, scores and verdict."""
    tree, path = result.tree, result.path
    assert tree is not None
    print_times(console, tree, total_s)
    done, asked = tree.attrs["frames_done"], tree.attrs["frames_asked"]
    early = f" (interrupted after {done} of {asked} frames)" if tree.attrs["interrupted"] else ""
    console.print(
        f"wrote {path}{early}: {len(list(listing(path)))} files, to look at: glintrack report {path}"
    )
    print_loss_budget(console, tree)
    print_scores(console, tree)
    for said in (result.verdict, *result.reservations):
        console.print(said, soft_wrap=True, markup=False)


def _heading(channel: str) -> str:
    """Its short name: with longer ones a table is wider than 80 columns."""
    return CHANNEL_WORDS.get(channel, channel).removesuffix(" elements")


def print_loss_budget(console: Console, tree: xr.DataTree) -> None:
    """Print the loss budget, one column for each group of elements, and the accuracy of positions."""
    budgets = stage_shares(tree)
    if not budgets:
        return
    title = f"of 100 moving vehicles, on {budget_frames(tree)} (stages: docs/theory/bounds.md)"
    table = Table(title=title, title_justify="left", box=SIMPLE, min_width=len(title))
    table.add_column("")
    for group in budgets:
        table.add_column(_heading(group), justify="right")
    for stage in dict.fromkeys(stage for one in budgets.values() for stage in one):
        shares = (one.get(stage, math.nan) for one in budgets.values())
        table.add_row(STAGE_LABELS.get(stage, stage), *("–" if v != v else f"{100 * v:.0f}" for v in shares))
    console.print(table)
    if any(one.get("tracker", 0) > one.get("oracle_association", 1) for one in budgets.values()):
        console.print(
            "The tracker also follows vehicles between detections. Its row can be above the rows before it.",
            soft_wrap=True,
        )
    for group, line in accuracy_lines(tree).items():
        console.print(f"{CHANNEL_WORDS.get(group, group)}: {line}", soft_wrap=True, markup=False)


def print_scores(console: Console, tree: xr.DataTree) -> None:
    """Scores of each loop over the whole flight."""
    table = Table(title="scores of the whole flight, by channel", title_justify="left", box=SIMPLE)
    table.add_column("", no_wrap=True)
    for heading in _SCORES.values():
        table.add_column(heading, justify="right", no_wrap=True)
    for channel in LOOP_COLOURS:
        if channel in tree.children:
            of = tree[channel].attrs
            table.add_row(_heading(channel), *(score_text(float(of[name])) for name in _SCORES))
    console.print(table)


def print_times(console: Console, tree: xr.DataTree, total_s: float) -> None:
    """Where the time went: stages of a frame, and what adds up to the whole."""
    times = Table(title="wall time", title_justify="left", box=SIMPLE)
    times.add_column("stage")
    times.add_column("ms a frame", justify="right")
    for key, value in ((str(k), v) for k, v in tree.attrs.items()):
        if key.endswith("_ms_per_frame"):
            stage = key.removesuffix("_ms_per_frame")
            times.add_row(_STAGES.get(stage, stage), f"{value:.1f}")
    for key, value in ((str(k), v) for k, v in tree.attrs.items()):
        if key.endswith("_ms_ahead"):  # of the light, in a thread beside the loop, which waits for the rest
            times.add_row(f"  in a thread beside: {key.removesuffix('_ms_ahead')}", f"{value:.1f}")
    console.print(times)
    frames_s = (
        1e-3
        * int(tree.attrs["frames_done"])
        * sum(value for key, value in tree.attrs.items() if str(key).endswith("_ms_per_frame"))
    )
    build_s, compile_s = float(tree.attrs["build_s"]), float(tree.attrs["compile_s"])
    rest_s = max(total_s - build_s - compile_s - frames_s, 0)
    compiling = f"{compile_s:.0f} s of waiting for kernels, once; " if compile_s >= 0.5 else ""
    console.print(
        f"{total_s:.0f} s in all: {compiling}{build_s:.0f} s to build, "
        f"{frames_s:.0f} s for frames, {rest_s:.0f} s for scores, pictures and files"
    )
