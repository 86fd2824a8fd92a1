"""Report tracks: at once, with a fixed lag, or back to where a track was before it was confirmed.

With existence reporting, `ReportingDesign.lag_s` after an epoch more is known of its tracks: which were
measured again, which were lost, and which were detected later. A track in a gap was on the straight line
between two measurements; one first measured within the lag was where its motion leads back to. The log odds
of existence then are a logistic model of all that is known (``data/calibration/existence_smoothed.toml``;
``python tools/calibrate.py existence`` fits it). Tracking and queries for spectra do not wait.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.track import existence
from glintrack.track.calibration import read_calibration
from glintrack.track.initiation import Targets, rows_among, select
from glintrack.track.state import TrackerState

MAX_LOG_ODDS = 6.0  # a lost track has the negative of it
MAX_BACK_S = 1.5  # before its first measurement a track is reported no earlier
MIN_BACK_HITS = 2  # measurements from which the motion leads back
DUPLICATE_M = 4.0  # nearer to another candidate it is the same vehicle
HISTORY_DUPLICATE_M = 3.0  # from a position already reported at that time: the same vehicle
_ROUNDING_S = 1e-6


def tracks_to_dataset(
    time_s: float,
    ident: Int[Array, "track"],
    mean: Float[Array, "track 4"],
    covariance: Float[Array, "track 4 4"],
    coasted: Bool[Array, "track"],
) -> xr.Dataset:
    """Tracks of one epoch, as a Dataset of the schema ``tracks``.

    Parameters
    ----------
    time_s
        Epoch. [s]
    ident
        Ids of the tracks.
    mean, covariance
        State ``[east, north, east speed, north speed]``. [m, m s⁻¹]
    coasted
        Whether each track was not measured.
    """
    columns = {
        "east": (mean[:, 0], "m"),
        "north": (mean[:, 1], "m"),
        "east_speed": (mean[:, 2], "m s-1"),
        "north_speed": (mean[:, 3], "m s-1"),
        "east_var": (covariance[:, 0, 0], "m2"),
        "north_var": (covariance[:, 1, 1], "m2"),
        "east_north_cov": (covariance[:, 0, 1], "m2"),
        "coasted": (np.asarray(coasted, float), "1"),
    }
    tracks = xr.Dataset(
        {name: ("track", values.copy(), {"units": units}) for name, (values, units) in columns.items()},
        coords={"track": np.array(ident, np.int64)},
        attrs={"time_s": time_s},
    )
    return schema.check(tracks, "tracks")


def report(state: TrackerState) -> xr.Dataset:
    """Reported tracks of the last epoch, without a lag, as a Dataset of the schema ``tracks``."""
    targets, shown, design = state.targets, state.targets.confirmed, state.effective_design
    if not design.reporting.coasted:
        shown = shown & (targets.misses == 0)
    if design.reporting.uses_existence:
        leader = existence.leaders(state.duplicates, targets)
        odds = existence.group_log_odds(design.detect.channel, targets, leader)
        shown = shown & (leader == np.arange(len(targets)))
        shown = existence.select_reported_tracks(odds, shown, design.reporting.max_false_share)
        targets = existence.move_to_mean_position(targets, leader)
    targets = select(targets, shown)
    return tracks_to_dataset(state.time_s, targets.id, targets.mean, targets.covariance, targets.misses > 0)


@dataclass(frozen=True)
class PendingEpoch:
    """What is kept of an epoch until its tracks are reported.

    Parameters
    ----------
    time_s
        Epoch. [s]
    channel, max_false_share, coasted
        Channel of the existence model, and the keys of the design.
    targets, log_odds
        One target of each vehicle (`existence.leaders`), confirmed or not, and its log odds. [nat]
    measured_s, measured_at
        Time and position of each target's last measurement. [s, m]
    known
        Ids of all targets of the epoch.
    live
        Tracks reported without a lag.
    """

    time_s: float
    channel: str
    max_false_share: float
    coasted: bool
    targets: Targets
    log_odds: Float[Array, "target"]
    measured_s: Float[Array, "target"]
    measured_at: Float[Array, "target 2"]
    known: Int[Array, "known"]
    live: xr.Dataset


@dataclass(frozen=True)
class ReportCandidates:
    """Tracks that may be reported of an epoch, by what is known at the end of the lag.

    Parameters
    ----------
    ident, mean, covariance, coasted
        See `tracks_to_dataset`.
    features
        Features of the smoothed existence model, in the order of its calibration.
    """

    ident: Int[Array, "track"]
    mean: Float[Array, "track 4"]
    covariance: Float[Array, "track 4 4"]
    coasted: Bool[Array, "track"]
    features: Float[Array, "track feature"]

    def select(self, index: Bool[Array, "track"] | Int[Array, "kept"]) -> "ReportCandidates":
        """The candidates at an index or mask."""
        return ReportCandidates(**{name: values[index] for name, values in vars(self).items()})

    def dataset(self, time_s: float) -> xr.Dataset:
        """The candidates as a Dataset of the schema ``tracks``."""
        return tracks_to_dataset(time_s, self.ident, self.mean, self.covariance, self.coasted)


def advance(
    pending: Sequence[PendingEpoch], state: TrackerState, live: xr.Dataset
) -> tuple[tuple[PendingEpoch, ...], tuple[xr.Dataset, ...]]:
    """Take in an epoch, and report those that are due.

    Parameters
    ----------
    pending
        Epochs that wait; none at first.
    state, live
        The tracker after this epoch, and its `report`.

    Returns
    -------
    The epochs that still wait, and the tracks of those that are due, the earliest first. Without a lag these
    are ``live``.
    """
    lag_s = state.effective_design.reporting.effective_lag_s
    if lag_s == 0:
        return (), (*flush(pending), live)
    epochs = (*pending, pending_epoch(pending[-1] if pending else None, state, live))
    due = sum(state.time_s - one.time_s >= lag_s - _ROUNDING_S for one in epochs)
    return epochs[due:], tuple(_smoothed(epochs[k:]) for k in range(due))


def flush(pending: Sequence[PendingEpoch]) -> tuple[xr.Dataset, ...]:
    """Tracks of the epochs that wait, when no more follow."""
    return tuple(_smoothed(pending[k:]) for k in range(len(pending)))


def reported_epochs(states: Iterable[TrackerState]) -> Iterator[xr.Dataset]:
    """Tracks of each epoch, with the lag of the design, from the states after each."""
    pending: tuple[PendingEpoch, ...] = ()
    for state in states:
        pending, due = advance(pending, state, report(state))
        yield from due
    yield from flush(pending)


@dataclass(frozen=True)
class LabelledTracks:
    """Tracks of an epoch that are reported at one or more limits of the false share.

    Parameters
    ----------
    tracks
        Schema ``tracks``.
    at
        Whether each track is reported at each limit.
    """

    tracks: xr.Dataset
    at: Bool[Array, "share track"]


def report_at_shares(
    states: Iterable[TrackerState], max_false_shares: Sequence[float]
) -> Iterator[LabelledTracks]:
    """Like `reported_epochs`, at several limits of the false share in place of the design's own."""
    waiting: list[tuple[PendingEpoch, TrackerState]] = []
    for state in states:
        if state.effective_design.reporting.effective_lag_s > 0:
            before = waiting[-1][0] if waiting else None
            waiting.append((pending_epoch(before, state, xr.Dataset()), state))
            continue
        yield from _smoothed_at_shares(waiting, max_false_shares)
        waiting = []
        yield _live_at_shares(state, max_false_shares)
    yield from _smoothed_at_shares(waiting, max_false_shares)


def _smoothed_at_shares(
    waiting: Sequence[tuple[PendingEpoch, TrackerState]], max_false_shares: Sequence[float]
) -> Iterator[LabelledTracks]:
    """Tracks of epochs after which none follows."""
    epochs, times_s = [one for one, _ in waiting], np.array([one.time_s for one, _ in waiting])
    for k, (first, state) in enumerate(waiting):
        known = np.flatnonzero(times_s - first.time_s >= state.design.reporting.lag_s - _ROUNDING_S)
        last = known[0] if len(known) else len(epochs) - 1
        if last == k:
            yield _live_at_shares(state, max_false_shares)
            continue
        found, odds, may = _smoothed_odds(epochs[k : last + 1])
        at = np.stack([existence.select_reported_tracks(odds, may, share) for share in max_false_shares])
        once = np.flatnonzero(at.any(axis=0))
        yield LabelledTracks(found.select(once).dataset(first.time_s), at[:, once])


def _live_at_shares(state: TrackerState, max_false_shares: Sequence[float]) -> LabelledTracks:
    """Tracks reported without a lag."""
    designs = [state.design for _ in max_false_shares]
    if state.effective_design.reporting.uses_existence:
        designs = [state.design.replace({"reporting.max_false_share": share}) for share in max_false_shares]
    reports = [report(replace(state, design=design)) for design in designs]
    share = np.repeat(np.arange(len(reports)), [one.sizes["track"] for one in reports])
    tracks = xr.concat(reports, "track", combine_attrs="override")
    return LabelledTracks(tracks, share == np.arange(len(reports))[:, None])


def pending_epoch(before: PendingEpoch | None, state: TrackerState, live: xr.Dataset) -> PendingEpoch:
    """What is to be kept of an epoch, given the one before and the tracks reported at once."""
    design, every = state.design, state.targets
    leader = existence.leaders(state.duplicates, every)
    leads = leader == np.arange(len(every))
    targets = select(existence.move_to_mean_position(every, leader), leads)
    odds = existence.group_log_odds(design.detect.channel, every, leader)[leads]
    measured_s = np.where(targets.misses == 0, state.time_s, np.nan)
    measured_at = targets.position.copy()
    if before is not None and len(before.targets):
        row, known = rows_among(before.targets.id, targets.id)
        old = known & (targets.misses > 0)
        measured_s[old], measured_at[old] = before.measured_s[row[old]], before.measured_at[row[old]]
    return PendingEpoch(
        time_s=state.time_s,
        channel=design.detect.channel,
        max_false_share=design.reporting.max_false_share,
        coasted=design.reporting.coasted,
        targets=targets,
        log_odds=odds.clip(-MAX_LOG_ODDS, MAX_LOG_ODDS),
        measured_s=measured_s,
        measured_at=measured_at,
        known=every.id,
        live=live,
    )


def report_candidates(epochs: Sequence[PendingEpoch]) -> ReportCandidates:
    """Tracks that may be reported of the first of two or more epochs, by all that came after."""
    now = _followed_tracks(epochs)
    back = _extrapolated_tracks(epochs)
    if len(now.ident) and len(back.ident):
        apart_m, _ = KDTree(now.mean[:, :2]).query(back.mean[:, :2])
        back = back.select(apart_m >= DUPLICATE_M)
    both = zip(vars(now).items(), vars(back).values(), strict=True)
    return ReportCandidates(**{name: np.concatenate([values, more]) for (name, values), more in both})


def _smoothed(epochs: Sequence[PendingEpoch]) -> xr.Dataset:
    """Tracks of the first of some epochs."""
    first = epochs[0]
    if len(epochs) == 1:
        return first.live
    found, odds, may = _smoothed_odds(epochs)
    reported = existence.select_reported_tracks(odds, may, first.max_false_share)
    return found.select(reported).dataset(first.time_s)


def _smoothed_odds(
    epochs: Sequence[PendingEpoch],
) -> tuple[ReportCandidates, Float[Array, "track"], Bool[Array, "track"]]:
    """Candidates of the first of some epochs, their log odds, and which may be reported."""
    found = report_candidates(epochs)
    odds = read_calibration("existence_smoothed").models[epochs[0].channel].log_odds(found.features)
    return found, odds, ~found.coasted if not epochs[0].coasted else np.ones(len(odds), bool)


def _followed_tracks(epochs: Sequence[PendingEpoch]) -> ReportCandidates:
    """Targets of the first of some epochs that are confirmed by the last."""
    first, later = epochs[0], epochs[1:]
    targets, n = first.targets, len(first.targets)
    last_odds, max_odds, confirmed = (
        np.full(n, -MAX_LOG_ODDS),
        first.log_odds.copy(),
        targets.confirmed.copy(),
    )
    hits, alive = np.zeros(n), np.zeros(n, bool)
    again_s, again_at = np.full(n, np.nan), targets.position.copy()
    for one in later:
        row, alive = rows_among(one.targets.id, targets.id)
        if not len(one.targets):
            last_odds[:] = -MAX_LOG_ODDS
            continue
        last_odds = np.where(alive, one.log_odds[row], -MAX_LOG_ODDS)
        max_odds = np.where(alive, np.maximum(max_odds, one.log_odds[row]), max_odds)
        confirmed |= alive & one.targets.confirmed[row]
        measured = alive & (one.targets.misses[row] == 0)
        fresh = measured & np.isnan(again_s)
        again_s[fresh], again_at[fresh] = one.time_s, one.targets.position[row[fresh]]
        hits += measured
    missed = targets.misses > 0
    gap = missed & np.isfinite(again_s) & np.isfinite(first.measured_s)
    part = (first.time_s - first.measured_s[gap]) / (again_s[gap] - first.measured_s[gap])
    mean, old = targets.mean.copy(), first.measured_at[gap]
    mean[gap, :2] = old + part[:, None] * (again_at[gap] - old)
    none = np.zeros(n)
    features = np.stack([
        first.log_odds, last_odds, max_odds, hits / len(later), ~alive, missed, missed & np.isnan(again_s),
        targets.confirmed, none, none,
    ], axis=-1).astype(float)  # fmt: skip
    return ReportCandidates(targets.id, mean, targets.covariance, missed, features).select(confirmed)


def _extrapolated_tracks(epochs: Sequence[PendingEpoch]) -> ReportCandidates:
    """Targets first measured after the first of some epochs, where their motion leads back to."""
    first, later, last = epochs[0], epochs[1:], epochs[-1]
    new = last.targets.confirmed & ~np.isin(last.targets.id, first.known)
    targets, odds = select(last.targets, new), last.log_odds[new]
    hits, born_s, born_at = np.zeros(len(odds)), np.full(len(odds), np.nan), targets.position.copy()
    for one in later:
        row, alive = rows_among(one.targets.id, targets.id)
        if not len(one.targets):
            continue
        measured = alive & (one.targets.misses[row] == 0)
        fresh = measured & np.isnan(born_s)
        born_s[fresh], born_at[fresh] = one.time_s, one.targets.position[row[fresh]]
        hits += measured
    before_s = born_s - first.time_s
    mean = np.concatenate([born_at - before_s[:, None] * targets.mean[:, 2:], targets.mean[:, 2:]], axis=1)
    ones, none = np.ones(len(odds)), np.zeros(len(odds))
    features = np.stack(
        [odds, odds, odds, hits / len(later), none, none, none, none, ones, before_s], axis=-1
    )
    sure = (hits >= MIN_BACK_HITS) & (before_s <= MAX_BACK_S + _ROUNDING_S)
    return ReportCandidates(targets.id, mean, targets.covariance, ones > 0, features).select(sure)


@dataclass(frozen=True)
class PastState:
    """State of one track at one time, and whether it was measured then."""

    time_s: float
    mean: Float[Array, "4"]
    covariance: Float[Array, "4 4"]
    measured: bool


@dataclass(frozen=True)
class History:
    """Earlier states of tracks that may still be reported.

    Parameters
    ----------
    waiting
        States of each track that wait, the oldest first.
    reported
        Positions reported at each time, as far back as any state that waits. [m]
    last
        Last measured state of each confirmed track.
    """

    waiting: Mapping[int, tuple[PastState, ...]] = field(default_factory=dict)
    reported: Mapping[float, np.ndarray] = field(default_factory=dict)
    last: Mapping[int, PastState] = field(default_factory=dict)


def report_history(
    history: History, state: TrackerState, live: xr.Dataset
) -> tuple[History, list[tuple[float, xr.Dataset]]]:
    """Report earlier states of tracks confirmed now, and gaps of tracks measured again.

    The earlier states are those that the tracker held tentatively, and the positions that a detector found in
    earlier frames. A gap is filled by a straight line between the two measurements.

    Parameters
    ----------
    history
        History after the epoch before.
    state, live
        The tracker after this epoch, and its `report`.

    Returns
    -------
    The history after this epoch; times, the earliest first, and tracks of earlier epochs, with ``tentative``
    1.
    """
    targets, coasted = state.targets, state.design.reporting.coasted
    waiting, last, known = {}, {}, {}
    reported = {**history.reported, state.time_s: np.stack([live["east"], live["north"]], axis=-1)}
    for k, ident in enumerate(targets.id.tolist()):
        measured, confirmed = bool(targets.misses[k] == 0), bool(targets.confirmed[k])
        now = PastState(state.time_s, targets.mean[k], targets.covariance[k], measured)
        before = history.waiting.get(ident)
        if before is None:
            before = () if ident in history.last else _states_before_birth(state, k)
        if not confirmed:
            waiting[ident] = (*before, now)
        elif measured:
            past = (*before, now) if ident not in history.last else (history.last[ident], *before, now)
            for one in _with_gaps_filled(past)[len(past) - len(before) - 1 : -1]:
                known.setdefault(one.time_s, []).append((ident, one))
            last[ident] = now
        else:
            waiting[ident] = before if coasted else (*before, now)
            last[ident] = history.last.get(ident, now)
    out = []
    for time_s in sorted(known):
        others = reported.get(time_s, np.empty((0, 2)))
        fresh = [(ident, one) for ident, one in known[time_s] if _is_apart(one.mean[:2], others)]
        if fresh:
            out.append((time_s, _tentative_tracks(fresh, time_s)))
            reported[time_s] = np.concatenate([others, [one.mean[:2] for _, one in fresh]])
    oldest = min((states[0].time_s for states in waiting.values() if states), default=state.time_s)
    oldest = min([oldest, *state.detections.earlier_s])
    kept = {time_s: positions for time_s, positions in reported.items() if time_s >= oldest}
    return History(waiting, kept, last), out


def _states_before_birth(state: TrackerState, k: int) -> tuple[PastState, ...]:
    """Earlier states of a new track, by the detector's own earlier positions."""
    found, targets = state.detections, state.targets
    if found.earlier is None or not len(found):
        return ()
    of = int(np.argmin(np.hypot(*(found.position - targets.born[k]).T)))
    out = []
    for time_s, position in zip(found.earlier_s, found.earlier[of], strict=True):
        if np.isfinite(position).all():
            mean = np.r_[position, targets.mean[k, 2:]]
            out.append(PastState(time_s, mean, targets.covariance[k], True))
    return tuple(out)


def _with_gaps_filled(states: tuple[PastState, ...]) -> tuple[PastState, ...]:
    """The states, those not measured moved onto the straight line between measured ones."""
    if all(one.measured for one in states):
        return states
    times = np.array([one.time_s for one in states])
    sure = np.array([one.measured for one in states])
    at = np.array([one.mean[:2] for one in states])
    line = np.stack([np.interp(times, times[sure], at[sure, k]) for k in range(2)], axis=-1)
    return tuple(
        one if one.measured else replace(one, mean=np.r_[xy, one.mean[2:]])
        for one, xy in zip(states, line, strict=True)
    )


def _is_apart(position: Float[Array, "2"], others: Float[Array, "n 2"]) -> bool:
    return not (np.hypot(*(others - position).T) < HISTORY_DUPLICATE_M).any()


def _tentative_tracks(states: list[tuple[int, PastState]], time_s: float) -> xr.Dataset:
    tracks = tracks_to_dataset(
        time_s,
        np.array([ident for ident, _ in states]),
        np.array([one.mean for _, one in states]),
        np.array([one.covariance for _, one in states]),
        np.array([not one.measured for _, one in states]),
    )
    return tracks.assign(tentative=("track", np.ones(len(states)), {"units": "1"}))
