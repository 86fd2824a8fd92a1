"""The tracker: frames and queried spectra in, tracks and the next queries out.

Its whole state is a frozen record of arrays; `step` returns a new one. The tracker never sees the truth.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.core.records import SpectralQuery
from glintrack.track import clutter, existence, hypotheses, identity, update
from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Association, Detections, order
from glintrack.track.detect.detector import Detector
from glintrack.track.detect.frame import Frame, Grid
from glintrack.track.flow import update_flow
from glintrack.track.frame_detections import FrameDetections, TrackerState, detect_frame, prepare_detections
from glintrack.track.initiation import concatenate, initiate, no_targets, prune, select, select_unassigned
from glintrack.track.queries import ColumnOf, query_predictions
from glintrack.track.roads import roads_of


def start(
    design: TrackDesign | None = None,
    seed: int = 0,
    roads: Sequence[Float[Array, "point 2"]] | None = None,
    detector: Detector | None = None,
    features: int = identity.BINS,
) -> TrackerState:
    """Start a tracker, before the first frame.

    Parameters
    ----------
    design
        Design of the tracker; the default design if none is given.
    seed
        Seed of the random query policy and of the queries of the ground; each frame draws from (seed, frame).
    roads
        Centre lines of lanes (east, north) [m]; used if the design has ``roads.prior``.
    detector
        Detector of vehicles; by default `detector_of` the design and the first frame.
    features
        Number of spectral features.

    Raises
    ------
    ValueError
        If the design wants roads and there are none.
    """
    design = TrackDesign() if design is None else design
    if design.roads.prior and not roads:
        raise ValueError("`roads` must be given where the design has roads.prior; got none.")
    population, targets = identity.empty_population(features), no_targets(design, features)
    window, leaves = np.empty((0, design.association.scans), np.int64), None
    if design.association.method == "mht":
        leaves = hypotheses.Leaves(targets, np.empty(0), window, window, np.empty(0, bool), 0)
    return TrackerState(
        design=design, detector=detector, seed=int(seed), targets=targets, population=population,
        ground=population, roads=roads_of(roads) if design.roads.prior and roads else None, leaves=leaves,
    )  # fmt: skip


def step(
    state: TrackerState,
    frame: Frame | FrameDetections,
    spectra: xr.Dataset | None = None,
    column_of: ColumnOf | None = None,
) -> tuple[TrackerState, tuple[SpectralQuery, ...]]:
    """Process one frame: detect, associate, update, and query the next frame's spectra.

    Parameters
    ----------
    state
        From `start` or the step before; not changed.
    frame
        On the same ground grid as before, later than the last. Or its `detect_frame`, if spectra were
        measured of its detections (`query_detections`).
    spectra
        Dataset of the schema ``spectra``, measured for the last queries; None or empty for none.
    column_of
        Superpixel column of ground points (n, 3), −1 off the array; None for no queries.

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
        raise ValueError("`frame` must be a frame or what was detected in one; got detections alone.")
    bins = len(state.population.mean)
    spectral, ground = np.full((len(seen.found), bins), np.nan), np.empty((0, bins))
    if spectra is not None and spectra.sizes.get("query", 0):
        of_ground = spectra["track_id"].values < 0
        _, ground = identity.spectral_features(spectra.isel(query=of_ground), bins)
        where, values = identity.spectral_features(spectra.isel(query=~of_ground), bins)
        if state.design.query.at == "detection":
            where = where - np.array(seen.found.displacement_m)
        spectral = identity.attach(where, values, seen.found.position, identity.ATTACH_RADIUS_M)
    new, explained = _step(state, seen, spectral, ground)
    own = np.zeros(len(explained), bool)
    own[seen.order] = explained
    memory = detector.update(seen.memory, seen.frame, seen.given, Association(own))
    found = replace(new.detections, detail=None)  # the detector's notes are large
    new = replace(new, detector=detector, memory=memory, detections=found)
    return new, query_predictions(new, column_of)


def step_detections(
    state: TrackerState,
    found: Detections | FrameDetections,
    time_s: float,
    grid: Grid,
    features: Float[Array, "detection feature"] | None = None,
    ground: Float[Array, "spectrum feature"] | None = None,
) -> TrackerState:
    """Process one epoch of the detections of another program, without an image.

    Parameters
    ----------
    state
        From `start` or the step before; not changed.
    found
        Detections of the epoch, in any order, or none. Or their `prepare_detections`, if spectra were
        measured (`query_detections`).
    time_s
        Epoch, later than the last. [s]
    grid
        Area in which targets live, and in which the clutter density is measured.
    features
        Spectral features of each detection (in the order of the `FrameDetections` if those are given), in the
        number given to `start`; a row of NaN for none.
    ground
        Spectral features of queries of the ground.

    Raises
    ------
    ValueError
        If a detection is not finite, the features have another size, time does not advance, or the frame
        detections are of another state, time or grid.
    """
    seen = found if isinstance(found, FrameDetections) else prepare_detections(state, found, time_s, grid)
    seen.check(state, time_s)
    if seen.grid != grid:
        raise ValueError(f"`grid` must be the detections' {seen.grid}; got {grid}.")
    shape = (len(seen.found), len(state.population.mean))
    spectral = np.full(shape, np.nan) if features is None else np.asarray(features, float)
    if spectral.shape != shape:
        raise ValueError(
            f"`features` must have a row of {shape[1]} for each of {shape[0]} detections; "
            f"got shape {spectral.shape}."
        )
    if isinstance(found, Detections):
        spectral = spectral[order(found)]
    ground = np.empty((0, shape[1])) if ground is None else np.asarray(ground, float)
    if ground.ndim != 2 or ground.shape[1] != shape[1]:
        raise ValueError(f"`ground` must have rows of {shape[1]} features; got shape {ground.shape}.")
    return _step(state, seen, spectral, ground)[0]


def _step(
    state: TrackerState,
    seen: FrameDetections,
    spectral: Float[Array, "detection feature"],
    ground: Float[Array, "spectrum feature"],
) -> tuple[TrackerState, Bool[Array, "detection"]]:
    """State after an epoch's detections, and the mask of those that confirmed tracks explain."""
    found, grid, leaves = seen.found, seen.grid, state.leaves
    has_ratios = found.log_likelihood_ratio is not None if len(found) else state.has_ratios
    design = state.design.effective(has_ratios)
    uses_existence = design.reporting.uses_existence
    if len(found) and state.design.reporting.uses_existence and not uses_existence:
        warnings.warn(  # once, by Python's own filter
            "detections have no log-likelihood ratio, which `track.reporting.method` = 'existence' needs: "
            "tracks are reported by 'confirmation'",
            stacklevel=2,
        )
    ground = ground[identity.ground_ratio(state.population, state.ground, ground) >= 0]  # no unknown vehicles
    none = np.zeros(len(ground))
    ground_population = identity.update_population(state.ground, ground, np.zeros_like(ground), none)
    before = replace(state, design=design, ground=ground_population)
    evidence = update.spectral_evidence(before, spectral)
    if leaves is None:
        targets, assigned, population = update.advance_targets(before, seen, evidence)
    else:
        leaves, assigned, population = hypotheses.advance_trees(before, seen, evidence)
        targets = select(leaves.targets, leaves.chosen)
    explained = np.zeros(len(found), bool)
    explained[assigned[(assigned >= 0) & targets.confirmed]] = True
    targets = prune(design, targets, grid)
    index = select_unassigned(design, targets, found.position, assigned)
    features, others = spectral.copy(), targets if uses_existence else None
    if design.identity.outlier_share:  # spectra that more probably show the ground than any vehicle
        features[evidence.index[evidence.ground > 0]] = np.nan
    flow = update_flow(state.flow, found.position, seen.time_s)
    new = initiate(design, found, features, index, state.next_id, flow, state.roads, others)
    if leaves is not None:
        leaves = hypotheses.prune(leaves, targets, new)
    targets, duplicates = concatenate(targets, new), state.duplicates
    next_id = max(state.next_id, int(targets.id.max(initial=-1)) + 1)
    if uses_existence:
        ids = existence.reassign_ids(state.targets, targets, seen.interval_s, next_id)
        if (ids >= next_id).any():
            leaves = None if leaves is None else hypotheses.rename_trees(leaves, targets.id, ids)
            next_id = int(ids.max()) + 1
            targets = select(replace(targets, id=ids), np.argsort(ids))
        duplicates = existence.update_duplicates(duplicates, targets, flow, seen.time_s)
    share = 1 - math.exp(-seen.interval_s / clutter.CLUTTER_S)
    new = replace(
        state, frame=state.frame + 1, time_s=seen.time_s, interval_s=seen.interval_s, grid=grid,
        clutter=clutter.update(clutter.map_of(state, grid), grid, found.position, explained, share),
        targets=targets, next_id=next_id, population=population, ground=before.ground, detections=found,
        leaves=leaves, duplicates=duplicates, flow=flow, has_ratios=has_ratios,
    )  # fmt: skip
    return new, explained
