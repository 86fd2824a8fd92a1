"""Tables of an atmosphere: shipped, cached, or solved now."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.atmosphere.cache import cache_folder, read_cached, read_shipped, store
from glintrack.atmosphere.design import AtmosphereDesign
from glintrack.atmosphere.sun import sun_direction
from glintrack.core.schema import RADIANCE, check


def solve_tables(
    design: AtmosphereDesign,
    progress: Callable[[float], None] | None = None,
    *,
    cache: Path | None = None,
    threads: int | None = None,
) -> xr.Dataset:
    """Sun, sky, path and transmittance of a design (schema ``atmosphere``).

    Tables that come with the package or lie in the cache are read; others are solved in a process of their
    own and put into the cache.

    Parameters
    ----------
    design
        The atmosphere.
    progress
        Called with the finished fraction while solving.
    cache
        Folder of solved tables; `cache.cache_folder` by default.
    threads
        Of the solver; all cores by default.

    Returns
    -------
    The factors `sky_spectrum` × `sky_map` and `path_spectrum` × `path_gas` × `path_map`, their products
    `sky_radiance` and `path_radiance` (float32), irradiances, transmittance and spherical albedo. Largest
    truncation errors of the factors are among the attributes.
    """
    sun_direction(design)  # a sun too low is the user's error, told before anything is solved
    shipped = read_shipped(design)
    if shipped is not None:
        return check(with_radiances(shipped), "atmosphere")
    folder = cache_folder() if cache is None else cache
    tables = read_cached(design, folder)
    if tables is None:
        with tempfile.TemporaryDirectory(prefix="glintrack-") as scratch:
            solved = solve_in_worker(design, Path(scratch), progress, threads)
            store(design, solved, folder)
            tables = xr.load_dataset(solved, engine="h5netcdf")
    return check(with_radiances(tables), "atmosphere")


def solve_in_worker(
    design: AtmosphereDesign,
    scratch: Path,
    progress: Callable[[float], None] | None = None,
    threads: int | None = None,
) -> Path:
    """Solve a design in a process of its own and return the file it wrote."""
    request, answer = scratch / "design.json", scratch / "tables.nc"
    request.write_text(design.model_dump_json(), encoding="utf-8")
    command = [sys.executable, "-m", "glintrack.atmosphere.worker", str(request), str(answer)]
    command.append(str(threads or os.cpu_count() or 1))
    # OpenBLAS reads this when numpy loads: more threads double the solver's time
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with (scratch / "errors.txt").open("w+", encoding="utf-8") as errors:
        with subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=errors, text=True, env=environment
        ) as process:
            for line in process.stdout or ():
                if progress is not None:
                    progress(float(line))
        if process.returncode:
            errors.seek(0)
            raise RuntimeError(f"solving the atmosphere failed: {errors.read().strip()[-2000:]}")
    return answer


def with_radiances(tables: xr.Dataset) -> xr.Dataset:
    """The same tables with the factors multiplied out: `sky_radiance` and `path_radiance`."""
    products = {}
    for name in ("sky", "path"):
        spectrum, maps = tables[f"{name}_spectrum"], tables[f"{name}_map"]
        product = np.einsum(
            "kw,k...->w...", spectrum.values.astype(np.float32), maps.values.astype(np.float32)
        )
        if name == "path":
            left = tables["path_gas"].transpose("wavelength", "altitude").values.astype(np.float32)
            product *= left[:, :, None, None, None]
        products[f"{name}_radiance"] = (
            ("wavelength", *maps.dims[1:]),
            product,
            {"units": RADIANCE, "stokes_frame": "meridian"},
        )
    return tables.assign(products)
