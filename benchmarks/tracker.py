"""Tracking step, assignment and change detection, beside a dense SciPy assignment and plain NumPy.

``python benchmarks/tracker.py [--quick] [--json FILE] [--plot FILE]``. Alternates ours and the peer in the
same run; the median of the alternations counts. ``ratio`` is the peer's time over ours. Steps with queries
are those of detections, in processor time, which a loaded machine stretches less than the wall clock's. What
they ask is served in the next step: the spectrum of the detection that lies there, or of the road.
"""

import argparse
import importlib.util
import json
import resource
import time
from collections.abc import Callable
from itertools import cycle
from pathlib import Path

import numpy as np
import xarray as xr
from scipy import ndimage
from scipy.optimize import linear_sum_assignment
from scipy.spatial import KDTree

from glintrack import track
from glintrack.core.schema import RADIANCE, SCHEMAS
from glintrack.track.association import associate
from glintrack.track.detect.background import BackgroundDetector
from glintrack.track.files import DETECTIONS_DESIGN
from glintrack.track.motion import Modes, combined, motion_over, predict_modes, update_modes

STEPS = ("default design", "asking at once", "GNN, one mode", "GNN", "MHT")


def alternating(ours, peer, repeats: int) -> tuple[float, float]:
    """Median time of each, run in turns after one warm-up. [ms]"""
    ours(), peer()
    times = np.empty((repeats, 2))
    for k in range(repeats):
        for which, work in enumerate((ours, peer)):
            start = time.perf_counter()
            work()
            times[k, which] = 1e3 * (time.perf_counter() - start)
    return tuple(np.median(times, axis=0).tolist())


def traffic(count: int, rng) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """States at constant density (200 per 660 m × 420 m), and their detections with misses and clutter."""
    side = np.sqrt(count / 200 * 660 * 420)
    mean = np.column_stack([rng.uniform(0, side, (count, 2)), rng.normal(0, 8, (count, 2))])
    covariance = np.repeat(np.diag([1.0, 1.0, 4.0, 4.0])[None], count, axis=0)
    seen = mean[rng.random(count) < 0.85, :2] + rng.normal(0, 0.6, (1, 2))
    measured = np.concatenate([seen, rng.uniform(0, side, (count // 5, 2))])
    noise = np.repeat(0.36 * np.eye(2)[None], len(measured), axis=0)
    return mean, covariance, measured, noise


def ours_step(mean, covariance, measured, noise):
    """Predict, gate, assign and update with one mode of motion."""
    motion = motion_over(
        track.TrackDesign().replace(
            {"motion.acceleration_psd_m2_s3": 4.0, "motion.model": "constant-velocity"}
        ),
        0.5,
    )
    n = len(mean)
    modes = Modes(mean[:, None], covariance[:, None], np.ones((n, 1)))
    modes = predict_modes(modes, motion, np.full(n, np.inf))
    mean, covariance = combined(modes)
    rows, columns = associate.gate(mean, covariance, measured, noise, 13.8)
    cost = associate.negative_log_likelihood(modes, np.ones(1), rows, columns, measured, noise)
    chosen = associate.assign(rows, columns, cost - 8.6, np.full(n, 1.9), len(measured))
    hit = np.flatnonzero(chosen >= 0)
    first = np.searchsorted(hit, np.arange(n + 1))
    modes = update_modes(modes, motion, np.ones(n), first, chosen[hit], np.ones(len(hit)), measured, noise)
    return modes, chosen


def numpy_step(mean, covariance, measured, noise):
    """The same filter in plain NumPy with a dense assignment."""
    n, m, dt = len(mean), len(measured), 0.5
    f = np.eye(4) + dt * np.eye(4, k=2)
    q = 4.0 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(2))
    mean, covariance = mean @ f.T, f @ covariance @ f.T + q
    innovation = measured[None] - mean[:, None, :2]
    spread = covariance[:, None, :2, :2] + noise[None]
    distance = np.einsum("nmi,nmij,nmj->nm", innovation, np.linalg.inv(spread), innovation)
    cost = 0.5 * (distance + np.log(np.linalg.det(spread))) + np.log(2 * np.pi) - 8.6
    table = np.full((n, m + n), 1e6)
    table[:, :m] = np.where(distance <= 13.8, cost, 1e6)
    table[np.arange(n), m + np.arange(n)] = 1.9
    _rows, columns = linear_sum_assignment(table)
    chosen = np.where(columns < m, columns, -1)
    hit = chosen >= 0
    gain = covariance[hit][:, :, :2] @ np.linalg.inv(spread[hit, chosen[hit]])
    mean[hit] += (gain @ innovation[hit, chosen[hit], :, None])[..., 0]
    covariance[hit] -= gain @ covariance[hit][:, :2]
    return (mean, covariance), chosen


def numpy_change(state, image):
    """Clipped exponential background with one global noise scale, and SciPy's labels."""
    difference = image - state["mean"]
    scale = 1.4826 * np.median(np.abs(difference[::4, ::4]))
    low = ndimage.minimum_filter(state["mean"], 3)
    high = ndimage.maximum_filter(state["mean"], 3)
    excess = np.maximum(np.maximum(image - high, low - image), 0) / scale
    labels, count = ndimage.label(ndimage.gaussian_filter(excess**2, 0.8) > 16, np.ones((3, 3)))
    centres = ndimage.center_of_mass(excess, labels, np.arange(1, count + 1))
    state["mean"] = state["mean"] + np.where(labels > 0, 0.02, 0.15) * difference
    return centres


def opencv_change(images: list[np.ndarray]) -> Callable[[], np.ndarray]:
    """OpenCV's mixture of Gaussians, which takes the images in turn and says what is foreground."""
    import cv2

    model, turn = cv2.createBackgroundSubtractorMOG2(detectShadows=False), cycle(images)
    return lambda: model.apply(next(turn))


def frames(shape: tuple[int, int], gsd_m: float, cars: int, count: int, rng) -> list[np.ndarray]:
    """Textured ground with square cars that move 5 m a frame."""
    ground = ndimage.gaussian_filter(rng.normal(size=shape), 2) * 4 + 8
    place = rng.uniform(8, np.array(shape) - 8, (cars, 2))
    step = rng.normal(0, 5 / gsd_m, (cars, 2))
    half = max(1, round(1.5 / gsd_m))
    out = []
    for k in range(count):
        image = ground + rng.normal(0, 0.15, shape)
        for row, column in np.mod(place + k * step, np.array(shape) - 16).astype(int) + 8:
            image[row - half : row + half, column - half : column + half] = 20
        out.append(image.astype(np.float32))
    return out


def dataset(pan: np.ndarray, gsd_m: float) -> xr.Dataset:
    """A frame of the schema ``image``."""
    stokes = next(name for name, variable in SCHEMAS["image"].items() if "stokes" in variable.dims)
    height, width = pan.shape
    return xr.Dataset(
        {
            "pan": (("y", "x"), pan, {"units": RADIANCE}),
            stokes: (
                ("y", "x", "stokes"),
                np.zeros((height, width, 3), np.float32),
                {"units": RADIANCE, "stokes_frame": "meridian"},
            ),
            "dolp": (("y", "x"), np.zeros_like(pan), {"units": "1"}),
        },
        coords={
            "y": ("y", -gsd_m * np.arange(height), {"units": "m"}),
            "x": ("x", gsd_m * np.arange(width), {"units": "m"}),
            "stokes": ["I", "Q", "U"],
        },
    )


def row(name: str, ours_ms: float, peer: str, peer_ms: float | None) -> dict:
    ratio = None if peer_ms is None else peer_ms / ours_ms
    return {"name": name, "value": ours_ms, "unit": "ms", "peer": peer, "ratio": ratio}


def filter_rows(quick: bool, rng) -> list[dict]:
    rows = []
    for count in (200, 2000) if quick else (200, 2000, 20000):
        problem = traffic(count, rng)
        if count > 2000:  # the dense table would take 10 GB
            ours_step(*problem)
            start = time.perf_counter()
            ours_step(*problem)
            rows.append(
                row(f"filter step, {count} targets", 1e3 * (time.perf_counter() - start), "none", None)
            )
            continue
        same = np.mean(ours_step(*problem)[1] == numpy_step(*problem)[1])
        if same < 1:
            raise RuntimeError(f"`assignment` must equal SciPy's, got {same:.3f} of {count} equal")
        ours, peer = alternating(
            lambda p=problem: ours_step(*p), lambda p=problem: numpy_step(*p), 3 if count > 200 else 11
        )
        rows.append(row(f"filter step, {count} targets", ours, "NumPy + dense SciPy assignment", peer))
    return rows


def frame_rows(quick: bool, rng) -> list[dict]:
    rows = []
    for shape, gsd_m in (((280, 440), 1.5), ((560, 880), 0.75)):
        images = frames(shape, gsd_m, 200, 6 if quick else 20, rng)
        detector = BackgroundDetector(track.TrackDesign().detect)
        grid = track.Grid(shape, (0.0, 0.0), gsd_m)
        seen = [track.Frame(0.0, dataset(image, gsd_m), grid=grid, interval_s=0.5) for image in images]
        ours, plain = {"memory": detector.start(seen[0]), "k": 0}, {"mean": images[-1], "k": 0}

        def detect(ours=ours, seen=seen, detector=detector):
            frame = seen[ours["k"] % len(seen)]
            found = detector.detect(ours["memory"], frame)
            nothing = track.Association(np.zeros(len(found), bool), np.empty((0, 2)))
            ours["memory"] = detector.update(ours["memory"], frame, found, nothing)
            ours["k"] += 1

        def peer(plain=plain, images=images):
            numpy_change(plain, images[plain["k"] % len(images)])
            plain["k"] += 1

        a, b = alternating(detect, peer, len(images))
        size = f"{shape[1]} × {shape[0]}"
        rows.append(row(f"change detection, {size}", a, "NumPy and scipy.ndimage, global noise scale", b))
        if importlib.util.find_spec("cv2"):
            a, b = alternating(detect, opencv_change(images), len(images))
            rows.append(row(f"change detection beside OpenCV, {size}", a, "OpenCV's MOG2", b))
        state, times = track.start(), []
        for k, image in enumerate(images):
            frame = track.Frame(0.5 * k, dataset(image, gsd_m))
            start = time.perf_counter()
            state, _ = track.step(state, frame, None, column_of)
            times.append(1e3 * (time.perf_counter() - start))
        rows.append(row(f"whole step, {size}", float(np.median(times)), "none", None))
    return rows


def moving(count: int, frames: int, rng) -> tuple[float, list[track.Detections]]:
    """Side of a square, and detections of vehicles that cross it at the density of `traffic`. [m]"""
    side = np.sqrt(count / 200 * 660 * 420)
    place, speed = rng.uniform(0, side, (count, 2)), rng.normal(0, 8, (count, 2))
    out = []
    for k in range(frames):
        seen = rng.random(count) < 0.85
        points = np.mod(place + 0.5 * k * speed, side)[seen] + rng.normal(0, 0.5, (seen.sum(), 2))
        points = np.concatenate([points, rng.uniform(0, side, (count // 5, 2))])
        n = len(points)
        noise = np.repeat(0.25 * np.eye(2)[None], n, axis=0)
        out.append(track.Detections(points, noise, np.full(n, 4.0), np.ones(n)))
    return side, out


def served(
    queries: tuple, found: track.Detections, colours: np.ndarray, rng
) -> tuple[np.ndarray | None, np.ndarray | None]:
    """Features of the detections nearest to where spectra were asked, and of the road beside."""
    if not queries:
        return None, None
    asked = np.array([(q.east_m, q.north_m) for q in queries])
    road = np.array([q.track_id < 0 for q in queries])
    features = np.full((len(found), colours.shape[1]), np.nan)
    away, nearest = KDTree(found.position).query(asked[~road])
    nearest = nearest[away < 1.5]
    features[nearest] = colours[nearest % len(colours)] + rng.normal(0, 0.1, (len(nearest), colours.shape[1]))
    return features, 1 + rng.normal(0, 0.1, (road.sum(), colours.shape[1]))


def column_of(ground: np.ndarray) -> np.ndarray:
    """Superpixel column that sees a point."""
    return (ground[:, 0] / 1.5).astype(int)


def designs() -> dict[str, track.TrackDesign]:
    """The designs whose steps are timed, by name."""
    asking = DETECTIONS_DESIGN.replace({"query.policy": "entropy"})
    one_mode = {"association.method": "gnn", "motion.model": "constant-velocity"}
    settings = (
        track.TrackDesign(),
        track.TrackDesign().replace({"query.at": "detection"}),
        asking.replace(one_mode),
        asking.replace({"association.method": "gnn"}),
        asking,
    )
    return dict(zip(STEPS, settings, strict=True))


def step_ms(design: track.TrackDesign, side: float, scans: list[track.Detections], rng) -> float:
    """Median processor time of a whole step of detections with queries, past the first six. [ms]"""
    cells = int(np.ceil(side / 15))
    grid = track.Grid((cells, cells), (7.5, side - 7.5), 15.0)
    colours = rng.normal(0, 0.5, (12, design.identity.bins))
    state, queries, times = track.start(design), (), []
    for k, found in enumerate(scans):
        start = time.process_time()
        seen = track.given_detections(state, found, 0.5 * k, grid)
        queries = queries or track.query_detections(state, seen, column_of)
        taken = time.process_time() - start
        features, road = served(queries, seen.found, colours, rng)
        start = time.process_time()
        state = track.step_detections(state, seen, 0.5 * k, grid, features, road)
        state, queries = track.query_predictions(state, column_of)
        times.append(1e3 * (time.process_time() - start + taken))
    return float(np.median(times[6:]))


def step_rows(quick: bool, rng) -> list[dict]:
    """Whole steps of detections with queries: processor time, by design and number of vehicles."""
    rows = []
    for count in (200, 2000) if quick else (200, 2000, 20000):
        side, scans = moving(count, 14 if count > 200 else 60, rng)
        for name, design in designs().items():
            took = step_ms(design, side, scans, rng)
            rows.append(row(f"step with queries, {name}, {count}", took, "none", None))
    return rows


def memory_over(frames: int, rng) -> tuple[list[int], list[float]]:
    """Peak memory of the process after so many frames of a flight that goes on and on. [MB]"""
    _, scans = moving(200, 40, rng)
    grid = track.Grid((38, 38), (7.5, 562.5), 15.0)
    state, counts, peaks = track.start(DETECTIONS_DESIGN), [], []
    for k in range(frames):
        state = track.step_detections(state, scans[k % len(scans)], 0.5 * k, grid)
        if k % (frames // 50) == 0:
            counts.append(k)
            peaks.append(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024)
    return counts, peaks


def draw(rows: list[dict], memory: tuple[list[int], list[float]], path: Path) -> None:
    """Step time over targets with its limits, change detection, and memory over frames."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 4), layout="constrained")
    left, middle, right = figure.subplots(1, 3)
    for name in STEPS:
        start = f"step with queries, {name}, "
        points = [
            (int(r["name"].removeprefix(start)), r["value"])
            for r in rows
            if r["name"].startswith(start) and r["name"].removeprefix(start).isdigit()
        ]
        left.loglog(*zip(*points, strict=True), "o-", label=name)
    left.loglog((200, 2000, 20000), (1, 5, 60), "k_", ms=22, label="wanted at most")
    left.set(xlabel="vehicles", ylabel="step with queries: processor time / ms")
    left.legend()
    left.grid(alpha=0.3, which="both")
    seen = {r["name"]: r["value"] for r in rows if " × " in r["name"] and "OpenCV" not in r["name"]}
    sizes = [name.removeprefix("whole step, ") for name in seen if name.startswith("whole step")]
    for side, what in ((-0.2, "change detection"), (0.2, "whole step")):
        values = [seen[f"{what}, {size}"] for size in sizes]
        middle.bar(np.arange(len(sizes)) + side, values, 0.36, label=what)
    middle.plot([0.6, 1.0], [8, 8], "k", lw=2, label="change detection wanted at most")
    middle.set(xticks=range(len(sizes)), xticklabels=sizes, xlabel="cells", ylabel="time of a frame / ms")
    middle.set_ylim(0, 1.35 * max(*seen.values(), 8))
    middle.legend(loc="upper left")
    right.plot(*memory)
    right.set(xlabel="frames", ylabel="peak memory / MB", ylim=(0, 1.2 * max(memory[1])))
    right.grid(alpha=0.3)
    figure.savefig(path, dpi=110)


def main() -> None:
    """Run, print and perhaps write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    parser.add_argument("--plot", type=Path, help="draw times and memory to this file")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    memory = memory_over(1000 if arguments.quick else 10_000, rng)  # before peers, whose peak would hide it
    rows = filter_rows(arguments.quick, rng) + frame_rows(arguments.quick, rng)
    rows += step_rows(arguments.quick, rng)
    grown = memory[1][-1] - memory[1][len(memory[1]) // 10]
    frames = memory[0][-1] + memory[0][1]
    rows.append({**row(f"growth of memory over {frames} frames", grown, "none", None), "unit": "MB"})
    if arguments.plot:
        draw(rows, memory, arguments.plot)
        print(f"wrote {arguments.plot}")
    reason = "not compared here" if importlib.util.find_spec("stonesoup") else "not installed"
    for r in rows:
        beside = "" if r["ratio"] is None else f"{r['ratio']:8.1f} × {r['peer']}"
        print(f"{r['name']:36s} {r['value']:9.2f} {r['unit']}  {beside}")
    print(f"{'Stone Soup GNN':36s}   skipped: {reason}")
    rows.append({"name": "Stone Soup GNN", "value": None, "unit": "ms", "peer": reason, "ratio": None})
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1))
        print(f"wrote {arguments.json}")


if __name__ == "__main__":
    main()
