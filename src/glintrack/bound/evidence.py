"""Evidence of change in a frame's elements against a background, by group: pan, DoLP, all four."""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.bound.finder import Plane, evidence
from glintrack.bound.polarized import Polarization, dolp_variance, polarization
from glintrack.sensor import Sensor

GROUPS = ("pan", "dolp", "all")


class Background(NamedTuple):
    """Electrons expected without vehicles, and the variance of what they are read as. [e, e²]"""

    electrons: Float[Array, "row column"]
    variance: Float[Array, "row column"]


def groups_of(sensor: Sensor) -> tuple[str, ...]:
    """The groups of elements that a sensor has."""
    has = {"pan": sensor.pan_element is not None, "dolp": sensor.stokes_matrix is not None, "all": True}
    return tuple(group for group in GROUPS if has[group])


def polarizer_places(sensor: Sensor) -> list[tuple[int, int]]:
    """(row, column) of the polarizers in the superpixel, in the order of `Sensor.stokes_matrix`."""
    layout = sensor.design.superpixel
    return [(i, j) for i, row in enumerate(layout) for j, what in enumerate(row) if not isinstance(what, str)]


def elements_of(group: str, sensor: Sensor) -> list[tuple[int, int]]:
    """Places in the superpixel of the elements whose own values a group consists of."""
    if group == "pan":
        return [sensor.mirror_element]
    side = sensor.side
    return [(i, j) for i in range(side) for j in range(side)]


def group_planes(
    group: str, electrons: Float[Array, "row column"], background: Background, sensor: Sensor
) -> list[Plane]:
    """Evidence of change of a group of elements, for `finder.find_vehicles`."""
    side = sensor.side
    if group == "dolp":
        z2 = dolp_change(electrons, background, sensor)
        return [Plane(evidence(z2), (side - 1) / 2, (side - 1) / 2, side)]
    z2 = (electrons - background.electrons) ** 2 / background.variance
    return [Plane(evidence(z2[i::side, j::side]), i, j, side) for i, j in elements_of(group, sensor)]


def dolp_change(
    electrons: Float[Array, "row column"], background: Background, sensor: Sensor
) -> Float[Array, "y x"]:
    """Squared change of each superpixel's DoLP over its variance, elements taken as they lie. [1]"""
    measured = superpixel_polarization(electrons, background.variance, sensor)
    expected = superpixel_polarization(background.electrons, background.variance, sensor)
    change = np.linalg.norm(measured.mean, axis=1) - np.linalg.norm(expected.mean, axis=1)
    shape = electrons.shape[0] // sensor.side, electrons.shape[1] // sensor.side
    return (change**2 / dolp_variance(expected)).reshape(shape)


def superpixel_polarization(
    electrons: Float[Array, "row column"],
    variance: Float[Array, "row column"],
    sensor: Sensor,
    chosen: Array | None = None,
) -> Polarization:
    """Q/I and U/I of superpixels, row by row, or of the chosen ones (y, x)."""
    if sensor.stokes_matrix is None:
        raise ValueError(f"`sensor` must have polarizers, got layout {sensor.design.layout!r}")
    side, places = sensor.side, polarizer_places(sensor)

    def stacked(values: Array) -> Array:
        if chosen is None:
            return np.stack([values[i::side, j::side].ravel() for i, j in places], axis=-1)
        rows, columns = side * chosen[:, 0], side * chosen[:, 1]
        return np.stack([values[rows + i, columns + j] for i, j in places], axis=-1)

    known = np.asarray(sensor.pattern.known_gain)
    gain = stacked(known) if known.ndim == 2 else known
    scale = gain * np.array([sensor.electrons_per_reading[place] for place in places])
    return polarization(stacked(electrons) / scale, stacked(variance) / scale**2, sensor.stokes_matrix)
