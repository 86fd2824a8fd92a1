"""``glintrack dataset``: build a labelled set of frames, and score detectors and trackers on it."""

import time
from collections import Counter
from pathlib import Path
from typing import Annotated, Literal

from glintrack.cli import options as cli
from glintrack.cli.track import stabilize_frames
from glintrack.core.installation import read_data
from glintrack.dataset import BASELINES, SCORES, build_dataset, plan_dataset, score_baselines
from glintrack.io.atomic import check_new
from glintrack.io.orthoimages import Geotransform, open_frames, read_frame_times
from glintrack.report.frames_page import write_label_page

_HEADS = read_data("page", "scores.toml")["detectors"]
app = cli.command_app(
    "Build a labelled set of frames, `dataset CASE… -o DIR`, score detectors, label own frames.",
    default="build",  # `dataset CASE`
)


@app.command("build")
def build(
    case: Annotated[
        list[str],
        cli.argument("Case files, packaged cases, 'standard' (extra `traffic`) or 'standard/*-clear'"),
    ],
    output: Annotated[Path, cli.option("Folder of the set: new, or of a stopped build", "-o", "--output")],
    frames: Annotated[int | None, cli.option("Frames of a case [default: its own; 20 in standard]")] = None,
    shard_frames: Annotated[int, cli.option("Frames of one file", "--shard-frames")] = 10,
    dry_run: Annotated[bool, cli.option("Print cases and size; simulate nothing", "--dry-run")] = False,
    allow_outside_paths: cli.OutsidePathsOption = False,
) -> None:
    """Simulate cases into a labelled set: raw frames, channels, radiance, poses, boxes, masks.

    Labels are written as COCO and MOTChallenge files. The same command continues a build that was stopped.
    """
    plan, console = plan_dataset(case, frames, shard_frames, allow_outside_paths), cli.open_console()
    splits = ", ".join(f"{count} {split}" for split, count in Counter(plan.split.values()).items())
    console.print(
        f"{len(plan.cases)} cases ({splits}), {plan.frames} frames, "
        f"at most {plan.max_size_bytes / 1e9:.2g} GB"
    )
    if dry_run:
        return
    begun = time.perf_counter()
    with cli.Bar(console, transient=True) as bar:
        task = bar.add_task("simulating", total=plan.frames)
        made = build_dataset(
            plan,
            output,
            lambda shard, count: bar.update(task, completed=count, description=f"simulating {shard.name}"),
        )
    took = time.perf_counter() - begun
    size = sum(p.stat().st_size for p in output.rglob("*") if p.is_file())
    console.print(
        f"wrote {output}: {made} frames simulated in {took:.0f} s, {plan.frames - made} there already, "
        f"{size / 1e6:.0f} MB"
    )


@app.command("label")
def label(
    frames: Annotated[Path, cli.argument("Folder of frames, .nc or .zarr stack, or video, as for track")],
    output: Annotated[Path, cli.option("Page to write, .html", "-o", "--output")],
    rate_hz: Annotated[float | None, cli.option("Frame rate if frames have no times [Hz]", "--rate")] = None,
    times: Annotated[Path | None, cli.option("CSV file with time_s of each frame [s]", "--times")] = None,
    geotransform: Annotated[cli.Corner | None, cli.option("West and north edge, pixel size [m]")] = None,
    area: Annotated[cli.Area | None, cli.option("West, south, east, north of the part to label [m]")] = None,
    uses_stabilization: Annotated[
        bool, cli.option("Stabilize frames of a moving camera first (extra `stabilize`)", "--stabilize")
    ] = False,
) -> None:
    """Write a page on which you label the vehicles in your own frames; it makes a CSV file for score."""
    cli.check_output(output, ".html")
    check_new(output)
    console = cli.open_console()
    grid = None if geotransform is None else Geotransform(*geotransform)
    times_s = None if times is None else read_frame_times(times)
    source = open_frames(frames, rate_hz, grid, times_s)
    if uses_stabilization:
        source = stabilize_frames(console, frames, source, open_frames(frames, rate_hz, grid, times_s))
    with cli.show_wait(console, "writing frames"):
        count = write_label_page(output, frames.name, source.frames, area)
    console.print(f"wrote {output}: {count} frames, {output.stat().st_size / 1e6:.3g} MB; open in a browser")


@app.command("baseline")
def baseline(
    dataset: Annotated[Path, cli.argument("Folder that `glintrack dataset` wrote")],
    split: Annotated[Literal["train", "val", "test"], cli.option("Split to score on")] = "test",
    allow_outside_paths: cli.OutsidePathsOption = False,
) -> None:
    """Score the packaged detectors and tracker: means over a split."""
    console = cli.open_console()
    with cli.show_wait(console, "tracking"):
        found = score_baselines(dataset, split, BASELINES, allow_outside_paths)
    rows = []
    for line, scores in found.items():
        detector, _, channel = line.rpartition(", ")
        rows.append([detector, channel, *(f"{scores[name]:.3f}" for name in SCORES)])
    headings = ("\ndetector", "\nin", *(_HEADS[name] for name in SCORES))
    table = cli.make_table(f"baselines on {split}", headings, rows, left=2, box=None, padding=(0, 1, 0, 0))
    for column in table.columns:
        column.no_wrap = True
    console.print(table)
