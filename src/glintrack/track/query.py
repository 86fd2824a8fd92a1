"""Which targets to ask spectra for in the next frame: one pixel per column, so one query per column."""

from collections.abc import Callable

import numpy as np
from jaxtyping import Float, Int

from glintrack.records import SpectralQuery

Array = np.ndarray
COASTING_GAIN = 0.3  # nat; a known vehicle that comes back must be recognised
UNKNOWN_GAIN = 0.5  # nat; of a track's first spectrum, falling with the count


def association_entropy(
    tracks: Int[Array, "pair"], cost: Float[Array, "pair"], miss_cost: Float[Array, "track"]
) -> Float[Array, "track"]:
    """Entropy of each track's choice among its gated detections and none. [nat]

    Parameters
    ----------
    tracks, cost
        Track of each gated pair and its cost, as in `associate.assign`. [nat]
    miss_cost
        Of no detection. [nat]
    """
    best = miss_cost.copy()
    np.minimum.at(best, tracks, cost)
    weight, alone = np.exp(best[tracks] - cost), np.exp(best - miss_cost)
    total = alone.copy()
    np.add.at(total, tracks, weight)
    share, none = weight / total[tracks], alone / total
    with np.errstate(divide="ignore", invalid="ignore"):
        entropy = -np.where(none > 0, none * np.log(none), 0.0)
        np.add.at(entropy, tracks, -np.where(share > 0, share * np.log(share), 0.0))
    return entropy


def gain(
    entropy: Float[Array, "track"], spectra: Float[Array, "track"], coasting: np.ndarray
) -> Float[Array, "track"]:
    """Expected worth of one more spectrum of each track. [nat]

    A spectrum resolves an ambiguous association only if the track has a spectrum to compare it with.
    """
    known = spectra > 0
    return known * entropy + UNKNOWN_GAIN / (1 + spectra) + COASTING_GAIN * (known & coasting)


def plan(
    position_m: Float[Array, "target 2"],
    track_id: Int[Array, "target"],
    priority: Float[Array, "target"],
    column_of: Callable[[Float[Array, "target 3"]], Int[Array, "target"]],
    budget: int,
) -> tuple[SpectralQuery, ...]:
    """The queries of greatest total priority, at most one per column and ``budget`` in all.

    Parameters
    ----------
    position_m
        Where each target will be at the next epoch. [m]
    track_id
        Of each target.
    priority
        Of each target; those of no worth (0 or less) are not asked for. [nat]
    column_of
        Superpixel column that sees each ground point (east, north, up), −1 off the array.
    budget
        Most queries in a frame.

    Returns
    -------
    Queries by falling priority, ties by track id.

    Notes
    -----
    With one column per target this is a partition matroid: taking each in turn if its column is free is
    optimal.
    """
    if len(position_m) == 0 or budget == 0:
        return ()
    ground = np.column_stack([position_m, np.zeros(len(position_m))])
    columns = np.asarray(column_of(ground))
    if columns.shape != (len(ground),):
        raise ValueError(f"`column_of` must return one column per point, got shape {columns.shape}")
    taken: set[int] = set()
    queries = []
    for k in np.lexsort((track_id, -priority)):
        column = int(columns[k])
        if column < 0 or column in taken or not priority[k] > 0:
            continue
        taken.add(column)
        east, north = position_m[k].tolist()
        queries.append(SpectralQuery(east, north, 0.0, int(track_id[k]), float(priority[k])))
        if len(queries) == budget:
            break
    return tuple(queries)
