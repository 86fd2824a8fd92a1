"""Solved tables on disk: addressed by content, verified by checksum, written all at once or not at all."""

import hashlib
import os
import tempfile
from importlib.metadata import version
from importlib.resources import as_file, files
from pathlib import Path

import xarray as xr

from glintrack.atmosphere.design import AtmosphereDesign

_CHECKSUM_DIGITS = 16


def cache_folder() -> Path:
    """Where solved tables are kept: ``$XDG_CACHE_HOME`` or ``~/.cache``, then ``glintrack/atmosphere``."""
    base = os.environ.get("XDG_CACHE_HOME")
    return (Path(base) if base else Path.home() / ".cache") / "glintrack" / "atmosphere"


def read_shipped(design: AtmosphereDesign) -> xr.Dataset | None:
    """Tables that come with the package for this very design, if there are any."""
    resource = files("glintrack") / "data" / "atmosphere" / f"tables_{design.content_key()}.nc"
    if not resource.is_file():
        return None
    with as_file(resource) as path:
        return xr.load_dataset(path, engine="h5netcdf")


def read_cached(design: AtmosphereDesign, folder: Path) -> xr.Dataset | None:
    """Tables of this design from the cache; a file that does not match its own checksum is removed."""
    for path in sorted(folder.glob(f"{_stem(design)}-*.nc")):
        if path.stem.rsplit("-", 1)[1] == _checksum(path):
            return xr.load_dataset(path, engine="h5netcdf")
        path.unlink(missing_ok=True)
    return None


def store(design: AtmosphereDesign, solved: Path, folder: Path) -> Path:
    """Move a solved file into the cache in one step, under a name that holds its checksum."""
    folder.mkdir(parents=True, exist_ok=True)
    target = folder / f"{_stem(design)}-{_checksum(solved)}.nc"
    handle, staged = tempfile.mkstemp(dir=folder, suffix=".part")
    try:
        with os.fdopen(handle, "wb") as file:
            file.write(solved.read_bytes())
        os.replace(staged, target)
    except BaseException:
        Path(staged).unlink(missing_ok=True)
        raise
    return target


def write_tables(tables: xr.Dataset, path: Path) -> None:
    """Write tables as compressed NetCDF-4; maps in single precision."""
    packed = {"zlib": True, "complevel": 6, "shuffle": True}
    encoding = {name: dict(packed) for name, variable in tables.data_vars.items() if variable.ndim > 1}
    tables.to_netcdf(path, engine="h5netcdf", encoding=encoding)


def _stem(design: AtmosphereDesign) -> str:
    """Content of the design, format of the tables and version of the program in one name."""
    content = f"{design.content_key()} glintrack {version('glintrack')}"
    return hashlib.sha256(content.encode()).hexdigest()[:32]


def _checksum(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()[:_CHECKSUM_DIGITS]
