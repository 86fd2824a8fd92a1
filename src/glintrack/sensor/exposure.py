"""From light on the elements to a frame: lens, detector array, calibration to radiance, Stokes vectors.

Shot, dark and read noise, full well, gain, quantizer and fixed pattern follow the lens. The
instantaneous-field-of-view error of the mosaic comes only from the elements' different rays. Each block of
rows has its own generator, spawned from the frame's, so that a frame does not depend on the threads.

Automatic exposure moves a quantile q of the last frame's elements to a share of the full well,
t' = t · share · well/q. The signal of a full element is unknown, so that exposure then falls by the share
at most, frame by frame.
"""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.core.records import Mosaic, Radiance, ServedQueries
from glintrack.core.schema import RADIANCE, check
from glintrack.sensor.demosaicking import demosaic, polarizer_centroid
from glintrack.sensor.layouts import Superpixel, pan_element, places
from glintrack.sensor.lens_kernels import aperture_weights, lens_kernels, through_lens, with_wings
from glintrack.sensor.sensor import Sensor, noise_equivalent_radiance
from glintrack.stokes import rotate_qu

MIN_EXPOSURE_MS, MAX_STEP = 0.001, 4.0  # of the automatic exposure, and its largest change by a frame
FULL_SHARE = 0.8  # of the full well: target of the automatic exposure
NOISE_FLOORS = 3.0  # DoLP is masked where S0 is under three times its noise


def expose(
    radiance: Radiance, sensor: Sensor, served: ServedQueries, rng: np.random.Generator, time_s: float = 0.0
) -> xr.Dataset:
    """One frame: panchromatic from the mirrors, Stokes from the polarizers.

    Parameters
    ----------
    radiance
        ``radiance(channels)`` gives the Stokes radiance of every element in the ``detector`` frame,
        dims (y, x, channel, stokes), or of n × n cells of every element; see `render.shade`.
    served
        Mirrors that feed the spectrometer in this frame; they are dark in pan.
    rng
        Shot and read noise.

    Returns
    -------
    Schema ``frame``; pan is NaN where the mirror fed the spectrometer. Without a mirror or an open element
    pan is S0, or the mean of the filters' readings; without polarizers S0 is pan, and S1 and S2 are NaN.
    """
    return frame_of(array_readout(radiance(sensor.channels).values, sensor, rng), sensor, served, time_s)


def frame_of(
    measured: Float[Array, "row column"], sensor: Sensor, served: ServedQueries, time_s: float = 0.0
) -> xr.Dataset:
    """Compute a frame from the readings of `array_readout`; the rest as in `expose`."""
    side, layout = sensor.side, sensor.design.superpixel
    place = sensor.pan_element
    pan = None
    dark = np.zeros((measured.shape[0] // side, measured.shape[1] // side), bool)
    if place is not None:
        pan = measured[place[0] :: side, place[1] :: side].copy()
        dark[served.rows[served.is_served], served.columns[served.is_served]] = True
        pan[dark] = np.nan
    if sensor.stokes_matrix is not None:
        readings = demosaic(measured, layout, sensor.design.demosaic, dark)
        stokes = readings @ sensor.stokes_matrix.T.astype(np.float32)
    else:
        stokes = np.full((*dark.shape, 3), np.nan, np.float32)
        if pan is None:  # filters alone
            pan = measured.reshape(dark.shape[0], side, dark.shape[1], side).mean(axis=(1, 3))
        stokes[..., 0] = pan
    about = {"time_s": float(time_s), "dolp_floor": NOISE_FLOORS * s0_noise_floor(sensor)}
    pan = stokes[..., 0] if pan is None else pan
    return check(label_frame(pan, stokes, layout, sensor.design.demosaic, about), "frame")


def array_readout(light: Array, sensor: Sensor, rng: np.random.Generator) -> Array:
    """Compute readings from light (y, x, channel, stokes): `light_on_elements`, then `read_out`."""
    return read_out(light_on_elements(light, sensor), sensor, rng)


def light_on_elements(light: Array, sensor: Sensor) -> Float[Array, "plane row column"]:
    """Light behind the lens on every element, `Sensor.planes` of it, from light (y, x, channel, stokes).

    Behind `sensor.optics.depolarizer`, M = diag(1, 0, 0), S1 and S2 are 0.

    Raises
    ------
    ValueError
        If the light's size is no whole multiple of the array's.
    """
    rows, columns = sensor.camera.rows, sensor.camera.columns
    fine = light.shape[0] // rows if light.ndim == 4 else 0
    expected = (rows * max(fine, 1), columns * max(fine, 1), len(sensor.channels), 3)
    if light.shape != expected:
        raise ValueError(
            f"`radiance` must give a frame of {expected} (the design's elements, or whole cells "
            f"of each); got {light.shape}."
        )
    planes = np.stack([light[:, :, channel, component] for channel, component in sensor.planes])
    if sensor.design.optics.depolarizer:
        planes = depolarize(planes, sensor)
    kernels = sensor.kernels
    if fine > 1:
        kernels = lens_kernels(sensor.design, sensor.wavelength_um, sensor.channels, fine)
    own = tuple(kernels[channel] for channel, _ in sensor.planes)
    weights = aperture_weights(sensor.design.oversampling, sensor.design.fill_factor, fine)
    on_elements = through_lens(planes, own, fine, weights)
    for k, kernel in enumerate(own):
        on_elements[k] = with_wings(on_elements[k], sensor.design, kernel.far_share, kernel.half_side_um)
    return on_elements


def depolarize(planes: Float[Array, "plane row column"], sensor: Sensor) -> Float[Array, "plane row column"]:
    """Set S1 and S2 of the light on the elements to 0."""
    component = np.array([component for _, component in sensor.planes])
    return np.where((component == 0)[:, None, None], planes, 0.0)


def s0_noise_floor(sensor: Sensor) -> float:
    """RMS of S0 in the dark; that of pan without polarizers. [W m⁻² sr⁻¹ µm⁻¹]"""
    if sensor.stokes_matrix is None:
        return noise_equivalent_radiance(sensor)
    polarizers = places(sensor.design.superpixel, "polarizer")
    noise = np.array([sensor.design.dark_noise_e / sensor.electrons_per_reading[k] for k in polarizers])
    return float(np.hypot.reduce(sensor.stokes_matrix[0] * noise))


def label_frame(
    pan: Float[Array, "y x"],
    stokes: Float[Array, "y x 3"],
    layout: Superpixel,
    demosaic_method: str,
    attributes: Mapping[str, float],
    units: str = RADIANCE,
) -> xr.Dataset:
    """Label a frame of the schema ``frame``, with the offsets of each variable's samples.

    Parameters
    ----------
    pan, stokes
        Values of every superpixel; pan is that of the mirror or open element, else S0.
    layout, demosaic_method
        Superpixel, and its demosaicking.
    attributes
        Attributes of the frame: ``time_s`` [s], ``dolp_floor``.
    units
        Unit of pan and the Stokes vectors.
    """
    side = len(layout)
    middle = (side - 1) / 2
    centre, place = polarizer_centroid(layout, demosaic_method), pan_element(layout)
    of_pan, of_stokes = (
        {"units": units, "row_offset": float(offset[0]), "column_offset": float(offset[1])}
        for offset in (centre if place is None else np.array(place, dtype=float) - middle, centre)
    )
    axes = {n: side * np.arange(count) + middle for n, count in zip("yx", pan.shape, strict=True)}
    return xr.Dataset(
        {
            "pan": (("y", "x"), pan, of_pan),
            "stokes_radiance": (("y", "x", "stokes"), stokes, {**of_stokes, "stokes_frame": "detector"}),
        },
        coords={n: (n, values, {"units": "element"}) for n, values in axes.items()}
        | {"stokes": ["I", "Q", "U"]},
        attrs=dict(attributes),
    )


MAX_MEAN_WELLS = 10.0  # full wells: elements are full for certain above that
BLOCK_ROWS = 32
MAX_MEAN_E = 1e18  # of NumPy's Poisson deviates


def read_out(
    planes: Float[Array, "plane row column"], sensor: Sensor, rng: np.random.Generator
) -> Float[Array, "row column"]:
    """Calibrated readings of the light on the elements.

    Parameters
    ----------
    planes
        Light on the elements, ``sensor.planes`` of it. [W m⁻² sr⁻¹ µm⁻¹]
    rng
        Source of a generator for each block of rows.

    Returns
    -------
    The band-mean radiance of unpolarized light with each element's count. [W m⁻² sr⁻¹ µm⁻¹]
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
    """Electrons in elements of mean gain: each one's analyser row times the light. [e]"""
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
    """Electrons of the counts of a block of rows."""
    design, pattern = sensor.design, sensor.pattern
    offset_e, full_well_e = pattern.offset_e[rows], design.full_well_e
    most_e = min(MAX_MEAN_WELLS * full_well_e, MAX_MEAN_E)
    expected_e = light_e * pattern.gain[rows] + np.maximum(offset_e, 0)
    electrons = rng.poisson(np.clip(expected_e, 0, most_e)) + np.minimum(offset_e, 0.0)
    electrons = np.minimum(electrons, full_well_e)
    if design.read_noise_e > 0:
        electrons += design.read_noise_e * rng.standard_normal(electrons.shape, dtype=np.float32)
    counts = np.floor(electrons / design.electrons_per_count + 0.5)
    return np.clip(counts, -design.pedestal_counts, 2**design.bits - 1) * design.electrons_per_count


def mosaic_of(measured: Float[Array, "row column"], sensor: Sensor, served: ServedQueries) -> Mosaic:
    """Electrons of every element and their standard deviation.

    Parameters
    ----------
    measured
        From `array_readout`. [W m⁻² sr⁻¹ µm⁻¹]
    served
        Mirrors that fed the spectrometer in this frame: their elements have no reading.

    Returns
    -------
    Electrons at the exposure of the design, whatever that of the frame, so that a detector may compare
    frames. The variance is that of the electrons (shot noise) plus that of the dark. Calibration errors of
    the elements' gains are left out, since they stay the same from frame to frame.
    """
    side = sensor.side
    rows, columns = (n // side for n in measured.shape)
    electrons = measured * np.tile(sensor.electrons_per_reading, (rows, columns)).astype(np.float32)
    gain = sensor.pattern.known_gain  # by which the readings were divided
    sigma_e = np.sqrt(sensor.design.noise_variance_e2(electrons * gain)) / gain
    away = served.is_served
    i, j = sensor.mirror_element
    part = np.float32(sensor.exposure_part)
    electrons, sigma_e = electrons / part, sigma_e / part
    electrons[side * served.rows[away] + i, side * served.columns[away] + j] = np.nan
    return Mosaic(electrons, sigma_e, sensor.design.superpixel, sensor.stokes_gains / sensor.exposure_part)


def next_exposure_ms(sensor: Sensor, measured: Float[Array, "row column"]) -> float:
    """Exposure of the next frame by the design. [ms]

    Parameters
    ----------
    sensor
        With the exposure of the last frame (`with_exposure`).
    measured
        Its readings, from `read_out`. [W m⁻² sr⁻¹ µm⁻¹]
    """
    design = sensor.design
    automatic = design.auto_exposure
    if not automatic.quantile:
        return design.integration_time_ms
    side = sensor.side
    rows, columns = (n // side for n in measured.shape)
    electrons = measured * np.tile(sensor.electrons_per_reading, (rows, columns)) * sensor.pattern.known_gain
    electrons = electrons + sensor.pattern.known_offset_e  # the well fills with dark current too
    quantile_e = max(float(np.quantile(electrons, automatic.quantile)), 1.0)
    change = FULL_SHARE * design.saturation_e / quantile_e
    change = min(max(change, 1 / MAX_STEP), MAX_STEP)
    return min(max(design.integration_time_ms * change, MIN_EXPOSURE_MS), design.longest_integration_time_ms)


def with_exposure(sensor: Sensor, exposure_ms: float) -> Sensor:
    """Change a sensor's exposure [ms]: electrons, dark current and their calibration scale."""
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


def noiseless_frame(radiance: Radiance, sensor: Sensor, time_s: float = 0.0) -> xr.Dataset:
    """Frame of the light itself: pan and Stokes vectors are the means over each superpixel's elements.

    Parameters
    ----------
    radiance
        As for `expose`, before motion and lens.

    Returns
    -------
    Schema ``frame``, sampled at the superpixels' centres.
    """
    light = np.asarray(radiance(sensor.pan_weights).values[:, :, 0], dtype=np.float64)
    rows, columns, components = light.shape
    side = sensor.side
    blocks = light.reshape(rows // side, side, columns // side, side, components)
    mean = blocks.mean(axis=(1, 3)).astype(np.float32)
    if sensor.design.optics.depolarizer:
        mean[..., 1:] = 0
    about = {"dolp_floor": 0.0, "time_s": float(time_s)}
    frame = label_frame(mean[..., 0], mean[..., :3], sensor.design.superpixel, "bilinear", about)
    frame["pan"].attrs |= {"row_offset": 0.0, "column_offset": 0.0}
    return check(frame, "frame")
