"""Evidence of change in a frame's elements against a background, by group: pan, DoLP, all four.

DoLP is one value per superpixel, √(S1² + S2²)/S0. Its noise follows from the readings to first order.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np
from jaxtyping import Float

from glintrack.bounds.finder import Plane, evidence
from glintrack.bounds.predictor import PredictedBackground
from glintrack.core.arrays import Array
from glintrack.core.records import Mosaic
from glintrack.sensor import Sensor
from glintrack.track.detect.binning import bin_mosaic

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
    """Q/I and U/I from the polarizers' readings with noise, to first order."""
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


def element_groups(sensor: Sensor) -> tuple[str, ...]:
    """List the groups of elements of a sensor; without that of all where every element is pan."""
    pan = sensor.pan_element is not None or sensor.stokes_matrix is None
    more = len(group_elements("pan", sensor)) < sensor.side**2
    has = {"pan": pan, "dolp": sensor.stokes_matrix is not None, "all": not pan or more}
    return tuple(group for group in GROUPS if has[group])


def group_elements(group: str, sensor: Sensor) -> list[tuple[int, int]]:
    """(row, column) in the superpixel of the elements of a group."""
    if group == "pan" and sensor.pan_element:
        return [sensor.pan_element]
    return [(i, j) for i in range(sensor.side) for j in range(sensor.side)]


def group_planes(
    group: str,
    electrons: Float[Array, "row column"],
    background: PredictedBackground,
    sensor: Sensor,
    factor: int = 1,
) -> list[Plane]:
    """Evidence of change of a group of elements, binned by a factor, for `finder.find_vehicles`."""
    side, gain = sensor.side, np.asarray(sensor.pattern.known_gain)
    if factor > 1:
        known, sigma_e = np.isfinite(background.electrons), np.sqrt(background.variance)
        whole = Mosaic(electrons, sigma_e, sensor.design.superpixel, np.zeros((side, side, 3)))
        measured, expected, gains = (
            bin_mosaic(replace(whole, electrons=np.where(known, one, np.nan)), factor)
            for one in (electrons, background.electrons, gain)
        )
        background = PredictedBackground(expected.electrons, expected.sigma_e**2)
        electrons, gain = measured.electrons, gains.electrons
    if group == "dolp":
        expected = superpixel_polarization(background.electrons, background.variance, sensor, gain=gain)
        measured = superpixel_polarization(electrons, background.variance, sensor, gain=gain)
        change = np.linalg.norm(measured.mean, axis=1) - np.linalg.norm(expected.mean, axis=1)
        shape = electrons.shape[0] // side, electrons.shape[1] // side
        z2 = (change**2 / dolp_variance(expected)).reshape(shape)
        middle = (factor * side - 1) / 2
        return [Plane(evidence(z2), middle, middle, factor * side)]
    z2 = (electrons - background.electrons) ** 2 / background.variance
    first = (factor - 1) / 2
    return [
        Plane(evidence(z2[i::side, j::side]), factor * i + first, factor * j + first, factor * side)
        for i, j in group_elements(group, sensor)
    ]


def superpixel_polarization(
    electrons: Float[Array, "row column"],
    variance: Float[Array, "row column"],
    sensor: Sensor,
    chosen: Array | None = None,
    gain: Array | None = None,
) -> Polarization:
    """Q/I and U/I of all superpixels, row by row, or of chosen ones (y, x), with a gain or the sensor's."""
    if sensor.stokes_matrix is None:
        raise ValueError(f"`sensor` must have polarizers; got layout {sensor.design.layout!r}.")
    layout, side = sensor.design.superpixel, sensor.side
    # in the order of `Sensor.stokes_matrix`
    places = [
        (i, j) for i, row in enumerate(layout) for j, kind in enumerate(row) if not isinstance(kind, str)
    ]

    def at_polarizers(values: Array) -> Float[Array, "superpixel polarizer"]:
        if chosen is None:
            return np.stack([values[i::side, j::side].ravel() for i, j in places], axis=-1)
        rows, columns = side * chosen[:, 0], side * chosen[:, 1]
        return np.stack([values[rows + i, columns + j] for i, j in places], axis=-1)

    gain = np.asarray(sensor.pattern.known_gain) if gain is None else gain
    gain = at_polarizers(gain) if gain.ndim == 2 else gain
    scale = gain * np.array([[sensor.electrons_per_reading[place] for place in places]])
    return polarization(
        at_polarizers(electrons) / scale, at_polarizers(variance) / scale**2, sensor.stokes_matrix
    )
