"""Trackers on recorded SUMO traffic: completeness, purity and time, all on the same detections.

``python benchmarks/tracking.py [--quick] [--json FILE]``. The detections are the truth of the
embedded recording with misses, clutter and noise of position; vehicles that stand are not detected, as change
detection would not. Ours (several designs), a SORT-style baseline, Stone Soup's GNN, and on fewer frames
Stone Soup's JPDA; then memory over many frames. ``ratio`` is the peer's time over that of our default. Times
are the processor's, which a loaded machine stretches less than the wall clock's.
"""

import argparse
import datetime
import json
import resource
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.optimize import linear_sum_assignment

import glintrack
from glintrack import metrics, track
from glintrack.scene.traffic import read_recording
from glintrack.track.files import DETECTIONS_DESIGN, strict_design

RECORDING = Path(glintrack.__file__).parent / "data" / "traffic" / "embedded.nc"
AREA_M = (-330.0, -210.0, 330.0, 210.0)
GRID = track.Grid((28, 44), (AREA_M[0] + 7.5, AREA_M[3] - 7.5), 15.0)
START_S, RATE_HZ, SIGMA_M, DETECTED, CLUTTER = 20.0, 2.0, 0.5, 0.85, 40
MOVING_M_S = 1.0

Epochs = list[tuple[float, np.ndarray, np.ndarray]]  # time, ids, states
Reports = list[tuple[np.ndarray, np.ndarray]]  # ids and positions of tracks
Tracker = Callable[[Epochs, list[np.ndarray]], tuple[Reports, list[float]]]


def traffic(frames: int, rate_hz: float = RATE_HZ, start_s: float = START_S) -> Epochs:
    """Vehicles inside the area at each epoch."""
    recorded = read_recording(RECORDING).traffic
    out = []
    for k in range(frames):
        ids, states = recorded.at(start_s + k / rate_hz)
        x, y = states[:, 0], states[:, 1]
        inside = (x >= AREA_M[0]) & (x <= AREA_M[2]) & (y >= AREA_M[1]) & (y <= AREA_M[3])
        out.append((k / rate_hz, ids[inside], states[inside]))
    return out


def speed_of(states: np.ndarray) -> np.ndarray:
    return np.hypot(states[:, 3], states[:, 4])


def measure(epochs: Epochs, seed: int) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Return detections of each epoch in random order, and their vehicles (−1 for none)."""
    rng = np.random.default_rng(seed)
    measured, whose = [], []
    for _, ids, states in epochs:
        seen = (rng.random(len(states)) < DETECTED) & (speed_of(states) >= MOVING_M_S)
        count = rng.poisson(CLUTTER)
        clutter = rng.uniform(AREA_M[:2], AREA_M[2:], (count, 2))
        points = np.r_[states[seen, :2] + rng.normal(0, SIGMA_M, (seen.sum(), 2)), clutter]
        order = rng.permutation(len(points))
        measured.append(points[order])
        whose.append(np.r_[ids[seen], np.full(count, -1)][order])
    return measured, whose


def truth_of(ids: np.ndarray, states: np.ndarray) -> xr.Dataset:
    """Dataset of the schema ``truth``."""
    none = np.zeros(len(ids))
    columns = {
        "east_m": (states[:, 0], "m"), "north_m": (states[:, 1], "m"), "up_m": (none, "m"),
        "east_speed_m_s": (states[:, 3], "m s-1"), "north_speed_m_s": (states[:, 4], "m s-1"),
        "heading_rad": (states[:, 2], "rad"), "length_m": (none + 4.5, "m"), "width_m": (none + 1.8, "m"),
        "height_m": (none + 1.5, "m"),
    }  # fmt: skip
    return xr.Dataset(
        {k: ("vehicle", np.asarray(v, float), {"units": u}) for k, (v, u) in columns.items()},
        coords={"vehicle": np.asarray(ids, np.int64)},
    )


def tracks_of(ids: np.ndarray, points: np.ndarray) -> xr.Dataset:
    """Dataset of the schema ``tracks``; only positions are scored."""
    points = np.asarray(points, float).reshape(-1, 2)
    none = np.zeros(len(points))
    columns = {
        "east_m": (points[:, 0], "m"), "north_m": (points[:, 1], "m"), "east_speed_m_s": (none, "m s-1"),
        "north_speed_m_s": (none, "m s-1"), "east_var_m2": (none + 1, "m2"), "north_var_m2": (none + 1, "m2"),
        "status": (np.full(len(points), "measured"), "1"),
    }  # fmt: skip
    return xr.Dataset(
        {k: ("track", v, {"units": u}) for k, (v, u) in columns.items()},
        coords={"track": np.asarray(ids, np.int64)},
    )


def score(epochs: Epochs, reports: Reports) -> dict[str, float]:
    return metrics.summarize(
        [
            metrics.score_epoch(tracks_of(*report), truth_of(ids, states), AREA_M)
            for (_, ids, states), report in zip(epochs, reports, strict=False)
        ]
    )


def ours(
    design: track.TrackDesign, features: list[np.ndarray] | None = None, roads: tuple[np.ndarray, ...] = ()
) -> Tracker:
    """Our tracker with one design."""

    def run(epochs: Epochs, measured: list[np.ndarray]) -> tuple[Reports, list[float]]:
        state, reports, times = track.start(design, roads=roads), [], []
        for k, ((time_s, *_), points) in enumerate(zip(epochs, measured, strict=True)):
            n = len(points)
            covariance = np.repeat(SIGMA_M**2 * np.eye(2)[None], n, axis=0)
            found = track.Detections(points, covariance, np.full(n, 4.0), np.ones(n))
            start = time.process_time()
            state = track.step_detections(
                state, found, time_s, GRID, None if features is None else features[k]
            )
            times.append(1e3 * (time.process_time() - start))
            reports.append(report_positions(state))
        return reports, times

    return run


def report_positions(state: track.TrackerState) -> tuple[np.ndarray, np.ndarray]:
    """Ids and positions of the tracks that the tracker reports."""
    tracks = track.report(state)
    return tracks["track"].values, np.stack([tracks["east_m"].values, tracks["north_m"].values], axis=-1)


def sort_style(epochs: Epochs, measured: list[np.ndarray]) -> tuple[Reports, list[float]]:
    """SORT (Bewley et al., ICIP 2016) on points: constant velocity, assignment by distance, 3 hits, 1 miss.

    Boxes and their overlap become positions and a gate of 5 m, as they must for points.
    """
    means, spreads, ids, hits, misses = np.empty((0, 4)), np.empty((0, 4, 4)), [], [], []
    following, last, reports, times = 0, None, [], []
    h, r = np.eye(4)[:2], SIGMA_M**2 * np.eye(2)
    for (time_s, *_), points in zip(epochs, measured, strict=True):
        start = time.process_time()
        dt = 0.0 if last is None else time_s - last
        last = time_s
        f = np.eye(4) + dt * np.eye(4, k=2)
        q = 1.5 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
        means, spreads = means @ f.T, f @ spreads @ f.T + q
        distance = np.hypot(*(means[:, None, :2] - points[None]).transpose(2, 0, 1))
        rows, columns = linear_sum_assignment(np.where(distance <= 5.0, distance, 1e3))
        near = distance[rows, columns] <= 5.0
        rows, columns = rows[near], columns[near]
        gain = spreads[rows][:, :, :2] @ np.linalg.inv(spreads[rows][:, :2, :2] + r)
        means[rows] += (gain @ (points[columns] - means[rows, :2])[..., None])[..., 0]
        spreads[rows] = (np.eye(4) - gain @ h) @ spreads[rows]
        hit = np.isin(np.arange(len(means)), rows)
        hits = [n + 1 if k else n for n, k in zip(hits, hit, strict=True)]
        misses = [0 if k else n + 1 for n, k in zip(misses, hit, strict=True)]
        keep = [k for k, n in enumerate(misses) if n <= 1]
        fresh = np.setdiff1d(np.arange(len(points)), columns)
        means = np.r_[means[keep], np.c_[points[fresh], np.zeros((len(fresh), 2))]]
        born = np.repeat(np.diag([SIGMA_M**2] * 2 + [64.0] * 2)[None], len(fresh), axis=0)
        spreads = np.r_[spreads[keep], born]
        ids = [ids[k] for k in keep] + list(range(following, following + len(fresh)))
        hits, misses = (
            [hits[k] for k in keep] + [1] * len(fresh),
            [misses[k] for k in keep] + [0] * len(fresh),
        )
        following += len(fresh)
        times.append(1e3 * (time.process_time() - start))
        shown = [k for k, n in enumerate(hits) if n >= 3 and misses[k] == 0]
        reports.append((np.array([ids[k] for k in shown], int), means[shown, :2]))
    return reports, times


def stone_soup(joint: bool) -> Tracker:
    """Stone Soup's global nearest neighbour or its JPDA, as its tutorials build them.

    JPDA by belief propagation: enumerating joint events takes more memory than there is at these densities.
    """
    from stonesoup.dataassociator.neighbour import GNNWith2DAssignment
    from stonesoup.dataassociator.probability import JPDAwithLBP
    from stonesoup.deleter.time import UpdateTimeStepsDeleter
    from stonesoup.hypothesiser.distance import DistanceHypothesiser
    from stonesoup.hypothesiser.probability import PDAHypothesiser
    from stonesoup.initiator.simple import MultiMeasurementInitiator
    from stonesoup.measures import Mahalanobis
    from stonesoup.models.measurement.linear import LinearGaussian
    from stonesoup.models.transition.linear import CombinedLinearGaussianTransitionModel, ConstantVelocity
    from stonesoup.predictor.kalman import KalmanPredictor
    from stonesoup.tracker.simple import MultiTargetMixtureTracker, MultiTargetTracker
    from stonesoup.types.detection import Detection
    from stonesoup.types.state import GaussianState
    from stonesoup.updater.kalman import KalmanUpdater

    model = LinearGaussian(4, (0, 2), SIGMA_M**2 * np.eye(2))
    predictor = KalmanPredictor(CombinedLinearGaussianTransitionModel([ConstantVelocity(1.5)] * 2))
    updater = KalmanUpdater(model)
    by_distance = GNNWith2DAssignment(
        DistanceHypothesiser(predictor, updater, measure=Mahalanobis(), missed_distance=3.0)
    )
    density = CLUTTER / ((AREA_M[2] - AREA_M[0]) * (AREA_M[3] - AREA_M[1]))
    by_probability = JPDAwithLBP(
        hypothesiser=PDAHypothesiser(
            predictor, updater, clutter_spatial_density=density, prob_detect=DETECTED
        )
    )
    initiator = MultiMeasurementInitiator(
        GaussianState(np.zeros((4, 1)), np.diag([SIGMA_M**2, 64.0] * 2)),
        UpdateTimeStepsDeleter(2), by_distance, updater, measurement_model=model, min_points=3,
    )  # fmt: skip
    kind = MultiTargetMixtureTracker if joint else MultiTargetTracker

    def run(epochs: Epochs, measured: list[np.ndarray]) -> tuple[Reports, list[float]]:
        epoch = datetime.datetime(2026, 1, 1)

        def detector():
            for (time_s, *_), points in zip(epochs, measured, strict=True):
                when = epoch + datetime.timedelta(seconds=time_s)
                yield when, {Detection(p[:, None], timestamp=when, measurement_model=model) for p in points}

        associator = by_probability if joint else by_distance
        stepper = iter(kind(initiator, UpdateTimeStepsDeleter(4), detector(), associator, updater))
        names: dict[str, int] = {}
        reports, times = [], []
        for _ in epochs:
            start = time.process_time()
            _, tracks = next(stepper)
            times.append(1e3 * (time.process_time() - start))
            ids = [names.setdefault(one.id, len(names)) for one in tracks]
            places = [[float(one.state_vector[0]), float(one.state_vector[2])] for one in tracks]
            reports.append((np.array(ids, int), np.array(places).reshape(-1, 2)))
        return reports, times

    return run


def row(name: str, epochs: Epochs, measured: list[np.ndarray], tracker: Tracker) -> dict:
    """Scores and median time of one tracker."""
    reports, times = tracker(epochs, measured)
    scores = score(epochs, reports)
    return {
        "name": name, "value": float(np.median(times[3:])), "unit": "ms", "frames": len(epochs),
        **{k: scores[k] for k in ("completeness", "purity", "false_per_frame", "identity_switches")},
    }  # fmt: skip


def paints(whose: list[np.ndarray], share: float, seed: int) -> list[np.ndarray]:
    """Made-up features: every vehicle one of twelve colours in eight numbers, told with 10 % noise.

    A share of the detections has one, chosen at random.
    """
    rng = np.random.default_rng(seed)
    colours = rng.normal(0, 0.5, (12, 8))
    out = []
    for ids in whose:
        feature = colours[np.where(ids >= 0, ids, rng.integers(12, size=len(ids))) % 12]
        feature = feature + rng.normal(0, 0.1, feature.shape)
        feature[rng.random(len(ids)) >= share] = np.nan
        out.append(feature)
    return out


def memory_row(frames: int) -> dict:
    """Growth of the process between a tenth and the whole of many frames. [MB]"""
    epochs = traffic(60)
    measured, _ = measure(epochs, 0)
    state, first = track.start(DETECTIONS_DESIGN), 0
    for k in range(frames):
        points = measured[k % len(measured)]
        n = len(points)
        covariance = np.repeat(SIGMA_M**2 * np.eye(2)[None], n, axis=0)
        found = track.Detections(points, covariance, np.full(n, 4.0), np.ones(n))
        state = track.step_detections(state, found, k / RATE_HZ, GRID)
        if k == frames // 10:
            first = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - first) / 1024
    return {"name": f"growth of memory over {frames} frames", "value": grown, "unit": "MB", "frames": frames}


def main() -> None:
    """Run, print and perhaps write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="about a minute")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    epochs = traffic(30 if arguments.quick else 120)
    few = 6 if arguments.quick else 30
    measured, whose = measure(epochs, 1)
    default = DETECTIONS_DESIGN
    changed = lambda **kw: ours(default.replace(kw))  # noqa: E731
    ours(default)(epochs[:6], measured[:6])  # compiles
    memory = memory_row(1000 if arguments.quick else 10_000)  # before the peers, whose peak would hide it
    one_mode = changed(**{"association.method": "gnn", "motion.model": "constant-velocity"})
    rows = [
        row("ours", epochs, measured, ours(default)),
        row("ours, strict", epochs, measured, ours(strict_design(default))),
        row("ours, GNN", epochs, measured, changed(**{"association.method": "gnn"})),
        row("ours, GNN, one mode of motion", epochs, measured, one_mode),
        row("ours, JPDA", epochs, measured, changed(**{"association.method": "jpda"})),
    ]
    for scans in (2, 3, 6):
        window = changed(**{"association.scans": scans})
        rows.append(row(f"ours, window of {scans} scans", epochs, measured, window))
    lanes = tuple(lane.points for lane in read_recording(RECORDING).network.of_kind("car", "internal"))
    mapped = ours(default.replace({"roads.prior": True}), roads=lanes)
    rows.append(row("ours, with the road map", epochs, measured, mapped))
    for share in (0.1, 1.0):
        told = ours(default, paints(whose, share, 3))
        rows.append(row(f"ours, {share:.0%} of detections with spectra", epochs, measured, told))
    rows.append(row("SORT-style", epochs, measured, sort_style))
    if find_spec("stonesoup"):
        some = few * 2 if arguments.quick else len(epochs)
        rows.append(row("Stone Soup GNN", epochs[:some], measured[:some], stone_soup(False)))
        rows.append(row("ours, the same frames", epochs[:some], measured[:some], ours(default)))
        rows.append(row("Stone Soup JPDA (LBP)", epochs[:few], measured[:few], stone_soup(True)))
        rows.append(row("ours, the same frames", epochs[:few], measured[:few], ours(default)))
    else:
        print("Stone Soup: skipped, not installed (pip install 'glintrack[stonesoup]')")
    for r in rows:
        is_peer = r["name"].startswith(("SORT", "Stone Soup"))
        r["peer"] = r["name"] if is_peer else None
        r["ratio"] = r["value"] / rows[0]["value"] if is_peer else None
    rows.append(memory)
    for r in rows:
        scores = "".join(f"  {k} {r[k]:.3f}" for k in list(r)[4:8] if k not in ("peer", "ratio"))
        beside = f"{r['ratio']:8.1f} ×" if r.get("ratio") else " " * 10
        print(f"{r['name']:42s} {r['value']:9.2f} {r['unit']} {beside} {r['frames']:6d} frames{scores}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1))
        print(f"wrote {arguments.json}")


if __name__ == "__main__":
    main()
