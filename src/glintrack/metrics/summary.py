"""Scores of a whole run: completeness, Eq. (13), purity, Eq. (14), custody, and the headline scores.

Completeness and purity do not fall when a track breaks and restarts. Custody does: it is the share of a
vehicle's visible time under one track. In its visible time a vehicle moves in the scored area and is visible.
Presnar et al., Proc. SPIE 7672, 76720T (2010), §4.2.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float
from scipy.stats import CensoredData, ecdf

from glintrack.core.arrays import Array
from glintrack.metrics.multi_object import Similarity, idf1
from glintrack.metrics.tracks import EpochScore, Over

HEADLINE = ("tracked_per_km2", "completeness", "completeness_visible", "custody", "false_per_km2")

DELAY_S, STOP_S = 10.0, 10.0
_SAME_TIME_S = 5e-3  # times in files are rounded


def summarize(epochs: Sequence[EpochScore]) -> dict[str, float]:
    """Compute the scores of a whole run, means over its epochs; NaN for a score without data.

    Returns
    -------
    The headline: ``tracked_per_km2`` (moving vehicles of the area that have a track) [km⁻²], ``completeness``
    of all movers, ``completeness_visible``, ``custody`` [1] and ``false_per_km2`` [km⁻²]. Others:
    ``completeness_with_stopped``, ``purity`` [1], ``false_per_frame``, ``tracks_per_frame``,
    ``vehicles_per_frame`` (that should be tracked), ``identity_switches``, ``median_time_to_loss_s`` [s],
    ``same_track_after_10s``, ``same_track_after_stop``, ``idf1_moving``, ``position_rms_m`` of valid tracks
    [m], ``frames``.
    """
    errors = np.concatenate([e.distance_m[e.valid] for e in epochs]) if epochs else np.empty(0)
    return {
        "tracked_per_km2": _mean([e.valid.sum() / e.area_km2 for e in epochs]),
        "completeness": _mean(completeness(epochs)),
        "completeness_visible": _mean(completeness(epochs, "visible")),
        "completeness_with_stopped": _mean(completeness(epochs, "all")),
        "purity": purity(epochs),
        "custody": custody(epochs),
        "median_time_to_loss_s": median_time_to_loss(epochs),
        "same_track_after_10s": same_track_after(epochs),
        "same_track_after_stop": same_track_after_stop(epochs),
        "idf1_moving": idf1_moving(epochs),
        "false_per_frame": _mean([e.false.sum() for e in epochs]),
        "false_per_km2": _mean([e.false.sum() / e.area_km2 for e in epochs]),
        "tracks_per_frame": _mean([len(e.track_ids) for e in epochs]),
        "vehicles_per_frame": _mean([e.should.sum() for e in epochs]),
        "identity_switches": float(identity_switches(epochs)),
        "position_rms_m": float(np.sqrt(_mean(errors**2))),
        "frames": float(len(epochs)),
    }


def _mean(values) -> float:
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else float("nan")


def completeness(epochs: Sequence[EpochScore], over: Over = "moving") -> Float[Array, "time"]:
    """Completeness of each epoch, Eq. (13); NaN where no vehicle should be tracked. [1]

    Parameters
    ----------
    epochs
        Scores in the order of time.
    over
        Vehicles that count; see `EpochScore.completeness`.
    """
    return np.array([epoch.completeness(over) for epoch in epochs], dtype=float)


def purity(epochs: Sequence[EpochScore]) -> float:
    """Mean over vehicles of the purity of their tracks, Eq. (14); NaN if no track was matched twice. [1]

    A vehicle's purity is the epoch-weighted mean over the tracks whose majority vehicle it is.
    """
    return _mean([*vehicle_purity(epochs).values()])


def running_purity(epochs: Sequence[EpochScore]) -> Float[Array, "time"]:
    """`purity` of the epochs up to each, the last of which is the whole run's; NaN at first. [1]"""
    counts: dict[int, Counter[int]] = {}
    return np.array([_mean([*vehicle_purity([epoch], counts).values()]) for epoch in epochs], dtype=float)


def vehicle_purity(
    epochs: Sequence[EpochScore], counts: dict[int, Counter[int]] | None = None
) -> dict[int, float]:
    """Purity of each vehicle that is the majority vehicle of a track matched twice or more. [1]

    The epoch-weighted mean over such tracks; a tie goes to the smallest vehicle id.

    Parameters
    ----------
    epochs
        Scores in the order of time.
    counts
        Number of earlier matches of each track with each vehicle; those of the epochs are added to it.
    """
    counts = {} if counts is None else counts
    for epoch in epochs:
        for track, vehicle in zip(epoch.track_ids.tolist(), epoch.matched_vehicle.tolist(), strict=True):
            if vehicle >= 0:
                counts.setdefault(track, Counter())[vehicle] += 1
    majority, matched = Counter(), Counter()
    for vehicles in counts.values():
        total = vehicles.total()
        if total >= 2:
            vehicle, count = min(vehicles.items(), key=lambda item: (-item[1], item[0]))
            majority[vehicle] += count
            matched[vehicle] += total
    return {vehicle: majority[vehicle] / matched[vehicle] for vehicle in sorted(matched)}


def identity_switches(epochs: Sequence[EpochScore]) -> int:
    """Count the matches of a vehicle to another track than when it was last matched."""
    last: dict[int, int] = {}
    switches = 0
    for epoch in epochs:
        for vehicle, track in zip(epoch.vehicle_ids.tolist(), epoch.matched_track.tolist(), strict=True):
            if track >= 0:
                switches += last.get(vehicle, track) != track
                last[vehicle] = track
    return switches


def custody(epochs: Sequence[EpochScore]) -> float:
    """Share of the vehicles' visible time under one track each; NaN without visible vehicles. [1]

    The visible epochs at which a vehicle is matched to the track that has most of them, summed over vehicles,
    divided by all visible epochs.
    """
    matches: dict[int, Counter[int]] = {}
    visible = 0
    for epoch in epochs:
        visible += int(epoch.visible.sum())
        for vehicle, track in _visible_matches(epoch).items():
            if track >= 0:
                matches.setdefault(vehicle, Counter())[track] += 1
    return sum(max(of.values()) for of in matches.values()) / visible if visible else float("nan")


def median_time_to_loss(epochs: Sequence[EpochScore]) -> float:
    """Median time from the start of a custody to its loss; NaN if more than half are never lost. [s]

    From the first match of a track and a moving vehicle of the area to the first epoch after their last. A
    vehicle that moved in the area at no later epoch was not lost; such times are censored (product limit).

    References
    ----------
    Kaplan and Meier, J. Am. Stat. Assoc. 53, 457 (1958).
    """
    first: dict[tuple[int, int], int] = {}
    last: dict[tuple[int, int], int] = {}
    here: dict[int, int] = {}  # last epoch at which a vehicle should be tracked
    for k, epoch in enumerate(epochs):
        columns = epoch.vehicle_ids, epoch.matched_track, epoch.should
        for vehicle, track, should in zip(*(column.tolist() for column in columns), strict=True):
            if should:
                here[vehicle] = k
                if track >= 0:
                    first.setdefault((vehicle, track), k)
            if (vehicle, track) in first:  # also while it stands
                last[vehicle, track] = k
    times = [epoch.time_s for epoch in epochs]
    durations_s, lost = [], []
    for pair, k in last.items():
        is_lost = here[pair[0]] > k
        durations_s.append(times[k + 1 if is_lost else k] - times[first[pair]])
        lost.append(is_lost)
    times_s, ended = np.array(durations_s, float), np.array(lost, bool)
    if not ended.any() or not np.isfinite(times_s).all():
        return float("nan")
    survival = ecdf(CensoredData(uncensored=times_s[ended], right=times_s[~ended])).sf
    half = np.flatnonzero(survival.probabilities <= 0.5 + 1e-12)
    return float(survival.quantiles[half[0]]) if len(half) else float("nan")


def same_track_after(epochs: Sequence[EpochScore], delay_s: float = DELAY_S) -> float:
    """Probability that a visible vehicle with a track has the same track later; NaN without data. [1]

    Counted over all pairs of epochs with this delay, to half a frame, at which the vehicle is visible.
    """
    times = np.array([epoch.time_s for epoch in epochs])
    near_s = max(float(np.median(np.diff(times))) / 2 if len(times) > 1 else 0.0, _SAME_TIME_S)
    same = pairs = 0
    for epoch in epochs:
        apart = np.abs(times - epoch.time_s - delay_s)
        later = int(apart.argmin())
        if not apart[later] <= near_s:  # also without times
            continue
        then = _visible_matches(epochs[later])
        for vehicle, track in _visible_matches(epoch).items():
            if track >= 0 and vehicle in then:
                pairs += 1
                same += then[vehicle] == track
    return same / pairs if pairs else float("nan")


def same_track_after_stop(epochs: Sequence[EpochScore], stop_s: float = STOP_S) -> float:
    """Share of vehicles that keep their track through a stop; NaN without stops. [1]

    Counted are vehicles with a track when they were last visible in motion, which are visible in motion again
    at least `stop_s` later and stood inside the area in between. They keep their track if the next one that
    they have while they are visible is the same.

    Parameters
    ----------
    epochs
        Scores in the order of time.
    stop_s
        Minimum duration of a stop. [s]
    """
    before: dict[int, tuple[float, int]] = {}  # time and track of each vehicle when last visible in motion
    stood: dict[int, bool] = {}  # whether it has stood at all epochs since
    waiting: dict[int, int] = {}  # track before the stop of vehicles that drive on, until they have one
    same = stops = 0
    for epoch in epochs:
        matches = _visible_matches(epoch)
        for vehicle, track in matches.items():
            time_s, old = before.get(vehicle, (np.nan, -1))
            if old >= 0 and stood.pop(vehicle, False) and epoch.time_s - time_s >= stop_s - _SAME_TIME_S:
                stops, waiting[vehicle] = stops + 1, old
            if track >= 0 and vehicle in waiting:
                same += waiting.pop(vehicle) == track
            before[vehicle] = epoch.time_s, track
        standing = set(epoch.vehicle_ids[epoch.inside & ~epoch.should].tolist())
        stood = {v: stood.get(v, True) and v in standing for v in before if v not in matches}
    return same / stops if stops else float("nan")


def _visible_matches(epoch: EpochScore) -> dict[int, int]:
    """Track of each visible vehicle, −1 for none."""
    seen = epoch.visible
    return dict(zip(epoch.vehicle_ids[seen].tolist(), epoch.matched_track[seen].tolist(), strict=True))


def idf1_moving(epochs: Sequence[EpochScore]) -> float:
    """IDF1 of the moving vehicles in the area and the tracks that are right or false, at 5 m. [1]

    References
    ----------
    Ristani et al., ECCV Workshops 2016.
    """
    alike = []
    for e in epochs:
        counted = e.valid | e.false
        track, vehicle = e.near[counted[e.near[:, 0]] & e.should[e.near[:, 1]]].T
        near = np.zeros((e.should.sum(), counted.sum()))
        near[np.cumsum(e.should)[vehicle] - 1, np.cumsum(counted)[track] - 1] = 1.0
        alike.append(Similarity(e.vehicle_ids[e.should], e.track_ids[counted], near))
    return idf1(alike) if alike else float("nan")
