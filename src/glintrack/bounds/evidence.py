"""Evidence of change in a frame's elements against a background, by group: pan, DoLP, all four.

DoLP is one number a superpixel, √(S1² + S2²)/S0, whose noise follows from the readings to first order.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from glintrack.bounds.finder import Plane, evidence
from glintrack.bounds.predictor import PredictedBackground
from glintrack.core.arrays import Array
from glintrack.sensor import Sensor

GROUPS = ("pan", "dolp", "all")


class Polarization(NamedTuple):
    """Q/I and U/I of superpixels, and the covariance that noise gives them. [1]"""

    mean: Float[Array, "superpixel 2"]
    covariance: Float[Array, "superpixel 2 2"]


def polarization(
    readings: Float[Array, "superpixel polarizer"],
    variance: Float[Array, "superpixel polarizer"],
    stokes_matrix: Float[Array, "3 polarizer"],
) -> Polarization:
    """Q/I and U/I of the polarizers' readings with noise, to first order."""
    s = readings @ stokes_matrix.T
    total = np.where(np.abs(s[:, :1]) > 1e-12, s[:, :1], 1e-12)
    mean = s[:, 1:] / total
    slope = (stokes_matrix[None, 1:] - mean[..., None] * stokes_matrix[None, :1]) / total[..., None]
    return Polarization(mean, np.einsum("nap,np,nbp->nab", slope, variance, slope))


def dolp_variance(of: Polarization) -> Float[Array, "superpixel"]:
    """Variance of the length of (Q/I, U/I), to first order; that of one component where it is 0. [1]"""
    length = np.linalg.norm(of.mean, axis=1)
    along = np.where(length[:, None] > 1e-9, of.mean / np.maximum(length, 1e-9)[:, None], [[1.0, 0.0]])
    return np.einsum("na,nab,nb->n", along, of.covariance, along)


def groups_of(sensor: Sensor) -> tuple[str, ...]:
    """The groups of elements that a sensor has; where all are pan there is no group of all."""
    pan = sensor.pan_element is not None
    has = {"pan": pan, "dolp": sensor.stokes_matrix is not None, "all": not pan or sensor.side > 1}
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
    group: str, electrons: Float[Array, "row column"], background: PredictedBackground, sensor: Sensor
) -> list[Plane]:
    """Evidence of change of a group of elements, for `finder.find_vehicles`."""
    side = sensor.side
    if group == "dolp":
        z2 = dolp_change(electrons, background, sensor)
        return [Plane(evidence(z2), (side - 1) / 2, (side - 1) / 2, side)]
    z2 = (electrons - background.electrons) ** 2 / background.variance
    return [Plane(evidence(z2[i::side, j::side]), i, j, side) for i, j in elements_of(group, sensor)]


def dolp_change(
    electrons: Float[Array, "row column"], background: PredictedBackground, sensor: Sensor
) -> Float[Array, "y x"]:
    """Squared change of each superpixel's DoLP over its variance, elements taken as they lie. [1]"""
    expected = superpixel_polarization(background.electrons, background.variance, sensor)
    measured = superpixel_polarization(electrons, background.variance, sensor)
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
    scale = _electrons_per_reading(sensor, chosen)
    mean, spread = (_at_polarizers(values, sensor, chosen) for values in (electrons, variance))
    return polarization(mean / scale, spread / scale**2, _stokes_matrix(sensor))


def _stokes_matrix(sensor: Sensor) -> Float[Array, "3 polarizer"]:
    if sensor.stokes_matrix is None:
        raise ValueError(f"`sensor` must have polarizers, got layout {sensor.design.layout!r}")
    return sensor.stokes_matrix


def _at_polarizers(
    values: Float[Array, "row column"], sensor: Sensor, chosen: Array | None = None
) -> Float[Array, "superpixel polarizer"]:
    """Values of the elements behind the polarizers of all superpixels, or of the chosen ones."""
    side, places = sensor.side, polarizer_places(sensor)
    if chosen is None:
        return np.stack([values[i::side, j::side].ravel() for i, j in places], axis=-1)
    rows, columns = side * chosen[:, 0], side * chosen[:, 1]
    return np.stack([values[rows + i, columns + j] for i, j in places], axis=-1)


def _electrons_per_reading(sensor: Sensor, chosen: Array | None = None) -> Float[Array, "_ polarizer"]:
    known = np.asarray(sensor.pattern.known_gain)
    gain = _at_polarizers(known, sensor, chosen) if known.ndim == 2 else known
    return gain * np.array([[sensor.electrons_per_reading[place] for place in polarizer_places(sensor)]])
