"""Queries to the sensor: spectra of predictions in the next frame, or of detections at once."""

from dataclasses import replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.records import SpectralQuery
from glintrack.track.association import associate, update
from glintrack.track.frame_detections import FrameDetections, motion_since, predicted
from glintrack.track.initiation import Targets, hits_of, select
from glintrack.track.queries import ambiguity, choose
from glintrack.track.queries.choose import ColumnOf
from glintrack.track.state import TrackerState


def query_predictions(
    state: TrackerState, column_of: ColumnOf | None
) -> tuple[TrackerState, tuple[SpectralQuery, ...]]:
    """What to ask for in the next frame, expected one interval later; `step` does this itself.

    Parameters
    ----------
    state
        `TrackerState` from `step_detections`.
    column_of
        As in `step`.

    Returns
    -------
    The state, which remembers who was asked, and the queries: none if the design asks at detections
    (`query_detections`).
    """
    design = state.design
    if column_of is None or state.interval_s == 0 or design.query.at != "prediction":
        return state, ()
    if design.query.policy == "none":
        return state, ()
    promising = hits_of(state.targets.history) >= 2
    motion = motion_since(state, state.interval_s)
    targets = predicted(select(state.targets, promising), design, motion)
    if design.query.policy == "entropy":
        detected = targets.mode_probability @ motion.detection
        priority = choose.information_gain(targets, detected, state.population, design)
    else:
        priority = _other_priority(state, targets.frames_since_query)
    spots = choose.candidate_points(targets.position, targets.mean[:, 2:], design.query.reach_m)
    queries = _with_ground(state, targets, spots, targets.id, priority, column_of)
    frames_since_query = state.targets.frames_since_query + 1
    frames_since_query[
        np.searchsorted(state.targets.id, [q.track_id for q in queries if q.track_id >= 0])
    ] = 0
    return replace(state, targets=replace(state.targets, frames_since_query=frames_since_query)), queries


def query_detections(
    state: TrackerState, seen: FrameDetections, column_of: ColumnOf | None
) -> tuple[SpectralQuery, ...]:
    """Of which detections to take spectra at once, while it is open whose they are.

    Parameters
    ----------
    state
        `TrackerState` before the frame, of a design with ``query.at = "detection"``; others ask nothing here.
    seen
        The frame, from `detect_frame`; `step` takes it, and the spectra, next.
    column_of
        As in `step`.

    Raises
    ------
    ValueError
        If the detections are of another state.

    Notes
    -----
    With association by many hypotheses only the best of them asks.
    """
    seen.check(state)
    design, found = state.design, seen.found
    if design.query.policy == "none" or column_of is None or design.query.at != "detection" or not len(found):
        return ()
    targets, share_seen = seen.predicted, seen.in_view
    if state.leaves is not None:
        targets, share_seen = select(targets, state.leaves.chosen), share_seen[state.leaves.chosen]
    no_spectra = np.full((len(found), design.identity.bins), np.nan)
    evidence = update.evidence_of(state, no_spectra, seen.polarization())
    costs = update.association_costs(state, seen.motion, targets, share_seen, found, seen.density, evidence)
    share = associate.marginals(costs.tracks, costs.partners, costs.cost, costs.miss_cost, len(found))
    owner = ambiguity.owner_of(costs, share, len(found))
    owned = owner >= 0
    if not owned.any():
        return ()
    if design.query.policy == "entropy":
        priority = ambiguity.information_gain(targets, state.population, design, costs, share, len(found))
    else:
        priority = np.where(owned, _other_priority(state, targets.frames_since_query[owner]), 0.0)
    velocity = np.where(owned[:, None], targets.mean[owner, 2:], 0.0)
    spots = choose.candidate_points(
        found.position + np.array(found.displacement_m), velocity, design.query.reach_m
    )
    known = select(targets, hits_of(targets.history) >= 2)
    return _with_ground(state, known, spots, np.where(owned, targets.id[owner], -1), priority, column_of)


def _other_priority(state: TrackerState, frames_since_query: Int[Array, "target"]) -> Float[Array, "target"]:
    """Priorities of the policies that do not weigh what a spectrum would say."""
    if state.design.query.policy == "round-robin":
        return frames_since_query + 1.0
    return np.random.default_rng((state.seed, state.frame)).random(len(frames_since_query))


def _with_ground(
    state: TrackerState, targets: Targets, spots, track_id, priority, column_of
) -> tuple[SpectralQuery, ...]:
    """The queries of greatest priority, and some of the bare road ahead of targets."""
    design, bare = state.design, np.empty((0, 2))
    if design.identity.outlier_share:
        rng = np.random.default_rng((state.seed, state.frame, 1))
        most = min(choose.MOST_GROUND, design.query.budget // choose.GROUND_SHARE)
        bare = choose.ground_points(targets, most, rng)
    queries = choose.plan(spots, track_id, priority, column_of, design.query.budget - len(bare))
    return queries + tuple(SpectralQuery(float(east), float(north)) for east, north in bare)
