"""The tracker: frames and queried spectra in, tracks and the next queries out.

Its whole state is a frozen record of arrays; `step` returns a new one. Tracks are kept by log-likelihood
ratio and M of N, detections assigned one to one at least cost. It never sees the truth.
"""

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.core.records import SpectralQuery
from glintrack.track import clutter, existence, hypotheses, identity, update
from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Association, Detections, no_detections, order
from glintrack.track.detect.detector import Detector
from glintrack.track.detect.frame import Frame, Grid
from glintrack.track.frame_detections import FrameDetections, detect_frame, given_detections
from glintrack.track.initiation import joined, newborn, no_targets, prune, select, unclaimed
from glintrack.track.queries import ColumnOf, query_predictions
from glintrack.track.roads import roads_of
from glintrack.track.state import TrackerState


def start(
    design: TrackDesign | None = None,
    seed: int = 0,
    roads: Sequence[Float[Array, "point 2"]] | None = None,
    detector: Detector | None = None,
) -> TrackerState:
    """A tracker that has seen nothing.

    Parameters
    ----------
    design
        The default design if none is given.
    seed
        Of the random query policy, and of which bare road is asked; each frame draws from (seed, frame).
    roads
        Centre lines of lanes (east, north) [m]; used if the design has ``roads.prior``.
    detector
        What finds vehicles in frames; by default `detector_of` the design and the first frame.

    Raises
    ------
    ValueError
        If the design wants roads and there are none.
    """
    design = TrackDesign() if design is None else design
    if design.roads.prior and not roads:
        raise ValueError("`roads` must be given where the design has roads.prior, got none")
    network = roads_of(roads) if design.roads.prior and roads else None
    population = identity.empty_population(design.identity.bins)
    return TrackerState(
        design=design,
        detector=detector,
        seed=int(seed),
        frame=0,
        time_s=-math.inf,
        interval_s=0.0,
        grid=None,
        memory=None,
        clutter=None,
        targets=no_targets(design),
        next_id=0,
        population=population,
        detections=no_detections(),
        roads=network,
        ground=population,
        leaves=hypotheses.no_leaves(design) if design.association.method == "mht" else None,
    )


def step(
    state: TrackerState,
    frame: Frame | FrameDetections,
    spectra: xr.Dataset | None = None,
    column_of: ColumnOf | None = None,
) -> tuple[TrackerState, tuple[SpectralQuery, ...]]:
    """One frame: detect, associate, update, and ask for the next frame's spectra if that is when.

    Parameters
    ----------
    state
        From `start` or the step before; not changed.
    frame
        On the same ground grid as before, later than the last. Or its `detect_frame`, where spectra were
        taken of its detections (`query_detections`).
    spectra
        Dataset of the schema ``spectra`` with what the sensor measured for the last queries; None or empty if
        there is none.
    column_of
        Superpixel column of ground points (n, 3), −1 off the array; None asks for no spectra.

    Returns
    -------
    The new state, and the queries for the next frame.

    Raises
    ------
    ValueError
        If the image breaks its schema, its grid has changed, time does not advance, or the detections are of
        another state.
    """
    seen = frame if isinstance(frame, FrameDetections) else detect_frame(state, frame)
    seen.check(state)
    detector = seen.detector
    if detector is None or seen.frame is None or seen.given is None or seen.order is None:
        raise ValueError("`frame` must be a frame or what was detected in one, got detections alone")
    spectral, missed = _spectral_features(state.design, spectra, seen)
    if len(missed):
        state = replace(state, ground=update.update_ground(state, missed))
    evidence = update.evidence_of(state, spectral)
    new, explained = _step(state, seen, evidence)
    measured = new.targets.position[new.targets.confirmed & (new.targets.misses == 0)]
    own = np.zeros(len(explained), bool)
    own[seen.order] = explained
    memory = detector.update(seen.memory, seen.frame, seen.given, Association(own, measured))
    # what its detector noted beside them is of no more use, and large
    found = replace(new.detections, detail=None)
    return query_predictions(replace(new, detector=detector, memory=memory, detections=found), column_of)


def step_detections(
    state: TrackerState,
    found: Detections | FrameDetections,
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
        Detections of the epoch, in any order; none is fine. Or the `given_detections` of
        them, where spectra were taken (`query_detections`).
    time_s
        Epoch, later than the last. [s]
    grid
        Area in which targets live, and in which the density of false detections is learnt.
    features
        Of each detection (in the order of the `FrameDetections` if those are given), as many as
        ``design.identity.bins``; a row of NaN for one that has none.
    ground
        Of spectra asked of the ground.

    Raises
    ------
    ValueError
        If a detection is not finite, the features have another size, time does not advance, or the frame
        detections are of another state, time or grid.
    """
    seen = found if isinstance(found, FrameDetections) else given_detections(state, found, time_s, grid)
    seen.check(state, time_s)
    if seen.grid != grid:
        raise ValueError(f"`grid` must be the detections' {seen.grid}, got {grid}")
    shape = (len(seen.found), state.design.identity.bins)
    unknown = features is None
    features = np.full(shape, np.nan) if unknown else np.asarray(features, float)
    if features.shape != shape:
        raise ValueError(
            f"`features` must have a row of {shape[1]} for each of {shape[0]} detections, "
            f"got shape {features.shape}"
        )
    if not (unknown or isinstance(found, FrameDetections)):
        features = features[order(found)]
    ground = np.empty((0, shape[1])) if ground is None else np.asarray(ground, float)
    if ground.ndim != 2 or ground.shape[1] != shape[1]:
        raise ValueError(f"`ground` must have rows of {shape[1]} features, got shape {ground.shape}")
    if len(ground):
        state = replace(state, ground=update.update_ground(state, ground))
    return _step(state, seen, update.evidence_of(state, features))[0]


def _step(
    state: TrackerState, seen: FrameDetections, evidence: update.Evidence
) -> tuple[TrackerState, Bool[Array, "detection"]]:
    """The state after an epoch's detections, and which of them a confirmed track explains."""
    found, grid, interval_s = seen.found, seen.grid, seen.interval_s
    design = state.design.effective(found.log_likelihood_ratio is not None)
    uses_existence = design.reporting.uses_existence
    before, leaves = replace(state, design=design), state.leaves
    if leaves is None:
        targets, assigned, population = update.advance_targets(before, seen, evidence)
    else:
        leaves, assigned, population = hypotheses.advance_trees(before, seen, evidence)
        targets = select(leaves.targets, leaves.chosen)
    explained = np.zeros(len(found), bool)
    explained[assigned[(assigned >= 0) & targets.confirmed]] = True
    targets = prune(design, targets, grid)
    fresh = update.without_ground(state, evidence)
    index = unclaimed(design, targets, found.position, assigned)
    born = newborn(
        design, found, fresh, index, state.next_id, state.roads, targets if uses_existence else None
    )
    if leaves is not None:
        leaves = hypotheses.prune(leaves, targets, born, index, state.frame)
    targets = joined(targets, born)
    next_id = max(state.next_id, int(targets.id.max(initial=-1)) + 1)
    if uses_existence:
        ids = existence.reassign_ids(state.targets, targets, interval_s, next_id)
        if (ids >= next_id).any():
            leaves = None if leaves is None else hypotheses.renamed(leaves, targets.id, ids)
            next_id = int(ids.max()) + 1
            targets = select(replace(targets, id=ids), np.argsort(ids))
    share = 1 - math.exp(-interval_s / clutter.CLUTTER_S)
    new = replace(
        state,
        frame=state.frame + 1,
        time_s=seen.time_s,
        interval_s=interval_s,
        grid=grid,
        clutter=clutter.update(clutter.map_of(state, grid), grid, found.position, explained, share),
        targets=targets,
        next_id=next_id,
        population=population,
        detections=found,
        motion=seen.motion,
        leaves=leaves,
        duplicates=existence.update_duplicates(state.duplicates, targets)
        if uses_existence
        else state.duplicates,
    )
    return new, explained


def detections(state: TrackerState) -> Detections:
    """Detections of the last frame; ``.records()`` gives them one by one."""
    return state.detections


def _spectral_features(
    design: TrackDesign, spectra, seen: FrameDetections
) -> tuple[Float[Array, "detection feature"], Float[Array, "spectrum feature"]]:
    """Of each detection, NaN for none; and of the spectra asked of the ground."""
    if not isinstance(spectra, xr.Dataset) or spectra.sizes.get("query", 0) == 0:
        return np.full((len(seen.found), design.identity.bins), np.nan), np.empty((0, design.identity.bins))
    bare = spectra["track_id"].values < 0
    _, ground = identity.of_spectra(spectra.isel(query=bare), design.identity.bins)
    where, values = identity.of_spectra(spectra.isel(query=~bare), design.identity.bins)
    if design.query.at == "detection":
        where = where - np.array(seen.found.displacement_m)
    return identity.attach(where, values, seen.found.position, identity.ATTACH_RADIUS_M), ground
