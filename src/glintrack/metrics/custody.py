"""Who kept track of whom: how long a vehicle stays under one and the same track.

Completeness and purity reward tracks that break and begin anew; custody does not. A vehicle's visible time is
that in which it moves, lies in the window and can be seen.
"""

from collections import Counter
from collections.abc import Sequence

import numpy as np

from glintrack.core.arrays import Array
from glintrack.metrics.multi_object import Similarity, idf1
from glintrack.metrics.tracks import EpochScore

DELAY_S = 10.0
_SAME_TIME_S = 5e-3  # files round their times


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


def custody_scores(epochs: Sequence[EpochScore]) -> dict[str, float]:
    """``custody``, ``same_track_after_10s``, ``idf1_moving`` [1], ``median_time_to_loss_s`` [s]."""
    return {
        "custody": custody(epochs),
        "median_time_to_loss_s": median_time_to_loss(epochs),
        "same_track_after_10s": same_track_after(epochs),
        "idf1_moving": idf1_moving(epochs),
    }
