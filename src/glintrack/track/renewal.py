"""A track that is found again far from where it was expected is another vehicle's more often than its own.

It is followed on, under a new number: whoever holds the old one lost it. Tracks that never were out of sight
keep theirs, since of those a jump as long is mostly a wrong detection.
"""

import numpy as np
from jaxtyping import Int

from glintrack.core.arrays import Array
from glintrack.track.initiation import Targets, rows_among

FAR_M = 6.0  # chosen on quickstart 11 and braunschweig 11: half of those farther are another vehicle


def renewed(before: Targets, after: Targets, interval_s: float, next_id: int) -> Int[Array, "target"]:
    """Ids of the targets after an epoch, new ones from `next_id` on where a target may be another vehicle.

    Parameters
    ----------
    before, after
        Targets of the epoch before, by rising id, and of this one.
    interval_s
        Between them. [s]
    next_id
        The first id that is free.
    """
    ids = after.id.copy()
    if len(before) == 0:
        return ids
    row, known = rows_among(before.id, after.id)
    expected = before.position[row] + before.mean[row, 2:4] * interval_s
    far = np.hypot(*(after.position - expected).T) > FAR_M
    found = known & (before.misses[row] > 0) & (after.misses == 0)
    new = np.flatnonzero(after.confirmed & found & far)
    ids[new] = next_id + np.arange(len(new))
    return ids
