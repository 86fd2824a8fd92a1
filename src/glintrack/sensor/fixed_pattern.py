"""Differences between elements (gain, offset, polarizer, incidence, fall-off) and their calibration."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.polarizer import Polarizer, axis_at_incidence
from glintrack.sensor.wavefront import relative_illumination

CALIBRATION_FRAMES = 100  # dark and half-full flat frames from which gains and offsets are measured
_COPY = 0  # seed of the one copy of the sensor


@dataclass(frozen=True)
class Departure:
    """Factors on each element's analyser row and on its polarized part, and rotation of its axis."""

    gain: Float[Array, "row column"]
    diattenuation: Float[Array, "row column"]
    turn_rad: Float[Array, "row column"]


def chief_rays(design: SensorDesign) -> tuple[Float[Array, "row column"], Float[Array, "row column"]]:
    """Angle of incidence of each element's chief ray, and the azimuth of its plane from the detector's +x.

    With focal length f and an exit pupil at f before the detector array their angle is arctan(r/f). [rad]
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
    """Departure of the elements because of their chief rays; None for normal incidence.

    Parameters
    ----------
    polarizer
        Its polarizer, with matrices that are interpolated between its angles of incidence.
    wavelength_um, weights
        Grid, and the weight of each wavelength in a bare element's reading. [µm, 1]
    """
    if design.polarizer_incidence == "normal" or not design.has_stokes:
        return None
    incidence, azimuth = chief_rays(design)
    known = polarizer.incidence_rad
    if len(known) > 1 and incidence.max() > known[-1] + 1e-9:
        raise ValueError(
            f"`sensor.polarizer` must be tabulated up to the largest angle of the chief rays, "
            f"{math.degrees(incidence.max()):.1f}°; got {math.degrees(known[-1]):.1f}°. Take a longer "
            "lens, or polarizer_incidence = 'normal'."
        )
    turn, covered = np.zeros(incidence.shape), np.zeros(incidence.shape)
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
        Gain of each element over the mean, with the light's fall-off over the field; true and calibrated.
        [1]
    offset_e, known_offset_e
        Dark electrons of one exposure (mean dark current and DSNU); true and calibrated. [e]
    polarizer_turn
        Rotation of each element's (Q, U) weights: factor of its diattenuation × cos 2α and × sin 2α, α the
        error of its pass axis; None where all elements of a kind are alike. [1]
    """

    gain: Float[Array, "row column"]
    known_gain: Float[Array, "row column"]
    offset_e: Float[Array, "row column"]
    known_offset_e: Float[Array, "row column"]
    polarizer_turn: Float[Array, "2 row column"] | None = None


def build_fixed_pattern(design: SensorDesign, slanted: Departure | None = None) -> FixedPattern:
    """Build the fixed pattern of one copy of the design, and its calibration.

    Parameters
    ----------
    slanted
        Effect of the angle of incidence on each element; its gain is calibrated.

    A real calibration averages dark frames and evenly lit ones at half the full well. The error of each
    element is the noise of that average.

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
    spread, turn = design.polarizer_spread, None
    if slanted is not None or (design.has_stokes and any(spread.model_dump().values())):
        first = slanted or Departure(np.ones(shape), np.ones(shape), np.zeros(shape))
        # the polarizers' uncalibrated errors, of this copy
        kinds = np.array([[not isinstance(what, str) for what in row] for row in design.superpixel], float)
        rng = np.random.default_rng(np.random.SeedSequence(_COPY, spawn_key=(8,)))
        errors = rng.standard_normal((3, *shape)) * np.tile(kinds, [n // len(kinds) for n in shape])
        gain = gain * np.maximum(1 + spread.gain * errors[0], 0.05)
        angle = 2 * (first.turn_rad + np.radians(spread.angle_deg) * errors[2])
        turn = first.diattenuation * np.clip(1 + spread.diattenuation * errors[1], 0, None)
        turn = (turn * np.stack([np.cos(angle), np.sin(angle)])).astype(np.float32)
    values = (np.ascontiguousarray(v, dtype=np.float32) for v in (gain, known_gain, offset, known_offset))
    return FixedPattern(*values, polarizer_turn=turn)
