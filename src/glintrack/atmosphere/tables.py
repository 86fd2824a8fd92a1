"""Tables of an atmosphere: shipped, cached, or solved in a separate process."""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.atmosphere.design import AtmosphereDesign
from glintrack.atmosphere.sun import sun_direction
from glintrack.core.installation import data_file
from glintrack.core.progress import step
from glintrack.core.schema import RADIANCE, check
from glintrack.io.atomic import write_bytes
from glintrack.io.cache import cache_folder, content_stem, find, store


def solve_tables(
    design: AtmosphereDesign,
    progress: Callable[[float], None] | None = None,
    *,
    cache: Path | None = None,
    threads: int | None = None,
) -> xr.Dataset:
    """Sun, sky, path and transmittance of a design (schema ``atmosphere``).

    Tables of the package or the cache are read; others are solved in a separate process and cached.

    Parameters
    ----------
    progress
        Called with the finished fraction while solving.
    cache
        Folder of solved tables; `io.cache.cache_folder` by default.
    threads
        Threads of the solver; all cores by default.

    Returns
    -------
    The factors `sky_spectrum` × `sky_map` and `path_spectrum` × `path_gas` × `path_map`, their products
    `sky_radiance` and `path_radiance` (float32), irradiances, transmittance and spherical albedo. Largest
    truncation errors of the factors are among the attributes.
    """
    sun_direction(design)  # refuse a sun that is too low before anything is solved
    tables = read_shipped(design)
    if tables is None:
        folder = cache_folder("atmosphere") if cache is None else cache
        stem = content_stem(design.content_key())
        path = find(stem, ".nc", folder)
        with tempfile.TemporaryDirectory(prefix="glintrack-") as scratch:
            if path is None:
                solving = step("solving the sky") if progress is None else nullcontext(progress)
                with solving as report:
                    path = solve_in_worker(design, Path(scratch), report, threads)
                store(stem, ".nc", folder, path.read_bytes())
            tables = xr.load_dataset(path, engine="h5netcdf")
    return check(with_radiances(tables), "atmosphere")


def is_solved(design: AtmosphereDesign) -> bool:
    """Return True if `solve_tables` reads the tables of a design from the package or the user's cache."""
    stem, folder = content_stem(design.content_key()), cache_folder("atmosphere")
    return _shipped(design).is_file() or any(folder.glob(f"{stem}-*.nc"))


def solve_in_worker(
    design: AtmosphereDesign,
    scratch: Path,
    progress: Callable[[float], None] | None = None,
    threads: int | None = None,
) -> Path:
    """Solve a design in a separate process and return the file it wrote."""
    request, answer = scratch / "design.json", scratch / "tables.nc"
    request.write_text(design.model_dump_json(), encoding="utf-8")
    command = [sys.executable, "-m", "glintrack.atmosphere.assemble", str(request), str(answer)]
    command.append(str(threads or os.cpu_count() or 1))
    # OpenBLAS reads this when numpy loads: more threads double the solver's time
    env = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}
    with (scratch / "errors.txt").open("w+", encoding="utf-8") as errors:
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=errors, text=True, env=env) as process:
            for line in process.stdout or ():
                if progress is not None:
                    progress(float(line))
        if process.returncode:
            errors.seek(0)
            raise RuntimeError(f"solving the atmosphere failed: {errors.read().strip()[-2000:]}")
    return answer


def with_radiances(tables: xr.Dataset) -> xr.Dataset:
    """Add the products of the factors, `sky_radiance` and `path_radiance`."""
    products, attrs = {}, {"units": RADIANCE, "stokes_frame": "meridian"}
    for name in ("sky", "path"):
        spectrum, maps = (tables[f"{name}_{part}"].astype(np.float32) for part in ("spectrum", "map"))
        product = np.einsum("kw,k...->w...", spectrum.values, maps.values)
        if name == "path":
            gas = tables["path_gas"].transpose("wavelength", "altitude").values.astype(np.float32)
            product *= gas[:, :, None, None, None]
        products[f"{name}_radiance"] = (("wavelength", *maps.dims[1:]), product, attrs)
    return tables.assign(products)


def read_shipped(design: AtmosphereDesign) -> xr.Dataset | None:
    """Read the package's tables of this design; None if there are none."""
    path = _shipped(design)
    return xr.load_dataset(path, engine="h5netcdf") if path.is_file() else None


def _shipped(design: AtmosphereDesign) -> Path:
    return data_file("atmosphere", f"tables_{design.content_key()}.nc")


def write_tables(tables: xr.Dataset, path: Path) -> None:
    """Write tables as compressed NetCDF-4; maps in single precision."""
    packed = {"zlib": True, "complevel": 6, "shuffle": True}
    encoding = {name: dict(packed) for name, variable in tables.data_vars.items() if variable.ndim > 1}
    write_bytes(path, bytes(tables.to_netcdf(engine="h5netcdf", encoding=encoding)))
