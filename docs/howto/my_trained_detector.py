"""Train a small detector on a set's labels, and write its detections on the test split."""

import sys
from pathlib import Path

import numpy as np
import pandas as pd
import xarray as xr
from scipy import ndimage
from sklearn.ensemble import RandomForestClassifier

from glintrack.dataset import read_plan, read_rows

MIN_PROBABILITY = 0.5
QUIET = 20  # training uses one of this number of cells without a moving vehicle
folder = Path(sys.argv[1] if len(sys.argv) > 1 else "my_set")
plan = read_plan(folder)


def frames_of(name):
    """Rectified pan and DoLP (frame, north, east) of a case, its times [s] and grid [m]."""
    files = [folder / shard.file("nc") for shard in plan.shards(name)]
    parts = [xr.load_dataset(file, engine="h5netcdf") for file in files]
    pan = np.concatenate([part["pan"].values for part in parts])
    dolp = np.concatenate([part["dolp"].values for part in parts])
    times_s = np.concatenate([part["time_s"].values for part in parts])
    return pan, dolp, times_s, parts[0]["east_m"].values, parts[0]["north_m"].values


def features_of(pan, dolp):
    """Features of each cell relative to its median over the flight: (frame, north, east, feature)."""
    change = np.stack([pan / np.nanmedian(pan, axis=0) - 1, dolp - np.nanmedian(dolp, axis=0)], axis=-1)
    change = np.nan_to_num(change).astype(np.float32)
    near = ndimage.uniform_filter(change, (1, 3, 3, 1))
    far = ndimage.uniform_filter(np.abs(change), (1, 9, 9, 1))
    before, after = np.roll(near, 1, axis=0), np.roll(near, -1, axis=0)
    return np.concatenate([change, near, far, before, after], axis=-1)


def labels_of(name, shape, east, north):
    """Mask of the cells that moving vehicles cover, by their boxes on the ground."""
    covered = np.zeros(shape, bool)
    boxes = read_rows(folder, plan, name, "boxes.csv")
    boxes = boxes[(boxes["moving"] == 1) & (boxes["visible_fraction"] >= 0.25)]
    for row in boxes.itertuples():
        y = (north >= row.south_m) & (north <= row.north_m)
        x = (east >= row.west_m) & (east <= row.east_m)
        covered[int(row.frame)][np.ix_(y, x)] = True
    return covered


def train():
    """Train a forest on all cells of the training split that move, and on some that do not."""
    seen, known = [], []
    for name in (name for name in plan.cases if plan.split[name] == "train"):
        pan, dolp, _, east, north = frames_of(name)
        found, moving = features_of(pan, dolp), labels_of(name, pan.shape, east, north)
        used = moving | (np.arange(moving.size).reshape(moving.shape) % QUIET == 0)
        seen.append(found[used])
        known.append(moving[used])
    forest = RandomForestClassifier(40, max_depth=10, class_weight="balanced", random_state=0)
    return forest.fit(np.concatenate(seen), np.concatenate(known))


def detect(forest, name):
    """Middles of what the forest holds for moving vehicles, as rows of a table of detections."""
    pan, dolp, times_s, east, north = frames_of(name)
    found = features_of(pan, dolp)
    rows = []
    for k, time_s in enumerate(times_s):
        likely = forest.predict_proba(found[k].reshape(-1, found.shape[-1]))[:, 1].reshape(pan.shape[1:])
        blobs, count = ndimage.label(likely > MIN_PROBABILITY)
        middles = ndimage.center_of_mass(likely, blobs, np.arange(1, count + 1))
        for y, x in middles:
            place = np.interp(x, np.arange(len(east)), east), np.interp(y, np.arange(len(north)), north)
            rows.append((time_s, *place, 1.0, 1.0))
    return pd.DataFrame(rows, columns=["time_s", "east_m", "north_m", "east_var_m2", "north_var_m2"])


forest = train()
for name in (name for name in plan.cases if plan.split[name] == "test"):
    table = detect(forest, name)
    table.to_csv(f"{name}.detections.csv", index=False)
    read_rows(folder, plan, name, "truth.csv").to_csv(f"{name}.truth.csv", index=False)
    print(f"{name}: {len(table)} detections over {plan.cases[name].flight.frames} frames")
