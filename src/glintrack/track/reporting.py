"""Report tracks: at once, with a fixed lag, or back to where a track was before it was confirmed.

With existence reporting, the tracks of an epoch are reported `ReportingDesign.lag_s` later. Then it is known
which were measured again, lost, or detected later. A track in a gap was on the straight line between two
measurements. One first measured within the lag is extrapolated back along its motion. The log odds of
existence are a logistic model of these observations (``data/calibration/existence_smoothed.toml``;
``python tools/calibrate.py`` fits it). Tracking and queries for spectra do not wait.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.core.schema import MOVING_SPEED_M_S
from glintrack.track import existence
from glintrack.track.calibration import read_calibration
from glintrack.track.design import TrackDesign
from glintrack.track.frame_detections import TrackerState
from glintrack.track.initiation import Targets, find_rows, select

MAX_LOG_ODDS = 6.0  # a lost track has its negative
MAX_BACK_S = 1.5  # maximum extrapolation before the first measurement
MIN_BACK_HITS, MIN_BACK_S = 2, 0.5  # minimum measurements for an extrapolation, and time since the first
DUPLICATE_M = 4.0  # an extrapolated track nearer to a candidate is the same vehicle
HISTORY_DUPLICATE_M = 3.0  # from a position already reported at that time: the same vehicle
_ROUNDING_S = 1e-6


def tracks_to_dataset(
    time_s: float,
    ident: Int[Array, "track"],
    mean: Float[Array, "track 4"],
    covariance: Float[Array, "track 4 4"],
    coasted: Bool[Array, "track"],
    tentative: bool = False,
) -> xr.Dataset:
    """Convert tracks of one epoch to a Dataset of the schema ``tracks``.

    Parameters
    ----------
    time_s
        Epoch. [s]
    ident
        Ids of the tracks.
    mean, covariance
        State ``[east, north, east speed, north speed]``. [m, m s⁻¹]
    coasted
        Mask of the tracks that were not measured. Their status is ``stopped`` below 1 m/s, else ``coasted``.
    tentative
        The tracks were confirmed only later: their status is ``tentative``.
    """
    unmeasured = np.where(is_moving(mean), "coasted", "stopped")
    status = np.full(len(ident), "tentative") if tentative else np.where(coasted, unmeasured, "measured")
    columns = {
        "east_m": (mean[:, 0], "m"),
        "north_m": (mean[:, 1], "m"),
        "east_speed_m_s": (mean[:, 2], "m s-1"),
        "north_speed_m_s": (mean[:, 3], "m s-1"),
        "east_var_m2": (covariance[:, 0, 0], "m2"),
        "north_var_m2": (covariance[:, 1, 1], "m2"),
        "east_north_cov_m2": (covariance[:, 0, 1], "m2"),
        "status": (status, "1"),
    }
    tracks = xr.Dataset(
        {name: ("track", values.copy(), {"units": units}) for name, (values, units) in columns.items()},
        coords={"track": np.array(ident, np.int64)},
        attrs={"time_s": time_s},
    )
    return schema.check(tracks, "tracks")


def is_moving(mean: Float[Array, "track 4"]) -> Bool[Array, "track"]:
    """Return True for states of at least 1 m/s."""
    return np.hypot(*mean[:, 2:].T) >= MOVING_SPEED_M_S


def report(state: TrackerState) -> xr.Dataset:
    """Report the tracks of the last epoch, without a lag, as a Dataset of the schema ``tracks``."""
    targets, shown, design = state.targets, state.targets.confirmed, state.effective_design
    if not design.reporting.coasted:
        shown = shown & (targets.misses == 0)
    if design.reporting.uses_existence:
        primary = existence.primary_targets(state.duplicates, targets)
        odds = existence.group_log_odds(design.detect.channel, targets, primary, state.flow, state.time_s)
        shown = shown & (primary == np.arange(len(targets)))
        shown = _select_candidates(design, odds, shown, targets.mean)
        targets = existence.move_to_mean_position(targets, primary)
    targets = select(targets, shown)
    return tracks_to_dataset(state.time_s, targets.id, targets.mean, targets.covariance, targets.misses > 0)


@dataclass(frozen=True)
class PendingEpoch:
    """Epoch whose tracks are not yet reported.

    Parameters
    ----------
    time_s
        Epoch. [s]
    design
        Design of the tracker.
    targets, log_odds
        One target of each vehicle (`existence.primary_targets`), confirmed or not, and its log odds. [nat]
    measured_s, measured_at
        Time and position of each target's last measurement. [s, m]
    known
        Ids of all targets of the epoch.
    live
        Tracks reported without a lag.
    """

    time_s: float
    design: TrackDesign
    targets: Targets
    log_odds: Float[Array, "target"]
    measured_s: Float[Array, "target"]
    measured_at: Float[Array, "target 2"]
    known: Int[Array, "known"]
    live: xr.Dataset


@dataclass(frozen=True)
class ReportCandidates:
    """Tracks of an epoch that may be reported at the end of the lag.

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

    def select(self, index: Bool[Array, "track"] | Int[Array, "some"]) -> "ReportCandidates":
        """Select the candidates at an index or mask."""
        return ReportCandidates(**{name: values[index] for name, values in vars(self).items()})

    def dataset(self, time_s: float) -> xr.Dataset:
        """Convert the candidates to a Dataset of the schema ``tracks``."""
        return tracks_to_dataset(time_s, self.ident, self.mean, self.covariance, self.coasted)


def advance(
    pending: Sequence[PendingEpoch], state: TrackerState, live: xr.Dataset
) -> tuple[tuple[PendingEpoch, ...], tuple[xr.Dataset, ...]]:
    """Add an epoch, and report those that are due.

    Parameters
    ----------
    pending
        Pending epochs; none at first.
    state, live
        The tracker after this epoch, and its `report`.

    Returns
    -------
    The epochs that are still pending, and the tracks of those that are due, the earliest first. Without a lag
    these are ``live``.
    """
    lag_s = state.effective_design.reporting.effective_lag_s
    if lag_s == 0:
        return (), (*flush(pending), live)
    epochs = (*pending, pending_epoch(pending[-1] if pending else None, state, live))
    due = sum(state.time_s - one.time_s >= lag_s - _ROUNDING_S for one in epochs)
    return epochs[due:], tuple(_report_smoothed(epochs[k:]) for k in range(due))


def flush(pending: Sequence[PendingEpoch]) -> tuple[xr.Dataset, ...]:
    """Report the pending epochs, when no more follow."""
    return tuple(_report_smoothed(pending[k:]) for k in range(len(pending)))


def report_epochs(states: Iterable[TrackerState]) -> Iterator[xr.Dataset]:
    """Report the tracks of each epoch, with the lag of the design, from the states after each."""
    pending: tuple[PendingEpoch, ...] = ()
    for state in states:
        pending, due = advance(pending, state, report(state))
        yield from due
    yield from flush(pending)


def pending_epoch(before: PendingEpoch | None, state: TrackerState, live: xr.Dataset) -> PendingEpoch:
    """Build the pending epoch of a state, given the one before and the tracks reported without a lag."""
    design, every = state.design, state.targets
    primary = existence.primary_targets(state.duplicates, every)
    is_primary = primary == np.arange(len(every))
    targets = select(existence.move_to_mean_position(every, primary), is_primary)
    channel = design.detect.channel
    odds = existence.group_log_odds(channel, every, primary, state.flow, state.time_s)[is_primary]
    measured_s = np.where(targets.misses == 0, state.time_s, np.nan)
    measured_at = targets.position.copy()
    if before is not None and len(before.targets):
        row, known = find_rows(before.targets.id, targets.id)
        old = known & (targets.misses > 0)
        measured_s[old], measured_at[old] = before.measured_s[row[old]], before.measured_at[row[old]]
    return PendingEpoch(
        time_s=state.time_s, design=design, targets=targets,
        log_odds=odds.clip(-MAX_LOG_ODDS, MAX_LOG_ODDS), measured_s=measured_s, measured_at=measured_at,
        known=every.id, live=live,
    )  # fmt: skip


def report_candidates(epochs: Sequence[PendingEpoch]) -> ReportCandidates:
    """Collect the tracks of the first of two or more epochs that may be reported."""
    now, back = _present_tracks(epochs), _extrapolate_tracks(epochs)
    if len(now.ident) and len(back.ident):
        apart_m, _ = KDTree(now.mean[:, :2]).query(back.mean[:, :2])
        back = back.select(apart_m >= DUPLICATE_M)
    both = zip(vars(now).items(), vars(back).values(), strict=True)
    return ReportCandidates(**{name: np.concatenate([values, more]) for (name, values), more in both})


def _report_smoothed(epochs: Sequence[PendingEpoch]) -> xr.Dataset:
    """Report the first of some epochs."""
    first, reporting = epochs[0], epochs[0].design.reporting
    if len(epochs) == 1:
        return first.live
    found = report_candidates(epochs)
    model = read_calibration("existence_smoothed").models[first.design.detect.channel]
    may = ~found.coasted if not reporting.coasted else np.ones(len(found.ident), bool)
    odds = model.log_odds(found.features)
    reported = _select_candidates(first.design, odds, may, found.mean)
    return found.select(reported).dataset(first.time_s)


def _select_candidates(
    design: TrackDesign,
    log_odds: Float[Array, "track"],
    candidate: Bool[Array, "track"],
    mean: Float[Array, "track 4"],
) -> Bool[Array, "track"]:
    """Select tracks by their log odds, adapted to the candidates of this epoch."""
    adapted = log_odds.copy()
    adapted[candidate] = existence.adapt_log_odds(design.detect.channel, log_odds[candidate])
    return existence.select_reported_tracks(
        adapted, candidate, is_moving(mean), design.reporting.max_false_share
    )


def _present_tracks(epochs: Sequence[PendingEpoch]) -> ReportCandidates:
    """Targets of the first of some epochs that are confirmed by the last."""
    first, later = epochs[0], epochs[1:]
    targets, n = first.targets, len(first.targets)
    last_odds, max_odds = np.full(n, -MAX_LOG_ODDS), first.log_odds.copy()
    confirmed = targets.confirmed.copy()
    hits, again_s, again_at = _first_measurements(targets, later)
    alive = np.zeros(n, bool)
    for one in later:
        row, alive = find_rows(one.targets.id, targets.id)
        last_odds = np.full(n, -MAX_LOG_ODDS)
        last_odds[alive] = one.log_odds[row[alive]]
        max_odds = np.maximum(max_odds, last_odds)
        confirmed[alive] |= one.targets.confirmed[row[alive]]
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


def _first_measurements(
    targets: Targets, later: Sequence[PendingEpoch]
) -> tuple[Float[Array, "target"], Float[Array, "target"], Float[Array, "target 2"]]:
    """Count the measurements of each target later, with time and position of the first. [1, s, m]"""
    hits, first_s = np.zeros(len(targets)), np.full(len(targets), np.nan)
    first_at = targets.position.copy()
    for one in later:
        row, alive = find_rows(one.targets.id, targets.id)
        measured = np.flatnonzero(alive)
        measured = measured[one.targets.misses[row[measured]] == 0]
        fresh = measured[np.isnan(first_s[measured])]
        first_s[fresh], first_at[fresh] = one.time_s, one.targets.position[row[fresh]]
        hits[measured] += 1
    return hits, first_s, first_at


def _extrapolate_tracks(epochs: Sequence[PendingEpoch]) -> ReportCandidates:
    """Extrapolate targets that were first measured after the first of some epochs back to it."""
    first, later, last = epochs[0], epochs[1:], epochs[-1]
    new = last.targets.confirmed & ~np.isin(last.targets.id, first.known)
    targets, odds = select(last.targets, new), last.log_odds[new]
    hits, first_s, first_at = _first_measurements(targets, later)
    before_s = first_s - first.time_s
    mean = np.concatenate([first_at - before_s[:, None] * targets.mean[:, 2:], targets.mean[:, 2:]], axis=1)
    ones, none = np.ones(len(odds)), np.zeros(len(odds))
    features = np.stack(
        [odds, odds, odds, hits / len(later), none, none, none, none, ones, before_s], axis=-1
    )
    sure = (hits >= MIN_BACK_HITS) & (before_s <= MAX_BACK_S + _ROUNDING_S)
    sure &= last.time_s - first_s >= MIN_BACK_S - _ROUNDING_S
    return ReportCandidates(targets.id, mean, targets.covariance, ones > 0, features).select(sure)


@dataclass(frozen=True)
class PastState:
    """State of one track at one time, measured or not."""

    time_s: float
    mean: Float[Array, "4"]
    covariance: Float[Array, "4 4"]
    measured: bool


@dataclass(frozen=True)
class History:
    """Earlier states of tracks that may still be reported.

    Parameters
    ----------
    pending
        Pending states of each track, the oldest first.
    reported
        Positions reported at each time, as far back as any pending state. [m]
    last
        Last measured state of each confirmed track.
    """

    pending: Mapping[int, tuple[PastState, ...]] = field(default_factory=dict)
    reported: Mapping[float, np.ndarray] = field(default_factory=dict)
    last: Mapping[int, PastState] = field(default_factory=dict)


def report_history(
    history: History, state: TrackerState, live: xr.Dataset
) -> tuple[History, list[tuple[float, xr.Dataset]]]:
    """Report earlier states of tracks confirmed now, and gaps of tracks measured again.

    The earlier states are those of the tentative track, and the positions that a detector found in earlier
    frames. A gap is filled by a straight line between the two measurements.

    Parameters
    ----------
    history
        History after the epoch before.
    state, live
        The tracker after this epoch, and its `report`.

    Returns
    -------
    The history after this epoch; times, the earliest first, and tracks of earlier epochs, all ``tentative``.
    """
    targets, coasted = state.targets, state.design.reporting.coasted
    pending, last, known = {}, {}, {}
    reported = {**history.reported, state.time_s: np.stack([live["east_m"], live["north_m"]], axis=-1)}
    for k, ident in enumerate(targets.id.tolist()):
        measured, confirmed = bool(targets.misses[k] == 0), bool(targets.confirmed[k])
        now = PastState(state.time_s, targets.mean[k], targets.covariance[k], measured)
        before = history.pending.get(ident)
        if before is None:
            before = () if ident in history.last else _states_before_birth(state, k)
        if not confirmed:
            pending[ident] = (*before, now)
        elif measured:
            past = (*before, now) if ident not in history.last else (history.last[ident], *before, now)
            for one in _fill_gaps(past)[len(past) - len(before) - 1 : -1]:
                known.setdefault(one.time_s, []).append((ident, one))
            last[ident] = now
        else:
            pending[ident] = before if coasted else (*before, now)
            last[ident] = history.last.get(ident, now)
    out = []
    for time_s in sorted(known):
        others = reported.get(time_s, np.empty((0, 2)))
        fresh = [
            (ident, one)
            for ident, one in known[time_s]
            if not (np.hypot(*(others - one.mean[:2]).T) < HISTORY_DUPLICATE_M).any()
        ]
        if fresh:
            tracks = tracks_to_dataset(
                time_s, np.array([ident for ident, _ in fresh]), np.array([one.mean for _, one in fresh]),
                np.array([one.covariance for _, one in fresh]),
                np.array([not one.measured for _, one in fresh]), tentative=True,
            )  # fmt: skip
            out.append((time_s, tracks))
            reported[time_s] = np.concatenate([others, [one.mean[:2] for _, one in fresh]])
    oldest = min((states[0].time_s for states in pending.values() if states), default=state.time_s)
    oldest = min([oldest, *state.detections.earlier_s])
    recent = {time_s: positions for time_s, positions in reported.items() if time_s >= oldest}
    return History(pending, recent, last), out


def _states_before_birth(state: TrackerState, k: int) -> tuple[PastState, ...]:
    """Earlier states of a new track, from the detector's own earlier positions."""
    found, targets = state.detections, state.targets
    if found.earlier is None or not len(found):
        return ()
    of = int(np.argmin(np.hypot(*(found.position - targets.first_position[k]).T)))
    out = []
    for time_s, position in zip(found.earlier_s, found.earlier[of], strict=True):
        if np.isfinite(position).all():
            mean = np.r_[position, targets.mean[k, 2:]]
            out.append(PastState(time_s, mean, targets.covariance[k], True))
    return tuple(out)


def _fill_gaps(states: tuple[PastState, ...]) -> tuple[PastState, ...]:
    """Move the states that were not measured onto the straight line between measured ones."""
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
