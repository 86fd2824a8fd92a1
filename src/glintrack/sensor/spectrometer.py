"""The multi-object spectrometer: assignment of queries to micromirrors, and the spectra of served queries.

One pixel per column: a mirror's spectrum is spread along its column of the spectrometer's array, where it
would overlap with a second one. Queries are served while a frame is exposed, and a mirror that serves is dark
in pan. Alternatively the tracker queries detections of a frame, and mirrors switch for a second exposure of
the same scene (`track.query_detections`). Where the mirrors are etalons, the pixel below each measures its
own spectrum by a sweep of the gap, and columns do not matter.
"""

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.camera import Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Radiance, ServedQueries, SpectralQuery
from glintrack.core.schema import RADIANCE, check
from glintrack.devices import etalon
from glintrack.sensor.exposure import MAX_MEAN_E
from glintrack.sensor.sensor import Sensor

SPREAD_ELEMENTS = 2  # of the point spread to either side that contribute to a spectrum


def serve(queries: tuple[SpectralQuery, ...], sensor: Sensor, reported_pose: Pose) -> ServedQueries:
    """Assign ground points to micromirrors by the *reported* pose, highest priority first.

    Parameters
    ----------
    queries
        The tracker's queries for this frame.
    sensor, reported_pose
        The sensor, and the navigator's pose.

    Returns
    -------
    The mirror of each query, or the reason of its refusal.
    """
    count = len(queries)
    rows, columns = np.full(count, -1), np.full(count, -1)
    if not sensor.design.has_mirror:
        return ServedQueries(tuple(queries), rows, columns, ("the superpixel has no mirror",) * count)
    refusals = ["outside the frame"] * count
    if count:
        place = sensor.superpixel_of(np.array([q.position for q in queries]), reported_pose)
        taken: set[int] = set()
        for i in sorted(range(count), key=lambda i: -queries[i].priority):
            row, column = int(place[i, 0]), int(place[i, 1])
            if row < 0:
                continue
            if column in taken and sensor.sweep_electrons is None:
                refusals[i] = "column already serves another query"
                continue
            taken.add(column)
            rows[i], columns[i], refusals[i] = row, column, ""
    return ServedQueries(tuple(queries), rows, columns, tuple(refusals))


def measure_spectra(
    served: ServedQueries, radiance: Radiance, sensor: Sensor, rng: np.random.Generator
) -> xr.Dataset:
    """Spectra of the served queries, with the noise of light, dark current and readout; bands never saturate.

    Parameters
    ----------
    served
        From `serve`.
    radiance
        ``radiance(channels, pixels=...)``; see `render.shade`.
    rng
        Noise.

    Returns
    -------
    Schema ``spectra``, one row a query in the same order; NaN where refused.
    """
    count, bands = len(served.queries), len(sensor.band_centre_um)
    spectrum = np.full((count, bands), np.nan)
    noise = np.full((count, bands), np.nan)
    on, sweep, read_e = served.is_served, sensor.sweep_electrons, sensor.design.read_noise_e
    if on.any():
        light = _through_lens(served.rows[on], served.columns[on], radiance, sensor)
        gain = sensor.band_electrons_per_radiance
        expected_e = light * gain if sweep is None else light @ sweep.T
        dark_e = 1e-3 * sensor.design.dark_current_e_per_s * sensor.design.spectrometer_integration_time_ms
        collected_e = rng.poisson(np.clip(expected_e + dark_e, 0, MAX_MEAN_E))
        electrons = collected_e - dark_e + read_e * rng.standard_normal(expected_e.shape)
        if sweep is None:
            spectrum[on] = electrons / gain
            noise[on] = np.sqrt(np.maximum(electrons, 0) + dark_e + read_e**2) / gain
        else:  # inverted with smoothing
            sigma = np.sqrt(np.maximum(electrons, 1) + dark_e + read_e**2)
            found = etalon.reconstruct(electrons, sweep, sensor.band_centre_um, sigma)
            spectrum[on], noise[on] = found["radiance"].values, found["radiance_sigma"].values
    queries, query_dims = served.queries, ("query", "wavelength")
    dataset = xr.Dataset(
        {
            "radiance": (query_dims, spectrum, {"units": RADIANCE}),
            "noise": (query_dims, noise, {"units": RADIANCE}),
            "served": ("query", on, {"units": "1"}),
            "track_id": ("query", np.array([q.track_id for q in queries], int), {"units": "1"}),
            "east_m": ("query", np.array([q.east_m for q in queries], float), {"units": "m"}),
            "north_m": ("query", np.array([q.north_m for q in queries], float), {"units": "m"}),
        },
        coords={"wavelength": ("wavelength", sensor.band_centre_um, {"units": "um"})},
    )
    return check(dataset, "spectra")


def fill_dark_mirrors(
    frame: xr.Dataset, served: ServedQueries, spectra: xr.Dataset, sensor: Sensor
) -> xr.Dataset:
    """Fill pan at mirrors that fed the spectrometer with an estimate by the design's method.

    Parameters
    ----------
    frame
        From `expose`.
    served, spectra
        Of the same frame, from `serve` and `measure_spectra`.
    sensor
        Its design names the method: ``"spectrum"`` integrates the mirror's spectrum over the pan band;
        ``"interpolate"`` is the mean of the neighbouring mirrors; ``"polarizers"`` is S0 of the same
        superpixel; ``"none"`` returns the frame unchanged.
    """
    way, on = sensor.design.fill_dark_mirrors, served.is_served
    if way == "none" or not on.any():
        return frame
    pan = frame["pan"].values.copy()
    rows, columns = served.rows[on], served.columns[on]
    if way == "spectrum":
        weights, centres = sensor.pan_weights[0], sensor.band_centre_um
        at_grid = [np.interp(sensor.wavelength_um, centres, one) for one in spectra["radiance"].values[on]]
        pan[rows, columns] = np.array(at_grid) @ (weights / weights.sum())
    elif way == "polarizers":
        pan[rows, columns] = frame["stokes_radiance"].values[rows, columns, 0]
    else:
        edged = np.pad(frame["pan"].values, 1, constant_values=np.nan)
        around = np.stack(
            [edged[rows + 1 + i, columns + 1 + j] for i, j in ((0, 1), (1, 0), (0, -1), (-1, 0))]
        )
        known = np.isfinite(around)
        total = np.where(known, around, 0).sum(axis=0)
        pan[rows, columns] = np.where(known.any(axis=0), total / np.maximum(known.sum(axis=0), 1), np.nan)
    return frame.assign(pan=frame["pan"].copy(data=pan.astype(np.float32)))


def _through_lens(rows: Array, columns: Array, radiance: Radiance, sensor: Sensor) -> Array:
    """Spectra (query, band) at the mirrors, through the middle of the lens's point spread."""
    kernel = sensor.kernels[0]
    middle = kernel.strength.shape[0] // 2
    full = kernel.at(middle, middle)
    half = min(kernel.half_width, SPREAD_ELEMENTS)
    inner = slice(kernel.half_width - half, kernel.half_width + half + 1)
    weight = full[inner, inner][::-1, ::-1].ravel()  # reversed: light from an element to the mirror
    side = sensor.side
    centre = side * np.stack([rows, columns], axis=1) + np.array(sensor.mirror_element)
    offset = np.arange(-half, half + 1)
    step = np.stack(np.meshgrid(offset, offset, indexing="ij"), axis=-1).reshape(-1, 2)
    last = [sensor.camera.rows - 1, sensor.camera.columns - 1]
    pixels = np.clip(centre[:, None] + step, 0, last)
    light = radiance(sensor.band_weights, pixels=pixels.reshape(-1, 2)).values[..., 0].astype(float)
    return np.einsum("qpb,p->qb", light.reshape(len(rows), len(step), -1), weight / weight.sum())


def noiseless_spectra(
    served: ServedQueries, radiance: Radiance, sensor: Sensor
) -> Float[Array, "query wavelength"]:
    """Spectra of the light at the serving mirrors' own rays; NaN where refused. [W m⁻² sr⁻¹ µm⁻¹]"""
    out = np.full((len(served.queries), len(sensor.band_centre_um)), np.nan)
    on = served.is_served
    if on.any():
        mirrors = (
            sensor.side * np.stack([served.rows[on], served.columns[on]], axis=1) + sensor.mirror_element
        )
        out[on] = radiance(sensor.band_weights, pixels=mirrors).values[..., 0]
    return out
