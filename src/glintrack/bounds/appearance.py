"""Fixed learners of vehicles for any sensor: of their appearance in a frame, and of their identity.

A frame's images are logarithms of the readings of each array, or of those over a predicted background. Planes
are formed of them: the first array's elements, contrasts of the four elements of a superpixel as they lie and
interpolated to its middle, and contrasts between arrays. Contrast k of values x is xₖ less the mean of all
later ones: of polarizers at 0°, 60° and 120° these are Q and U. Principal components of each plane's windows,
and extremes of each contrast, are the features of gradient-boosted trees.

Two looks at a vehicle differ in their mean logarithm of each channel. The likelihood ratio of two normal
distributions, of differences of one vehicle and of any two, tells whether they show the same.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage, stats

from glintrack.core.arrays import Array
from glintrack.core.installation import require_extra

RATES_PER_KM2 = (50, 200)  # false objects of a frame
_NEGATIVES = 0.1  # share of the superpixels without a vehicle that are learnt from
_BACKGROUND = 9  # superpixels along the window of the local median
_COMPONENTS = {100: 16, 25: 5}  # of the values of a window: of the first plane, and of the others
_TREES = {"max_iter": 80, "learning_rate": 0.1, "max_leaf_nodes": 20, "l2_regularization": 1.0}


@dataclass(frozen=True)
class Look:
    """Measured frame of a city, as the arrays of one sensor read it.

    Parameters
    ----------
    images, extra
        Logarithm of the readings of each array; or of those over the predicted ones, and further planes on
        superpixels. Without these the local median is removed. [ln]
    ids, superpixel_km2
        Vehicle at the middle of each element, −1 for none; and mean ground area of a superpixel. [km²]
    targets, excluded
        Ids of the vehicles to find or recognize, and of those near which nothing counts as false.
    """

    images: Sequence[Float[Array, "row column"]]
    ids: Int[Array, "row column"]
    targets: Int[Array, "target"]
    excluded: Int[Array, "excluded"]
    superpixel_km2: float
    extra: Sequence[Float[Array, "y x"]] = ()


def superpixels(image: Float[Array, "row column"]) -> Float[Array, "y x"]:
    """Mean over the 2 × 2 elements of each superpixel."""
    return np.mean(_kinds(image), axis=0)


def find_unseen(learn: Sequence[Sequence[Look]], test: Sequence[Look]) -> dict[str, float]:
    """Share of the target vehicles of a city that is found by what was learnt in others.

    Returns
    -------
    ``vehicles``, and ``found_50`` and ``found_200``, the shares at so many false objects per km² of a frame.
    """
    odds = _fit_learner([look for city in learn for look in city])
    peaks, best, area_km2 = [], [], 0.0
    for look in test:
        empty = _empty(look)
        score = ndimage.uniform_filter(odds(_windows(look, np.arange(empty.size))).reshape(empty.shape), 3)
        peaks.append(score[(score == ndimage.maximum_filter(score, 5)) & empty])
        area_km2 += look.superpixel_km2 * score.size
        on = [_on(look, vehicle) for vehicle in np.intersect1d(look.targets, look.ids)]
        best += [score[one].max() for one in on if one.sum() >= 2]
    false = np.sort(np.concatenate(peaks))[::-1]
    if not best or not len(false):
        raise ValueError("`cities` must have vehicles for the task; got a city without one.")
    limits = {rate: false[min(int(rate * area_km2), len(false) - 1)] for rate in RATES_PER_KM2}
    found = {f"found_{rate}": float(np.mean(np.array(best) > limit)) for rate, limit in limits.items()}
    return {"vehicles": len(best), **found}


def _fit_learner(looks: Sequence[Look]) -> Callable[[list[Array]], Array]:
    """Learn the log odds of a vehicle from a superpixel's windows; of a moving one, from residuals."""
    ensemble = require_extra("sklearn.ensemble", "optimize", "learn the appearance of vehicles")
    rng, windows, labels = np.random.default_rng(0), [], []
    for look in looks:
        on = _on(look, look.targets if look.extra else look.excluded)
        chosen = np.flatnonzero(on | (_empty(look) & (rng.random(on.shape) < _NEGATIVES)))
        windows.append(_windows(look, chosen))
        labels.append(on.ravel()[chosen])
    if not np.concatenate(labels).any():
        raise ValueError("`cities` must have vehicles for the task; got none to learn from.")
    joint = [np.concatenate(parts) for parts in zip(*windows, strict=True)]
    bases = [np.linalg.eigh(np.cov(one.T))[1][:, -_COMPONENTS[one.shape[1]] :] for one in joint]
    trees = ensemble.HistGradientBoostingClassifier(**_TREES, random_state=0, early_stopping=False)
    trees.fit(_features(joint, bases), np.concatenate(labels))
    return lambda windows: trees.decision_function(_features(windows, bases))


def _on(look: Look, vehicles: Array) -> Array:
    return superpixels(np.isin(look.ids, vehicles).astype(float)) >= 0.5


def _empty(look: Look) -> Array:  # away from vehicles, and from the shadows of moving ones
    near = superpixels(np.isin(look.ids, look.excluded).astype(float)) > 0
    return np.logical_not(ndimage.binary_dilation(near, iterations=4 if look.extra else 2))


def _windows(look: Look, chosen: Array) -> list[Array]:
    """Values of each plane of a look around some superpixels: 10 × 10 elements, or 5 × 5 superpixels."""
    kinds = _kinds(look.images[0])
    middle = np.mean(kinds, axis=0)
    median = np.zeros_like(middle) if look.extra else ndimage.median_filter(middle, _BACKGROUND)
    moves = [((k // 2 - 0.5) / 2, (k % 2 - 0.5) / 2) for k in range(4)]  # to the superpixel's middle
    moved = [ndimage.shift(one, by, order=1, mode="nearest") for one, by in zip(kinds, moves, strict=True)]
    arrays = [middle, *map(superpixels, look.images[1:])]
    coarse = *_contrasts(kinds), *_contrasts(moved), *_contrasts(arrays), *(look.extra or [median])
    fine = np.pad(look.images[0] - np.kron(median, np.ones((2, 2))), 4, mode="edge")
    views = [np.lib.stride_tricks.sliding_window_view(fine, (10, 10))[::2, ::2]]
    views += [np.lib.stride_tricks.sliding_window_view(np.pad(p, 2, mode="edge"), (5, 5)) for p in coarse]
    some = np.unravel_index(chosen, middle.shape)
    return [view[some].reshape(len(chosen), -1).astype(np.float32) for view in views]


def _kinds(image: Array) -> list[Array]:
    return [image[i::2, j::2] for i in (0, 1) for j in (0, 1)]


def _contrasts(values: Sequence[Array]) -> list[Array]:
    return [values[k] - np.mean(values[k + 1 :], axis=0) for k in range(len(values) - 1)]


def _features(windows: Sequence[Array], bases: Sequence[Array]) -> Array:
    columns = [windows[0][:, [44, 45, 54, 55]]]  # the elements of the superpixel itself
    for one, basis in zip(windows, bases, strict=True):
        columns += [one @ basis, one.std(axis=1, keepdims=True)]
    for one in windows[1:]:
        inner = one[:, [6, 7, 8, 11, 12, 13, 16, 17, 18]]  # 3 × 3
        columns += [inner[:, 4:5], np.abs(inner[:, 4:5])]
        columns.append(np.stack([np.abs(inner).mean(1), inner.max(1), inner.min(1)], axis=1))
    return np.concatenate(columns, axis=1, dtype=np.float32)


def recognize_unseen(learn: Sequence[Sequence[Look]], test: Sequence[Look]) -> dict[str, float]:
    """Recognize vehicles of a city in later frames by what was learnt in others.

    Returns
    -------
    ``vehicles``, the pairs of looks at one, and ``auc`` (ROC) of these against pairs of looks at two.
    """
    own = _differences(test)
    joint = [np.concatenate(parts) for parts in zip(*map(_differences, learn), strict=True)]
    if min(map(len, (*joint, *own))) < 2:
        raise ValueError("`cities` must have vehicles that are seen in two frames; got too few.")
    same, other = (np.linalg.inv(d.T @ d / len(d) + 1e-6 * np.eye(d.shape[1])) for d in joint)
    ratio = [np.einsum("ni,ij,nj->n", d, other - same, d) for d in own]
    above = stats.mannwhitneyu(*ratio).statistic / len(ratio[1])
    return {"vehicles": len(ratio[0]), "auc": float(above / len(ratio[0]))}


def _differences(looks: Sequence[Look]) -> tuple[Array, Array]:
    """Differences of the channels of looks in two frames, at the same vehicle and at another."""
    seen, out = [], ([], [])
    for number, look in enumerate(looks):
        for vehicle in np.intersect1d(look.targets, look.ids):
            on = _kinds(look.ids == vehicle)
            if all(one.any() for one in on):  # some of each place in the superpixel
                means = [kind[k].mean() for i in look.images for k, kind in zip(on, _kinds(i), strict=True)]
                seen.append((number, vehicle, np.array(means)))
    for (k, vehicle, before), (j, other, after) in combinations(seen, 2):
        if k != j:
            out[int(vehicle != other)].append(after - before)
    return np.array(out[0]), np.array(out[1])
