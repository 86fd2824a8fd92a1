"""``glintrack run`` and ``warm-up``: simulate a case, and compile what a simulation needs."""

import math
import time
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated

import xarray as xr
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn

from glintrack.bounds import STAGE_LABELS, STAGES_NOTE
from glintrack.case.area import describe_window, fit_window
from glintrack.case.check import assess_case
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.case.quantities import describe_time
from glintrack.cli import options as cli
from glintrack.core.installation import read_data
from glintrack.core.numba_cache import is_complete, mark_complete
from glintrack.core.parallel import compilation
from glintrack.core.units import format_duration
from glintrack.io.atomic import check_new_folder, list_files
from glintrack.io.toml import toml_value
from glintrack.metrics import Area
from glintrack.metrics.requirement import (
    Assessment,
    Requirement,
    assess_flight,
    describe_assessment,
    read_requirement,
)
from glintrack.metrics.rows import score_epochs
from glintrack.results.collect import scored_times
from glintrack.results.epoch import Epoch
from glintrack.results.figures import LOOP_STYLES
from glintrack.results.read import Result, score_text
from glintrack.results.recorder import FlightPace
from glintrack.results.run import KERNELS, compile_kernels
from glintrack.results.run import run as run_case
from glintrack.results.verdict import (
    CHANNEL_WORDS,
    accuracy_lines,
    budget_frames,
    select_channel,
    stage_shares,
)
from glintrack.scene.read.sumo import sumo_home

app, warm_up_app = cli.command_app(), cli.command_app()

_STAGES = {"light": "tracing (waiting for it)", "callback": "loss budget, images"}
_SCORES: Mapping[str, str] = read_data("page", "scores.toml")["printed"]


def parse_changes(changes: list[str]) -> dict[str, object]:
    """Keys and values of ``KEY=VALUE``, values as TOML; a bare word is a string."""
    out = {}
    for change in changes:
        key, sign, value = change.partition("=")
        if not sign or not key.strip():
            raise ValueError(f"`--set` must be KEY=VALUE, as sensor.pitch_um=8.5; got {change!r}.")
        out[key.strip()] = toml_value(value)
    return out


@app.command()
def run(
    case: cli.CaseArgument = "quickstart",
    output: Annotated[Path | None, cli.option("New folder [default: result-NAME]", "-o", "--output")] = None,
    frames: cli.FramesOption = None,
    changes: Annotated[
        list[str] | None,
        cli.option(
            "Change a key of the case; the value as in TOML: --set sensor.pitch_um=8.5; repeatable",
            "--set",
            metavar="KEY=VALUE",
        ),
    ] = None,
    require: cli.RequireOption = None,
    force: Annotated[bool, cli.option("Simulate a case with bad quantities (glintrack case check)")] = False,
    allow_outside_paths: cli.OutsidePathsOption = False,
) -> None:
    """Simulate a case: city, frames, tracks and scores; writes a result folder.

    Ctrl-C ends the simulation early and keeps the frames done. With --require the exit code says whether the
    scores are reached: 0 yes, 1 no, 3 undecided.
    """
    requirements = [read_requirement(text) for text in require or []]
    design = Case.from_toml(find_case(case), allow_outside_paths, parse_changes(changes or []))
    design = cli.limit_frames(design, frames)
    for one in requirements:
        one.check_channel(design.channels)
    judged = assess_case(design)
    if not force and (bad := [one.reason for one in judged if one.answer == "bad"]):
        raise ValueError(
            f"`case` must have no bad quantity; got {len(bad)}: {'; '.join(bad)}. "
            "`glintrack case check` shows all quantities; --force simulates the case anyway."
        )
    check_new_folder(output or Path(f"result-{design.name}"))
    console = cli.open_console()
    for answer in ("bad", "doubtful"):
        if of := [f"{one.label} {one.text}" for one in judged if one.answer == answer]:
            console.print(f"{answer}: {', '.join(of)} (why: glintrack case check)")
    console.print(describe_window(design))
    console.print(describe_time(design) + ("" if is_complete() else ". Kernels are compiled first, once"))
    warnings.filterwarnings("ignore", "window: ")  # which is said already
    if fit_window(design) is not design:
        sumo_home()  # simulates the traffic of the larger window: say before any compilation if it is missing
    if not is_complete():
        _show_warm_up(console)
    areas: dict[float, Area] = {}
    columns = (
        TextColumn("{task.description}"),
        BarColumn(cli.BAR_WIDTH),
        MofNCompleteColumn(),
        TextColumn("{task.fields[left]}"),
    )
    pace, last = FlightPace(design.flight.frames), design.channels[-1]
    with cli.Bar(console, *columns) as progress:
        task = progress.add_task(design.name, total=design.flight.frames, left="")

        def show(epoch: Epoch) -> None:
            areas[epoch.time_s] = epoch.true_frame.area
            if epoch.channel == last:
                done = epoch.index + 1 == design.flight.frames
                doing = "scoring, writing …" if done else describe_progress(epoch, design)
                pace.add(epoch.index, time.perf_counter() - compilation.seconds)
                left_s = pace.left_s()
                left = "" if left_s is None or done else f"{format_duration(left_s)} left"
                progress.update(task, advance=1, description=f"{design.name}: {doing}", left=left)

        began = time.perf_counter()
        try:
            result = run_case(design, output, show)
        except ValueError:  # nothing was simulated: the message stands without a bar
            progress.live.transient = True
            raise
        progress.update(task, left="")
        total_s = time.perf_counter() - began
    tree = result.tree
    assert tree is not None
    _conclude(console, result, tree, total_s)
    best = select_channel(result.scores) or last
    found = [(one, assess_tracks(tree, one, one.channel or best, areas)) for one in requirements]
    for requirement, assessment in found:
        console.print(describe_assessment(requirement, assessment))
    cli.check_answers(assessment.answer for _, assessment in found)


def describe_progress(epoch: Epoch, case: Case) -> str:
    """Count the tracked vehicles of a frame; before the first tracks, say when they are expected."""
    rate_hz, lag_s = case.flight.rate_hz, case.track.reporting.effective_lag_s
    first = case.track.count_learning_frames(rate_hz) + math.ceil(lag_s * rate_hz) + 1
    if epoch.index + 1 < first and not epoch.score.valid.any():
        return f"learning the ground, first tracks from about frame {first}"
    return f"{epoch.score.valid.sum()}/{epoch.score.should.sum()} moving vehicles tracked now"


def assess_tracks(
    tree: xr.DataTree, requirement: Requirement, channel: str, areas: Mapping[float, Area]
) -> Assessment:
    """Judge a requirement by the reported tracks after learning, with the scored area at each time. [s, m]"""
    scored_s = scored_times(tree, channel)
    if not len(scored_s):
        return assess_flight(requirement, [])
    tracks, truth = tree[f"{channel}/tracks"].to_dataset(), tree["truth"].to_dataset()
    scores = score_epochs(tracks, truth, areas.__getitem__, first_s=float(scored_s[0]))
    return assess_flight(requirement, scores)


def _conclude(console: Console, result: Result, tree: xr.DataTree, total_s: float) -> None:
    """Print times and folder, then the answer: loss budget, scores and verdict."""
    _print_times(console, tree, total_s)
    done, asked = tree.attrs["frames_done"], tree.attrs["frames_asked"]
    early = f" (interrupted after {done} of {asked} frames)" if tree.attrs["interrupted"] else ""
    path = result.path
    console.print(f"wrote {path}{early}: {len(list_files(path))} files (show them: glintrack report {path})")
    print_loss_budget(console, tree)
    print_scores(console, tree)
    for said in (result.verdict, *result.reservations):
        console.print(said)


def _heading(channel: str) -> str:
    """Short name of a channel, so that a table fits into 80 columns."""
    return CHANNEL_WORDS.get(channel, channel).removesuffix(" elements")


def print_loss_budget(console: Console, tree: xr.DataTree) -> None:
    """Print the loss budget of 100 moving vehicles, a column for each channel, and the position errors."""
    budgets = stage_shares(tree)
    if not budgets:
        return
    title = f"loss budget of 100 moving vehicles, {budget_frames(tree)} (docs/theory/bounds.md)"
    rows = []
    for stage in dict.fromkeys(stage for one in budgets.values() for stage in one):
        shares = (one.get(stage, math.nan) for one in budgets.values())
        rows.append([STAGE_LABELS.get(stage, stage), *("–" if v != v else f"{100 * v:.0f}" for v in shares)])
    console.print(cli.make_table(title, ["", *map(_heading, budgets)], rows, min_width=len(title)))
    console.print(STAGES_NOTE)
    for group, line in accuracy_lines(tree).items():
        console.print(f"{CHANNEL_WORDS.get(group, group)}: {line}")


def print_scores(console: Console, tree: xr.DataTree) -> None:
    """Print the scores of each channel over the whole simulation."""
    rows = [
        (_heading(channel), *(score_text(float(tree[channel].attrs[name])) for name in _SCORES))
        for channel in LOOP_STYLES
        if channel in tree.children
    ]
    frames = len(scored_times(tree, next(name for name in LOOP_STYLES if name in tree.children)))
    of = f"{frames} of {tree.attrs['frames_done']} frames, after learning the background"
    title = f"scores of {of}: tracked vehicles per km², and tracked share of the moving and visible ones"
    console.print(cli.make_table(title, ["", *_SCORES.values()], rows))


def _print_times(console: Console, tree: xr.DataTree, total_s: float) -> None:
    """Print the wall time of each stage of a frame, and of the whole run."""
    attrs = {str(key): value for key, value in tree.attrs.items()}
    waited = {k.removesuffix("_ms_per_frame"): v for k, v in attrs.items() if k.endswith("_ms_per_frame")}
    ahead = {k.removesuffix("_ms_ahead"): v for k, v in attrs.items() if k.endswith("_ms_ahead")}
    rows = [(_STAGES.get(stage, stage), f"{ms:.1f}") for stage, ms in waited.items()]
    rows += [(f"  in a parallel thread: {stage}", f"{ms:.1f}") for stage, ms in ahead.items()]
    console.print(cli.make_table("wall time", ["stage", "ms per frame"], rows))
    frames_s = 1e-3 * int(attrs["frames_done"]) * sum(waited.values())
    build_s, compile_s = float(attrs["build_s"]), float(attrs["compile_s"])
    rest_s = max(total_s - build_s - compile_s - frames_s, 0)
    compiling = f"{compile_s:.0f} s to compile kernels, once; " if compile_s >= 0.5 else ""
    console.print(
        f"{total_s:.0f} s in all: {compiling}{build_s:.0f} s to build, "
        f"{frames_s:.0f} s for frames, {rest_s:.0f} s for scores, images and files"
    )


@warm_up_app.command()
def warm_up() -> None:
    """Compile all kernels of a simulation, once after an installation."""
    console = cli.open_console()
    _show_warm_up(console)
    console.print(f"{compilation.kernels} kernels compiled in {compilation.seconds:.0f} s")


def _show_warm_up(console: Console) -> None:
    """Compile all kernels with a progress bar, and note that they are compiled."""
    columns = TextColumn("{task.description}"), BarColumn(cli.BAR_WIDTH), TextColumn("{task.fields[left]}")
    with cli.Bar(console, *columns) as progress:
        task = progress.add_task("compiling kernels, once after an installation", total=KERNELS, left="")

        def show(count: int) -> None:
            progress.update(task, completed=min(count, KERNELS), left=f"{count} of about {KERNELS} kernels")

        compilation.on_kernel = show
        compile_kernels()
        compilation.on_kernel = lambda count: None
        progress.update(task, completed=KERNELS)
    mark_complete()
