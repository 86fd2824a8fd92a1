"""Exposure that follows the light: each frame's from what the frame before it read.

The next exposure holds a quantile q of the last frame's elements at a share of the full well,
t' = t · share · well/q, within what a frame leaves. A full element tells only that it is full, so that
exposure then falls by the share at most, frame by frame. Nothing of the frame to come is known, and nothing
is drawn.
"""

from dataclasses import replace

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.sensor.sensor import Sensor


def next_exposure_ms(sensor: Sensor, measured: Float[Array, "row column"]) -> float:
    """Exposure of the frame that follows one, as the design says. [ms]

    Parameters
    ----------
    sensor
        As exposed: `with_exposure` of the last frame's.
    measured
        Its readings, from `readout.read_out`. [W m⁻² sr⁻¹ µm⁻¹]
    """
    design = sensor.design
    automatic = design.auto_exposure
    if not automatic.quantile:
        return design.integration_time_ms
    side = sensor.side
    rows, columns = (n // side for n in measured.shape)
    electrons = measured * np.tile(sensor.electrons_per_reading, (rows, columns)) * sensor.pattern.known_gain
    held_e = max(float(np.quantile(electrons, automatic.quantile)), 1.0)
    change = automatic.full_share * design.full_well_e / held_e
    change = min(max(change, 1 / automatic.largest_step), automatic.largest_step)
    return min(
        max(design.integration_time_ms * change, automatic.shortest_ms), design.longest_integration_time_ms
    )


def with_exposure(sensor: Sensor, exposure_ms: float) -> Sensor:
    """The same sensor exposing for another time: electrons and dark current scale, calibration knows it.

    Parameters
    ----------
    sensor
        From `build_sensor` or from here.
    exposure_ms
        [ms]
    """
    before_ms = sensor.design.integration_time_ms
    if exposure_ms == before_ms:
        return sensor
    part = exposure_ms / before_ms
    dark_e = np.float32(1e-3 * sensor.design.dark_current_e_per_s * (exposure_ms - before_ms))
    pattern = replace(
        sensor.pattern,
        offset_e=sensor.pattern.offset_e + dark_e,
        known_offset_e=sensor.pattern.known_offset_e + dark_e,
    )
    return replace(
        sensor,
        design=sensor.design.model_copy(update={"integration_time_ms": exposure_ms}),
        element_gains=part * sensor.element_gains,
        stokes_gains=part * sensor.stokes_gains,
        pattern=pattern,
        exposure_part=part * sensor.exposure_part,
    )
