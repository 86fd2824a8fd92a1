"""Chief rays onto the polarizers, and how far they take each analyser row from that at normal incidence."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.polarizer import Polarizer, axis_at_incidence


@dataclass(frozen=True)
class Departure:
    """By how much each element's analyser row differs from that of its kind.

    Parameters
    ----------
    gain
        Factor on the whole row. [1]
    diattenuation
        Factor on its polarized part. [1]
    turn_rad
        Of its axis, counter-clockwise looking at the source. [rad]
    """

    gain: Float[Array, "row column"]
    diattenuation: Float[Array, "row column"]
    turn_rad: Float[Array, "row column"]


def chief_rays(design: SensorDesign) -> tuple[Float[Array, "row column"], Float[Array, "row column"]]:
    """Angle of incidence of each element's chief ray, and the direction of its plane from the detector's +x.

    A lens of focal length f whose exit pupil lies f before the detector sends them at arctan(r/f). [rad]
    """
    rows, columns = (np.arange(n) - (n - 1) / 2 for n in (design.rows, design.columns))
    right, up = columns[None] * design.pitch_um, -rows[:, None] * design.pitch_um
    return np.arctan(np.hypot(right, up) * 1e-3 / design.focal_length_mm), np.arctan2(up, right + 0 * up)


def departure_at_incidence(
    design: SensorDesign,
    polarizer: Polarizer,
    wavelength_um: Float[Array, "wavelength"],
    weights: Float[Array, "wavelength"],
) -> Departure | None:
    """Departure of the elements because of their chief rays; None where all are taken as normal.

    Parameters
    ----------
    design
        The sensor.
    polarizer
        Its polarizer; what it transmits is interpolated between its angles of incidence.
    wavelength_um, weights
        Grid, and what each wavelength counts for in a bare element's reading. [µm, 1]
    """
    if design.polarizer_incidence == "normal" or not design.has_stokes:
        return None
    incidence, azimuth = chief_rays(design)
    turn = np.zeros(incidence.shape)
    covered = np.zeros(incidence.shape)
    side = len(design.superpixel)
    used = weights > 0
    row = np.array(
        [weights[used] @ polarizer.analyser_row(wavelength_um[used], 0.0, i) for i in polarizer.incidence_rad]
    )
    degree = np.hypot(row[:, 1], row[:, 2]) / row[:, 0]
    gain = np.interp(incidence, polarizer.incidence_rad, row[:, 0] / row[0, 0])
    diattenuation = np.interp(incidence, polarizer.incidence_rad, degree / degree[0])
    for i, line in enumerate(design.superpixel):
        for j, what in enumerate(line):
            if isinstance(what, str):
                continue
            own = (slice(i, None, side), slice(j, None, side))
            angle = np.radians(what)
            difference = axis_at_incidence(angle, incidence[own], azimuth[own]) - angle
            turn[own] = (difference + np.pi / 2) % np.pi - np.pi / 2
            covered[own] = 1
    return Departure(1 + covered * (gain - 1), 1 + covered * (diattenuation - 1), turn)
