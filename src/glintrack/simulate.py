"""The loop of Figure 1: fly one design over a city, track what moves, ask the sensor for spectra, score it.

The one feedback edge is a value: the tracker's queries of one frame are served by the sensor in the next.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from importlib.metadata import version

import numpy as np
import xarray as xr

from . import metrics, track
from .atmosphere import solve_tables
from .camera import Camera, Pose
from .config import Case
from .flight import Flight
from .ortho import orthorectify
from .records import ServedQueries, SpectralQuery
from .render import Hits, Sky, build_tracer, shade, trace, unpack_sky
from .scene import City, build_scene
from .sensor import build_sensor, expose, measure_spectra, navigate, serve

Array = np.ndarray


@dataclass(frozen=True)
class Epoch:
    """One turn of one modality's loop, for whoever watches."""

    index: int
    time_s: float
    modality: str
    city: City
    sky: Sky
    camera: Camera
    hits: Hits
    reported_pose: Pose
    image: xr.Dataset
    served: ServedQueries
    detections: track.Detections
    tracks: xr.Dataset
    score: metrics.EpochScore


@dataclass(frozen=True)
class FrameRngs:
    """One generator a stage, spawned by (case, frame): a frame can be redone alone."""

    navigation: np.random.Generator
    noise: np.random.Generator
    spectra: np.random.Generator


def frame_rngs(seed: int, frame: int) -> FrameRngs:
    """Generators of one frame; the same whatever was simulated before it."""
    children = np.random.SeedSequence(entropy=seed, spawn_key=(frame,)).spawn(3)
    return FrameRngs(*(np.random.default_rng(child) for child in children))


def simulate(case: Case, watch: Callable[[Epoch], None] | None = None) -> xr.DataTree:
    """Fly one design over the scene and score the tracker (the paper's Fig. 1).

    Parameters
    ----------
    case
        The whole design. Each modality it names (pan, DoLP) closes its own loop over the same light.
    watch
        Called after every turn of a loop.

    Returns
    -------
    ``/pan`` and ``/dolp`` with completeness, false tracks and counts over ``time`` and the aggregate scores
    as attributes; ``/pan/tracks`` and so on with one row per confirmed track and frame; ``/truth`` likewise.
    An interrupt (Ctrl-C) ends the flight early and keeps the frames done.
    """
    clock = _Stopwatch()
    city, tables = build_scene(case.scene), solve_tables(case.atmosphere)
    flight = Flight(case.flight, float(tables.attrs["sun_azimuth_rad"]))
    sky = unpack_sky(tables, case.flight.altitude_m)
    sensor = build_sensor(case.sensor, sky.wavelength_um)
    tracer = build_tracer(city.at(case.flight.start_s))
    roughness, surroundings = (
        city.materials["roughness"].values,
        int(city.materials.get_index("material").get_loc("grass")),
    )
    loops = {modality: _Loop.begin(case, modality) for modality in case.modalities}
    truths: list[xr.Dataset] = []
    interrupted = False
    clock.lap("build")
    try:
        for k, t in enumerate(flight.times_s):
            true_pose = flight.pose(t)
            reported_pose = navigate(true_pose, case.navigation, frame_rngs(case.seed, k).navigation)
            scene_now, truth = city.at(t), city.truth(t)
            clock.lap("scene")
            hits = trace(
                scene_now,
                sensor.camera,
                true_pose,
                sky.sun_direction,
                roughness,
                surroundings,
                case.sensor.oversampling,
                tracer,
            )
            clock.lap("trace")
            radiance = _remember(partial(shade, hits, sky, city.materials))
            radiance(sensor.pan_weights)
            clock.lap("shade")
            turned = dict(loops)
            for modality, loop in loops.items():
                rng = frame_rngs(case.seed, k)
                served = serve(loop.queries, sensor, reported_pose)  # mirrors, one a column; dark in pan
                frame = expose(radiance, sensor, served, rng.noise, t)
                spectra = measure_spectra(served, radiance, sensor, rng.spectra)
                clock.lap("sensor")
                image = orthorectify(
                    frame,
                    sensor.camera,
                    reported_pose,
                    city.terrain,
                    case.ortho.gsd_m,
                    city.extent_m,
                    case.ortho.method,
                    frame.attrs["dolp_floor"],
                )
                clock.lap("rectify")
                column_of = partial(sensor.column_of, pose=reported_pose)
                state, queries = track.step(loop.state, image, spectra, t, column_of)  # the feedback edge
                tracks = track.report(state)
                clock.lap("track")
                score = metrics.score_epoch(tracks, truth, city.extent_m)
                turned[modality] = loop.turned(state, queries, tracks, score, served)
                clock.lap("score")
                if watch is not None:
                    seen = track.detections(state)
                    camera = sensor.camera
                    watch(
                        Epoch(
                            k,
                            t,
                            modality,
                            city,
                            sky,
                            camera,
                            hits,
                            reported_pose,
                            image,
                            served,
                            seen,
                            tracks,
                            score,
                        )
                    )
                    clock.lap("watch")
            loops = turned
            truths.append(truth)
    except KeyboardInterrupt:
        interrupted = True
    return _collect(case, flight.times_s[: len(truths)], loops, truths, clock.seconds, interrupted)


@dataclass(frozen=True)
class _Loop:
    """What one modality's loop carries from frame to frame."""

    state: track.TrackerState
    queries: tuple[SpectralQuery, ...]
    tracks: tuple[xr.Dataset, ...]
    scores: tuple[metrics.EpochScore, ...]
    asked: tuple[int, ...]
    served: tuple[int, ...]

    @classmethod
    def begin(cls, case: Case, modality: str) -> "_Loop":
        design = case.track.model_copy(update={"modality": modality})
        return cls(track.start(design, case.seed), (), (), (), (), ())

    def turned(self, state, queries, tracks, score, served: ServedQueries) -> "_Loop":
        return _Loop(
            state,
            queries,
            (*self.tracks, tracks),
            (*self.scores, score),
            (*self.asked, len(served.queries)),
            (*self.served, int(served.served.sum())),
        )


class _Stopwatch:
    """Wall time by stage."""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


def _remember(radiance: Callable[..., xr.DataArray]) -> Callable[..., xr.DataArray]:
    """The same function, keeping full frames: every modality's sensor looks at the same light."""
    frames: dict[bytes, xr.DataArray] = {}

    def remembered(channels: Array, pixels: Array | None = None) -> xr.DataArray:
        if pixels is not None:
            return radiance(channels, pixels=pixels)
        key = np.ascontiguousarray(channels).tobytes()
        if key not in frames:
            frames[key] = radiance(channels)
        return frames[key]

    return remembered


def _collect(case, times_s, loops, truths, seconds, interrupted) -> xr.DataTree:
    """Scores over time, rows of tracks and truth, and the provenance of the run."""
    count = len(times_s)
    nodes: dict[str, xr.Dataset] = {}
    for modality, loop in loops.items():
        scores = loop.scores[:count]
        nodes[f"/{modality}"] = _over_time(times_s, scores, loop, count)
        nodes[f"/{modality}/tracks"] = _rows(times_s, loop.tracks[:count], "track")
    nodes["/truth"] = _rows(times_s, truths, "vehicle")
    frames = max(count, 1)
    per_frame = {
        f"{stage}_ms_per_frame": 1e3 * s / frames for stage, s in seconds.items() if stage != "build"
    }
    nodes["/"] = xr.Dataset(
        attrs={
            "case": case.name,
            "seed": case.seed,
            "glintrack_version": version("glintrack"),
            "frames_asked": len(Flight(case.flight, 0.0).times_s),
            "frames_done": count,
            "interrupted": int(interrupted),
            "build_s": seconds.get("build", 0.0),
            **per_frame,
        }
    )
    return xr.DataTree.from_dict(nodes)


def _over_time(times_s: Array, scores, loop: _Loop, count: int) -> xr.Dataset:
    per_epoch = {
        "completeness": (metrics.completeness(scores), "1"),
        "false_tracks": (np.array([s.false.sum() for s in scores], float), "1"),
        "should": (np.array([s.should.sum() for s in scores], float), "1"),
        "valid": (np.array([s.valid.sum() for s in scores], float), "1"),
        "queries_asked": (np.array(loop.asked[:count], float), "1"),
        "queries_served": (np.array(loop.served[:count], float), "1"),
    }
    return xr.Dataset(
        {name: (("time",), values, {"units": units}) for name, (values, units) in per_epoch.items()},
        coords={"time": ("time", np.asarray(times_s, float), {"units": "s"})},
        attrs={k: float(v) for k, v in metrics.summarize(scores).items()},
    )


def _rows(times_s: Array, datasets, name: str) -> xr.Dataset:
    """Datasets of successive epochs as one table: dim ``row``, with ``time_s`` and the item's id."""
    datasets = [d.drop_vars([v for v in d.coords if v != name]) for d in datasets]
    if not datasets:
        return xr.Dataset()
    table = {
        str(v): ("row", np.concatenate([d[v].values for d in datasets]), datasets[0][v].attrs)
        for v in datasets[0].data_vars
        if datasets[0][v].dims == (name,)
    }
    table[f"{name}_id"] = ("row", np.concatenate([d[name].values for d in datasets]), {"units": "1"})
    epoch = np.repeat(np.asarray(times_s, float), [d.sizes[name] for d in datasets])
    table["time_s"] = ("row", epoch, {"units": "s"})
    return xr.Dataset(table)
