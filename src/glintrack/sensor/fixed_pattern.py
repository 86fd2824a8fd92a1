"""What differs from element to element: gains, offsets, the light's fall-off; and how well that is known."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.wavefront import relative_illumination


@dataclass(frozen=True)
class FixedPattern:
    """Gains and offsets of the elements.

    Parameters
    ----------
    gain, known_gain
        Of each element over the mean, with the light's fall-off over the field; what calibration found. [1]
    offset_e, known_offset_e
        Dark electrons of one exposure (mean dark current and DSNU); what calibration found. [e]
    """

    gain: Float[Array, "row column"]
    known_gain: Float[Array, "row column"]
    offset_e: Float[Array, "row column"]
    known_offset_e: Float[Array, "row column"]


def fixed_pattern(design: SensorDesign) -> FixedPattern:
    """Fixed pattern of one copy of the design, and its calibration.

    A real calibration averages dark frames and evenly lit ones at half the full well; what it finds of each
    element is off by the noise of that average. Without such frames only the means are known.

    References
    ----------
    EMVA Standard 1288, release 3.1, §8: PRNU and DSNU as relative RMS gain and RMS dark signal.
    """
    shape = (design.rows, design.columns)
    rng = np.random.default_rng(np.random.SeedSequence(design.fixed_pattern_seed, spawn_key=(7,)))
    light = relative_illumination(design, np.arange(float(shape[0])), np.arange(float(shape[1])))
    dark_e = design.dark_current_e_per_s * design.integration_time_ms * 1e-3
    gain, known_gain = light, light
    offset = known_offset = np.broadcast_to(np.float32(dark_e), shape)
    frames = design.calibration_frames
    noise_e = np.hypot(design.read_noise_e, design.electrons_per_count / np.sqrt(12))
    if design.prnu > 0:
        gain = light * np.maximum(1 + design.prnu * rng.standard_normal(shape), 0.05)
        if frames:
            half_e = design.full_well_e / 2
            error = np.sqrt(half_e + noise_e**2) / half_e / np.sqrt(frames)
            known_gain = gain * np.maximum(1 + error * rng.standard_normal(shape), 0.05)
    if design.dsnu_e > 0:
        offset = dark_e + design.dsnu_e * rng.standard_normal(shape)
        if frames:
            error_e = np.sqrt(dark_e + noise_e**2) / np.sqrt(frames)
            known_offset = offset + error_e * rng.standard_normal(shape)
    return FixedPattern(
        *(np.ascontiguousarray(a, dtype=np.float32) for a in (gain, known_gain, offset, known_offset))
    )
