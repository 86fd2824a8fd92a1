"""Scores of a whole run: completeness, Eq. (13), purity, Eq. (14), custody, and what the report leads with.

Completeness and purity reward tracks that break and begin anew; custody does not: it is how long a vehicle
stays under one and the same track. A vehicle's visible time is that in which it moves, lies in the window and
can be seen. Presnar et al., Proc. SPIE 7672, 76720T (2010), §4.2.
"""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.metrics.multi_object import Similarity, idf1
from glintrack.metrics.tracks import EpochScore, Over

HEADLINE = ("held_per_km2", "completeness", "completeness_visible", "custody", "false_per_km2")

DELAY_S = 10.0
_SAME_TIME_S = 5e-3  # files round their times


def summarize(epochs: Sequence[EpochScore] | EpochScore) -> dict[str, float]:
    """Scores of a whole run, means over its epochs; NaN where nothing could be scored.

    Returns
    -------
    The headline: ``held_per_km2`` (moving vehicles of the window that have a track) [km⁻²], ``completeness``
    of all movers, ``completeness_visible``, ``custody`` [1] and ``false_per_km2`` [km⁻²]. Beside it:
    ``completeness_all``, ``purity`` [1], ``false_per_epoch``, ``tracks_per_epoch``, ``vehicles_per_epoch``
    (that should be tracked), ``identity_switches``, ``median_time_to_loss_s`` [s], ``same_track_after_10s``,
    ``idf1_moving``, ``position_rms_m`` of valid tracks [m], ``epochs``.
    """
    epochs = as_sequence(epochs)
    errors = np.concatenate([e.distance_m[e.valid] for e in epochs]) if epochs else np.empty(0)
    return {
        "held_per_km2": _mean([e.valid.sum() / e.area_km2 for e in epochs]),
        "completeness": _mean(completeness(epochs)),
        "completeness_visible": _mean(completeness(epochs, "visible")),
        "completeness_all": _mean(completeness(epochs, "all")),
        "purity": purity(epochs),
        "custody": custody(epochs),
        "median_time_to_loss_s": median_time_to_loss(epochs),
        "same_track_after_10s": same_track_after(epochs),
        "idf1_moving": idf1_moving(epochs),
        "false_per_epoch": _mean([e.false.sum() for e in epochs]),
        "false_per_km2": _mean([e.false.sum() / e.area_km2 for e in epochs]),
        "tracks_per_epoch": _mean([len(e.track_ids) for e in epochs]),
        "vehicles_per_epoch": _mean([e.should.sum() for e in epochs]),
        "identity_switches": float(identity_switches(epochs)),
        "position_rms_m": float(np.sqrt(_mean(errors**2))),
        "epochs": float(len(epochs)),
    }


def _mean(values) -> float:
    values = np.asarray(values, dtype=float)
    values = values[np.isfinite(values)]
    return float(values.mean()) if values.size else float("nan")


def completeness(epochs: Sequence[EpochScore] | EpochScore, over: Over = "moving") -> Float[Array, "time"]:
    """Completeness of each epoch, Eq. (13); NaN where no vehicle should be tracked. [1]

    Parameters
    ----------
    epochs
        Scores in the order of time.
    over
        Which vehicles count; see `EpochScore.completeness`.
    """
    return np.array([epoch.completeness(over) for epoch in as_sequence(epochs)], dtype=float)


def purity(epochs: Sequence[EpochScore] | EpochScore) -> float:
    """Mean over vehicles of the purity of their tracks, Eq. (14); NaN if no track was matched twice. [1]

    A vehicle's purity is the epoch-weighted mean over the tracks whose majority vehicle it is.
    """
    return _mean_purity(vehicle_purity(epochs))


def running_purity(epochs: Sequence[EpochScore] | EpochScore) -> Float[Array, "time"]:
    """`purity` of the epochs up to and with each, the last of which is the whole run's; NaN at first. [1]"""
    counts: dict[int, Counter[int]] = {}
    out = []
    for epoch in as_sequence(epochs):
        _count_matches(counts, epoch)
        out.append(_mean_purity(_purity_by_vehicle(counts)))
    return np.array(out, dtype=float)


def vehicle_purity(epochs: Sequence[EpochScore] | EpochScore) -> dict[int, float]:
    """Purity of each vehicle that is the majority vehicle of a track matched twice or more. [1]

    The epoch-weighted mean over such tracks; a tie goes to the smallest vehicle id.
    """
    counts: dict[int, Counter[int]] = {}
    for epoch in as_sequence(epochs):
        _count_matches(counts, epoch)
    return _purity_by_vehicle(counts)


def _count_matches(counts: dict[int, Counter[int]], epoch: EpochScore) -> None:
    """Add an epoch's matches to the number of epochs at which each track is matched to each vehicle."""
    for track, vehicle in zip(epoch.track_ids.tolist(), epoch.matched_vehicle.tolist(), strict=True):
        if vehicle >= 0:
            counts.setdefault(track, Counter())[vehicle] += 1


def _purity_by_vehicle(counts: Mapping[int, Counter[int]]) -> dict[int, float]:
    majority, matched = Counter(), Counter()
    for vehicles in counts.values():
        total = vehicles.total()
        if total >= 2:
            vehicle, count = min(vehicles.items(), key=lambda item: (-item[1], item[0]))
            majority[vehicle] += count
            matched[vehicle] += total
    return {vehicle: majority[vehicle] / matched[vehicle] for vehicle in sorted(matched)}


def _mean_purity(by_vehicle: Mapping[int, float]) -> float:
    return float(np.mean(list(by_vehicle.values()))) if by_vehicle else float("nan")


def identity_switches(epochs: Sequence[EpochScore] | EpochScore) -> int:
    """How often a vehicle is matched to another track than when it was last matched."""
    last: dict[int, int] = {}
    switches = 0
    for epoch in as_sequence(epochs):
        for vehicle, track in zip(epoch.vehicle_ids.tolist(), epoch.matched_track.tolist(), strict=True):
            if track >= 0:
                switches += last.get(vehicle, track) != track
                last[vehicle] = track
    return switches


def as_sequence(epochs: Sequence[EpochScore] | EpochScore) -> Sequence[EpochScore]:
    """Epochs in a sequence, one alone too."""
    return [epochs] if isinstance(epochs, EpochScore) else list(epochs)


def custody(epochs: Sequence[EpochScore]) -> float:
    """Share of the vehicles' visible time under one and the same track, a vehicle's best; NaN if none. [1]

    Of each vehicle the visible epochs at which it is matched to the track that has most of them, summed over
    vehicles, over all visible epochs.
    """
    held: dict[int, Counter[int]] = {}
    visible = 0
    for epoch in epochs:
        visible += int(epoch.visible.sum())
        for vehicle, track in zip(
            epoch.vehicle_ids[epoch.visible].tolist(),
            epoch.matched_track[epoch.visible].tolist(),
            strict=True,
        ):
            if track >= 0:
                held.setdefault(vehicle, Counter())[track] += 1
    return sum(max(of.values()) for of in held.values()) / visible if visible else float("nan")


def median_time_to_loss(epochs: Sequence[EpochScore]) -> float:
    """Median time a track keeps a moving vehicle of the window; NaN if more than half are never lost. [s]

    From the first match of a track and a vehicle to the first epoch after their last. A vehicle that moved in
    the window at no later epoch was not lost; such times count by the product limit.

    References
    ----------
    Kaplan and Meier, J. Am. Stat. Assoc. 53, 457 (1958).
    """
    first: dict[tuple[int, int], int] = {}
    last: dict[tuple[int, int], int] = {}
    here: dict[int, int] = {}  # last epoch at which a vehicle should be tracked
    for k, epoch in enumerate(epochs):
        for vehicle, track in zip(
            epoch.vehicle_ids[epoch.should].tolist(), epoch.matched_track[epoch.should].tolist(), strict=True
        ):
            here[vehicle] = k
            if track >= 0:
                first.setdefault((vehicle, track), k)
                last[vehicle, track] = k
    times = [epoch.time_s for epoch in epochs]
    kept, lost = [], []
    for pair, k in last.items():
        is_lost = here[pair[0]] > k
        kept.append(times[k + 1 if is_lost else k] - times[first[pair]])
        lost.append(is_lost)
    return _product_limit_median(np.array(kept, float), np.array(lost, bool))


def _product_limit_median(times_s: Array, ended: Array) -> float:
    """Least time at which the product-limit estimate of survival is at most a half; NaN if none is."""
    if not np.isfinite(times_s).all():  # epochs of no stated time
        return float("nan")
    surviving = 1.0
    for time_s in np.unique(times_s[ended]):
        at_risk = int((times_s >= time_s).sum())
        surviving *= 1 - int((ended & (times_s == time_s)).sum()) / at_risk
        if surviving <= 0.5:
            return float(time_s)
    return float("nan")


def same_track_after(epochs: Sequence[EpochScore], delay_s: float = DELAY_S) -> float:
    """P(same id): of the visible vehicles with a track, those that have the same later; NaN if none.

    Counted over all pairs of epochs so far apart at which the vehicle is visible. [1]
    """
    times = np.array([epoch.time_s for epoch in epochs])
    same = pairs = 0
    for epoch in epochs:
        later = np.flatnonzero(np.abs(times - epoch.time_s - delay_s) <= _SAME_TIME_S)
        if not later.size:
            continue
        then = _held(epochs[later[0]])
        for vehicle, track in _held(epoch).items():
            if track >= 0 and vehicle in then:
                pairs += 1
                same += then[vehicle] == track
    return same / pairs if pairs else float("nan")


def _held(epoch: EpochScore) -> dict[int, int]:
    """Track of each visible vehicle, −1 for none."""
    seen = epoch.visible
    return dict(zip(epoch.vehicle_ids[seen].tolist(), epoch.matched_track[seen].tolist(), strict=True))


def idf1_moving(epochs: Sequence[EpochScore]) -> float:
    """IDF1 of the moving vehicles in the window and the tracks that are right or false, at 5 m. [1]

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
