"""The loop of Figure 1: render, expose, rectify, detect, track, and query the sensor for spectra.

`simulate` is that figure in one function, `_process_frame` one frame of it. Trackers influence the sensor by
their queries alone: those of one frame are served in the next, or by a second exposure of the same frame
(`track.query.at`).
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, NamedTuple

import numpy as np
import xarray as xr

from glintrack import metrics, track
from glintrack import sensor as sensing
from glintrack.camera import Pose
from glintrack.case.build import Scenario, build_scenario
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.parallel import prefetch
from glintrack.core.records import Mosaic, Radiance, Rows, ServedQueries, SpectralQuery
from glintrack.ortho import on_ground, orthorectify, register
from glintrack.render import FrameCache, Hits, keep_frames
from glintrack.results.collect import Loop, Stopwatch, collect, rows_of
from glintrack.results.epoch import Epoch, TrueFrame
from glintrack.scene import City

ImageCallback = Callable[[str, int, xr.Dataset, City], None]


def simulate(
    case: Case,
    callback: Callable[[Epoch], None] | None = None,
    hits_cache: FrameCache | None = None,
    trackers: Mapping[str, track.TrackDesign] | None = None,
    detectors: Mapping[str, track.Detector] | None = None,
    on_image: ImageCallback | None = None,
) -> xr.DataTree:
    """Simulate a case and score its trackers (the paper's Fig. 1).

    Parameters
    ----------
    case
        The design. All tracking channels that it names use the same rendered frames.
    callback
        Called after each frame and channel.
    hits_cache
        Source of traced frames by their time; by default they are traced. Filters, tracker and reported
        pose do not change the hits, so a trade study may share them.
    trackers
        Designs of trackers by name, one channel each; by default the case's own, named after its channels.
    detectors
        Detectors by the same names, instead of those that the designs name.
    on_image
        Called with each rectified frame before it is tracked: channel, index, schema ``image``, and city.

    Returns
    -------
    ``/pan`` and ``/dolp`` (or the names given) with completeness, false tracks and counts over ``time`` and
    the aggregate scores as attributes; ``/pan/tracks`` and so on with one row per reported track and frame;
    ``/truth`` likewise.
    An interrupt (Ctrl-C) ends the simulation early and keeps the frames done.
    """
    clock, render_clock = Stopwatch(), Stopwatch()
    scenario = build_scenario(case)
    city, observer, sensor = scenario.city, scenario.observer, scenario.sensor
    times_s = scenario.flight.times_s
    if hits_cache is None:
        observer.prepare()  # with a cache, perhaps no frame needs tracing
    surface = observer.surface_model(case.ortho.gsd_m) if case.ortho.surface == "surface" else None
    lanes = city.lanes if case.track.roads.prior else ()  # from a map, not from the truth
    rectify = partial(
        orthorectify,
        camera=sensor.camera,
        terrain=city.terrain,
        gsd_m=case.ortho.gsd_m,
        area_m=city.extent_m,
        method=case.ortho.method,
        surface=surface,
    )
    ground = {"terrain": city.terrain, "surface": surface, "lanes": lanes}
    run = _Run(scenario, rectify, ground, callback, on_image, clock)
    loops = _start_trackers(run, trackers, detectors or {})
    errors = case_navigation_errors(case, times_s)
    truths, exposures_ms, interrupted = Rows(), list[float](), False
    frames = prefetch(partial(_render, scenario, hits_cache, render_clock), times_s)
    clock.lap("build")
    try:
        for index, rendered in enumerate(frames):
            clock.lap("light")
            exposure_ms = sensor.design.integration_time_ms
            loops, sensor = _process_frame(run, index, rendered, errors[index], sensor, loops)
            truths = truths.append(rows_of(rendered.truth, "vehicle", rendered.time_s))
            exposures_ms.append(exposure_ms)
            clock.lap("score")
    except KeyboardInterrupt:
        interrupted = True
    finally:
        frames.close()
    done = truths, exposures_ms, clock.seconds, render_clock.seconds, interrupted
    return collect(case, scenario.area, times_s, loops, *done)


@dataclass(frozen=True)
class _Run:
    """Parts of a simulation that do not change from frame to frame; see `simulate`."""

    scenario: Scenario
    rectify: Callable[..., xr.Dataset]
    ground: Mapping[str, Any]
    callback: Callable[[Epoch], None] | None
    on_image: ImageCallback | None
    clock: Stopwatch


def _start_trackers(
    run: _Run, trackers: Mapping[str, track.TrackDesign] | None, detectors: Mapping[str, track.Detector]
) -> dict[str, Loop]:
    """Start a tracker for each design, or for each channel of the case."""
    case = run.scenario.case
    if trackers is None:
        trackers = {channel: case.track.replace({"detect.channel": channel}) for channel in case.channels}
    if unknown := sorted(set(detectors) - set(trackers)):
        raise ValueError(f"`detectors` must name channels ({', '.join(trackers)}); got {unknown[0]!r}.")
    return {
        name: Loop(track.start(design, case.seed, run.ground["lanes"], detectors.get(name)))
        for name, design in trackers.items()
    }


@dataclass(frozen=True)
class RenderedFrame:
    """A traced frame. It does not depend on the trackers, so it is traced ahead.

    Parameters
    ----------
    time_s, pose
        Time and true pose. [s]
    hits, truth, area, light
        As in `results.epoch.TrueFrame`.
    """

    time_s: float
    pose: Pose
    hits: Hits
    truth: xr.Dataset
    area: metrics.Area
    light: Radiance


def _render(
    scenario: Scenario, hits_cache: FrameCache | None, clock: Stopwatch, time_s: float
) -> RenderedFrame:
    """Trace the frame of one time; it is shaded at the first use of its light."""
    clock.start()
    city, observer = scenario.city, scenario.observer
    pose, snapshot = scenario.flight.pose(time_s), city.at(time_s)
    clock.lap("scene")
    observe = partial(observer.observe, snapshot, pose)
    traced = observe() if hits_cache is None else hits_cache.get(time_s, observe)
    clock.lap("trace")
    truth = with_visibility(city.truth(time_s), snapshot.vehicle_id[snapshot.fixed :], traced.seen)
    truth, area = scenario.area.mark(truth, city.terrain, scenario.sensor.camera, pose)
    clock.lap("truth")
    return RenderedFrame(time_s, pose, traced.hits, truth, area, keep_frames(observer.radiance(traced.hits)))


def _expose(
    scenario: Scenario, rendered: RenderedFrame, sensor: sensing.Sensor, navigation_error: Array
) -> TrueFrame:
    """Move the rendered light over the elements during the exposure, and report the pose with its error."""
    exposure_s = 1e-3 * sensor.design.integration_time_ms
    flight, time_s = scenario.flight, rendered.time_s
    motion = sensing.image_motion(sensor.camera, flight.pose, time_s, exposure_s, flight.stare_point[2])
    light = sensing.smear(rendered.light, motion)(sensor.channels)
    return TrueFrame(
        sensor=sensor,
        true_pose=rendered.pose,
        reported_pose=sensing.navigate(rendered.pose, navigation_error),
        motion=motion,
        hits=rendered.hits,
        light=rendered.light,
        planes=sensing.light_on_elements(light.values, sensor),
        truth=rendered.truth,
        area=rendered.area,
    )


class _Image(NamedTuple):
    """A rectified frame, its mosaic, and the queries that were served with it."""

    image: xr.Dataset
    mosaic: Mosaic
    served: ServedQueries
    spectra: xr.Dataset


def _process_frame(
    run: _Run,
    index: int,
    rendered: RenderedFrame,
    navigation_error: Array,
    sensor: sensing.Sensor,
    loops: Mapping[str, Loop],
) -> tuple[dict[str, Loop], sensing.Sensor]:
    """Expose one frame, and advance the tracker of each channel by it.

    Returns
    -------
    The channels after the frame, and the sensor with the exposure time of the next one.
    """
    case, city, observer = run.scenario.case, run.scenario.city, run.scenario.observer
    clock, time_s = run.clock, rendered.time_s
    rendered.light(sensor.channels)  # here and not ahead: either thread has about half of the work
    clock.lap("shade")
    true_frame = _expose(run.scenario, rendered, sensor, navigation_error)
    pose, truth = true_frame.reported_pose, true_frame.truth
    readout = sensing.read_out(
        true_frame.planes, sensor, frame_rngs(case.seed, index).noise
    )  # of all channels
    answer = partial(_answer_queries, run.scenario, index, true_frame)

    def columns(enu: Array) -> Array:  # of superpixels that see points of the ground, −1 off the array
        return sensor.superpixel_of(on_ground(city.terrain, enu), pose)[:, 1]

    def form_image(queries: tuple[SpectralQuery, ...]) -> _Image:
        served, spectra = answer(queries)  # by mirrors that are dark in pan
        frame = sensing.fill_dark_mirrors(
            sensing.frame_of(readout, sensor, served, time_s), served, spectra, sensor
        )
        clock.lap("sensor")
        image, mosaic = run.rectify(frame, reported_pose=pose), sensing.mosaic_of(readout, sensor, served)
        clock.lap("rectify")
        return _Image(image, mosaic, served, spectra)

    images: dict[tuple[SpectralQuery, ...], _Image] = {}  # channels with the same queries share an image
    advanced: dict[str, Loop] = {}
    for channel, loop in loops.items():
        if loop.queries not in images:
            images[loop.queries] = form_image(loop.queries)
        image, mosaic, served, spectra = images[loop.queries]
        if case.ortho.registration != "none" and loop.reference is not None:
            image = register(image, loop.reference)
        clock.lap("rectify")
        if run.on_image is not None:
            run.on_image(channel, index, image, city)
            clock.lap("callback")
        frame = track.Frame(time_s, image, mosaic, sensor.camera, pose, **run.ground)
        detections = track.detect_frame(loop.state, frame)
        ambiguous = track.query_detections(loop.state, detections, columns)
        clock.lap("track")
        if ambiguous:  # a second exposure, for this frame's detections
            served, spectra = answer(ambiguous)
            clock.lap("sensor")
        state, queries = track.step(loop.state, detections, spectra, columns)  # the only feedback
        tracks = track.report(state)  # without a lag; `Loop.advance` may report them later
        clock.lap("track")
        score = metrics.score_epoch(tracks, truth, true_frame.area, time_s=time_s)
        clock.lap("score")
        quality = _assess_quality(run, true_frame, image, served, spectra) if case.output.quality else None
        clock.lap("quality")
        known = truth, true_frame.area
        advanced[channel] = loop.advance(state, queries, tracks, score, known, served, image, quality)
        if run.callback is not None:
            outputs = {"image": image, "served": served, "spectra": spectra, "tracks": tracks, "score": score}
            run.callback(
                Epoch(index, time_s, channel, observer, true_frame, detections=state.detections, **outputs)
            )
            clock.lap("callback")
    return advanced, sensing.with_exposure(sensor, sensing.next_exposure_ms(sensor, readout))


def _answer_queries(
    scenario: Scenario, index: int, true_frame: TrueFrame, queries: tuple[SpectralQuery, ...]
) -> tuple[ServedQueries, xr.Dataset]:
    """Serve queries with mirrors, one in each column, and measure their spectra.

    Queries have no height: the tracker works on the map. At 50° off nadir, one metre of height displaces a
    point by 1.2 m.
    """
    sensor, terrain = true_frame.sensor, scenario.city.terrain
    if queries:
        up_m = on_ground(terrain, np.array([[q.east_m, q.north_m] for q in queries]))[:, 2]
        queries = tuple(replace(q, up_m=float(u)) for q, u in zip(queries, up_m, strict=True))
    served = sensing.serve(queries, sensor, true_frame.reported_pose)
    rng = frame_rngs(scenario.case.seed, index).spectra
    return served, sensing.measure_spectra(
        served, sensing.smear(true_frame.light, true_frame.motion), sensor, rng
    )


def _assess_quality(
    run: _Run, true_frame: TrueFrame, image: xr.Dataset, served: ServedQueries, spectra: xr.Dataset
) -> dict[str, float]:
    """Compare a frame with the noiseless one at the true pose."""
    sensor, light, true_pose = true_frame.sensor, true_frame.light, true_frame.true_pose
    truth = run.rectify(sensing.noiseless_frame(light, sensor), reported_pose=true_pose)
    true_spectra = sensing.noiseless_spectra(served, light, sensor)
    poses = true_pose, true_frame.reported_pose
    return metrics.frame_quality(image, truth, sensor.camera, *poses, spectra, true_spectra)


class FrameRngs(NamedTuple):
    """Random generators of one frame, one for each stage: a frame can be repeated alone."""

    navigation: np.random.Generator
    noise: np.random.Generator
    spectra: np.random.Generator


def frame_rngs(seed: int, frame: int) -> FrameRngs:
    """Spawn the random generators of one frame; they do not depend on other frames."""
    children = np.random.SeedSequence(entropy=seed, spawn_key=(frame,)).spawn(3)
    return FrameRngs(*(np.random.default_rng(child) for child in children))


def case_navigation_errors(case: Case, times_s: Array) -> Array:
    """Errors of the reported pose at each frame; see `sensor.navigation_errors`."""
    rngs = [frame_rngs(case.seed, k).navigation for k in range(len(times_s))]
    return sensing.navigation_errors(case.navigation, times_s, rngs)


def true_frame_at(
    scenario: Scenario, time_s: float, navigation_error: Array, hits_cache: FrameCache | None = None
) -> TrueFrame:
    """Frame at one time before any tracker, for bounds and labelled sets.

    Parameters
    ----------
    scenario
        From `build_scenario`.
    time_s
        Time of the frame. [s]
    navigation_error
        A row of `case_navigation_errors`.
    hits_cache
        As for `simulate`.
    """
    rendered = _render(scenario, hits_cache, Stopwatch(), time_s)
    return _expose(scenario, rendered, scenario.sensor, navigation_error)


def with_visibility(truth: xr.Dataset, vehicle_id: Array, seen: Array) -> xr.Dataset:
    """Add the visible fraction of each vehicle to the truth; 0 for vehicles outside the snapshot."""
    fraction = dict(zip(np.asarray(vehicle_id).tolist(), seen.tolist(), strict=True))
    values = np.array([fraction.get(int(v), 0.0) for v in truth["vehicle"].values])
    return truth.assign(visible_fraction=("vehicle", values, {"units": "1"}))
