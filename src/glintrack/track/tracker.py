"""The tracker: rectified frames and queried spectra in, tracks and the next queries out.

Its whole state is a frozen record of arrays; `step` returns a new one. Tracks are kept by log-likelihood
ratio and M of N, detections assigned one to one at least cost. It never sees the truth.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from glintrack import schema
from glintrack.arrays import Array
from glintrack.records import SpectralQuery, Track
from glintrack.track import clutter
from glintrack.track.association import hypotheses, update
from glintrack.track.design import TrackDesign
from glintrack.track.detect import channel
from glintrack.track.detect.blobs import Detections, no_detections, order
from glintrack.track.detect.frame import Grid
from glintrack.track.detect.frame_detections import Look, look, look_at_detections
from glintrack.track.identity import features
from glintrack.track.initiation import Targets, joined, kept, newborn, no_targets, select, unclaimed
from glintrack.track.queries.ask import ask
from glintrack.track.queries.choose import ColumnOf
from glintrack.track.roads import roads_of
from glintrack.track.state import TrackerState


def start(
    design: TrackDesign | None = None, seed: int = 0, roads: Sequence[Float[Array, "point 2"]] | None = None
) -> TrackerState:
    """A tracker that has seen nothing.

    Parameters
    ----------
    design
        The default design if none is given.
    seed
        Of the random query policy, and of which bare road is asked; each frame draws from (seed, frame).
    roads
        Centre lines of lanes (east, north) [m]; used if the design has ``road_prior``.

    Raises
    ------
    ValueError
        If the design wants roads and there are none.
    """
    design = TrackDesign() if design is None else design
    if design.road_prior and not roads:
        raise ValueError("`roads` must be given where the design has road_prior, got none")
    network = roads_of(roads) if design.road_prior and roads else None
    population = features.empty_population(design.feature_bins)
    none = no_targets(design)
    return TrackerState(
        design, int(seed), 0, -math.inf, 0.0, None, {}, None, none, 0, population, no_detections(),
        roads=network, ground=population,
        leaves=hypotheses.no_leaves(design) if design.association == "mht" else None,
    )  # fmt: skip


def step(
    state: TrackerState,
    image: xr.Dataset | Look,
    spectra: xr.Dataset | tuple | None,
    time_s: float,
    column_of: ColumnOf | None = None,
) -> tuple[TrackerState, tuple[SpectralQuery, ...]]:
    """One frame: detect change, associate, update, and ask for the next frame's spectra if that is when.

    Parameters
    ----------
    state
        From `start` or the step before; not changed.
    image
        Dataset of the schema ``image`` on the same ground grid as before; NaN where there is no data. Or the
        `look` at it, where spectra were taken of its `doubts`.
    spectra
        Dataset of the schema ``spectra`` with what the sensor measured for the last queries or doubts; None
        or empty if there is none.
    time_s
        Epoch of the frame, later than the last. [s]
    column_of
        Superpixel column of ground points (n, 3), −1 off the array; None asks for no spectra.

    Returns
    -------
    The new state, and the queries for the next frame.

    Raises
    ------
    ValueError
        If the image breaks its schema, its grid has changed, time does not advance, or a look is of another
        state or time.
    """
    seen = image if isinstance(image, Look) else look(state, image, time_s)
    seen.check(state, time_s)
    frame = seen.frame
    if frame is None:
        raise ValueError("`image` must be a frame or the look at one, got a look at detections alone")
    spectral, missed = _spectral_features(state.design, spectra, seen)
    if len(missed):
        state = replace(state, ground=update.learnt_ground(state, missed))
    told = update.told_of(state, spectral, seen.polarization())
    new, explained = _advanced(state, seen, told)
    measured = new.targets.position[new.targets.confirmed & (new.targets.misses == 0)]
    learnt = channel.learn(
        state.design, frame.backgrounds, frame.changes, frame.choice, explained, measured,
        seen.interval_s or state.design.untracked_s,
    )  # fmt: skip
    return ask(replace(new, backgrounds=learnt, choice=frame.choice), column_of)


def step_detections(
    state: TrackerState,
    found: Detections | Look,
    time_s: float,
    grid: Grid,
    features: Float[Array, "detection feature"] | None = None,
    ground: Float[Array, "spectrum feature"] | None = None,
) -> TrackerState:
    """One epoch of somebody else's detections, without an image.

    Parameters
    ----------
    state
        From `start` or the step before; not changed.
    found
        Detections of the epoch, in any order; none is fine. Or `look_at_detections` of them, where spectra
        were taken of its `doubts`.
    time_s
        Epoch, later than the last. [s]
    grid
        Area in which targets live, and in which the density of false detections is learnt.
    features
        Of each detection (in the look's order if that is given), as many as ``design.feature_bins``; a row of
        NaN for one that has none.
    ground
        Of spectra asked of the ground (`ask`).

    Raises
    ------
    ValueError
        If a detection is not finite, the features have another size, time does not advance, or a look is of
        another state, time or grid.
    """
    seen = found if isinstance(found, Look) else look_at_detections(state, found, time_s, grid)
    seen.check(state, time_s)
    if seen.grid != grid:
        raise ValueError(f"`grid` must be the look's {seen.grid}, got {grid}")
    shape = (len(seen.found), state.design.feature_bins)
    untold = features is None
    features = np.full(shape, np.nan) if untold else np.asarray(features, float)
    if features.shape != shape:
        raise ValueError(
            f"`features` must have a row of {shape[1]} for each of {shape[0]} detections, "
            f"got shape {features.shape}"
        )
    if not (untold or isinstance(found, Look)):
        features = features[order(found)]
    ground = np.empty((0, shape[1])) if ground is None else np.asarray(ground, float)
    if ground.ndim != 2 or ground.shape[1] != shape[1]:
        raise ValueError(f"`ground` must have rows of {shape[1]} features, got shape {ground.shape}")
    if len(ground):
        state = replace(state, ground=update.learnt_ground(state, ground))
    return _advanced(state, seen, update.told_of(state, features, seen.polarization()))[0]


def _advanced(
    state: TrackerState, seen: Look, told: update.Told
) -> tuple[TrackerState, Bool[Array, "detection"]]:
    """The state after an epoch's detections, and which of them a confirmed track explains."""
    design, found, grid, interval_s = state.design, seen.found, seen.grid, seen.interval_s
    known = (state, seen.motion, seen.predicted, seen.seen, found, seen.density, told, interval_s)
    leaves = state.leaves
    if leaves is None:
        targets, assigned, learnt = update.advanced(*known)
    else:
        leaves, assigned, learnt = hypotheses.advanced(*known)
        targets = select(leaves.targets, leaves.chosen)
    explained = np.zeros(len(found), bool)
    explained[assigned[(assigned >= 0) & targets.confirmed]] = True
    targets = kept(design, targets, grid)
    fresh = (update.without_ground(state, told), told.polarized)
    index = unclaimed(design, targets, found.position, assigned)
    born = newborn(design, found, fresh, index, state.next_id, state.roads)
    if leaves is not None:
        leaves = hypotheses.settled(leaves, targets, born, index, state.frame)
    targets = joined(targets, born)
    share = 1 - math.exp(-interval_s / design.clutter_s)
    new = TrackerState(
        design, state.seed, state.frame + 1, seen.time_s, interval_s, grid, state.backgrounds,
        clutter.learn(clutter.map_of(state, grid), grid, found.position, explained, share),
        targets, max(state.next_id, int(targets.id.max(initial=-1)) + 1), learnt[0], found,
        state.choice, learnt[1], state.roads, seen.motion, state.ground, leaves,
    )  # fmt: skip
    return new, explained


def detections(state: TrackerState) -> Detections:
    """Blobs of the last frame that may be vehicles; ``.records()`` gives them one by one."""
    return state.detections


def report(state: TrackerState) -> xr.Dataset:
    """Confirmed tracks at the last epoch, as a Dataset of the schema ``tracks``."""
    targets = _reported(state)
    columns = {
        "east": (targets.mean[:, 0], "m"),
        "north": (targets.mean[:, 1], "m"),
        "east_speed": (targets.mean[:, 2], "m s-1"),
        "north_speed": (targets.mean[:, 3], "m s-1"),
        "east_var": (targets.covariance[:, 0, 0], "m2"),
        "north_var": (targets.covariance[:, 1, 1], "m2"),
        "east_north_cov": (targets.covariance[:, 0, 1], "m2"),
        "coasted": ((targets.misses > 0).astype(float), "1"),
    }
    tracks = xr.Dataset(
        {name: ("track", values.copy(), {"units": units}) for name, (values, units) in columns.items()},
        coords={"track": targets.id.copy()},
        attrs={"time_s": state.time_s},
    )
    return schema.check(tracks, "tracks")


def tracks(state: TrackerState) -> tuple[Track, ...]:
    """The same tracks as small records."""
    targets = _reported(state)
    return tuple(
        Track(
            track_id=int(targets.id[k]),
            time_s=state.time_s,
            east_m=float(targets.mean[k, 0]),
            north_m=float(targets.mean[k, 1]),
            east_speed_m_s=float(targets.mean[k, 2]),
            north_speed_m_s=float(targets.mean[k, 3]),
            east_var_m2=float(targets.covariance[k, 0, 0]),
            north_var_m2=float(targets.covariance[k, 1, 1]),
            status="coasted" if targets.misses[k] else "measured",
        )
        for k in range(len(targets))
    )


def _reported(state: TrackerState) -> Targets:
    shown = state.targets.confirmed
    if not state.design.report_coasted:
        shown = shown & (state.targets.misses == 0)
    return select(state.targets, shown)


def _spectral_features(
    design: TrackDesign, spectra, seen: Look
) -> tuple[Float[Array, "detection feature"], Float[Array, "spectrum feature"]]:
    """Of each detection, NaN for none; and of the spectra asked of the ground."""
    if not isinstance(spectra, xr.Dataset) or spectra.sizes.get("query", 0) == 0:
        return np.full((len(seen.found), design.feature_bins), np.nan), np.empty((0, design.feature_bins))
    kind = (design.feature_bins, design.feature_projection, design.feature_invariance)
    bare = spectra["track_id"].values < 0
    _, ground = features.of_spectra(spectra.isel(query=bare), *kind)
    where, values = features.of_spectra(spectra.isel(query=~bare), *kind)
    if design.query_at == "detection":
        where = where - seen.displacement_m
    return features.attach(where, values, seen.found.position, design.feature_radius_m), ground
