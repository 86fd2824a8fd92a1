"""Tracks told some time late, by what came after: which of them are vehicles, and where they were.

At its time the tracker knows of a frame only what came before. `ReportingDesign.lag_s` later it knows
who was measured again, who was lost for good, and who came in sight. A track that was missed and measured
again was on the straight line between both places; one first measured within the lag was where its motion
leads back to. The log odds that each was a vehicle come from a logistic law of all that is known by then;
``python tools/calibrate_belief.py`` fits it. Following and asking for spectra wait for none of it.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int
from scipy.spatial import KDTree

from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.track import belief, companions
from glintrack.track.initiation import Targets, rows_among, select
from glintrack.track.state import TrackerState
from glintrack.track.told import told
from glintrack.track.tracker import report

FEATURES = (
    "odds", "odds at the end", "greatest odds", "share measured since", "gone", "missed", "missed for good",
    "confirmed", "born since", "time before birth",
)  # fmt: skip
# calibrated: of each channel an intercept, and a weight of each of `FEATURES`
LAW = {
    "pan": (0.35, 0.18, 0.43, 0.51, -0.88, 1.70, 0.28, -0.63, 0.31, 0.97, -2.52),
    "dolp": (0.07, 0.27, 0.31, 0.50, -0.32, 1.30, 0.10, -0.14, -0.00, 0.78, -2.99),
    "all": (0.30, 0.23, 0.45, 0.44, -0.97, 1.83, 0.21, -0.65, 0.47, 1.23, -2.89),
}
# end of what is calibrated
MOST_ODDS = 6.0  # of a track gone by then the negative of it
BACK_S = 1.5  # before its first measurement a track is told no earlier
BACK_HITS = 2  # measurements from which its motion leads back
DOUBLE_M = 4.0  # from another candidate it is that one's vehicle


@dataclass(frozen=True)
class Moment:
    """What is kept of an epoch until its tracks are told.

    Parameters
    ----------
    time_s
        Of the epoch. [s]
    channel, false_share
        By whose law tracks are judged, and which share of those told may be false.
    targets, odds
        One of each vehicle (`companions.leaders`), confirmed or not, and the log odds of it then. [nat]
    measured_s, measured_at
        When and where each was last measured. [s, m]
    known
        Numbers of all targets there were.
    coasted
        Whether what was not measured may be told.
    live
        What was told at once.
    """

    time_s: float
    channel: str
    false_share: float
    targets: Targets
    odds: Float[Array, "target"]
    measured_s: Float[Array, "target"]
    measured_at: Float[Array, "target 2"]
    known: Int[Array, "known"]
    coasted: bool
    live: xr.Dataset


@dataclass(frozen=True)
class Candidates:
    """What may be told of an epoch, by what came after.

    Parameters
    ----------
    ident, mean, covariance, coasted
        As of `told`.
    features
        `FEATURES` of each.
    """

    ident: Int[Array, "track"]
    mean: Float[Array, "track 4"]
    covariance: Float[Array, "track 4 4"]
    coasted: Bool[Array, "track"]
    features: Float[Array, "track feature"]

    def only(self, kept: Bool[Array, "track"] | Int[Array, "kept"]) -> "Candidates":
        """Those that are kept."""
        return Candidates(
            self.ident[kept], self.mean[kept], self.covariance[kept], self.coasted[kept], self.features[kept]
        )

    def dataset(self, time_s: float) -> xr.Dataset:
        """As a Dataset of the schema ``tracks``."""
        tracks = told(time_s, self.ident, self.mean, self.covariance, self.coasted)
        return schema.check(tracks, "tracks")


def tell(
    waiting: Sequence[Moment], state: TrackerState, live: xr.Dataset
) -> tuple[tuple[Moment, ...], tuple[xr.Dataset, ...]]:
    """What can be told after an epoch, and what waits on.

    Parameters
    ----------
    waiting
        After the epoch before; none at first.
    state, live
        The tracker after this epoch, and its `report`.

    Returns
    -------
    What waits; tracks of the epochs whose time has come, the earliest first. Without
    ``reporting.lag_s``, or without existence reporting, that is ``live``.
    """
    if not _waits(state):
        return (), (*rest(waiting), live)
    lag_s = state.design.reporting.lag_s
    moments = (*waiting, moment(waiting[-1] if waiting else None, state, live))
    due = sum(state.time_s - one.time_s >= lag_s - 1e-6 for one in moments)
    return moments[due:], tuple(_told(moments[k:]) for k in range(due))


def _waits(state: TrackerState) -> bool:
    """Whether what is told of an epoch waits for others."""
    return state.effective_design.reporting.effective_lag_s > 0


def rest(waiting: Sequence[Moment]) -> tuple[xr.Dataset, ...]:
    """Tracks of the epochs that wait, when no more will come."""
    return tuple(_told(waiting[k:]) for k in range(len(waiting)))


def told_of(states: Iterable[TrackerState]) -> Iterator[xr.Dataset]:
    """Tracks of each epoch of a flight, late as the design has it, from the states after each."""
    waiting: tuple[Moment, ...] = ()
    for state in states:
        waiting, due = tell(waiting, state, report(state))
        yield from due
    yield from rest(waiting)


@dataclass(frozen=True)
class ToldAt:
    """Tracks of an epoch that are told at one or more of some shares of false ones, and at which.

    Parameters
    ----------
    tracks
        Schema ``tracks``.
    at
        Whether each is told at each share.
    """

    tracks: xr.Dataset
    at: Bool[Array, "share track"]


def told_at(states: Iterable[TrackerState], false_shares: Sequence[float]) -> Iterator[ToldAt]:
    """As `told_of`, at each of some shares of false tracks in the place of the design's own.

    Each epoch is judged once, at the end: states are held till then.
    """
    waiting: list[tuple[Moment, TrackerState]] = []
    for state in states:
        if _waits(state):
            before = waiting[-1][0] if waiting else None
            waiting.append((moment(before, state, xr.Dataset()), state))
            continue
        yield from _told_each(waiting, false_shares)
        waiting = []
        yield _reported_at(state, false_shares)
    yield from _told_each(waiting, false_shares)


def _told_each(
    waiting: Sequence[tuple[Moment, TrackerState]], false_shares: Sequence[float]
) -> Iterator[ToldAt]:
    """Tracks of epochs after which nothing comes."""
    moments, times_s = [one for one, _ in waiting], np.array([one.time_s for one, _ in waiting])
    for k, (first, state) in enumerate(waiting):
        known = np.flatnonzero(times_s - first.time_s >= state.design.reporting.lag_s - 1e-6)
        last = known[0] if len(known) else len(moments) - 1
        if last == k:
            yield _reported_at(state, false_shares)
            continue
        found, odds, may = _judged(moments[k : last + 1])
        at = np.stack([belief.surest(odds, may, share) for share in false_shares])
        told_once = np.flatnonzero(at.any(axis=0))
        yield ToldAt(found.only(told_once).dataset(first.time_s), at[:, told_once])


def _reported_at(state: TrackerState, false_shares: Sequence[float]) -> ToldAt:
    """What is told at once."""
    design = state.design
    if state.effective_design.reporting.uses_existence:
        designs = [design.replace({"reporting.max_false_share": share}) for share in false_shares]
    else:
        designs = [design for _ in false_shares]
    reports = [report(replace(state, design=design)) for design in designs]
    share = np.repeat(np.arange(len(reports)), [one.sizes["track"] for one in reports])
    tracks = xr.concat(reports, "track", combine_attrs="override")
    return ToldAt(tracks, share == np.arange(len(reports))[:, None])


def moment(before: Moment | None, state: TrackerState, live: xr.Dataset) -> Moment:
    """What is to be kept of an epoch; ``before`` of the one before it."""
    if state.grid is None:
        raise ValueError("`state` must have seen a frame, got one that has not")
    design, every = state.design, state.targets
    leader = companions.leaders(state.companions, every)
    leads = leader == np.arange(len(every))
    targets = select(companions.in_the_middle(every, leader), leads)
    odds = belief.led_odds(design.detect.channel, every, leader)[leads]
    measured_s = np.where(targets.misses == 0, state.time_s, np.nan)
    measured_at = targets.position.copy()
    if before is not None and len(before.targets):
        row, there = rows_among(before.targets.id, targets.id)
        old = there & (targets.misses > 0)
        measured_s[old], measured_at[old] = before.measured_s[row[old]], before.measured_at[row[old]]
    false_share = design.reporting.max_false_share
    return Moment(
        state.time_s, design.detect.channel, false_share, targets, odds.clip(-MOST_ODDS, MOST_ODDS),
        measured_s, measured_at, every.id, design.reporting.coasted, live,
    )  # fmt: skip


def candidates(moments: Sequence[Moment]) -> Candidates:
    """What may be told of the first of some epochs, by all that came after.

    Parameters
    ----------
    moments
        Two at least, the earliest first.
    """
    now = _alive(moments)
    back = _led_back(moments)
    if len(now.ident) and len(back.ident):
        apart_m, _ = KDTree(now.mean[:, :2]).query(back.mean[:, :2])
        back = back.only(apart_m >= DOUBLE_M)
    return Candidates(*(np.concatenate(pair) for pair in zip(_columns(now), _columns(back), strict=True)))


def _told(moments: Sequence[Moment]) -> xr.Dataset:
    """Tracks of the first of some epochs."""
    first = moments[0]
    if len(moments) == 1:
        return first.live
    found, odds, may = _judged(moments)
    return found.only(belief.surest(odds, may, first.false_share)).dataset(first.time_s)


def _judged(moments: Sequence[Moment]) -> tuple[Candidates, Float[Array, "track"], Bool[Array, "track"]]:
    """Candidates of the first of some epochs, the log odds of each, and which may be told."""
    found = candidates(moments)
    intercept, *weights = LAW[moments[0].channel]
    odds = intercept + found.features @ np.array(weights)
    return found, odds, ~found.coasted if not moments[0].coasted else np.ones(len(odds), bool)


def _alive(moments: Sequence[Moment]) -> Candidates:
    """What was followed at the first of some epochs and is or was confirmed by the last."""
    first, later = moments[0], moments[1:]
    targets, n = first.targets, len(first.targets)
    last_odds, most_odds, confirmed = np.full(n, -MOST_ODDS), first.odds.copy(), targets.confirmed.copy()
    hits, alive = np.zeros(n), np.zeros(n, bool)
    again_s, again_at = np.full(n, np.nan), targets.position.copy()
    for one in later:
        row, alive = rows_among(one.targets.id, targets.id)
        if not len(one.targets):
            last_odds[:] = -MOST_ODDS
            continue
        last_odds = np.where(alive, one.odds[row], -MOST_ODDS)
        most_odds = np.where(alive, np.maximum(most_odds, one.odds[row]), most_odds)
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
    nothing = np.zeros(n)
    features = np.stack([
        first.odds, last_odds, most_odds, hits / len(later), ~alive, missed, missed & np.isnan(again_s),
        targets.confirmed, nothing, nothing,
    ], axis=-1).astype(float)  # fmt: skip
    return Candidates(targets.id, mean, targets.covariance, missed, features).only(confirmed)


def _led_back(moments: Sequence[Moment]) -> Candidates:
    """What was first measured after the first of some epochs, where its motion leads back to."""
    first, later, last = moments[0], moments[1:], moments[-1]
    new = last.targets.confirmed & ~np.isin(last.targets.id, first.known)
    targets, odds = select(last.targets, new), last.odds[new]
    hits, born_s, born_at = np.zeros(len(odds)), np.full(len(odds), np.nan), targets.position.copy()
    for one in later:
        row, there = rows_among(one.targets.id, targets.id)
        if not len(one.targets):
            continue
        measured = there & (one.targets.misses[row] == 0)
        fresh = measured & np.isnan(born_s)
        born_s[fresh], born_at[fresh] = one.time_s, one.targets.position[row[fresh]]
        hits += measured
    before_s = born_s - first.time_s
    mean = np.concatenate([born_at - before_s[:, None] * targets.mean[:, 2:], targets.mean[:, 2:]], axis=1)
    one, nothing = np.ones(len(odds)), np.zeros(len(odds))
    features = np.stack([
        odds, odds, odds, hits / len(later), nothing, nothing, nothing, nothing, one, before_s,
    ], axis=-1)  # fmt: skip
    sure = (hits >= BACK_HITS) & (before_s <= BACK_S + 1e-6)
    return Candidates(targets.id, mean, targets.covariance, one > 0, features).only(sure)


def _columns(found: Candidates) -> tuple[Array, ...]:
    return found.ident, found.mean, found.covariance, found.coasted, found.features
