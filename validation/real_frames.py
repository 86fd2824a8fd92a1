"""Vehicles in real wide-area frames, by detector, and beside simulated frames of the same camera.

``python validation/real_frames.py [--wpafb FOLDER] [--clif FOLDER] [--twin FOLDER]``. The first two are
clones of https://github.com/Ayana-Inria/GLMB-adaptive-birth-satellite-videos (six labelled, stabilised frames
of the U.S. Air Force's WPAFB 2009, area of interest 02, frames 100 to 105, some 1 m, 1.25 Hz) and of
https://github.com/mleotta/cvpr2015-opensfm (frames of CLIF 2007, some 0.9 m, 1.5 Hz). No image of them is in
this repository. CLIF is stabilised as by ``glintrack track --stabilize``; its labels are in clif_vehicles.csv
and clif_ground.csv. `median-motion` tracks as ``glintrack track`` does, with no settings. The others are
classical detectors with the constant-velocity tracker of rectified frames.

A position is right within 4 m of a label that moves at 1 m/s or more over the frames about it, one to one.
Beside any other label it counts neither way. In WPAFB nothing within 4 m of the frame's edge counts, and
``five`` leaves out the first file, whose labels are of another moment. In CLIF ``roads`` are labelled roads
in view in three quarters of the frames, ``ground`` is all labelled ground. ``now`` are positions reported
with a lag of 0: none before a track's confirmation, but also tracks that end early. Most positions of a false
track are false. Switches are changes of the track of a labelled vehicle, per vehicle and 15 s of tracks.

With --twin, a set that ``glintrack dataset build validation/clif_twin.toml -o FOLDER`` simulates, one table
has the measurements of `glintrack.dataset.comparison` in CLIF and its twin instead. The twin's frames are
compressed with the JPEG tables of CLIF.
"""

import argparse
import sys
import warnings
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.path import Path as Polygon
from PIL import Image

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.detectors import CLASSICAL
from glintrack import track
from glintrack.dataset import read_plan, read_rows
from glintrack.dataset.comparison import CUSTODY_S, comparison_table, frame_rows, measure, tracks_of
from glintrack.dataset.sequences import (
    LABEL_COLUMNS,
    LabelledSequence,
    count_switches,
    match_positions,
    with_speeds,
)
from glintrack.io.orthoimages import Geotransform, open_frames
from glintrack.io.raw_mosaics import read_raw
from glintrack.metrics import VISIBLE_FRACTION
from glintrack.ortho.stabilization import (
    StabilizedGrid,
    plan_grid,
    register_frames,
    transform_points,
    warp_frame,
)
from glintrack.track.files import RECTIFIED_DESIGN, as_rows
from glintrack.track.reporting import History, report_history

WPAFB = Path("dataset/WPAFB_2009/AOI_02")
WPAFB_FRAMES, WPAFB_LABELS = WPAFB / "INPUT_DATA/stabilized_data", WPAFB / "GT/transformed_object_states.csv"
CLIF, TIME_COLUMN = Path("Data/CLIF_2007"), 6  # of a line of a frame's pose: seconds of the day
CLIF_LABELS = "clif_vehicles.csv", "clif_ground.csv"
WPAFB_HZ, WPAFB_GSD_M, WPAFB_FIRST, CLIF_GSD_M = 1.25, 1.0, 100, 0.9
EDGE_PX, CLIF_QUALITY = 4, 92
METHODS = {name: CLASSICAL[name] for name in ("three-frame", "median")} | {"median-motion": None}


def track_rows(sequence: LabelledSequence, detector) -> pd.DataFrame:
    """Rows of the tracks, those before a track's confirmation with ``tentative`` 1."""
    if detector is None:
        return tracks_of(sequence)
    design = RECTIFIED_DESIGN.replace({"reporting.history": True, "reporting.coasted": False})
    state, history, reports = track.start(design, detector=detector), History(), []
    for time_s, image in sequence.images():
        state, _ = track.step(state, track.Frame(time_s, image))
        history, earlier = report_history(history, state, now := track.report(state))
        reports += [*earlier, (time_s, now.assign(tentative=("track", np.zeros(now.sizes["track"]))))]
    return frame_rows(as_rows(reports), sequence.times_s).assign(lasting=True)


def score(sequence: LabelledSequence, rows: pd.DataFrame, area: str) -> str:
    """F1, right, false and missed positions, false positions and tracks per km², and identity switches."""
    found, seen = match_positions(sequence, rows, area), np.isfinite(sequence.frames)
    right, asked, wrong = int(found.labels["found"].sum()), len(found.labels), len(found.false)
    km2 = [
        max((sequence.areas[area] & one).sum() * sequence.gsd_m**2 * 1e-6, 1e-9)
        for one in (seen, seen.any(axis=0))
    ]
    seconds = max(right, 1) * float(np.ptp(sequence.times_s)) / (len(sequence.times_s) - 1)
    switches, tracks = count_switches(found.labels), len(found.false_tracks)
    counts = f"({right} right, {wrong} false, {asked - right} missed), {wrong / km2[0]:.1f} false/km²"
    false_tracks = f"{tracks} false tracks ({tracks / km2[1]:.1f}/km²)"
    custody = f"{switches} switches ({switches * CUSTODY_S / seconds:.2f})"
    return f"F1 {found.f1:.2f} {counts}, {false_tracks}, {custody}"


def read_wpafb(folder: Path) -> LabelledSequence:
    """Read the frames and labels of WPAFB 2009."""
    frames = list(open_frames(folder / WPAFB_FRAMES, WPAFB_HZ, Geotransform(0.0, 0.0, WPAFB_GSD_M)).frames)
    images = np.stack([image["pan"].values for _, image in frames])
    table = pd.read_csv(folder / WPAFB_LABELS).set_index("Frame Number").sort_index()
    rows = []
    for name in (column.removesuffix("_px") for column in table.columns if column.endswith("_px")):
        at = table[[f"{name}_py", f"{name}_px"]].to_numpy(float)  # column and row of a pixel; 0, 0 is nowhere
        for k in np.flatnonzero((at != 0).any(axis=1)):
            rows.append((table.index[k], int(name[4:]), True, at[k, 0] + 0.5, -at[k, 1] - 0.5))
    labels = pd.DataFrame(rows, columns=LABEL_COLUMNS).assign(frame=lambda of: of["frame"] - WPAFB_FIRST)
    labels = labels[labels["frame"].between(0, len(frames) - 1)].reset_index(drop=True)
    times_s = np.array([time_s for time_s, _ in frames])
    all_ground = np.pad(np.ones(np.array(images.shape[1:]) - 2 * EDGE_PX, bool), EDGE_PX)
    return LabelledSequence(times_s, images, WPAFB_GSD_M, with_speeds(labels, times_s), {"all": all_ground})


def stabilize(counts: list[np.ndarray]) -> tuple[StabilizedGrid, np.ndarray]:
    """Register frames, and resample them on one grid."""
    grid = plan_grid(list(register_frames(counts)), counts[0].shape)
    return grid, np.stack([warp_frame(a, b, grid.shape) for a, b in zip(counts, grid.onto_grid, strict=True)])


def on_grid(grid: StabilizedGrid, table: pd.DataFrame) -> np.ndarray:
    """Column and row on the grid of points of the frames."""
    points = table[["frame", "column", "row"]].to_numpy(float)
    return np.concatenate([transform_points(grid.onto_grid[int(k)], np.array([p])) for k, *p in points])


def label(table: pd.DataFrame, grid: StabilizedGrid, times_s: np.ndarray) -> pd.DataFrame:
    """Labels on the grid, of a table with frame, vehicle_id, asked, column and row."""
    at = CLIF_GSD_M * (on_grid(grid, table) + 0.5) * (1, -1)
    labels = table[LABEL_COLUMNS[:3]].assign(east_m=at[:, 0], north_m=at[:, 1])
    return with_speeds(labels.reset_index(drop=True), times_s)


def read_clif(folder: Path) -> Iterator[tuple[str, LabelledSequence]]:
    """Read and stabilise the labelled frames of CLIF 2007, region by region."""
    vehicles, ground = (pd.read_csv(Path(__file__).with_name(name), comment="#") for name in CLIF_LABELS)
    for region, mine in vehicles.groupby("region"):
        numbers = np.arange(mine["frame"].min(), mine["frame"].max() + 1)
        paths = [folder / CLIF / "jpg" / f"000000-{n}.jpg" for n in numbers]
        poses = [(folder / CLIF / "pos" / f"000000-{n}.txt").read_text().split(",") for n in numbers]
        grid, images = stabilize([np.asarray(Image.open(path).convert("L"), np.float32) for path in paths])
        times_s = np.array([float(pose[TIME_COLUMN]) for pose in poses])
        pixels, masks = np.indices(grid.shape)[::-1].reshape(2, -1).T, dict[str, np.ndarray]()
        for (_, kind), outline in ground[ground["region"] == region].groupby(["polygon", "kind"]):
            corners = on_grid(grid, outline.assign(frame=outline["frame"] - numbers[0]))
            mask = Polygon(corners).contains_points(pixels).reshape(grid.shape)
            masks[kind] = masks.get(kind, np.zeros(grid.shape, bool)) | mask
        all_ground = masks["ground"] & ~masks.get("hidden", np.zeros(grid.shape, bool))
        roads = all_ground & masks["road"] & (np.isfinite(images).mean(axis=0) >= 0.75)
        mine = mine.assign(frame=mine["frame"] - numbers[0], asked=mine["kind"] == "vehicle")
        labels, areas = label(mine, grid, times_s), {"roads": roads, "ground": all_ground}
        yield f"CLIF {region}", LabelledSequence(times_s - times_s[0], images, CLIF_GSD_M, labels, areas)


def compress(counts: np.ndarray) -> np.ndarray:
    """Compress counts as JPEG of 8 bits with the tables of CLIF's files."""
    file = BytesIO()
    Image.fromarray(np.minimum(counts, 255).astype(np.uint8)).save(file, "jpeg", quality=CLIF_QUALITY)
    return np.asarray(Image.open(file), np.float32)


def read_twin(folder: Path) -> Iterator[tuple[str, LabelledSequence]]:
    """Read and stabilise the raws of a simulated set, with the true vehicles in view as labels."""
    plan = read_plan(folder)
    for name, case in plan.cases.items():
        files = [folder / shard.raw(k) for shard in plan.shards(name) for k in shard.frames]
        grid, images = stabilize([compress(read_raw(file)) for file in files])
        times_s = np.arange(len(files)) / case.flight.rate_hz
        boxes = read_rows(folder, plan, name, "boxes.csv")
        column, row = ((boxes[f"{axis}0_px"] + boxes[f"{axis}1_px"]) / 2 - 0.5 for axis in "xy")
        table = boxes.assign(column=column, row=row, asked=boxes["visible_fraction"] >= VISIBLE_FRACTION)
        areas = {"ground": np.isfinite(images).any(axis=0)}
        yield name, LabelledSequence(times_s, images, CLIF_GSD_M, label(table, grid, times_s), areas)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Vehicles in real wide-area frames: F1 by detector")
    for name in ("wpafb", "clif", "twin"):
        parser.add_argument(f"--{name}", type=Path, help="folder, see the module's docstring")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # of detections without a likelihood ratio
    clif = read_clif(arguments.clif) if arguments.clif else ()
    if arguments.twin:
        every = [*clif, *read_twin(arguments.twin)]
        print(comparison_table({name: measure(sequence, "ground") for name, sequence in every}))
        return
    wpafb = [("WPAFB", read_wpafb(arguments.wpafb))] if arguments.wpafb else []
    for name, sequence in (*wpafb, *(("WPAFB five", one.after(1)) for _, one in wpafb), *clif):
        for method, detector in METHODS.items():
            rows = track_rows(sequence, detector)
            for area in sequence.areas:
                for text, part in (("", rows[rows["lasting"]]), (" now", rows[rows["tentative"] == 0])):
                    print(f"{name:11} {method:14} {area + text:11} {score(sequence, part, area)}", flush=True)


if __name__ == "__main__":
    main()
