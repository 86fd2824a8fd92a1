"""Trackers on the same detections: custody, completeness, purity and time.

``python benchmarks/tracking.py [--quick] [--json FILE]``. The detections are the truth of the
embedded recording with misses, clutter and noise of position; vehicles that stand are not detected, as change
detection would not. Ours (several designs), a SORT-style baseline, Stone Soup's GNN, and on fewer frames
Stone Soup's JPDA; then memory over many frames. ``ratio`` is the peer's time over that of our default. Times
are the processor's, which a loaded machine stretches less than the wall clock's.

``python benchmarks/tracking.py --flights motorway:1 quickstart:12`` simulates each flight
(`tools/record_flight.py`), detects once in all elements, and gives every tracker these detections. Peers get
those above a log-likelihood ratio of `PEER_NAT`; ours weighs them all. This threshold and the spread of speed
of the peers' new tracks, `FLIGHT_M_S`, were the best for them on the training flights.
"""

import argparse
import datetime
import json
import resource
import sys
import time
from collections.abc import Callable
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.optimize import linear_sum_assignment

sys.path.insert(0, str(Path(__file__).parents[1]))
import glintrack
from glintrack import metrics, track
from glintrack.scene.traffic import read_recording
from glintrack.track import reporting
from glintrack.track import stone_soup as conversion
from glintrack.track.files import DETECTIONS_DESIGN, strict_design
from tools.calibrate import Flight, design_of, detect_flight
from tools.record_flight import record_flight

RECORDING = Path(glintrack.__file__).parent / "data" / "traffic" / "embedded.nc"
AREA_M = (-330.0, -210.0, 330.0, 210.0)
GRID = track.Grid((28, 44), (AREA_M[0] + 7.5, AREA_M[3] - 7.5), 15.0)
START_S, RATE_HZ, SIGMA_M, DETECTED, CLUTTER = 20.0, 2.0, 0.5, 0.85, 40
MOVING_M_S = 1.0
FLIGHT_M_S, SCORED_S, PEER_NAT = 18.0, 4.0, -1.0  # of simulated flights
SCORES = ("completeness", "purity", "false_per_frame", "identity_switches")
FLIGHT_SCORES = ("custody", "completeness_visible", "purity", "false_per_km2", "identity_switches")

Epochs = list[tuple[float, xr.Dataset]]  # time, truth
Measured = list[track.Detections]
Tracker = Callable[[Epochs, Measured], tuple[list[xr.Dataset], list[float]]]


def traffic(frames: int, rate_hz: float = RATE_HZ, start_s: float = START_S) -> Epochs:
    """Vehicles inside the area at each epoch."""
    recorded = read_recording(RECORDING).traffic
    out = []
    for k in range(frames):
        ids, states = recorded.at(start_s + k / rate_hz)
        x, y = states[:, 0], states[:, 1]
        inside = (x >= AREA_M[0]) & (x <= AREA_M[2]) & (y >= AREA_M[1]) & (y <= AREA_M[3])
        out.append((k / rate_hz, truth_of(ids[inside], states[inside])))
    return out


def measure(epochs: Epochs, seed: int) -> Measured:
    """Return detections of each epoch in random order."""
    rng = np.random.default_rng(seed)
    measured = []
    for _, truth in epochs:
        at, moves = columns_of(truth, "m"), np.hypot(*columns_of(truth, "speed_m_s").T) >= MOVING_M_S
        seen = (rng.random(len(at)) < DETECTED) & moves
        count = rng.poisson(CLUTTER)
        clutter = rng.uniform(AREA_M[:2], AREA_M[2:], (count, 2))
        points = np.r_[at[seen] + rng.normal(0, SIGMA_M, (seen.sum(), 2)), clutter]
        order, n = rng.permutation(len(points)), len(points)
        covariance = np.repeat(SIGMA_M**2 * np.eye(2)[None], n, axis=0)
        measured.append(track.Detections(points[order], covariance, np.full(n, 4.0), np.ones(n)))
    return measured


def columns_of(rows: xr.Dataset, quantity: str) -> np.ndarray:
    """Two columns, of the east and the north."""
    return np.stack([rows[f"{axis}_{quantity}"].values for axis in ("east", "north")], axis=-1)


def truth_of(ids: np.ndarray, states: np.ndarray) -> xr.Dataset:
    """Dataset of the schema ``truth``."""
    east, north, heading, *speed = states[:, :5].T
    none = np.zeros(len(ids))
    columns = {
        "m": {"east_m": east, "north_m": north, "up_m": none,
              "length_m": none + 4.5, "width_m": none + 1.8, "height_m": none + 1.5},
        "m s-1": {"east_speed_m_s": speed[0], "north_speed_m_s": speed[1]}, "rad": {"heading_rad": heading},
    }  # fmt: skip
    return xr.Dataset(
        {k: ("vehicle", v, {"units": u}) for u, some in columns.items() for k, v in some.items()},
        coords={"vehicle": np.asarray(ids, np.int64)},
    )


def score(epochs: Epochs, reports: list[xr.Dataset], first_s: float = 0.0) -> dict[str, float]:
    """Scores of the epochs from a time on."""
    pairs = zip(epochs, reports, strict=False)
    return metrics.summarize(
        [metrics.score_epoch(report, truth, AREA_M) for (t, truth), report in pairs if t >= first_s]
    )


def ours(design: track.TrackDesign, roads: tuple[np.ndarray, ...] = (), grid: track.Grid = GRID) -> Tracker:
    """Our tracker with one design, and the reports after its lag."""

    def run(epochs: Epochs, measured: Measured) -> tuple[list[xr.Dataset], list[float]]:
        state, pending, reports, times = track.start(design, roads=roads), (), [], []
        for (time_s, _), found in zip(epochs, measured, strict=True):
            start = time.process_time()
            state = track.step_detections(state, found, time_s, grid)
            pending, due = reporting.advance(pending, state, track.report(state))
            times.append(1e3 * (time.process_time() - start))
            reports += due
        return [*reports, *reporting.flush(pending)], times

    return run


def true_velocities(truth: xr.Dataset, points: np.ndarray) -> np.ndarray:
    """Velocity of the vehicle within 4 m of each point, else 0. [m s⁻¹]"""
    apart = np.hypot(*(points[:, None] - columns_of(truth, "m")[None]).transpose(2, 0, 1))
    near = apart.argmin(axis=1)
    close = apart[np.arange(len(points)), near] <= 4.0
    return np.where(close[:, None], columns_of(truth, "speed_m_s")[near], 0.0)


def baseline(sort: bool = True, oracle: bool = False, birth_m_s: float = 8.0) -> Tracker:
    """SORT (Bewley et al., ICIP 2016) on points, or plain nearest neighbours; both with constant velocity.

    Both assign detections at least total distance, and report a track while it is measured, from its third
    measurement. SORT: within 5 m, which stands for the overlap of boxes; deleted after 2 misses. Plain:
    within 3 standard deviations; deleted after 5 misses. The oracle knows the velocity of a new track.
    """
    gate, misses_allowed, birth_m_s = (5.0, 1, birth_m_s) if sort else (3.0, 4, 1.0 if oracle else birth_m_s)

    def run(epochs: Epochs, measured: Measured) -> tuple[list[xr.Dataset], list[float]]:
        means, spreads, ids, hits, misses = np.empty((0, 4)), np.empty((0, 4, 4)), *np.zeros((3, 0), int)
        following, last, reports, times = 0, epochs[0][0], [], []
        for (time_s, truth), found in zip(epochs, measured, strict=True):
            points = found.position
            velocity = true_velocities(truth, points) if oracle else np.zeros((len(points), 2))
            start = time.process_time()
            dt, last = time_s - last, time_s
            f = np.eye(4) + dt * np.eye(4, k=2)
            q = 1.5 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
            means, spreads = means @ f.T, f @ spreads @ f.T + q
            apart = points[None] - means[:, None, :2]
            innovation = spreads[:, None, :2, :2] + found.covariance[None]
            inverse = np.eye(2) if sort else np.linalg.inv(innovation)
            cost = np.sqrt((apart[..., None, :] @ inverse @ apart[..., None])[..., 0, 0])
            rows, columns = linear_sum_assignment(np.where(cost <= gate, cost, 1e3))
            near = cost[rows, columns] <= gate
            rows, columns = rows[near], columns[near]
            gain = spreads[rows][:, :, :2] @ np.linalg.inv(innovation[rows, columns])
            means[rows] += (gain @ apart[rows, columns, :, None])[..., 0]
            spreads[rows] -= gain @ spreads[rows, :2]
            hit, fresh = np.isin(np.arange(len(means)), rows), np.setdiff1d(np.arange(len(points)), columns)
            misses, hits = np.where(hit, 0, misses + 1), hits + hit
            keep, n = misses <= misses_allowed, len(fresh)
            born = np.tile(birth_m_s**2 * np.eye(4), (n, 1, 1))
            born[:, :2, :2] = found.covariance[fresh]
            means = np.r_[means[keep], np.c_[points[fresh], velocity[fresh]]]
            spreads = np.r_[spreads[keep], born]
            ids = np.r_[ids[keep], np.arange(following, following + n)]
            hits, misses = np.r_[hits[keep], np.ones(n, int)], np.r_[misses[keep], np.zeros(n, int)]
            following += n
            times.append(1e3 * (time.process_time() - start))
            shown = (hits >= 3) & (misses == 0)
            report = ids[shown], means[shown], spreads[shown], misses[shown] > 0
            reports.append(reporting.tracks_to_dataset(time_s, *report))
        return reports, times

    return run


def stone_soup(joint: bool, birth_m_s: float = 8.0) -> Tracker:
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
        GaussianState(np.zeros((4, 1)), np.diag([SIGMA_M**2, birth_m_s**2] * 2)),
        UpdateTimeStepsDeleter(2), by_distance, updater, measurement_model=model, min_points=3,
    )  # fmt: skip
    kind = MultiTargetMixtureTracker if joint else MultiTargetTracker

    def run(epochs: Epochs, measured: Measured) -> tuple[list[xr.Dataset], list[float]]:
        epoch = datetime.datetime(2026, 1, 1)

        def detector():
            for (time_s, _), found in zip(epochs, measured, strict=True):
                when = epoch + datetime.timedelta(seconds=float(time_s))
                yield when, set(conversion.to_detections(found, time_s, epoch))

        associator = by_probability if joint else by_distance
        stepper = iter(kind(initiator, UpdateTimeStepsDeleter(4), detector(), associator, updater))
        reports, times = [], []
        for time_s, _ in epochs:
            start = time.process_time()
            _, tracks = next(stepper)
            times.append(1e3 * (time.process_time() - start))
            reports.append(conversion.from_tracks(tracks, time_s, epoch))
        return reports, times

    return run


def row(name: str, epochs: Epochs, measured: Measured, tracker: Tracker, first_s: float = 0.0) -> dict:
    """Scores and median time of one tracker."""
    reports, times = tracker(epochs, measured)
    scores = score(epochs, reports, first_s)
    return {
        "name": name, "value": float(np.median(times[3:])), "unit": "ms", "frames": len(epochs),
        **{k: scores[k] for k in (FLIGHT_SCORES if first_s else SCORES)},
    }  # fmt: skip


def strong_detections(found: track.Detections) -> track.Detections:
    """Return the positions and sizes of the detections that peers get."""
    ratio = found.log_likelihood_ratio
    keep = np.ones(len(found), bool) if ratio is None else ratio >= PEER_NAT
    names = ("position", "covariance", "extent", "contrast")
    return track.Detections(*(getattr(found, name)[keep] for name in names))


def flight_rows(flight: Flight) -> list[dict]:
    """All trackers on the detections of a simulated flight."""
    epochs = [(float(time_s), truth) for time_s, _, _, truth in flight.found]
    every = [found for _, found, _, _ in flight.found]
    strong = [strong_detections(one) for one in every]
    design, grid = design_of(flight.case, "all", {}), flight.found[0][2]
    ours(design, grid=grid)(epochs[:6], every[:6])  # compiles
    trackers = {
        "glintrack": ours(design, grid=grid),
        "glintrack, MHT": ours(design.replace({"association.method": "mht"}), grid=grid),
        "Stone Soup GNN": stone_soup(False, FLIGHT_M_S), "SORT": baseline(birth_m_s=FLIGHT_M_S),
        "nearest neighbour": baseline(sort=False, birth_m_s=FLIGHT_M_S),
        "nearest neighbour, true birth velocity": baseline(sort=False, oracle=True),
    }  # fmt: skip
    return [
        row(name, epochs, every if "glintrack" in name else strong, tracker, SCORED_S)
        for name, tracker in trackers.items()
    ]


def memory_row(frames: int) -> dict:
    """Growth of the process between a tenth and the whole of many frames. [MB]"""
    measured = measure(traffic(60), 0)
    state, first = track.start(DETECTIONS_DESIGN), 0
    for k in range(frames):
        state = track.step_detections(state, measured[k % len(measured)], k / RATE_HZ, GRID)
        if k == frames // 10:
            first = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    grown = (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - first) / 1024
    return {"name": f"growth of memory over {frames} frames", "value": grown, "unit": "MB", "frames": frames}


def main() -> None:
    """Run, print and perhaps write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="about a minute")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument(
        "--flights", nargs="+", default=[], help="NAME:SEED of simulated flights, or given detections"
    )
    arguments = parser.parse_args()
    for name in arguments.flights:
        for one in flight_rows(detect_flight(record_flight(name), "all")):
            print(
                f"{name:16}{one['name']:40}", *(f"{key} {one[key]:.3f}" for key in ("value", *FLIGHT_SCORES))
            )
    if arguments.flights:
        return
    epochs = traffic(30 if arguments.quick else 120)
    few = 6 if arguments.quick else 30
    measured = measure(epochs, 1)
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
    lanes = tuple(lane.points for lane in read_recording(RECORDING).network.of_kind("car", "internal"))
    mapped = ours(default.replace({"roads.prior": True}), roads=lanes)
    rows.append(row("ours, with the road map", epochs, measured, mapped))
    rows.append(row("SORT-style", epochs, measured, baseline()))
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
