"""Vehicles in real wide-area frames: F1, false positions and identity switches of the tracks, by detector.

``python validation/real_frames.py [--wpafb FOLDER] [--clif FOLDER]``. The folders are clones of
https://github.com/Ayana-Inria/GLMB-adaptive-birth-satellite-videos (six labelled, stabilised frames of the
U.S. Air Force's WPAFB 2009, area of interest 02, frames 100 to 105, some 1 m, 1.25 Hz) and of
https://github.com/mleotta/cvpr2015-opensfm (frames of CLIF 2007, some 0.9 m, 1.5 Hz). No image of them is in
this repository. CLIF is stabilised as by ``glintrack track --stabilize``; its labels are in clif_vehicles.csv
and clif_ground.csv. `median-motion` tracks as ``glintrack track`` does, with no settings. The others are
classical detectors with the constant-velocity tracker of rectified frames.

A position is right within 4 m of a label that moves at 1 m/s or more over the frames about it, one to one.
Beside any other label it counts neither way. In WPAFB nothing within 4 m of the frame's edge counts, and
``five`` leaves out the first file, whose labels are of another moment than its image. In CLIF ``roads`` are
labelled roads in view in three quarters of the frames, ``ground`` is all labelled ground. ``now`` are the
positions that are reported at once, without those before a track's confirmation. Switches are changes of the
track of a labelled vehicle, per vehicle and 15 s of its tracks.
"""

import argparse
import sys
import warnings
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from matplotlib.path import Path as Polygon
from PIL import Image
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.detectors import CLASSICAL
from glintrack import track
from glintrack.io.orthoimages import Geotransform, image_of, open_frames
from glintrack.ortho.stabilization import plan_grid, register_frames, transform_points, warp_frame
from glintrack.track.files import FRAMES_DESIGN, RECTIFIED_DESIGN, as_rows, track_frames
from glintrack.track.reporting import History, report_history

WPAFB = Path("dataset/WPAFB_2009/AOI_02")
WPAFB_FRAMES, WPAFB_LABELS = WPAFB / "INPUT_DATA/stabilized_data", WPAFB / "GT/transformed_object_states.csv"
CLIF, TIME_COLUMN = Path("Data/CLIF_2007"), 6  # of a line of a frame's pose: seconds of the day
CLIF_LABELS = "clif_vehicles.csv", "clif_ground.csv"
WPAFB_HZ, WPAFB_GSD_M, WPAFB_FIRST, CLIF_GSD_M = 1.25, 1.0, 100, 0.9
ABOUT = 2  # frames before and after, over which a label's speed is taken
EDGE_PX, MOVING_M_S, NEAR_M, CUSTODY_S = 4, 1.0, 4.0, 15.0
METHODS = {name: CLASSICAL[name] for name in ("three-frame", "median")} | {"median-motion": None}
COLUMNS = ["frame", "vehicle_id", "asked", "east_m", "north_m"]


@dataclass(frozen=True)
class Sequence:
    """Frames on one grid, whose north-west corner lies at (0, 0), and the labels in them.

    `times_s` are the frames' times [s], `frames` their counts (frame, y, x), `gsd_m` the side of a pixel [m],
    `labels` a table with `COLUMNS`, and `areas` masks of ground (y, x) by name.
    """

    times_s: np.ndarray
    frames: np.ndarray
    gsd_m: float
    labels: pd.DataFrame
    areas: dict[str, np.ndarray]

    def images(self) -> Iterator[tuple[float, xr.Dataset]]:
        """Yield the time and image of each frame, as ``glintrack track`` reads them."""
        for time_s, counts in zip(self.times_s, self.frames, strict=True):
            image = image_of({"pan": counts.astype(np.float32)}, Geotransform(0.0, 0.0, self.gsd_m))
            yield float(time_s), image

    def later(self, first: int) -> "Sequence":
        """Sequence without its first frames."""
        labels = self.labels[self.labels["frame"] >= first].assign(frame=lambda of: of["frame"] - first)
        return replace(self, times_s=self.times_s[first:], frames=self.frames[first:], labels=labels)

    def inside(self, area: str, places: np.ndarray) -> np.ndarray:
        """Mask of the places that lie in an area."""
        cell = np.floor(places[:, ::-1] * (-1, 1) / self.gsd_m).astype(int)
        last = np.array(self.areas[area].shape) - 1
        known = ((cell >= 0) & (cell <= last)).all(axis=1)
        return known & self.areas[area][tuple(np.clip(cell, 0, last).T)]


def track_rows(scene: Sequence, detector) -> pd.DataFrame:
    """Rows of the tracks, those before a track's confirmation with ``tentative`` 1."""
    if detector is None:
        rows = as_rows(track_frames(scene.images(), FRAMES_DESIGN))
    else:
        design = RECTIFIED_DESIGN.replace({"reporting.history": True, "reporting.coasted": False})
        state, history, reports = track.start(design, detector=detector), History(), []
        for time_s, image in scene.images():
            state, _ = track.step(state, track.Frame(time_s, image))
            history, earlier = report_history(history, state, now := track.report(state))
            reports += [*earlier, (time_s, now.assign(tentative=("track", np.zeros(now.sizes["track"]))))]
        rows = as_rows(reports)
    names = ["time_s", "track_id", "east_m", "north_m", "tentative"]
    table = pd.DataFrame({name: rows.get(name, np.empty(0)) for name in names})
    return table.assign(frame=np.searchsorted(scene.times_s, table["time_s"] - 1e-6))


def score(scene: Sequence, rows: pd.DataFrame, area: str) -> str:
    """F1, right, false and missed positions, false ones per km², and identity switches per vehicle."""
    right, wrong, asked, ground_km2, pairs = 0, 0, 0, 1e-9, []
    for k in range(len(scene.times_s)):
        mine, labels = rows[rows["frame"] == k], scene.labels[scene.labels["frame"] == k]
        places, there = (of[["east_m", "north_m"]].to_numpy(float) for of in (mine, labels))
        distance = np.hypot(*(places[:, None] - there[None]).transpose(2, 0, 1))
        is_asked, is_near = labels["asked"].to_numpy(bool), distance <= NEAR_M
        cost = np.where(is_near[:, is_asked], distance[:, is_asked], 1e3)
        i, j = linear_sum_assignment(cost)
        i, j = i[cost[i, j] < 1e3], j[cost[i, j] < 1e3]
        is_alone = ~is_near[:, ~is_asked].any(axis=1)
        is_alone[i] = False
        is_inside = scene.inside(area, there[is_asked])
        right += is_inside[j].sum()
        asked += is_inside.sum()
        wrong += scene.inside(area, places[is_alone]).sum()
        ground_km2 += (scene.areas[area] & np.isfinite(scene.frames[k])).sum() * scene.gsd_m**2 * 1e-6
        vehicles, track_ids = labels["vehicle_id"].to_numpy()[is_asked][j], mine["track_id"].to_numpy()[i]
        pairs += zip(vehicles[is_inside[j]], track_ids[is_inside[j]], strict=True)
    seconds = max(right, 1) * float(np.ptp(scene.times_s)) / (len(scene.times_s) - 1)
    paths = pd.DataFrame(pairs, columns=["vehicle", "track"]).groupby("vehicle")["track"]
    switches = sum(int((np.diff(path) != 0).sum()) for _, path in paths)
    found = f"({right} right, {wrong} false, {asked - right} missed), {wrong / ground_km2:.1f} false/km²"
    custody = f"{switches} switches ({switches * CUSTODY_S / seconds:.2f})"
    return f"F1 {2 * right / max(right + wrong + asked, 1):.2f} {found}, {custody}"


def with_speed(table: pd.DataFrame, times_s: np.ndarray) -> pd.DataFrame:
    """Labels of which those that stand are not asked for."""
    asked = table["asked"].to_numpy(bool).copy()
    for _, index in table.groupby("vehicle_id").indices.items():
        frame, place = table["frame"].to_numpy()[index], table[["east_m", "north_m"]].to_numpy(float)[index]
        for n, k in enumerate(frame):
            near = np.flatnonzero(np.abs(frame - k) <= ABOUT)[[0, -1]]
            way_m, passed_s = np.hypot(*np.ptp(place[near], axis=0)), np.ptp(times_s[frame[near]])
            asked[index[n]] &= way_m >= MOVING_M_S * max(passed_s, 1e-9)
    return table.assign(asked=asked)


def read_wpafb(folder: Path) -> Sequence:
    """Read the frames and labels of WPAFB 2009."""
    frames = list(open_frames(folder / WPAFB_FRAMES, WPAFB_HZ, Geotransform(0.0, 0.0, WPAFB_GSD_M)).frames)
    images = np.stack([image["pan"].values for _, image in frames])
    table = pd.read_csv(folder / WPAFB_LABELS).set_index("Frame Number").sort_index()
    rows = []
    for name in (column.removesuffix("_px") for column in table.columns if column.endswith("_px")):
        at = table[[f"{name}_py", f"{name}_px"]].to_numpy(float)  # column and row of a pixel; 0, 0 is nowhere
        for k in np.flatnonzero((at != 0).any(axis=1)):
            rows.append((table.index[k], int(name[4:]), True, at[k, 0] + 0.5, -at[k, 1] - 0.5))
    labels = pd.DataFrame(rows, columns=COLUMNS).assign(frame=lambda of: of["frame"] - WPAFB_FIRST)
    labels = labels[labels["frame"].between(0, len(frames) - 1)].reset_index(drop=True)
    times_s = np.array([time_s for time_s, _ in frames])
    all_ground = np.pad(np.ones(np.array(images.shape[1:]) - 2 * EDGE_PX, bool), EDGE_PX)
    return Sequence(times_s, images, WPAFB_GSD_M, with_speed(labels, times_s), {"all": all_ground})


def read_clif(folder: Path) -> Iterator[tuple[str, Sequence]]:
    """Read and stabilise the labelled frames of CLIF 2007, region by region."""
    vehicles, ground = (pd.read_csv(Path(__file__).with_name(name), comment="#") for name in CLIF_LABELS)
    for region, mine in vehicles.groupby("region"):
        numbers = np.arange(mine["frame"].min(), mine["frame"].max() + 1)
        paths = [folder / CLIF / "jpg" / f"000000-{n}.jpg" for n in numbers]
        poses = [(folder / CLIF / "pos" / f"000000-{n}.txt").read_text().split(",") for n in numbers]
        counts = [np.asarray(Image.open(path).convert("L"), np.float32) for path in paths]
        grid = plan_grid(list(register_frames(counts)), counts[0].shape)
        images = np.stack([warp_frame(a, b, grid.shape) for a, b in zip(counts, grid.onto_grid, strict=True)])
        times_s = np.array([float(pose[TIME_COLUMN]) for pose in poses])

        def places(table, first=numbers[0], onto=grid.onto_grid):
            points = table[["frame", "column", "row"]].to_numpy(float)
            return np.concatenate([transform_points(onto[int(k) - first], np.array([p])) for k, *p in points])

        at = CLIF_GSD_M * (places(mine) + 0.5) * (1, -1)
        values = (mine["frame"] - numbers[0], mine["vehicle_id"], mine["kind"] == "vehicle", *at.T)
        labels = pd.DataFrame(dict(zip(COLUMNS, map(np.asarray, values), strict=True)))
        pixels, masks = np.indices(grid.shape)[::-1].reshape(2, -1).T, dict[str, np.ndarray]()
        for (_, kind), outline in ground[ground["region"] == region].groupby(["polygon", "kind"]):
            mask = Polygon(places(outline)).contains_points(pixels).reshape(grid.shape)
            masks[kind] = masks.get(kind, np.zeros(grid.shape, bool)) | mask
        all_ground = masks["ground"] & ~masks.get("hidden", np.zeros(grid.shape, bool))
        roads = all_ground & masks["road"] & (np.isfinite(images).mean(axis=0) >= 0.75)
        areas = {"roads": roads, "ground": all_ground}
        labels = with_speed(labels, times_s)
        yield f"CLIF {region}", Sequence(times_s - times_s[0], images, CLIF_GSD_M, labels, areas)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Vehicles in real wide-area frames: F1 by detector")
    for name in ("wpafb", "clif"):
        parser.add_argument(f"--{name}", type=Path, help="clone of its repository")
    arguments = parser.parse_args()
    warnings.simplefilter("ignore")  # of detections without a likelihood ratio
    clif = read_clif(arguments.clif) if arguments.clif else ()
    wpafb = [("WPAFB", read_wpafb(arguments.wpafb))] if arguments.wpafb else []
    for name, scene in (*wpafb, *(("WPAFB five", scene.later(1)) for _, scene in wpafb), *clif):
        for method, detector in METHODS.items():
            rows = track_rows(scene, detector)
            for area in scene.areas:
                for text, part in (("", rows), (" now", rows[rows["tentative"] == 0])):
                    print(f"{name:11} {method:14} {area + text:11} {score(scene, part, area)}", flush=True)


if __name__ == "__main__":
    main()
