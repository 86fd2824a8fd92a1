"""What a run says at its end: a loss budget and scores that fit a narrow terminal, and one sentence."""

import io
import time

import numpy as np
import xarray as xr
from rich.console import Console

from glintrack.cli import options
from glintrack.cli.options import Bar, show_wait
from glintrack.cli.run import assess_tracks, print_loss_budget, print_scores
from glintrack.core.progress import step
from glintrack.metrics.requirement import read_requirement

SCORES = {
    "tracked_per_km2": 118.2, "completeness": 0.302, "completeness_visible": 0.341, "custody": 0.338,
    "false_per_km2": 11.4, "purity": 0.941, "identity_switches": 9.0,
}  # fmt: skip


def said(show, tree, width=80):
    console = Console(file=io.StringIO(), width=width)
    show(console, tree)
    return console.file.getvalue().splitlines()  # pyright: ignore[reportAttributeAccessIssue]


def tree():
    stages = ["moving", "known_background", "detector", "tracker"]
    budgets = {"pan": [1.0, 0.78, 0.593, 0.431], "dolp": [1.0, 0.777, np.nan, 0.333]}
    nodes = {
        f"/bound/{g}": xr.Dataset({"of_moving": ("stage", v)}, {"stage": stages}) for g, v in budgets.items()
    }
    return xr.DataTree.from_dict(
        nodes
        | {f"/{name}": xr.Dataset({}, {"time": np.arange(9.0)}, SCORES) for name in ("pan", "dolp", "all")}
        | {"/": xr.Dataset(attrs={"frames_done": 9})}
    )


def test_the_loss_budget_is_one_table_with_a_column_a_group():
    lines = [line.split() for line in said(print_loss_budget, tree())]
    assert ["pan", "DoLP"] in lines and ["background", "known", "78", "78"] in lines
    assert ["detector", "in", "use", "59", "–"] in lines and ["tracker", "43", "33"] in lines
    assert said(print_loss_budget, xr.DataTree.from_dict({"/pan": xr.Dataset()})) == []


def test_the_scores_fit_eighty_columns_with_their_headings_whole():
    lines = [line.split() for line in said(print_scores, tree())]
    assert [
        "per",
        "km²",
        "moving",
        "visible",
        "custody",
        "false/km²",
        "purity",
        "switches",
    ] in lines
    assert ["DoLP", "118", "0.302", "0.341", "0.338", "11.4", "0.941", "9"] in lines


def test_where_output_is_a_file_a_line_comes_at_intervals(monkeypatch):
    monkeypatch.setattr(options, "LINE_S", 0.02)
    lines = io.StringIO()

    def wait_for(line):
        deadline = time.monotonic() + 30
        while not any(found.startswith(line) for found in lines.getvalue().splitlines()):
            assert time.monotonic() < deadline, lines.getvalue()
            time.sleep(0.005)

    with Bar(Console(file=lines)) as bar:
        task = bar.add_task("flight", total=4, left="")
        with step("building the city"), step("running SUMO"):
            wait_for("flight: running SUMO, after 0 s")
        with step("solving the sky") as report:
            report(0.34)
            wait_for("flight: solving the sky, 34 %, after 0 s")
        bar.update(task, advance=1, left="3 s left")
        wait_for("flight, 25 %, 3 s left, after ")
        assert list(bar.track(range(2), description="drawing")) == [0, 1]
    assert lines.getvalue().splitlines()[0] == "flight"


def test_what_ends_soon_prints_no_line():
    def wait(console, _):
        with show_wait(console, "tracking"):
            pass

    assert said(wait, None) == []


def test_steps_without_a_listener_do_nothing():
    with step("building") as report:
        report(0.5)


def one_car(frames):
    """A car that drives east; half of its frames are told with a track on it."""
    time_s = np.arange(float(frames))
    car = {"time_s": time_s, "vehicle_id": np.zeros(frames), "east_m": 10 * time_s, "north_m": 0 * time_s,
           "east_speed_m_s": np.full(frames, 10.0), "north_speed_m_s": np.zeros(frames)}  # fmt: skip
    track = {name: car[name][::2] for name in ("time_s", "east_m", "north_m")}
    tables = {"/truth": car, "/pan/tracks": track | {"track_id": np.ones(len(track["time_s"]))}}
    return xr.DataTree.from_dict(
        {path: xr.Dataset({k: ("row", v) for k, v in table.items()}) for path, table in tables.items()}
        | {"/pan": xr.Dataset(coords={"time": time_s[:3]})}  # which its tables inherit
    )


def test_a_requirement_is_judged_by_the_tracks_that_are_told():
    areas = dict.fromkeys(range(12), (-10.0, -10.0, 200.0, 10.0))
    requirement, flown = read_requirement("completeness>=0.4"), one_car(12)
    found = assess_tracks(flown, requirement, "pan", areas)
    assert found.value == 0.5 and found.answer == "yes"
    flown["pan"].attrs["learning_frames"] = 3.0
    assert assess_tracks(flown, requirement, "pan", {}).answer == "undecided"  # no frame is scored


def test_a_requirement_counts_from_the_end_of_learning():
    """The first frame has a track, the second has none."""
    flown = one_car(13)
    flown["pan"].attrs["learning_frames"] = 1.0
    areas = dict.fromkeys(range(13), (-10.0, -10.0, 200.0, 10.0))
    assert assess_tracks(flown, read_requirement("completeness>=0.4"), "pan", areas).value == 0.5
    flown["pan"].attrs["learning_frames"] = 0.0
    assert assess_tracks(flown, read_requirement("completeness>=0.4"), "pan", areas).value == 7 / 13
