"""Solved tables of the atmosphere, shipped or in the cache."""

from importlib.resources import as_file, files
from pathlib import Path

import xarray as xr

from glintrack.atmosphere.design import AtmosphereDesign
from glintrack.io import cache
from glintrack.io.atomic import write_bytes


def cache_folder() -> Path:
    """Where solved atmospheres are kept, see `cache.cache_folder`."""
    return cache.cache_folder("atmosphere")


def read_shipped(design: AtmosphereDesign) -> xr.Dataset | None:
    """Tables that come with the package for this very design, if there are any."""
    resource = files("glintrack") / "data" / "atmosphere" / f"tables_{design.content_key()}.nc"
    if not resource.is_file():
        return None
    with as_file(resource) as path:
        return xr.load_dataset(path, engine="h5netcdf")


def read_cached(design: AtmosphereDesign, folder: Path) -> xr.Dataset | None:
    """Tables of this design from the cache; a file that does not match its own checksum is removed."""
    path = cache.find(cache.content_stem(design.content_key()), ".nc", folder)
    return None if path is None else xr.load_dataset(path, engine="h5netcdf")


def store(design: AtmosphereDesign, solved: Path, folder: Path) -> Path | None:
    """Move a solved file into the cache in one step, under a name that holds its checksum."""
    return cache.keep(cache.content_stem(design.content_key()), ".nc", folder, solved.read_bytes())


def write_tables(tables: xr.Dataset, path: Path) -> None:
    """Write tables as compressed NetCDF-4; maps in single precision."""
    packed = {"zlib": True, "complevel": 6, "shuffle": True}
    encoding = {name: dict(packed) for name, variable in tables.data_vars.items() if variable.ndim > 1}
    write_bytes(path, bytes(tables.to_netcdf(engine="h5netcdf", encoding=encoding)))
