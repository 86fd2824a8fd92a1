"""Vehicles in real wide-area frames: F1 of frames and of tracks, by detector.

``python benchmarks/real_frames.py FOLDER [--only NAME …] [--pictures DIR]``. FOLDER is a clone of
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
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from near_nadir import METHODS, detections_of, f1, places_of, right_and_wrong, tracks_of
from near_nadir_scenes import Sequence
from PIL import Image, ImageDraw

from glintrack.io.orthoimages import Geotransform, open_frames

FRAMES = Path("dataset/WPAFB_2009/AOI_02/INPUT_DATA/stabilized_data")
LABELS = Path("dataset/WPAFB_2009/AOI_02/GT/transformed_object_states.csv")
RATE_HZ, GSD_M, FIRST = 1.25, 1.0, 100
ABOUT = 2  # frames before and after, over which a label's speed is taken
CAR_M = 4.5  # labels are points


def read(folder: Path) -> Sequence:
    """Frames and labels."""
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
            rows.append((times[when[k] - FIRST], int(name[4:]), *at[k], *speed, CAR_M, 1.0))
    names = ["time_s", "vehicle_id", "east_m", "north_m", "east_speed_m_s", "north_speed_m_s"]
    truth = pd.DataFrame(rows, columns=[*names, "length_m", "visible_fraction"])
    return Sequence("WPAFB 2009, area 02", times, images, GSD_M, truth)


def later(scene: Sequence, first: int) -> Sequence:
    """The same without its first frames."""
    return replace(scene, times_s=scene.times_s[first:], frames=scene.frames[first:])


def picture(scene: Sequence, k: int, places: np.ndarray, scale: int = 3) -> Image.Image:
    """A frame with what was found (green) and the labels that move (yellow)."""
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
    """Run, print and perhaps draw."""
    parser = argparse.ArgumentParser(description="Vehicles in real wide-area frames: F1 by detector")
    parser.add_argument("folder", type=Path, help="clone of the named repository")
    parser.add_argument("--only", nargs="*", help="methods")
    parser.add_argument("--pictures", type=Path, help="folder for frames with what the last method found")
    arguments = parser.parse_args()
    scene = read(arguments.folder)
    count, places = len(scene.times_s), []
    print(f"{'':30}{'detections':>22}{'tracks':>22}{'five':>22}{'s':>7}")
    for name, method in METHODS.items():
        if arguments.only is not None and name.strip("`") not in arguments.only:
            continue
        alike = method == "median-motion" or "alike" in name
        found, contrast, seconds = detections_of(scene, method)
        sure = [p[c >= 1] for p, c in zip(found, contrast, strict=True)]
        first = next((k for k, p in enumerate(sure) if len(p)), count)
        five = later(scene, 1)
        places = places_of(scene, tracks_of(scene, method, alike), count)
        cells = [
            (later(scene, first), sure[first:]),
            (scene, places),
            (five, places_of(five, tracks_of(five, method, alike), count - 1)),
        ]
        told = []
        for of, mine in cells:
            right, wrong, asked = np.sum([right_and_wrong(of, k, p) for k, p in enumerate(mine)], axis=0)
            told.append(f"{f1(of, mine):.2f} ({right}, {wrong} of {asked})")
        print(f"{name:30}" + "".join(f"{one:>22}" for one in told) + f"{seconds:7.2f}", flush=True)
    if arguments.pictures:
        arguments.pictures.mkdir(parents=True, exist_ok=True)
        for k, mine in enumerate(places):
            picture(scene, k, mine).save(arguments.pictures / f"{k}.png")


if __name__ == "__main__":
    main()
