"""NetCDF-4 in and out: datasets and whole results."""

from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.io.atomic import write_bytes
from glintrack.io.untrusted import check_netcdf


def write_dataset(path: Path, dataset: xr.Dataset) -> None:
    """A dataset as NetCDF-4, compressed, whole or not at all."""
    encoding = {str(name): {"zlib": True} for name in dataset.data_vars}
    # made in memory: HDF5 crashes where it cannot write, on a full disk
    write_bytes(path, bytes(dataset.to_netcdf(engine="h5netcdf", encoding=encoding)))


def read_dataset(path: Path, name: str) -> xr.Dataset:
    """A NetCDF file in memory; ``name`` says what the file is in the error.

    Raises
    ------
    ValueError
        If the file cannot be read, or holds an infinite number; NaN may stand for none.
    """
    check_netcdf(path, name)
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            dataset = file.load()
    except Exception as error:  # whatever strange attributes make the decoders say
        raise ValueError(f"`{name}` must be a readable NetCDF-4 file, got {path}: {error}") from error
    for variable, values in dataset.variables.items():
        if values.dtype.kind in "fc" and np.isinf(values.values).any():
            raise ValueError(
                f"`{name}` must hold finite numbers, got an infinite one in `{variable}` of {path}"
            )
    return dataset


def write_tree(path: Path, tree: xr.DataTree) -> None:
    """The whole result as NetCDF-4 with one group a node."""
    write_bytes(path, bytes(tree.to_netcdf(engine="h5netcdf")))
