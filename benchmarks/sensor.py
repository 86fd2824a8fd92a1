"""Exposing and rectifying a frame of superpixels, beside the plain numpy and scipy way of doing the same.

``python benchmarks/sensor.py [--quick] [--json FILE]``. Alternates ours and the peer in the same run; the
median of the alternations counts. ``ratio`` is the peer's time over ours. The peer blurs with scipy's
Gaussian filter, draws with numpy's generator and demosaicks with slices: no aberrations, no fixed pattern.
False polarization and the error of filled mirrors are measured on the same made-up frame of squares.
"""

import argparse
import json
import resource
import time
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.ndimage import gaussian_filter

from glintrack.camera import Pose, look_at
from glintrack.core.records import ServedQueries, SpectralQuery
from glintrack.core.spectral import wavelength_grid
from glintrack.ortho import orthorectify
from glintrack.sensor import (
    Sensor,
    SensorDesign,
    build_sensor,
    expose,
    fill_dark_mirrors,
    measure_spectra,
)
from glintrack.stokes import dolp, fesenkov

AREA_M = (-330.0, -210.0, 330.0, 210.0)
POSE = look_at(Pose(0.0, -2298.0, 1928.0, kind="reported"), (0.0, 0.0, 0.0))
NOTHING = ServedQueries((), np.zeros(0, int), np.zeros(0, int), ())
CASES = {
    "ideal polarizers": {},
    "grid A, measured inverse": {"polarizer": "grid_a"},
    "ppid": {"demosaic": "ppid"},
    "eari": {"demosaic": "eari"},
    "coma over the field": {"optics": {"coma_corner_rms_nm": 60.0}},
    "scatter": {"optics": {"scatter_fraction": 0.05}},
    "fixed pattern": {"prnu": 0.01, "dsnu_e": 5.0},
    "pan": {"layout": "pan"},
}


def light_for(sensor: Sensor) -> xr.DataArray:
    """A frame of squares, partly polarized, for every channel of the sensor."""
    rng = np.random.default_rng(0)
    shape = (sensor.camera.rows, sensor.camera.columns)
    grey = np.full(shape, 60.0, np.float32)
    for _ in range(400):
        y, x = rng.integers(0, shape[0] - 20), rng.integers(0, shape[1] - 20)
        grey[y : y + rng.integers(3, 20), x : x + rng.integers(3, 20)] = rng.uniform(20, 120)
    vector = np.array([1.0, 0.1, -0.05], np.float32)
    values = grey[:, :, None, None] * vector * np.ones((len(sensor.channels), 1), np.float32)
    return xr.DataArray(values)


def plain(light: np.ndarray, sensor: Sensor, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """The same frame by whole-array steps."""
    design = sensor.design
    blurred = gaussian_filter(light[:, :, 0], (0.71, 0.71, 0), mode="nearest", truncate=3.0)
    weights = sensor.element_gains
    through = np.empty(blurred.shape[:2])
    for i in range(2):
        for j in range(2):
            through[i::2, j::2] = blurred[i::2, j::2] @ weights[i, j]
    electrons = np.minimum(rng.poisson(np.clip(through, 0, 10 * design.full_well_e)), design.full_well_e)
    electrons = electrons + design.read_noise_e * rng.standard_normal(through.shape)
    counts = np.clip(np.round(electrons / design.electrons_per_count), -64, 2**design.bits - 1)
    found = counts * design.electrons_per_count / sensor.electrons_per_radiance
    planes = []
    for row, column in ((0, 1), (1, 0), (1, 1)):
        plane = found[row::2, column::2]
        for axis, place in ((0, row), (1, column)):
            plane = 0.75 * plane + 0.25 * np.roll(plane, 1 if place else -1, axis)
        planes.append(plane)
    return found[::2, ::2], fesenkov(*planes)


def alternating(works: list, repeats: int) -> np.ndarray:
    """Median time of each, run in turns. [s]"""
    times = np.empty((repeats, len(works)))
    for k in range(repeats):
        for which, work in enumerate(works):
            start = time.perf_counter()
            work()
            times[k, which] = time.perf_counter() - start
    return np.median(times, axis=0)


def level(height_m: float = 0.0) -> xr.Dataset:
    """Level ground."""
    edge = np.array([-1000.0, 1000.0])
    return xr.Dataset(
        {"height": (("y", "x"), np.full((2, 2), height_m), {"units": "m"})},
        coords={"y": ("y", -edge, {"units": "m"}), "x": ("x", edge, {"units": "m"})},
    )


def false_polarization() -> list[dict]:
    """RMS DoLP that each demosaicking method sees in unpolarized squares."""
    rows = []
    for layout in ("mirror-0-60-120", "0-45-90-135"):
        for method in ("superpixel", "bilinear", "ppid", "eari"):
            design = SensorDesign(layout=layout, demosaic=method, integration_time_ms=1.0, full_well_e=1e7)
            sensor = build_sensor(design, wavelength_grid(0.4, 1.0))
            light = light_for(sensor)
            light[..., 1:] = 0
            frame = expose(lambda channels, light=light: light, sensor, NOTHING, np.random.default_rng(1))
            value = float(np.sqrt(np.mean(dolp(frame["stokes_radiance"].values) ** 2)))
            rows.append({"name": f"false DoLP, {layout}, {method}", "value": value, "unit": "1"})
    return rows


def filled_mirrors() -> list[dict]:
    """RMS error of pan where 200 mirrors were away, relative to its mean, each way of filling it."""
    grid, rows = wavelength_grid(0.4, 1.0), []
    for way in ("spectrum", "polarizers", "interpolate"):
        sensor = build_sensor(SensorDesign(fill_dark_mirrors=way), grid)
        light = light_for(sensor)
        grey = light.values[:, :, 0]

        def radiance(channels, pixels=None, light=light, grey=grey):
            if pixels is None:
                return light
            at = grey[pixels[:, 0], pixels[:, 1]]
            return xr.DataArray(np.ones((len(pixels), len(channels), 1), np.float32) * at[:, None])

        rng = np.random.default_rng(2)
        columns = np.sort(rng.choice(440, 200, replace=False))
        place = rng.integers(0, 280, 200), columns
        served = ServedQueries(tuple(SpectralQuery(0, 0) for _ in columns), *place, ("",) * 200)
        truth = expose(radiance, sensor, NOTHING, np.random.default_rng(1))["pan"].values
        frame = expose(radiance, sensor, served, np.random.default_rng(1))
        spectra = measure_spectra(served, radiance, sensor, np.random.default_rng(3))
        found = fill_dark_mirrors(frame, served, spectra, sensor)["pan"].values
        error = float(np.sqrt(np.mean((found[place] - truth[place]) ** 2)) / truth.mean())
        rows.append({"name": f"error of filled mirrors, {way}", "value": error, "unit": "1"})
    return rows


def rows_of(quick: bool) -> list[dict]:
    """Every row of the table."""
    repeats, grid = (5 if quick else 15), wavelength_grid(0.4, 1.0)
    rows = []
    for name, keys in CASES.items():
        start = time.perf_counter()
        sensor = build_sensor(SensorDesign(**keys), grid)
        built = time.perf_counter() - start
        light, terrain = light_for(sensor), level()

        def ours(light=light, sensor=sensor):
            return expose(lambda channels: light, sensor, NOTHING, np.random.default_rng(1))

        frame = ours()

        def rectified(frame=frame, sensor=sensor, terrain=terrain):
            return orthorectify(frame, sensor.camera, POSE, terrain, 1.5, AREA_M)

        rectified()
        works = [ours, rectified]
        if name == "ideal polarizers":
            works.append(
                lambda light=light, sensor=sensor: plain(light.values, sensor, np.random.default_rng(1))
            )
        found = alternating(works, repeats)
        rows.append({"name": f"expose, {name}", "value": 1e3 * found[0], "unit": "ms"})
        if len(works) > 2:
            rows[-1] |= {"peer": "numpy and scipy", "ratio": found[2] / found[0]}
            rows.append({"name": "expose and rectify", "value": 1e3 * (found[0] + found[1]), "unit": "ms"})
        rows.append({"name": f"build, {name}", "value": 1e3 * built, "unit": "ms"})
    rows.append(
        {
            "name": "largest memory of the run",
            "value": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
            "unit": "MB",
        }
    )
    rows += false_polarization() + filled_mirrors()
    return [{"peer": "", "ratio": None, **row} for row in rows]


def main() -> None:
    """Print the table; write it too, if asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="fewer repetitions")
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    arguments = parser.parse_args()
    rows = rows_of(arguments.quick)
    for row in rows:
        ratio = f"  {row['peer']} takes {row['ratio']:.1f} times as long" if row["ratio"] else ""
        print(f"{row['name']:<44} {row['value']:>9.4g} {row['unit']}{ratio}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1), encoding="utf-8")


if __name__ == "__main__":
    main()
