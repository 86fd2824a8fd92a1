"""Differences between elements (gain, offset, polarizer, incidence, fall-off) and their calibration."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.layouts import MIRROR, OPEN
from glintrack.sensor.polarizer import Polarizer, axis_at_incidence
from glintrack.sensor.wavefront import relative_illumination

CALIBRATION_FRAMES = (
    100  # dark and half-full flat frames that the elements' gains and offsets are measured with
)
_COPY = 0  # seed of the one copy of the sensor


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


@dataclass(frozen=True)
class FixedPattern:
    """Gains and offsets of the elements.

    Parameters
    ----------
    gain, known_gain
        Of each element over the mean, with the light's fall-off over the field; what calibration found. [1]
    offset_e, known_offset_e
        Dark electrons of one exposure (mean dark current and DSNU); what calibration found. [e]
    polarizer_turn
        What turns each element's (Q, U) weights: factor of its diattenuation × cos 2α and × sin 2α, α the
        error of its pass axis; None where all elements of a kind are alike. [1]
    """

    gain: Float[Array, "row column"]
    known_gain: Float[Array, "row column"]
    offset_e: Float[Array, "row column"]
    known_offset_e: Float[Array, "row column"]
    polarizer_turn: Float[Array, "2 row column"] | None = None


def fixed_pattern(design: SensorDesign, slanted: Departure | None = None) -> FixedPattern:
    """Fixed pattern of one copy of the design, and its calibration.

    Parameters
    ----------
    design
        The sensor.
    slanted
        What the angle of incidence does to each element; calibration knows its gain.

    A real calibration averages dark frames and evenly lit ones at half the full well; what it finds of each
    element is off by the noise of that average.

    References
    ----------
    EMVA Standard 1288, release 3.1, §8: PRNU and DSNU as relative RMS gain and RMS dark signal.
    """
    shape = (design.rows, design.columns)
    rng = np.random.default_rng(np.random.SeedSequence(_COPY, spawn_key=(7,)))
    light = relative_illumination(design, np.arange(float(shape[0])), np.arange(float(shape[1])))
    dark_e = design.dark_current_e_per_s * design.integration_time_ms * 1e-3
    gain, known_gain = light, light
    offset = known_offset = np.broadcast_to(np.float32(dark_e), shape)
    noise_e = np.hypot(design.read_noise_e, design.electrons_per_count / np.sqrt(12))
    if design.prnu > 0:
        gain = light * np.maximum(1 + design.prnu * rng.standard_normal(shape), 0.05)
        half_e = design.full_well_e / 2
        error = np.sqrt(half_e + noise_e**2) / half_e / np.sqrt(CALIBRATION_FRAMES)
        known_gain = gain * np.maximum(1 + error * rng.standard_normal(shape), 0.05)
    if design.dsnu_e > 0:
        offset = dark_e + design.dsnu_e * rng.standard_normal(shape)
        error_e = np.sqrt(dark_e + noise_e**2) / np.sqrt(CALIBRATION_FRAMES)
        known_offset = offset + error_e * rng.standard_normal(shape)
    if slanted is not None:
        gain, known_gain = gain * slanted.gain, known_gain * slanted.gain
    error = _polarizer_errors(design)
    turn = None
    if slanted is not None or error is not None:
        nothing = Departure(np.ones(shape), np.ones(shape), np.zeros(shape))
        first, second = slanted or nothing, error or nothing
        gain = gain * second.gain
        angle = 2 * (first.turn_rad + second.turn_rad)
        turn = first.diattenuation * second.diattenuation * np.stack([np.cos(angle), np.sin(angle)])
        turn = turn.astype(np.float32)
    values = (gain, known_gain, offset, known_offset)
    return FixedPattern(
        *(np.ascontiguousarray(value, dtype=np.float32) for value in values), polarizer_turn=turn
    )


def _polarizer_errors(design: SensorDesign) -> Departure | None:
    """What calibration left of the polarizers' differences; those of this copy."""
    spread, shape = design.polarizer_spread, (design.rows, design.columns)
    if not design.has_stokes or not (spread.gain or spread.diattenuation or spread.angle_deg):
        return None
    rng = np.random.default_rng(np.random.SeedSequence(_COPY, spawn_key=(8,)))
    gain, diattenuation, turn = rng.standard_normal((3, *shape)) * _over_polarizers(design)
    return Departure(
        np.maximum(1 + spread.gain * gain, 0.05),
        np.clip(1 + spread.diattenuation * diattenuation, 0, None),
        np.radians(spread.angle_deg) * turn,
    )


def _over_polarizers(design: SensorDesign) -> Float[Array, "row column"]:
    """1 where a polarizer stands over an element, 0 elsewhere."""
    kinds = np.array([[what not in (MIRROR, OPEN) for what in row] for row in design.superpixel], float)
    return np.tile(kinds, (design.rows // len(kinds), design.columns // len(kinds)))
