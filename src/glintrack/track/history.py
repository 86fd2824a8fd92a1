"""Past places of a track, reported once it is confirmed; and those of frames in which it was not measured.

A track is confirmed some frames after its vehicle came in sight. By then the tracker knows where it was in
those frames: the states it held tentatively, and, if the detector decides by several frames, the places where
that one saw the first detection earlier. Nothing of a later frame is used in any of them, but a reader who
must act at once has them only when the track is confirmed. A gap is filled by the straight line between the
two measurements about it, when the second is there.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
import xarray as xr

from glintrack.track.state import TrackerState
from glintrack.track.told import told

DOUBLE_M = 3.0  # from a place already reported at that time: the same vehicle


@dataclass(frozen=True)
class Place:
    """One track at one time: state, covariance, and whether it was measured then."""

    time_s: float
    mean: np.ndarray
    covariance: np.ndarray
    measured: bool


@dataclass(frozen=True)
class History:
    """What is not reported yet.

    Parameters
    ----------
    waiting
        Places of each track that may still be reported, the oldest first.
    reported
        Places of each that are, as far back as any that waits.
    confirmed
        Tracks that were reported.
    """

    waiting: Mapping[int, tuple[Place, ...]] = field(default_factory=dict)
    reported: Mapping[float, np.ndarray] = field(default_factory=dict)
    last: Mapping[int, Place] = field(default_factory=dict)


def remember(
    history: History, state: TrackerState, report: xr.Dataset
) -> tuple[History, list[tuple[float, xr.Dataset]]]:
    """What can be reported now of earlier epochs, and what waits on.

    Parameters
    ----------
    history
        After the epoch before.
    state, report
        The tracker after this epoch, and what it reports of it.

    Returns
    -------
    The history after this epoch; times, the earliest first, and tracks of earlier epochs, like ``report``
    with ``tentative`` 1.
    """
    targets, coasted = state.targets, state.design.reporting.coasted
    waiting, last, known = {}, {}, {}
    reported = {**history.reported, state.time_s: np.stack([report["east"], report["north"]], axis=-1)}
    for k, ident in enumerate(targets.id.tolist()):
        measured, confirmed = bool(targets.misses[k] == 0), bool(targets.confirmed[k])
        now = Place(state.time_s, targets.mean[k], targets.covariance[k], measured)
        before = history.waiting.get(ident)
        if before is None:
            before = () if ident in history.last else _earlier(state, k)
        if not confirmed:
            waiting[ident] = (*before, now)
        elif measured:
            past = (*before, now) if ident not in history.last else (history.last[ident], *before, now)
            for place in _filled(past)[len(past) - len(before) - 1 : -1]:
                known.setdefault(place.time_s, []).append((ident, place))
            last[ident] = now
        else:
            waiting[ident] = before if coasted else (*before, now)
            last[ident] = history.last.get(ident, now)
    out = []
    for time_s in sorted(known):
        fresh = [one for one in known[time_s] if not _double(one[1], reported.get(time_s))]
        if fresh:
            out.append((time_s, _dataset(fresh, time_s)))
            places = np.array([one.mean[:2] for _, one in fresh])
            reported[time_s] = np.concatenate([reported.get(time_s, np.empty((0, 2))), places])
    oldest = min((places[0].time_s for places in waiting.values() if places), default=state.time_s)
    oldest = min([oldest, *state.detections.earlier_s])
    kept = {time_s: places for time_s, places in reported.items() if time_s >= oldest}
    return History(waiting, kept, last), out


def as_reported(report: xr.Dataset) -> xr.Dataset:
    """The same tracks, none of them tentative."""
    return report.assign(tentative=("track", np.zeros(report.sizes["track"]), {"units": "1"}))


def _earlier(state: TrackerState, k: int) -> tuple[Place, ...]:
    """Of a track just born, the detector's own earlier places."""
    found, targets = state.detections, state.targets
    if found.earlier is None or not len(found):
        return ()
    of = int(np.argmin(np.hypot(*(found.position - targets.born[k]).T)))
    out = []
    for time_s, place in zip(found.earlier_s, found.earlier[of], strict=True):
        if np.isfinite(place).all():
            mean = np.r_[place, targets.mean[k, 2:]]
            out.append(Place(time_s, mean, targets.covariance[k], True))
    return tuple(out)


def _filled(places: tuple[Place, ...]) -> tuple[Place, ...]:
    """The same places, those not measured moved onto the straight line between measured ones."""
    if all(place.measured for place in places):
        return places
    times = np.array([place.time_s for place in places])
    sure = np.array([place.measured for place in places])
    at = np.array([place.mean[:2] for place in places])
    line = np.stack([np.interp(times, times[sure], at[sure, k]) for k in range(2)], axis=-1)
    return tuple(
        place if place.measured else Place(place.time_s, np.r_[xy, place.mean[2:]], place.covariance, False)
        for place, xy in zip(places, line, strict=True)
    )


def _double(place: Place, others: np.ndarray | None) -> bool:
    return others is not None and bool((np.hypot(*(others - place.mean[:2]).T) < DOUBLE_M).any())


def _dataset(places: list[tuple[int, Place]], time_s: float) -> xr.Dataset:
    mean = np.array([place.mean for _, place in places])
    covariance = np.array([place.covariance for _, place in places])
    ident, coasted = np.array([ident for ident, _ in places]), np.array([not p.measured for _, p in places])
    return told(time_s, ident, mean, covariance, coasted).assign(
        tentative=("track", np.ones(len(places)), {"units": "1"})
    )
