"""The multi-object spectrometer: which queries get a micromirror, and the spectra they bring back.

One pixel per column: a mirror's spectrum is spread along its column of the spectrometer's detector, so a
second one in the same column would fall on it. A mirror that serves is dark in pan that frame.
"""

import numpy as np
import xarray as xr

from ..camera import Pose
from ..records import ServedQueries, SpectralQuery
from ..schema import RADIANCE, check
from .design import Sensor
from .focalplane import Radiance

Array = np.ndarray


def serve(queries: tuple[SpectralQuery, ...], sensor: Sensor, reported_pose: Pose) -> ServedQueries:
    """Turn ground points into micromirrors through the *reported* pose, highest priority first.

    Parameters
    ----------
    queries
        The tracker's wishes for this frame.
    sensor, reported_pose
        Where the navigator says the camera is.

    Returns
    -------
    The mirror of each query, or why it was refused.
    """
    count = len(queries)
    rows, columns = np.full(count, -1), np.full(count, -1)
    refusals = ["outside the frame"] * count
    if count:
        place = sensor.superpixel_of(np.array([q.position for q in queries]), reported_pose)
        taken: set[int] = set()
        for i in sorted(range(count), key=lambda i: -queries[i].priority):
            row, column = int(place[i, 0]), int(place[i, 1])
            if row < 0:
                continue
            if column in taken:
                refusals[i] = "column already serves another query"
                continue
            taken.add(column)
            rows[i], columns[i], refusals[i] = row, column, ""
    return ServedQueries(tuple(queries), rows, columns, tuple(refusals))


def measure_spectra(
    served: ServedQueries, radiance: Radiance, sensor: Sensor, rng: np.random.Generator
) -> xr.Dataset:
    """Spectra of the served queries, with shot and read noise.

    Parameters
    ----------
    served
        From `serve`.
    radiance
        ``radiance(channels, pixels=...)``; see `render.shade`.
    sensor
        From `build_sensor`.
    rng
        Noise.

    Returns
    -------
    Schema ``spectra``, one row a query in the order asked; NaN where refused.
    """
    count, bands = len(served.queries), len(sensor.band_centre_um)
    spectrum = np.full((count, bands), np.nan)
    noise = np.full((count, bands), np.nan)
    on = served.served
    if on.any():
        light = _through_lens(served.rows[on], served.columns[on], radiance, sensor)
        gain = sensor.band_electrons_per_radiance
        electrons = rng.poisson(np.maximum(light, 0) * gain).astype(float)
        read = sensor.design.read_noise_e
        electrons += read * rng.standard_normal(electrons.shape)
        spectrum[on] = electrons / gain
        noise[on] = np.sqrt(np.maximum(electrons, 0) + read**2) / gain
    query_dims = ("query", "wavelength")
    dataset = xr.Dataset(
        {
            "radiance": (query_dims, spectrum, {"units": RADIANCE}),
            "noise": (query_dims, noise, {"units": RADIANCE}),
            "served": (("query",), on.astype(np.int8), {"units": "1"}),
            "track_id": (("query",), np.array([q.track_id for q in served.queries], int), {"units": "1"}),
            "east": (("query",), np.array([q.east_m for q in served.queries], float), {"units": "m"}),
            "north": (("query",), np.array([q.north_m for q in served.queries], float), {"units": "m"}),
        },
        coords={"wavelength": ("wavelength", sensor.band_centre_um, {"units": "um"})},
    )
    return check(dataset, "spectra")


def _through_lens(rows: Array, columns: Array, radiance: Radiance, sensor: Sensor) -> Array:
    """Spectra (query, band) at the mirrors, blurred over 3 × 3 elements by the lens's point spread."""
    mirror = np.array(sensor.mirror_element)
    centre = 2 * np.stack([rows, columns], axis=1) + mirror
    step = np.stack(np.meshgrid([-1, 0, 1], [-1, 0, 1], indexing="ij"), axis=-1).reshape(-1, 2)
    weight = np.exp(-0.5 * (step**2).sum(axis=1) / max(sensor.blur_sigma, 0.05) ** 2)
    last = [sensor.camera.rows - 1, sensor.camera.columns - 1]
    pixels = np.clip(centre[:, None] + step, 0, last)
    light = radiance(sensor.band_weights, pixels=pixels.reshape(-1, 2)).values[..., 0].astype(float)
    return np.einsum("qpb,p->qb", light.reshape(len(rows), len(step), -1), weight / weight.sum())
