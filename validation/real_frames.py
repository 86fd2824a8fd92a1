"""Vehicles in real wide-area frames: F1 of frames and of tracks, by detector.

``python validation/real_frames.py FOLDER [--only NAME …] [--pictures DIR]``. FOLDER is a clone of
https://github.com/Ayana-Inria/GLMB-adaptive-birth-satellite-videos, which holds six stabilised frames of the
U.S. Air Force Research Laboratory's WPAFB 2009 (area of interest 02, frames 100 to 105, 8 bits, some 1 m,
1.25 Hz) with the places of labelled vehicles in all frames; nothing of it is in this repository. The first
two of the six files are one image. Frames are read and tracked as ``glintrack track FRAMES --rate 1.25
--geotransform 0 0 1`` does, with no settings. A place is right within 4 m of a label that moves at 1 m/s or
more over the frames about it, one to one; beside one that stands it counts neither way, and nothing within 4
m of the frame's edge counts. ``detections`` are those of each frame by itself, from the third file or the
third image on; ``tracks`` what the command writes, all frames from the first. ``five`` leaves out the first
file, whose labels are of another moment than its image.
"""

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from PIL import Image, ImageDraw
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(Path(__file__).parents[1]))
from benchmarks.detectors import CLASSICAL
from glintrack import track
from glintrack.io.orthoimages import Geotransform, image_of, open_frames
from glintrack.track.detect.frame import grid_of
from glintrack.track.files import FRAMES_DESIGN, as_rows, track_frames

FRAMES = Path("dataset/WPAFB_2009/AOI_02/INPUT_DATA/stabilized_data")
LABELS = Path("dataset/WPAFB_2009/AOI_02/GT/transformed_object_states.csv")
RATE_HZ, GSD_M, FIRST = 1.25, 1.0, 100
ABOUT = 2  # frames before and after, over which a label's speed is taken
CAR_M = 4.5  # labels are points
EDGE_M, MOVING_M_S, NEAR_M = 4.0, 1.0, 4.0
METHODS = {**CLASSICAL, "median-motion": "median-motion"}


@dataclass(frozen=True)
class Sequence:
    """Frames on one grid and the vehicles in them.

    Parameters
    ----------
    times_s
        Times of the frames. [s]
    frames
        Counts (frame, y, x).
    gsd_m
        Side of a pixel; the north-west corner lies at (0, 0). [m]
    truth
        time_s, vehicle_id, east_m, north_m, east_speed_m_s, north_speed_m_s, length_m.
    """

    times_s: np.ndarray
    frames: np.ndarray
    gsd_m: float
    truth: pd.DataFrame

    def images(self) -> Iterator[tuple[float, xr.Dataset]]:
        """Yield the time and image of each frame, as ``glintrack track`` reads them."""
        for time_s, counts in zip(self.times_s, self.frames, strict=True):
            image = image_of({"pan": counts.astype(np.float32)}, Geotransform(0.0, 0.0, self.gsd_m))
            yield float(time_s), image


def detections_of(scene: Sequence, detector) -> tuple[list[np.ndarray], float]:
    """Places of sure detections in each frame without tracks, and processor time a frame. [s]"""
    state, places, last, start = None, [], None, time.process_time()
    for time_s, image in scene.images():
        frame = track.Frame(time_s, image, interval_s=0.0 if last is None else time_s - last)
        frame, last = replace(frame, grid=grid_of(frame, None)), time_s
        state = detector.start(frame) if state is None else state
        found = detector.detect(state, frame)
        nobody = track.Association(np.zeros(len(found), bool), np.empty((0, 2)))
        state = detector.update(state, frame, found, nobody)
        places.append(found.position[found.contrast >= 1])
    return places, (time.process_time() - start) / len(places)


def track_places(scene: Sequence, method) -> list[np.ndarray]:
    """Places of the tracks in each frame."""
    if isinstance(method, str):
        rows = as_rows(track_frames(scene.images(), FRAMES_DESIGN.replace({"detect.detector": method})))
    else:
        state, reports = track.start(detector=method), []
        for time_s, image in scene.images():
            state, _ = track.step(state, track.Frame(time_s, image))
            reports.append((time_s, track.report(state)))
        rows = as_rows(reports)
    if "time_s" not in rows:
        return [np.empty((0, 2))] * len(scene.times_s)
    here = np.stack([rows["east_m"].values, rows["north_m"].values], axis=-1)
    return [here[np.isclose(rows["time_s"].values, t)] for t in scene.times_s]


def count_matches(scene: Sequence, k: int, places: np.ndarray) -> np.ndarray:
    """Count the right places, the false places and the moving vehicles of a frame."""
    height, width = (n * scene.gsd_m for n in scene.frames.shape[1:])

    def inside(east, north):
        return (east > EDGE_M) & (east < width - EDGE_M) & (north < -EDGE_M) & (north > EDGE_M - height)

    truth = scene.truth[np.isclose(scene.truth["time_s"], scene.times_s[k])]
    east, north = truth["east_m"].to_numpy(), truth["north_m"].to_numpy()
    speed = np.hypot(truth["east_speed_m_s"], truth["north_speed_m_s"]).to_numpy()
    asked = inside(east, north) & (speed >= MOVING_M_S)
    places = places[inside(*places.T)]
    distance = np.hypot(places[:, :1] - east, places[:, 1:] - north)
    near = distance <= np.maximum(NEAR_M, truth["length_m"].to_numpy() / 2 + 1)
    cost = np.where(near[:, asked], distance[:, asked], 1e3)
    rows, columns = linear_sum_assignment(cost)
    hit = cost[rows, columns] < 1e3
    lone = np.ones(len(places), bool)
    lone[rows[hit]] = False
    return np.array([hit.sum(), (lone & ~near[:, ~asked].any(axis=1)).sum(), asked.sum()], int)


def read(folder: Path) -> Sequence:
    """Read the frames and their labels."""
    frames = list(open_frames(folder / FRAMES, RATE_HZ, Geotransform(0.0, 0.0, GSD_M)).frames)
    times = np.array([time_s for time_s, _ in frames])
    images = np.stack([image["pan"].values for _, image in frames])
    table = pd.read_csv(folder / LABELS).set_index("Frame Number").sort_index()
    table = table.loc[FIRST - ABOUT : FIRST + len(times) - 1 + ABOUT]
    rows = []
    for name in sorted(
        {column.removesuffix("_px") for column in table.columns if column.endswith("_px")},
        key=lambda n: int(n[4:]),
    ):
        at = table[[f"{name}_py", f"{name}_px"]].to_numpy(float)  # column and row of a pixel; 0, 0 is nowhere
        seen = (at != 0).any(axis=1)
        at, when = GSD_M * (at[seen] + 0.5) * (1, -1), table.index.to_numpy()[seen]
        for k in np.flatnonzero((when >= FIRST) & (when < FIRST + len(times))):
            near = np.flatnonzero(np.abs(when - when[k]) <= ABOUT)
            passed_s = max((when[near[-1]] - when[near[0]]) / RATE_HZ, 1.0)
            speed = (at[near[-1]] - at[near[0]]) / passed_s
            rows.append((times[when[k] - FIRST], int(name[4:]), *at[k], *speed, CAR_M))
    names = ["time_s", "vehicle_id", "east_m", "north_m", "east_speed_m_s", "north_speed_m_s"]
    truth = pd.DataFrame(rows, columns=[*names, "length_m"])
    return Sequence(times, images, GSD_M, truth)


def later(scene: Sequence, first: int) -> Sequence:
    """Sequence without its first frames."""
    return replace(scene, times_s=scene.times_s[first:], frames=scene.frames[first:])


def picture(scene: Sequence, k: int, places: np.ndarray, scale: int = 3) -> Image.Image:
    """Draw a frame with the tracks (green) and the labels that move (yellow)."""
    values = scene.frames[k]
    low, high = np.quantile(values, [0.01, 0.995])
    grey = np.clip((values - low) / (high - low) * 255, 0, 255).astype(np.uint8)
    height, width = grey.shape
    image = Image.fromarray(grey).resize((scale * width, scale * height)).convert("RGB")
    draw, here = ImageDraw.Draw(image), scene.truth[np.isclose(scene.truth["time_s"], scene.times_s[k])]
    moving = np.hypot(here["east_speed_m_s"], here["north_speed_m_s"]) >= 1
    labels = here.loc[moving, ["east_m", "north_m"]].to_numpy()
    for xy, radius, colour in ((places, 10, "lime"), (labels, 5, "yellow")):
        for x, y in xy / scene.gsd_m * scale:
            draw.ellipse((x - radius, -y - radius, x + radius, -y + radius), outline=colour, width=2)
    return image


def main() -> None:
    """Print the table, and optionally draw."""
    parser = argparse.ArgumentParser(description="Vehicles in real wide-area frames: F1 by detector")
    parser.add_argument("folder", type=Path, help="clone of the named repository")
    parser.add_argument("--only", nargs="*", help="methods")
    parser.add_argument("--pictures", type=Path, help="folder for frames with what the last method found")
    arguments = parser.parse_args()
    scene = read(arguments.folder)
    count, places = len(scene.times_s), []
    print(f"{'':30}{'detections':>22}{'tracks':>22}{'five':>22}{'s':>7}")
    for name, method in METHODS.items():
        if arguments.only is not None and name not in arguments.only:
            continue
        detector = track.DETECTORS[method](FRAMES_DESIGN.detect) if isinstance(method, str) else method
        found, seconds = detections_of(scene, detector)
        first = next((k for k, p in enumerate(found) if len(p)), count)
        five, places = later(scene, 1), track_places(scene, method)
        cells = []
        scored = ((later(scene, first), found[first:]), (scene, places), (five, track_places(five, method)))
        for of, mine in scored:
            right, wrong, asked = sum((count_matches(of, k, p) for k, p in enumerate(mine)), np.zeros(3, int))
            cells.append(f"{2 * right / max(right + wrong + asked, 1):.2f} ({right}, {wrong} of {asked})")
        print(f"{name:30}" + "".join(f"{cell:>22}" for cell in cells) + f"{seconds:7.2f}", flush=True)
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
        for k, mine in enumerate(places):
            picture(scene, k, mine).save(arguments.pictures / f"{k}.png")


if __name__ == "__main__":
    main()
