"""The loop of Figure 1: fly one design over a city, track what moves, ask the sensor for spectra, score it.

The one feedback edge is a value: what the tracker asks of a frame, the sensor serves in the next, or by a
second exposure before the tracker says whose its detections are (`track.query.at`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
import xarray as xr

from glintrack import metrics, track
from glintrack.camera import Pose
from glintrack.case.build import Scenario, build_scenario
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.parallel import prefetch
from glintrack.core.records import Radiance, Rows, ServedQueries, SpectralQuery
from glintrack.ortho import on_ground, orthorectify, register
from glintrack.render import FrameCache, Hits, LightCache, keep_frames
from glintrack.results.collect import Loop, Stopwatch, collect, rows_of
from glintrack.results.epoch import Epoch, TrueFrame
from glintrack.scene import City
from glintrack.sensor import (
    Sensor,
    fill_dark_mirrors,
    frame_of,
    image_motion,
    light_on_elements,
    measure_spectra,
    mosaic_of,
    navigate,
    navigation_errors,
    next_exposure_ms,
    noiseless_frame,
    noiseless_spectra,
    read_out,
    serve,
    smear,
    with_exposure,
)

Pictured = Callable[[str, int, xr.Dataset, City], None]


class Rectify(Protocol):
    """`orthorectify` with all that stays the same over a flight."""

    def __call__(self, frame: xr.Dataset, *, reported_pose: Pose) -> xr.Dataset:
        """The ground image of one frame."""
        ...


def simulate(
    case: Case,
    callback: Callable[[Epoch], None] | None = None,
    hits_cache: FrameCache | None = None,
    trackers: Mapping[str, track.TrackDesign] | None = None,
    detectors: Mapping[str, track.Detector] | None = None,
    pictured: Pictured | None = None,
) -> xr.DataTree:
    """Fly one design over the scene and score the tracker (the paper's Fig. 1).

    Parameters
    ----------
    case
        The whole design. Each channel it names (pan, DoLP) closes its own loop over the same light.
    callback
        Called after every turn of a loop.
    hits_cache
        Asked for each traced frame by its time, with a function that traces it; by default that is called.
        If it is a `render.LightCache`, for the light in the sensor's channels too.
        Filters, tracker and reported pose have no part in it, so that a trade study may keep it.
    trackers
        Designs that fly over the same light, by name, each with its own loop; by default the case's own, one
        for each of its channels and named after it.
    detectors
        Detectors of those trackers, by the same names, in the place of those that the designs name.
    pictured
        Called with each rectified frame before it is tracked: its loop, index, schema ``image``, and city.

    Returns
    -------
    ``/pan`` and ``/dolp`` (or the names given) with completeness, false tracks and counts over ``time`` and
    the aggregate scores as attributes; ``/pan/tracks`` and so on with one row per reported track and frame;
    ``/truth`` likewise.
    An interrupt (Ctrl-C) ends the flight early and keeps the frames done.
    """
    clock = Stopwatch()
    scenario = build_scenario(case)
    city, flight, sensor, observer = scenario.city, scenario.flight, scenario.sensor, scenario.observer
    surface = observer.surface_model(case.ortho.gsd_m) if case.ortho.surface == "surface" else None
    rectify = _rectify(case, city, sensor, surface)
    serve_spectra = partial(_serve_spectra, case.seed, city, sensor)
    if hits_cache is None:
        observer.prepare()  # a flight over kept hits may never trace
    errors = case_navigation_errors(case, flight.times_s)
    judge = partial(_judge, sensor, rectify) if case.output.quality else None
    roads = city.lanes if case.track.roads.prior else ()  # a map, no truth: where cars may drive
    loops = _loops(case, trackers, detectors or {}, roads)
    ground = {"terrain": city.terrain, "surface": surface, "lanes": roads}
    truths, exposures_ms, interrupted = Rows(), list[float](), False
    beside = Stopwatch()
    coming = prefetch(partial(_lit_frame, scenario, hits_cache, beside), flight.times_s)
    clock.lap("build")
    try:
        for k, lit in enumerate(coming):
            t, true_pose, hits, truth, light = lit.time_s, lit.pose, lit.hits, lit.truth, lit.light
            clock.lap("light")
            reported_pose = navigate(true_pose, errors[k])
            motion = image_motion(sensor.camera, flight.pose, t, 1e-3 * sensor.design.integration_time_ms)
            radiance = keep_frames(smear(light, motion))
            planes = light_on_elements(radiance(sensor.channels).values, sensor)
            measured = read_out(planes, sensor, frame_rngs(case.seed, k).noise)  # for all the same
            true_frame = TrueFrame(
                sensor, true_pose, reported_pose, motion, hits=hits, light=light, planes=planes, truth=truth
            )
            turned, pictures = {}, {}
            for channel, loop in loops.items():
                answer = partial(serve_spectra, k, radiance, reported_pose)
                if loop.queries not in pictures:  # of the frame before; who asks the same sees the same
                    served, spectra = answer(loop.queries)  # by mirrors that are dark in pan
                    frame = frame_of(measured, sensor, served, t)
                    frame = fill_dark_mirrors(frame, served, spectra, sensor)
                    clock.lap("sensor")
                    picture = rectify(frame, reported_pose=reported_pose)
                    pictures[loop.queries] = picture, mosaic_of(measured, sensor, served), served, spectra
                    clock.lap("rectify")
                image, mosaic, served, spectra = pictures[loop.queries]
                image = _registered(case, image, loop.reference)
                clock.lap("rectify")
                _show(pictured, clock, channel, k, image, city)
                column_of = partial(_column_of, sensor, city.terrain, reported_pose)
                frame = track.Frame(t, image, mosaic, sensor.camera, reported_pose, **ground)
                seen = track.detect_frame(loop.state, frame)
                ambiguous = track.query_detections(loop.state, seen, column_of)
                clock.lap("track")
                if ambiguous:  # a second exposure, of this frame's detections
                    served, spectra = answer(ambiguous)
                    clock.lap("sensor")
                state, queries = track.step(loop.state, seen, spectra, column_of)  # the feedback edge
                tracks = track.report(state)  # without a lag; `Loop.advance` may report them later
                clock.lap("track")
                score = metrics.score_epoch(tracks, truth, city.extent_m, time_s=t)
                clock.lap("score")
                quality = judge(light, image, spectra, served, true_pose, reported_pose) if judge else None
                clock.lap("quality")
                known = truth, city.extent_m
                turned[channel] = loop.advance(state, queries, tracks, score, known, served, image, quality)
                loops[channel] = replace(loop, state=state)  # an interrupt wants the record before it alone
                if callback is not None:
                    turn = (image, served, tracks, score, spectra, state.detections)
                    callback(Epoch(k, t, channel, observer, true_frame, *turn))
                    clock.lap("callback")
                del seen, answer  # large
            kept = truths.append(rows_of(truth, "vehicle", t))
            loops, truths, exposures_ms = turned, kept, [*exposures_ms, sensor.design.integration_time_ms]
            sensor = with_exposure(sensor, next_exposure_ms(sensor, measured))  # known before the next frame
            del lit, hits, light, radiance, true_frame, pictures  # not held while the next frame is awaited
            clock.lap("score")
    except KeyboardInterrupt:
        interrupted = True
    finally:
        coming.close()
    took = clock.seconds, beside.seconds
    return collect(case.name, case.seed, flight.times_s, loops, truths, exposures_ms, *took, interrupted)


@dataclass(frozen=True)
class LitFrame:
    """A frame before any loop: nothing in it depends on what a tracker asks, so that it may be made ahead.

    Parameters
    ----------
    time_s, pose
        When, and the true pose. [s]
    hits, truth, light
        As of `results.epoch.TrueFrame`.
    """

    time_s: float
    pose: Pose
    hits: Hits
    truth: xr.Dataset
    light: Radiance


def _lit_frame(
    scenario: Scenario,
    hits_cache: FrameCache | None,
    clock: Stopwatch,
    time_s: float,
) -> LitFrame:
    """Trace and shade the frame of one time for the sensor's channels."""
    clock.start()
    city, observer = scenario.city, scenario.observer
    pose, now = scenario.flight.pose(time_s), city.at(time_s)
    clock.lap("scene")
    observe = partial(observer.observe, now, pose)
    traced = observe() if hits_cache is None else hits_cache.get(time_s, observe)
    clock.lap("trace")
    truth = with_visibility(city.truth(time_s), now.vehicle_id[now.fixed :], traced.seen)
    clock.lap("truth")
    light = keep_frames(observer.radiance(traced.hits))
    channels = scenario.sensor.channels
    if isinstance(hits_cache, LightCache):  # of what else is asked for nothing is kept
        known = hits_cache.light(time_s, observer, channels, partial(light, channels))
        light = keep_frames(light, lambda asked, shade: known if np.array_equal(asked, channels) else shade())
    light(channels)
    clock.lap("shade")
    return LitFrame(time_s, pose, traced.hits, truth, light)


def _show(pictured: Pictured | None, clock: Stopwatch, *frame: Any) -> None:
    """Hand out a rectified frame, if somebody wants it."""
    if pictured is not None:
        pictured(*frame)
        clock.lap("callback")


def _loops(
    case: Case,
    trackers: Mapping[str, track.TrackDesign] | None,
    detectors: Mapping[str, track.Detector],
    roads,
) -> dict[str, Loop]:
    """One loop a tracker, or a channel of the case, with its own detector if one was handed in."""
    if trackers is None:
        trackers = {m: case.track.replace({"detect.channel": m}) for m in case.channels}
    if unknown := sorted(set(detectors) - set(trackers)):
        loops = ", ".join(trackers)
        raise ValueError(f"`detectors` must name loops of the flight ({loops}), got {unknown[0]!r}")
    return {
        name: Loop(track.start(design, case.seed, roads, detectors.get(name)))
        for name, design in trackers.items()
    }


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


def _registered(case: Case, image: xr.Dataset, reference: xr.Dataset | None) -> xr.Dataset:
    """The frame moved onto the loop's first one, if the case asks for it."""
    if case.ortho.registration == "none" or reference is None:
        return image
    return register(image, reference)


def _judge(
    sensor: Sensor,
    rectify: Rectify,
    light: Radiance,
    image: xr.Dataset,
    spectra: xr.Dataset,
    served: ServedQueries,
    true_pose: Pose,
    reported_pose: Pose,
) -> dict[str, float]:
    """One frame against the light itself, seen without noise and placed by the true pose."""
    truth = rectify(noiseless_frame(light, sensor), reported_pose=true_pose)
    true_spectra = noiseless_spectra(served, light, sensor)
    camera = sensor.camera
    return metrics.frame_quality(image, truth, camera, true_pose, reported_pose, spectra, true_spectra)


def case_navigation_errors(case: Case, times_s: Array) -> Array:
    """Errors of the reported pose at each frame; see `sensor.navigation_errors`."""
    rngs = [frame_rngs(case.seed, k).navigation for k in range(len(times_s))]
    return navigation_errors(case.navigation, times_s, rngs)


def _rectify(case: Case, city: City, sensor: Sensor, surface: xr.Dataset | None) -> Rectify:
    """`orthorectify` with all that stays the same over a flight."""
    return partial(
        orthorectify,
        camera=sensor.camera,
        terrain=city.terrain,
        gsd_m=case.ortho.gsd_m,
        area_m=city.extent_m,
        method=case.ortho.method,
        surface=surface,
    )


def _column_of(sensor: Sensor, terrain: xr.Dataset, pose: Pose, enu: Array) -> Array:
    """Superpixel column that sees each point of the ground, −1 off the array."""
    return sensor.superpixel_of(on_ground(terrain, enu), pose)[:, 1]


def _serve_spectra(
    seed: int,
    city: City,
    sensor: Sensor,
    frame: int,
    radiance: Radiance,
    reported_pose: Pose,
    queries: tuple[SpectralQuery, ...],
) -> tuple[ServedQueries, xr.Dataset]:
    """Mirrors for the tracker's queries, one a column, and what they bring back.

    The tracker asks by the map, without heights.
    """
    served = serve(_raised(queries, city.terrain), sensor, reported_pose)
    return served, measure_spectra(served, radiance, sensor, frame_rngs(seed, frame).spectra)


def _raised(queries: tuple[SpectralQuery, ...], terrain: xr.Dataset) -> tuple[SpectralQuery, ...]:
    """The same queries at the ground's height: on a hill 50° off nadir a metre of height is one of place."""
    if not queries:
        return ()
    up_m = on_ground(terrain, np.array([[q.east_m, q.north_m] for q in queries]))[:, 2]
    return tuple(replace(q, up_m=float(u)) for q, u in zip(queries, up_m, strict=True))


def true_frame_at(
    scenario: Scenario, time_s: float, navigation_error: Array, hits_cache: FrameCache | None = None
) -> TrueFrame:
    """The frame before all loops at a time, flown by itself: what bounds and labelled sets begin with.

    Parameters
    ----------
    scenario
        From `build_scenario`.
    time_s
        Of the flight. [s]
    navigation_error
        A row of `case_navigation_errors`.
    hits_cache
        As of `simulate`.
    """
    sensor, flight = scenario.sensor, scenario.flight
    lit = _lit_frame(scenario, hits_cache, Stopwatch(), time_s)
    motion = image_motion(sensor.camera, flight.pose, time_s, 1e-3 * sensor.design.integration_time_ms)
    planes = light_on_elements(smear(lit.light, motion)(sensor.channels).values, sensor)
    reported_pose = navigate(lit.pose, navigation_error)
    seen = {"hits": lit.hits, "light": lit.light, "planes": planes, "truth": lit.truth}
    return TrueFrame(sensor, lit.pose, reported_pose, motion, **seen)


def with_visibility(truth: xr.Dataset, vehicle_id: Array, seen: Array) -> xr.Dataset:
    """The truth with each vehicle's visible fraction; 0 for one that the snapshot left out."""
    fraction = dict(zip(np.asarray(vehicle_id).tolist(), seen.tolist(), strict=True))
    values = np.array([fraction.get(int(v), 0.0) for v in truth["vehicle"].values])
    return truth.assign(visible_fraction=("vehicle", values, {"units": "1"}))
