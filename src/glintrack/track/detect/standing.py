"""Vehicles that stand: where they are in one frame, and how long the ground below them is remembered.

Change detection takes a vehicle that stands for a part of the ground. The tracker knows where its slow
vehicles are. As long as such a place differs from its surroundings, the map of the ground below is kept from
the time before the vehicle came, for `hold_s` at most, and the change that remains there is the vehicle. A
place that looks like its surroundings is empty: change there is a hole that a vehicle left in the map. The
constants are in ``data/calibration/mosaic.toml``.
"""

import math

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import uniform_filter
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.track.calibration import read_calibration
from glintrack.track.detect.mosaic_peaks import MAX_RATIO, MIN_RATIO

CENTRE_CELLS = 3  # along a square inside a car
RING_M = 2.4, 4.7  # radii of the ring around a car
SEARCH_M = 1.5  # from the predicted place of a track to the middle of the square


def is_occupied(
    place_m: Float[Array, "place 2"],
    corner_m: tuple[float, float],
    cell_m: float,
    element: tuple[Float[Array, "y x"], Float[Array, "y x"]],
    kinds: tuple[tuple[tuple[int, int], ...], int, tuple[Float[Array, "row column"], ...]],
) -> Bool[Array, "place"]:
    """Return True for places that differ from their surroundings in the frame itself.

    Parameters
    ----------
    place_m
        East and north of each place. [m]
    corner_m, cell_m, element
        Ground grid, and the element that sees each of its cells, as in `mosaic_model.elements_of_cells`.
    kinds
        Place of each kind of element in the superpixel, elements along a superpixel, and readings. [e]
    """
    places, side, every = kinds
    reach = math.ceil((RING_M[1] + SEARCH_M) / cell_m)
    dy, dx = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    i = np.rint((corner_m[1] - place_m[:, 1]) / cell_m).astype(int)[:, None, None] + dy
    j = np.rint((place_m[:, 0] - corner_m[0]) / cell_m).astype(int)[:, None, None] + dx
    rows, columns = element[0].shape
    on_grid = (i >= 0) & (j >= 0) & (i < rows) & (j < columns)
    i, j = np.clip(i, 0, rows - 1), np.clip(j, 0, columns - 1)
    far_m = np.hypot(dy, dx) * cell_m
    ring = (far_m >= RING_M[0]) & (far_m <= RING_M[1])
    contrast = np.zeros(i.shape)
    for (row, column), readings in zip(places, every, strict=True):
        r, c = (element[0][i, j] - row) / side + 0.5, (element[1][i, j] - column) / side + 0.5
        seen = on_grid & (r >= 0) & (c >= 0) & (r < readings.shape[0]) & (c < readings.shape[1])
        now = np.where(seen, readings[np.where(seen, r, 0).astype(int), np.where(seen, c, 0).astype(int)], 0)
        seen &= np.isfinite(now)
        around = np.ma.median(np.ma.array(now[:, ring], mask=~seen[:, ring]), axis=1).filled(0)[:, None, None]
        share = uniform_filter(seen.astype(float), CENTRE_CELLS, axes=(1, 2))
        known = (share > 0.01) & (around > 0)  # light is known on both sides, and there is some
        light = uniform_filter(np.where(seen, now, 0.0), CENTRE_CELLS, axes=(1, 2))
        inside = light / np.where(known, share, 1)
        contrast += np.where(known, np.abs(inside / np.where(known, around, 1) - 1), 0) / len(every)
    return contrast[:, far_m <= SEARCH_M].max(axis=1) >= _constants()["contrast"]


def standing_ratio(
    ratio: Float[Array, "peak"],
    strength: Float[Array, "peak"],
    place_m: Float[Array, "peak 2"],
    slow_m: Float[Array, "slow 2"],
    occupied: Bool[Array, "slow"],
) -> tuple[Float[Array, "peak"], Float[Array, "peak"]]:
    """Log-likelihood ratio of vehicle against clutter, where slow vehicles are expected. [nat]

    Elsewhere a vehicle is known by its motion. At an occupied place its strength is enough; at an empty one
    there is none.

    Parameters
    ----------
    ratio, strength, place_m
        Log-likelihood ratio of each peak by its motion [nat], its strength [1] and its place [m].
    slow_m, occupied
        Places of slow tracks [m], and the mask of the occupied ones.

    Returns
    -------
    The ratio, and that by motion alone.
    """
    if len(slow_m) == 0 or len(ratio) == 0:
        return ratio, ratio
    known = _constants()
    to_vehicle, to_empty = (_distance(place_m, slow_m[which]) for which in (occupied, ~occupied))
    by_strength = np.minimum(known["intercept"] + known["root_strength"] * np.sqrt(strength), MAX_RATIO)
    hole = (to_empty <= known["hole_m"]) & (to_empty < to_vehicle)
    by_motion = np.where(hole, np.minimum(ratio, 0.0), ratio)
    near = to_vehicle <= known["vehicle_m"]
    return np.where(near, np.maximum(by_motion, by_strength), by_motion), by_motion


def select_standing(
    ratio: Float[Array, "peak"],
    place_m: Float[Array, "peak 2"],
    occupied_m: Float[Array, "place 2"],
    selected: Int[Array, "selected"],
) -> Int[Array, "standing"]:
    """Select the likeliest peak of each occupied place that has none selected yet.

    Parameters
    ----------
    ratio, place_m
        Log-likelihood ratio of each peak [nat], and its place [m].
    occupied_m
        Occupied places of slow tracks. [m]
    selected
        Index of the peaks that are selected by their motion.
    """
    reach_m = _constants()["vehicle_m"]
    free = occupied_m[_distance(occupied_m, place_m[selected]) > reach_m]
    if len(free) == 0 or len(place_m) == 0:
        return np.empty(0, int)
    around = [np.array(one, int) for one in KDTree(place_m).query_ball_point(free, reach_m)]
    best = [one[ratio[one].argmax()] for one in around if len(one)]
    return np.unique(np.array([k for k in best if ratio[k] > MIN_RATIO], int))


def hold_s() -> float:
    """Longest time for which ground is kept below a vehicle. [s]"""
    return _constants()["hold_s"]


def _constants() -> dict[str, float]:
    """Constants of the calibration."""
    return read_calibration("mosaic").constants["standing"]


def _distance(place_m: Float[Array, "n 2"], other_m: Float[Array, "m 2"]) -> Float[Array, "n"]:
    """Distance to the nearest of some points, infinite without any. [m]"""
    return KDTree(other_m).query(place_m)[0] if len(other_m) else np.full(len(place_m), np.inf)
