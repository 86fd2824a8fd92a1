"""The raw mosaic with its noise, for detectors that want the elements as they lie."""

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.records import Mosaic, ServedQueries
from glintrack.sensor.exposure import dark_noise_e
from glintrack.sensor.sensor import Sensor


def mosaic_of(measured: Float[Array, "row column"], sensor: Sensor, served: ServedQueries) -> Mosaic:
    """Electrons of every element and their standard deviation.

    Parameters
    ----------
    measured
        From `detector_readout`. [W m⁻² sr⁻¹ µm⁻¹]
    sensor
        From `build_sensor`.
    served
        Mirrors that fed the spectrometer in this frame: their elements have no reading.

    Returns
    -------
    Electrons that the exposure given in the design would have made, whatever that of the frame was, so that a
    detector may hold frames against each other. The variance is the electrons' own (shot noise) plus that of
    the dark; what calibration does not know of the elements' gains is left out, since it stays with the
    element from frame to frame.
    """
    side = sensor.side
    rows, columns = (n // side for n in measured.shape)
    electrons = measured * np.tile(sensor.electrons_per_reading, (rows, columns)).astype(np.float32)
    sigma_e = np.sqrt(np.maximum(electrons, 0) + np.float32(dark_noise_e(sensor) ** 2))
    away = served.served
    i, j = sensor.mirror_element
    part = np.float32(sensor.exposure_part)
    electrons, sigma_e = electrons / part, sigma_e / part
    electrons[side * served.rows[away] + i, side * served.columns[away] + j] = np.nan
    return Mosaic(electrons, sigma_e, sensor.design.superpixel, sensor.stokes_gains / sensor.exposure_part)
