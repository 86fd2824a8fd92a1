"""The ideal observer over the vehicles of one frame: which elements are whose, and what they tell."""

import math
from collections.abc import Iterator
from typing import cast

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from glintrack.bounds.evidence import elements_of, superpixel_polarization
from glintrack.bounds.finder import DIRECTIONS, FOOTPRINTS_M
from glintrack.bounds.frame import full_electrons
from glintrack.bounds.likelihood import (
    Cumulants,
    Elements,
    detectability,
    detection_probability,
    element_cumulants,
)
from glintrack.bounds.polarized import dolp_cumulants
from glintrack.core.arrays import Array
from glintrack.sensor import Sensor, dark_noise_e

REACH_ELEMENTS = 14.0  # from a vehicle's silhouette: its shadow
_CHANGED = 0.05  # of the noise: less is the renderer's rounding
Changed = tuple[int, Array, Array]  # number of a vehicle, rows and columns of elements


def hypotheses(area_m: tuple[float, float, float, float]) -> float:
    """Places and directions in which a car may stand in the window: footprints side by side, times eight."""
    west, south, east, north = area_m
    length, width = FOOTPRINTS_M[0]
    return (east - west) * (north - south) / (length * width) * DIRECTIONS


def ideal_observer(
    group: str,
    without_e: Float[Array, "row column"],
    present_e: Float[Array, "row column"],
    nearest: Int[Array, "row column"],
    vehicles: Int[Array, "vehicle"],
    sensor: Sensor,
    false_alarm: float,
    rng: np.random.Generator,
) -> tuple[Float[Array, "vehicle"], Float[Array, "vehicle"]]:
    """P_D and d′ of each vehicle, its place and the background known, noise alone against it.

    Parameters
    ----------
    group
        pan, dolp or all.
    without_e, present_e
        Expected electrons of the frame without vehicles and with them. [e]
    nearest
        From `nearest_vehicle`: whose a change is.
    vehicles
        Ids.
    sensor, false_alarm
        The sensor; the false-alarm probability of one hypothesis.
    rng
        Draws of `polarized`.
    """
    probability, told = np.zeros(len(vehicles)), np.zeros(len(vehicles))
    frames, dark_e = (without_e, present_e), dark_noise_e(sensor)
    changed = list(changed_elements(*frames, nearest, vehicles, dark_e))
    if group == "dolp":
        known = _of_dolp(frames, changed, sensor, rng)
    else:
        known = _of_elements(frames, changed, group, sensor)
    for k, cumulants, limit in known:
        told[k] = detectability(cumulants)
        probability[k] = detection_probability(cumulants, false_alarm, min(limit, 1e4))
    return probability, told


def _of_elements(
    frames: tuple[Array, Array], changed: list[Changed], group: str, sensor: Sensor
) -> Iterator[tuple[int, Cumulants, float]]:
    """Number of each vehicle that a group's elements tell of, its K(s), and up to which s that is finite."""
    for k, rows, columns in changed:
        kept = is_of(group, rows, columns, sensor)
        if kept.any():
            without, present = (frame[rows[kept], columns[kept]] for frame in frames)
            elements = Elements(without, present, dark_noise_e(sensor), full_electrons(sensor))
            yield k, *element_cumulants(elements)


def _of_dolp(
    frames: tuple[Array, Array], changed: list[Changed], sensor: Sensor, rng: np.random.Generator
) -> Iterator[tuple[int, Cumulants, float]]:
    """The same of what superpixels tell by their DoLP alone."""
    side, shape = sensor.side, np.array(frames[0].shape) // sensor.side
    places, told = [], []
    for k, rows, columns in changed:
        own = np.unique(np.stack([rows // side, columns // side], axis=1), axis=0)
        if len(own := own[(own < shape).all(axis=1)]):
            places.append(own)
            told.append(k)
    if not told:
        return
    chosen, first = np.concatenate(places), np.cumsum([0, *map(len, places)])
    read = (np.minimum(mean, full_electrons(sensor)) for mean in frames)
    both = ((mean, np.maximum(mean, 0) + dark_noise_e(sensor) ** 2) for mean in read)
    without, present = (superpixel_polarization(*one, sensor, chosen) for one in both)
    for k, cumulants in zip(told, dolp_cumulants(without, present, first, rng), strict=True):
        yield k, cumulants, math.inf


def nearest_vehicle(on: Int[Array, "row column"]) -> Int[Array, "row column"]:
    """Id of the vehicle whose silhouette is nearest to each element, −1 beyond `REACH_ELEMENTS`.

    Of shadows that vehicles share each so has its own part. ``on`` is from `frame.vehicles_on`.
    """
    found = ndimage.distance_transform_edt(on < 0, return_indices=True)
    distance, nearest = cast(tuple[Array, Array], found)  # SciPy's annotation allows None too
    return np.where(distance <= REACH_ELEMENTS, on[tuple(nearest)], -1)


def changed_elements(
    without_e: Array, present_e: Array, nearest: Array, vehicles: Array, dark_e: float
) -> Iterator[Changed]:
    """Number of each vehicle that changes anything, and rows and columns of the elements it changes."""
    sigma = np.sqrt(np.maximum(without_e, 0) + dark_e**2)
    rows, columns = np.nonzero((np.abs(present_e - without_e) > _CHANGED * sigma) & (nearest >= 0))
    owner = nearest[rows, columns]
    order = np.argsort(owner, kind="stable")
    first = np.searchsorted(owner[order], vehicles, "left")
    last = np.searchsorted(owner[order], vehicles, "right")
    for k, (start, stop) in enumerate(zip(first, last, strict=True)):
        if stop > start:
            mine = order[start:stop]
            yield k, rows[mine], columns[mine]


def is_of(group: str, rows: Array, columns: Array, sensor: Sensor) -> Array:
    """Whether elements are among those whose own values a group consists of."""
    places = elements_of(group, sensor)
    inside = np.zeros((sensor.side, sensor.side), np.bool_)
    for place in places:
        inside[place] = True
    return inside[rows % sensor.side, columns % sensor.side]
