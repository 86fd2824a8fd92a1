"""Read and write NetCDF-4: datasets and whole results."""

from pathlib import Path

import numpy as np
import xarray as xr

from glintrack.io.atomic import write_bytes
from glintrack.io.untrusted import check_netcdf


def write_dataset(path: Path, dataset: xr.Dataset) -> None:
    """Write a dataset as compressed NetCDF-4."""
    encoding = {str(name): {"zlib": True} for name in dataset.data_vars}
    # in memory first: HDF5 crashes on a full disk
    write_bytes(path, bytes(dataset.to_netcdf(engine="h5netcdf", encoding=encoding)))


def read_dataset(path: Path, name: str) -> xr.Dataset:
    """Read a NetCDF file into memory; error messages call it ``name``.

    Raises
    ------
    ValueError
        If the file cannot be read, or holds an infinite number (NaN is allowed).
    """
    check_netcdf(path, name)
    try:
        with xr.open_dataset(path, engine="h5netcdf") as file:
            dataset = file.load()
    except Exception as error:  # whatever attributes make the decoders raise
        raise ValueError(f"`{name}` must be a readable NetCDF-4 file; got {path}: {error}.") from error
    for variable, values in dataset.variables.items():
        if values.dtype.kind in "fc" and np.isinf(values.values).any():
            raise ValueError(f"`{name}` must hold finite numbers; got infinity in `{variable}` of {path}.")
    return dataset


def write_tree(path: Path, tree: xr.DataTree) -> None:
    """Write a whole result as NetCDF-4 with one group for each node."""
    write_bytes(path, bytes(tree.to_netcdf(engine="h5netcdf")))
