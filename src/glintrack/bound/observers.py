"""The ideal observer over the vehicles of one frame: which elements are whose, and what they tell."""

import math
from collections.abc import Iterator
from typing import cast

import numpy as np
from jaxtyping import Float, Int
from scipy import ndimage

from glintrack.arrays import Array
from glintrack.bound.evidence import elements_of, superpixel_polarization
from glintrack.bound.finder import DIRECTIONS, FOOTPRINTS_M
from glintrack.bound.frame import full_electrons
from glintrack.bound.likelihood import Elements, detectability, detection_probability, element_cumulants
from glintrack.bound.polarized import dolp_cumulants
from glintrack.sensor import Sensor, dark_noise_e

REACH_ELEMENTS = 14.0  # from a vehicle's silhouette: its shadow
_CHANGED = 0.05  # of the noise: less is the renderer's rounding


def hypotheses(area_m: tuple[float, float, float, float]) -> float:
    """Places and directions in which a car may stand in the window: footprints side by side, times eight."""
    west, south, east, north = area_m
    length, width = FOOTPRINTS_M[0]
    return (east - west) * (north - south) / (length * width) * DIRECTIONS


def ideal_observer(
    group: str,
    without_e: Float[Array, "row column"],
    present_e: Float[Array, "row column"],
    on: Int[Array, "row column"],
    vehicles: Int[Array, "vehicle"],
    sensor: Sensor,
    false_alarm: float,
    rng: np.random.Generator,
) -> tuple[Float[Array, "vehicle"], Float[Array, "vehicle"]]:
    """P_D and d′ of each vehicle, its place and the background known, noise alone against it.

    A change belongs to the vehicle whose silhouette is nearest, within `REACH_ELEMENTS`: of shadows that
    vehicles share each has its own part.

    Parameters
    ----------
    group
        pan, dolp or all.
    without_e, present_e
        Expected electrons of the frame without vehicles and with them. [e]
    on
        From `frame.vehicles_on`.
    vehicles
        Ids.
    sensor, false_alarm
        The sensor; the false-alarm probability of one hypothesis.
    rng
        Draws of `polarized`.
    """
    probability, told = np.zeros(len(vehicles)), np.zeros(len(vehicles))
    dark2 = dark_noise_e(sensor) ** 2
    both = []
    if group == "dolp":
        read = [np.minimum(mean, full_electrons(sensor)) for mean in (without_e, present_e)]
        both = [(mean, np.maximum(mean, 0) + dark2) for mean in read]
    for k, rows, columns in changed_elements(without_e, present_e, on, vehicles, dark_noise_e(sensor)):
        if group == "dolp":
            cumulants, limit = _dolp(both, rows, columns, sensor, rng), math.inf
        else:
            kept = is_of(group, rows, columns, sensor)
            place = rows[kept], columns[kept]
            elements = Elements(
                without_e[place], present_e[place], dark_noise_e(sensor), full_electrons(sensor)
            )
            cumulants, limit = element_cumulants(elements) if kept.any() else (None, 1.0)
        if cumulants is None:
            continue
        told[k] = detectability(cumulants)
        probability[k] = detection_probability(cumulants, false_alarm, min(limit, 1e4))
    return probability, told


def changed_elements(
    without_e: Array, present_e: Array, on: Array, vehicles: Array, dark_e: float
) -> Iterator[tuple[int, Array, Array]]:
    """Number of each vehicle that changes anything, and rows and columns of the elements it changes."""
    found = ndimage.distance_transform_edt(on < 0, return_indices=True)
    distance, nearest = cast(tuple[Array, Array], found)  # SciPy's annotation allows None too
    sigma = np.sqrt(np.maximum(without_e, 0) + dark_e**2)
    changed = (np.abs(present_e - without_e) > _CHANGED * sigma) & (distance <= REACH_ELEMENTS)
    rows, columns = np.nonzero(changed)
    owner = on[tuple(axis[rows, columns] for axis in nearest)]
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


def _dolp(frames: list[tuple[Array, Array]], rows: Array, columns: Array, sensor: Sensor, rng):
    """K(s) of the DoLP of some elements, from expected electrons and variance without and with vehicles."""
    side, shape = sensor.side, frames[0][0].shape
    inside = (rows < shape[0] // side * side) & (columns < shape[1] // side * side)
    if not inside.any():
        return None
    chosen = np.unique(np.stack([rows[inside] // side, columns[inside] // side], axis=1), axis=0)
    without, present = (superpixel_polarization(*frame, sensor, chosen) for frame in frames)
    return dolp_cumulants(without, present, rng)
