"""Recompute a study's rows from its raw tracks and truth, without any code of glintrack.

For each case and channel: vehicles held per km², completeness (Eq. 13 of Presnar et al., Proc. SPIE 7672,
76720T (2010)) of all movers and of visible ones, and purity (Eq. 14), from `result.nc`; and a contrast of two
channels or levels as the mean over replicates with an interval by resampling them. Each figure stands beside
that of `results.parquet`; the exit code is 1 where any differs by more than 1e-9 of itself.

    python tools/recompute_rows.py study-polarization --axis elements \
        --of adaptive:all --against depolarized:all

The study's folder must hold its cases. Only NumPy, SciPy, netCDF4 and pandas are used.
"""

import argparse
import sys
from collections import Counter, defaultdict
from pathlib import Path

import netCDF4
import numpy as np
import pandas as pd
from scipy.optimize import linear_sum_assignment

NEAR_M, MOVING_M_S, SEEN = 5.0, 1.0, 0.25  # docs/conventions.md
FAR = 1e6  # cost of a pair that is none
SCORES = ("held_per_km2", "completeness", "completeness_visible", "purity")


def scores_of(path: Path, channel: str, window_m: tuple[float, float]) -> dict[str, float]:
    """Scores of one channel of one flight, means over its frames."""
    with netCDF4.Dataset(path) as file:
        truth = {name: np.asarray(v[:]) for name, v in file["truth"].variables.items()}
        tracks = {name: np.asarray(v[:]) for name, v in file[f"{channel}/tracks"].variables.items()}
        times = np.asarray(file[channel]["time"][:] if "time" in file[channel].variables else file["time"][:])
    half_east, half_north = window_m[0] / 2, window_m[1] / 2
    held, whole, seen = [], [], []
    of_track: dict[int, Counter] = defaultdict(Counter)
    for time in times:
        mine, there = tracks["time_s"] == time, truth["time_s"] == time
        east, north = truth["east"][there], truth["north"][there]
        speed = np.hypot(truth["east_speed"][there], truth["north_speed"][there])
        should = (speed >= MOVING_M_S) & (np.abs(east) <= half_east) & (np.abs(north) <= half_north)
        visible = should & (truth["visible_fraction"][there] >= SEEN)
        distance = np.hypot(
            tracks["east"][mine][:, None] - east[None], tracks["north"][mine][:, None] - north[None]
        )
        rows, columns = linear_sum_assignment(np.where(distance <= NEAR_M, distance, FAR))
        good = distance[rows, columns] <= NEAR_M
        rows, columns = rows[good], columns[good]
        tracked = np.zeros(len(east), bool)
        tracked[columns] = True
        held.append((tracked & should).sum() / (1e-6 * window_m[0] * window_m[1]))
        whole.append(tracked[should].mean() if should.any() else np.nan)
        seen.append(tracked[visible].mean() if visible.any() else np.nan)
        vehicles, names = truth["vehicle_id"][there], tracks["track_id"][mine]
        for row, column in zip(rows, columns, strict=True):
            of_track[int(names[row])][int(vehicles[column])] += 1
    most, matched = Counter(), Counter()  # by the vehicle that most of a track's matches are of
    for counts in of_track.values():
        if counts.total() >= 2:
            vehicle = min(counts, key=lambda one: (-counts[one], one))
            most[vehicle] += counts[vehicle]
            matched[vehicle] += counts.total()
    return {
        "held_per_km2": float(np.mean(held)),
        "completeness": float(np.nanmean(whole)),
        "completeness_visible": float(np.nanmean(seen)),
        "purity": float(np.mean([most[vehicle] / matched[vehicle] for vehicle in matched] or [np.nan])),
    }


def main() -> int:
    """Compare every row, and print one contrast."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("study", type=Path)
    parser.add_argument("--axis", default="elements", help="Column of the rows that tells the levels")
    parser.add_argument("--of", default="adaptive:all", help="LEVEL:CHANNEL")
    parser.add_argument("--against", default="depolarized:all", help="LEVEL:CHANNEL")
    parser.add_argument("--window", type=float, nargs=2, default=(660.0, 420.0), help="East and north [m]")
    given = parser.parse_args()
    table = pd.read_parquet(given.study / "results.parquet")
    if given.axis not in table:
        parser.error(
            f"`--axis` must be a column of results.parquet, got {given.axis} (give --of and --against too)"
        )
    table = table[table["status"] == "finished"]
    rows, apart = [], 0.0
    for row in table.to_dict("records"):
        mine = scores_of(
            given.study / "cases" / row["case"] / "result.nc", row["channel"], tuple(given.window)
        )
        apart = max(apart, *(abs(mine[name] - row[name]) / max(abs(row[name]), 1e-12) for name in SCORES))
        rows.append(
            {given.axis: row[given.axis], "channel": row["channel"], "replicate": row["replicate"], **mine}
        )
    found = pd.DataFrame(rows)
    print(
        f"{len(found)} rows of {table['case'].nunique()} flights; largest difference {apart:.1e} of the value"
    )

    def level(name: str) -> pd.DataFrame:
        value, channel = name.rsplit(":", 1)
        chosen = found[(found[given.axis].astype(str) == value) & (found["channel"] == channel)]
        return chosen.groupby("replicate")[list(SCORES)].mean()

    change = (level(given.of) - level(given.against)).dropna()
    drawn = np.random.default_rng(0).integers(0, len(change), (20_000, len(change)))
    for name in SCORES:
        means = change[name].to_numpy()[drawn].mean(axis=1)
        low, high = np.percentile(means, [2.5, 97.5])
        print(f"{given.of} - {given.against}, {name}: {change[name].mean():+.5g} ({low:+.3g} to {high:+.3g})")
    return int(apart > 1e-9)


if __name__ == "__main__":
    sys.exit(main())
