"""Frames and spectra of an ideal sensor, without noise, blur or mosaic; for scores, never for the tracker."""

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.records import Radiance, ServedQueries
from glintrack.core.schema import RADIANCE, check
from glintrack.sensor.sensor import Sensor


def noiseless_frame(radiance: Radiance, sensor: Sensor, time_s: float = 0.0) -> xr.Dataset:
    """A frame of the light itself: pan and Stokes vectors are the means over each superpixel's elements.

    Parameters
    ----------
    radiance
        As for `expose`, before anything moved or blurred it.
    sensor
        From `build_sensor`.
    time_s
        Written to the frame.

    Returns
    -------
    Schema ``frame``, sampled at the superpixels' centres.
    """
    light = np.asarray(radiance(sensor.pan_weights).values[:, :, 0], dtype=np.float64)
    rows, columns, components = light.shape
    side, middle = sensor.side, (sensor.side - 1) / 2
    blocks = light.reshape(rows // side, side, columns // side, side, components)
    mean = blocks.mean(axis=(1, 3)).astype(np.float32)
    if sensor.design.optics.depolarizer:
        mean[..., 1:] = 0
    element = {"units": "element"}
    frame = xr.Dataset(
        {
            "pan": (("y", "x"), mean[..., 0], {"units": RADIANCE}),
            "stokes_radiance": (
                ("y", "x", "stokes"),
                mean[..., :3],
                {"units": RADIANCE, "stokes_frame": "detector"},
            ),
        },
        coords={
            "y": ("y", side * np.arange(rows // side) + middle, element),
            "x": ("x", side * np.arange(columns // side) + middle, element),
            "stokes": ["I", "Q", "U"],
        },
        attrs={"time_s": float(time_s), "dolp_floor": 0.0},
    )
    return check(frame, "frame")


def noiseless_spectra(
    served: ServedQueries, radiance: Radiance, sensor: Sensor
) -> Float[Array, "query wavelength"]:
    """Spectra of the light at the serving mirrors' own rays; NaN where refused. [W m⁻² sr⁻¹ µm⁻¹]"""
    out = np.full((len(served.queries), len(sensor.band_centre_um)), np.nan)
    on = served.served
    if on.any():
        mirrors = (
            sensor.side * np.stack([served.rows[on], served.columns[on]], axis=1) + sensor.mirror_element
        )
        out[on] = radiance(sensor.band_weights, pixels=mirrors).values[..., 0]
    return out
