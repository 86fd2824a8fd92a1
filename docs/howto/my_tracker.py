"""A tracker of one's own: change detection by difference, nearest neighbour, and its scores beside ours."""

import itertools

import numpy as np
import xarray as xr
from scipy import ndimage
from scipy.spatial import cKDTree

from glintrack import Case, metrics, simulate

REACH_M = 12.0  # farthest that a vehicle gets between frames
frames = []


def keep(epoch):
    """Keep each panchromatic frame on the ground, and the truth it is scored with."""
    truth = epoch.city.truth(epoch.time_s)
    frames.append((epoch.time_s, epoch.image, truth, epoch.city.extent_m))


def detect(before, now):
    """East and north of what is brighter or darker than the frame before. [m]"""
    change = now["pan"].values - before["pan"].values
    noise = 1.48 * np.nanmedian(np.abs(change))
    blobs, count = ndimage.label(np.abs(np.nan_to_num(change)) > 6 * noise)
    centres = np.array(ndimage.center_of_mass(blobs > 0, blobs, np.arange(1, count + 1))).reshape(-1, 2)
    row, column = np.round(centres).astype(int).T
    return np.stack([now["x"].values[column], now["y"].values[row]], axis=1)


def follow(tracks, found, names):
    """Carry each name to the nearest detection; what nobody claims is new."""
    here = {}
    tree = cKDTree(found) if len(found) else None
    for name, place in tracks.items():
        near, which = tree.query(place, distance_upper_bound=REACH_M) if tree else (np.inf, -1)
        if np.isfinite(near):
            here[name] = found[which]
    claimed = {tuple(place) for place in here.values()}
    return here | {next(names): place for place in found if tuple(place) not in claimed}


def as_tracks(tracks, before, step_s):
    """Make a dataset of the schema `tracks`."""
    names = list(tracks)
    place = np.array([tracks[n] for n in names]).reshape(-1, 2)
    last = np.array([before.get(n, tracks[n]) for n in names]).reshape(-1, 2)
    speed = (place - last) / step_s
    columns = {"east_m": (place[:, 0], "m"), "north_m": (place[:, 1], "m")}
    columns |= {"east_speed_m_s": (speed[:, 0], "m s-1"), "north_speed_m_s": (speed[:, 1], "m s-1")}
    columns |= {"east_var_m2": (np.ones(len(names)), "m2"), "north_var_m2": (np.ones(len(names)), "m2")}
    columns |= {"status": (np.full(len(names), "measured"), "1")}
    data = {name: ("track", values, {"units": units}) for name, (values, units) in columns.items()}
    return xr.Dataset(data, coords={"track": np.array(names, dtype=int)})


case = Case.from_toml("small.toml").replace({"channels": ["pan"]})
theirs = simulate(case, keep)["pan"].attrs

names, tracks, scores = itertools.count(1), {}, []
for (_, before, *_), (_, now, truth, area_m) in itertools.pairwise(frames):
    earlier, tracks = tracks, follow(tracks, detect(before, now), names)
    scores.append(metrics.score_epoch(as_tracks(tracks, earlier, 0.5), truth, area_m))
mine = metrics.summarize(scores)
for name in ("completeness", "purity", "false_per_frame", "identity_switches"):
    print(f"{name:18s} mine {mine[name]:8.3f}   glintrack's {theirs[name]:8.3f}")
