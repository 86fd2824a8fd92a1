"""Spectra taken at once, of detections whose owner is in doubt."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import entr, logsumexp

from glintrack import track
from glintrack.track import identity, queries, update
from glintrack.track.flow import no_flow
from glintrack.track.initiation import initiate
from tests.plain import plain_tracker

GRID = track.Grid((100, 100), (-75.0, 75.0), 1.5)
EVERY_COLUMN = lambda enu: np.floor((enu[:, 0] + 75) / 1.5).astype(int)  # noqa: E731
BINS = identity.BINS


def population_of(paints, sigma=0.05, rng=None):
    """What is learnt from many spectra of vehicles with these paints."""
    rng = np.random.default_rng(0) if rng is None else rng
    kind = rng.integers(len(paints), size=2000)
    spectra = paints[kind] + rng.normal(0, sigma, (len(kind), paints.shape[1]))
    return identity.update_population(
        identity.empty_population(paints.shape[1]), spectra, paints[kind], np.full(len(kind), 50.0)
    )


def targets_with(feature, spectra, design):
    """Confirmed targets of these features."""
    n = len(feature)
    found = track.Detections(np.zeros((n, 2)), np.repeat(np.eye(2)[None], n, 0), np.ones(n), np.ones(n))
    new = initiate(design, found, np.full((n, BINS), np.nan), np.arange(n), 0, no_flow())
    return replace(new, confirmed=np.ones(n, bool), spectra=np.full(n, float(spectra)), feature=feature)


def one_detection_of(share):
    """AssociationCosts in which all targets contend for one detection."""
    n = len(share)
    pairs = np.arange(n), np.zeros(n, int)
    return update.AssociationCosts(*pairs, np.zeros(n), np.zeros(n), np.zeros(n)), np.asarray(share, float)


@pytest.mark.parametrize("unlike", [0.0, 0.1, 0.2, 0.5, 2.0])
def test_worth_now_is_a_lower_bound_of_the_mutual_information(unlike, monkeypatch):
    """Against draws of owner and spectrum: never above, close where spectra are all alike or all apart."""
    design = plain_tracker()
    monkeypatch.setattr(identity, "MAX_RATIO_NAT", 1e3)
    rng = np.random.default_rng(3)
    paints = rng.normal(0, 0.5, (40, BINS))
    population = population_of(paints)
    mean = np.zeros((3, BINS))
    mean[1, 0], mean[2, 1] = unlike, -unlike
    targets = targets_with(mean, 1e6, design)  # so many spectra that nothing is left to learn later
    share = np.array([0.5, 0.3, 0.2])
    costs, share = one_detection_of(share)
    found = queries.detection_gain(targets, population, costs, share, 1)[0]

    ratio, basis = identity.axes(population)
    along = (targets.feature - population.mean) @ basis
    centre, variance = identity.next_spectrum(along, targets.spectra, ratio)
    owner = rng.choice(3, 100_000, p=share)
    drawn = centre[owner] + rng.normal(size=(len(owner), BINS)) * np.sqrt(variance[owner])
    log = np.log(share) - 0.5 * ((drawn[:, None] - centre) ** 2 / variance + np.log(variance)).sum(axis=2)
    posterior = np.exp(log - logsumexp(log, axis=1, keepdims=True))
    information = entr(share).sum() - entr(posterior).sum(axis=1).mean()
    assert found <= information + 0.01  # four standard errors of the draws
    assert found >= 0.5 * information - 0.01
    if unlike == 0.0:
        assert found == pytest.approx(0, abs=1e-6)
    if unlike == 2.0:
        assert found == pytest.approx(entr(share).sum(), rel=0.01)


def test_a_spectrum_is_worth_most_where_unlike_targets_contend():
    design = plain_tracker()
    paints = np.random.default_rng(1).normal(0, 0.5, (12, BINS))
    population = population_of(paints)

    def information_gain(kinds, share, spectra=9):
        targets = targets_with(paints[kinds], spectra, design)
        return queries.detection_gain(targets, population, *one_detection_of(share), 1)[0]

    assert information_gain([0, 1], [0.5, 0.5]) > 3 * information_gain([0, 0], [0.5, 0.5])
    assert information_gain([0, 1], [0.5, 0.5]) > 3 * information_gain([0, 1], [0.99, 0.01])
    # alike so far: a reference for later
    assert information_gain([0, 0], [0.5, 0.5], spectra=0) > 2 * information_gain(
        [0, 0], [0.5, 0.5], spectra=9
    )


def crossing(seed, query_at, policy="entropy"):
    """Two vehicles drive side by side, come together for seconds and part, having changed sides or not."""
    rng = np.random.default_rng(seed)
    design = plain_tracker().replace(
        {
            "query.at": query_at,
            "query.policy": policy,
            "query.budget": 8,
            "identity.outlier_share": 0,
            "initiation.duplicate_m": 0,
        }
    )
    paints = np.random.default_rng(7).normal(0, 0.5, (12, BINS))
    state = replace(track.start(design, seed), population=population_of(paints))
    first, queries = None, ()
    for k in range(40):
        t = 0.5 * k
        turn = 4.0 * np.tanh((t - 10) / 3.0) ** 3
        if seed % 2:
            turn = -abs(turn)
        place = np.array([[6 * t - 60, turn], [6 * t - 60, -turn]])
        order = rng.permutation(2)
        found = track.Detections(
            (place + rng.normal(0, 0.6, place.shape))[order],
            np.repeat(0.36 * np.eye(2)[None], 2, 0), np.full(2, 4.0), np.ones(2),
        )  # fmt: skip
        seen = track.prepare_detections(state, found, t, GRID)
        if query_at == "detection":
            queries = track.query_detections(state, seen, EVERY_COLUMN)
        asked = np.array([(q.east_m, q.north_m) for q in queries if q.track_id >= 0]).reshape(-1, 2)
        whose = np.hypot(*(asked[:, None] - place[None]).transpose(2, 0, 1)).argmin(axis=1)
        spectra = paints[whose] + rng.normal(0, 0.05, (len(asked), BINS))
        evidence = identity.attach(asked, spectra, seen.found.position, identity.ATTACH_RADIUS_M)
        state = track.step_detections(state, seen, t, GRID, evidence)
        queries = track.query_predictions(state, EVERY_COLUMN)
        tracks = track.report(state)
        if tracks.sizes["track"] == 2:
            at = np.stack([tracks["east_m"].values, tracks["north_m"].values], axis=1)
            mine = np.hypot(*(at[:, None] - place[None]).transpose(2, 0, 1)).argmin(axis=0)
            ids = tracks["track"].values[mine].tolist()
            if k == 14:
                first = ids
    return first is not None and first == ids and len(set(ids)) == 2


def test_spectra_at_once_keep_apart_who_changes_sides():
    """Of twelve pairs; without spectra it is left to chance."""
    seeds = range(12)
    kept = sum(crossing(s, "detection") for s in seeds)
    without = sum(crossing(s, "detection", "none") for s in seeds)
    assert kept >= 11 and 3 <= without <= 9


def test_what_is_likely_is_not_thereby_a_vehicle():
    """Likeness decides whose a detection is, and adds nothing to a score."""
    design = plain_tracker().replace({"identity.outlier_share": 0.0})
    paints = np.random.default_rng(1).normal(0, 0.5, (12, BINS))
    evidence, scores = np.stack([paints[0]]), []
    for feature in (evidence, None):
        state = replace(track.start(design), population=population_of(paints))
        for k in range(5):
            found = track.Detections(
                np.array([[4.0 * k, 0.0]]), 0.36 * np.eye(2)[None], np.ones(1), np.ones(1)
            )
            state = track.step_detections(state, found, 0.5 * k, GRID, feature)
        scores.append(state.targets.score)
    assert state.targets.score[0] > 0
    np.testing.assert_array_equal(*scores)


def test_only_a_design_that_asks_at_detections_asks_of_them():
    found = track.Detections(np.zeros((1, 2)), 0.36 * np.eye(2)[None], np.ones(1), np.ones(1))
    for design, count in (
        (plain_tracker(), 0),
        (plain_tracker().replace({"query.at": "detection"}), 1),
        (plain_tracker().replace({"query.at": "detection", "query.policy": "none"}), 0),
        (
            plain_tracker().replace(
                {"query.at": "detection", "association.method": "mht", "motion.model": "imm"}
            ),
            1,
        ),
    ):
        state = track.start(design)
        for k in range(3):
            state = track.step_detections(state, found, 0.5 * k, GRID)
        seen = track.prepare_detections(state, found, 1.5, GRID)
        queries = [q for q in track.query_detections(state, seen, EVERY_COLUMN) if q.track_id >= 0]
        assert len(queries) == count
        assert track.query_predictions(state, EVERY_COLUMN) == () or design.query.at == "prediction"
        for q in queries:
            assert (q.east_m, q.north_m) == (0.0, 0.0) and q.track_id == state.targets.id[0]


def test_frame_detections_are_of_their_state_time_and_grid_alone():
    found = track.Detections(np.zeros((1, 2)), 0.36 * np.eye(2)[None], np.ones(1), np.ones(1))
    first = track.start(plain_tracker().replace({"query.at": "detection"}))
    seen = track.prepare_detections(first, found, 0.0, GRID)
    second = track.step_detections(first, seen, 0.0, GRID)
    with pytest.raises(ValueError, match="of the state that they are used with; got those of frame 0"):
        track.step_detections(second, seen, 0.0, GRID)
    with pytest.raises(ValueError, match="must be of the state"):
        track.query_detections(second, seen, EVERY_COLUMN)
    with pytest.raises(ValueError, match="`time_s` must be the detections' 0 s; got 1"):
        track.step_detections(first, seen, 1.0, GRID)
    with pytest.raises(ValueError, match="`grid` must be the detections'"):
        track.step_detections(first, seen, 0.0, replace(GRID, gsd_m=2.0))
    with pytest.raises(ValueError, match="got detections alone"):
        track.step(first, seen)
    with pytest.raises(ValueError, match="`ground` must have rows of 8 features; got shape"):
        track.step_detections(first, seen, 0.0, GRID, ground=np.zeros((2, 5)))
