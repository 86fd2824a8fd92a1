"""``glintrack dataset``: a labelled set from seeds, and what detectors and trackers make of it."""

import time
from pathlib import Path
from typing import Annotated, Literal

import typer
import typer.core
from rich.console import Console
from rich.progress import BarColumn, TextColumn, TimeRemainingColumn
from rich.table import Table

from glintrack.cli.options import STYLE, OutsidePathsOption, group_with_default
from glintrack.cli.progress import Bar
from glintrack.dataset import (
    BASELINES,
    SCORES,
    build_dataset,
    plan_dataset,
    score_baselines,
)

_HEADS = {
    "completeness": "held,\nof all",
    "completeness_visible": "of\nseen",
    "purity": "\npurity",
    "idf1": "\nIDF1",
    "hota": "\nHOTA",
    "false_per_epoch": "false a\nframe",
}

app = typer.Typer(
    cls=group_with_default("build"),  # `dataset CASE`
    help="Build a labelled set of frames, `glintrack dataset CASE… -o DIR`, or score baselines on one.",
    **STYLE,
)


@app.command("build")
def build(
    case: Annotated[
        list[str],
        typer.Argument(
            help="Case files or packaged cases; 'standard' for the standard set (extra `traffic`), or a part "
            "of it, as 'standard/*-clear'"
        ),
    ],
    output: Annotated[
        Path, typer.Option("-o", "--output", help="Folder of the set: new, or one whose build was stopped")
    ],
    frames: Annotated[
        int | None, typer.Option(help="Frames of each case [default: its own, 20 in the standard set]")
    ] = None,
    shard_frames: Annotated[int, typer.Option("--shard-frames", help="Frames written together")] = 10,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say what would be flown and how large it is; fly nothing")
    ] = False,
    allow_outside_paths: OutsidePathsOption = False,
) -> None:
    """Fly cases into a labelled set: raws, channels, light, poses, boxes, masks, COCO and MOTChallenge."""
    plan, console = plan_dataset(case, frames, shard_frames, allow_outside_paths), Console()
    gigabytes = plan.max_size_bytes / 1e9
    splits = ", ".join(
        f"{list(plan.split.values()).count(s)} {s}" for s in dict.fromkeys(plan.split.values())
    )
    console.print(
        f"{len(plan.cases)} cases ({splits}), {plan.frames} frames, at most {gigabytes:.2g} GB",
        soft_wrap=True,
    )
    if dry_run:
        return
    begun = time.perf_counter()
    columns = TextColumn("flying {task.description}"), BarColumn(), TimeRemainingColumn()
    with Bar(console, *columns, transient=True) as bar:
        task = bar.add_task("…", total=plan.frames)
        flown = build_dataset(
            plan, output, lambda shard, count: bar.update(task, completed=count, description=shard.name)
        )
    took = time.perf_counter() - begun
    size = sum(p.stat().st_size for p in output.rglob("*") if p.is_file())
    console.print(
        f"wrote {output}: {flown} frames flown in {took:.0f} s, {plan.frames - flown} there already, "
        f"{size / 1e6:.0f} MB",
        soft_wrap=True,
        markup=False,
    )


@app.command("baseline")
def baseline(
    dataset: Annotated[Path, typer.Argument(help="A folder that `glintrack dataset` wrote")],
    split: Annotated[Literal["train", "val", "test"], typer.Option(help="Which of its splits")] = "test",
    allow_outside_paths: OutsidePathsOption = False,
) -> None:
    """Score our detectors and classical ones with our tracker; means over a split."""
    console = Console()
    with console.status("tracking …"):
        found = score_baselines(dataset, split, BASELINES, allow_outside_paths)
    console.print(_baselines(f"baselines on {split}", found))


def _baselines(title: str, found: dict[str, dict[str, float]]) -> Table:
    """Scores of each detector and channel, within 80 columns."""
    table = Table(title=title, title_justify="left", box=None, padding=(0, 1, 0, 0))
    table.add_column("\ndetector", no_wrap=True)
    table.add_column("\nin", no_wrap=True)
    for name in SCORES:
        table.add_column(_HEADS[name], justify="right", no_wrap=True)
    for line, scores in found.items():
        detector, _, channel = line.rpartition(", ")
        table.add_row(detector, channel, *(f"{scores[name]:.3f}" for name in SCORES))
    return table
