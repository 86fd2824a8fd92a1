"""Electrons to counts and back: shot, dark and read noise, full well, gain, quantizer, calibration.

Blocks of rows have generators of their own, spawned from the frame's, so that a frame does not depend on how
its blocks were spread over threads.
"""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.sensor.sensor import Sensor
from glintrack.stokes import rotate_qu

PEDESTAL_COUNTS = 64  # of the converter below zero, so that dark noise is not cut off
FULL_FOR_CERTAIN = 10.0  # full wells: glints need no larger Poisson deviates than that
BLOCK_ROWS = 32
_LARGEST_MEAN_E = 1e18  # that NumPy draws Poisson deviates of


def read_out(
    planes: Float[Array, "plane row column"], sensor: Sensor, rng: np.random.Generator
) -> Float[Array, "row column"]:
    """Light on the elements to what each reads, calibrated.

    Parameters
    ----------
    planes
        Light on the elements, ``sensor.planes`` of it. [W m⁻² sr⁻¹ µm⁻¹]
    sensor
        From `build_sensor`.
    rng
        Spawns a generator for each block of rows.

    Returns
    -------
    The band-mean radiance of unpolarized light that gives each element's count. [W m⁻² sr⁻¹ µm⁻¹]
    """
    rows, columns = planes.shape[1:]
    side = sensor.side
    light = photo_electrons(planes, sensor)
    per_reading = np.tile(sensor.electrons_per_reading, (rows // side, columns // side))
    streams = rng.spawn(-(-rows // BLOCK_ROWS))
    out = np.empty((rows, columns), np.float32)

    def work(start: int, stop: int) -> None:
        for block in range(start, stop):
            own = slice(block * BLOCK_ROWS, (block + 1) * BLOCK_ROWS)
            out[own] = _counts_e(light[own], sensor, own, streams[block])
            out[own] -= sensor.pattern.known_offset_e[own]
            out[own] /= per_reading[own] * sensor.pattern.known_gain[own]

    over_rows(work, len(streams))
    return out


def photo_electrons(planes: Float[Array, "plane row column"], sensor: Sensor) -> Float[Array, "row column"]:
    """Electrons that light makes in elements of mean gain: each one's analyser row times the light. [e]"""
    side, turn = sensor.side, sensor.pattern.polarizer_turn
    out = np.zeros(planes.shape[1:])
    for i in range(side):
        for j in range(side):
            own = (slice(i, None, side), slice(j, None, side))
            for k, (_, component) in enumerate(sensor.planes):
                gain = sensor.element_gains[i, j, k]
                if component and turn is not None:  # Q and U of a channel lie side by side
                    q, u = sensor.element_gains[i, j, k + 1 - component : k + 3 - component]
                    c, s = turn[(0, *own)], turn[(1, *own)]
                    gain = rotate_qu.py_func(q, u, c, -s)[component - 1]
                elif not gain:
                    continue
                out[own] += gain * planes[(k, *own)].astype(float)
    return out


def _counts_e(light_e: Array, sensor: Sensor, rows: slice, rng: np.random.Generator) -> Array:
    """Electrons that the counts of a block of rows stand for."""
    design, pattern = sensor.design, sensor.pattern
    offset_e, full_well_e = pattern.offset_e[rows], design.full_well_e
    most_e = min(FULL_FOR_CERTAIN * full_well_e, _LARGEST_MEAN_E)
    expected_e = light_e * pattern.gain[rows] + np.maximum(offset_e, 0)
    electrons = rng.poisson(np.clip(expected_e, 0, most_e)) + np.minimum(offset_e, 0.0)
    electrons = np.minimum(electrons, full_well_e)
    if design.read_noise_e > 0:
        electrons += design.read_noise_e * rng.standard_normal(electrons.shape, dtype=np.float32)
    counts = np.floor(electrons / design.electrons_per_count + 0.5)
    return np.clip(counts, -PEDESTAL_COUNTS, 2**design.bits - 1) * design.electrons_per_count
