"""Read a stack of rectified frames from NetCDF-4 or Zarr: its grid, CRS by CF's grid mapping, and times."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyproj
import pyproj.exceptions
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.io.crs import any_crs
from glintrack.io.read_raster import length_unit_m
from glintrack.io.times import times_of
from glintrack.io.untrusted import MAX_CELLS, check_netcdf

_STEP = 1e-4  # relative tolerance of regular steps
_MAX_FRAMES = 1_000_000


@dataclass(frozen=True)
class Stack:
    """An open stack of frames.

    Parameters
    ----------
    dataset, variable
        Open file, and its variable over time, y, x; y falls.
    crs
        CRS of the grid; None if unknown.
    """

    dataset: xr.Dataset
    variable: str
    crs: str | None

    @property
    def count(self) -> int:
        """Number of frames."""
        return self.dataset.sizes["time"]

    def frame(self, k: int) -> Float[Array, "y x"]:
        """Read one frame."""
        return self.dataset[self.variable].isel(time=k).values.astype(np.float32)

    def times_s(self, path: Path, rate_hz: float | None) -> Float[Array, "time"]:
        """Return the times of the frames, by a rate or by the file's coordinate. [s]"""
        if rate_hz is not None:
            return np.arange(self.count) / rate_hz
        if "time" not in self.dataset.coords:
            raise ValueError(f"`frames` must have a coordinate time, or --rate; got neither in {path}")
        return times_of(self.dataset, path)

    def corner_and_gsd(self, path: Path) -> tuple[float, float, float]:
        """West and north edge and side of a pixel, by the coordinates x and y. [m]

        Raises
        ------
        ValueError
            If there are none, or they are not in metres, not evenly spaced or of pixels that are not square.
        """
        stack = self.dataset
        if not {"x", "y"} <= set(stack.coords):
            raise ValueError(
                f"`frames` must have coordinates x and y in metres; got none in {path}. "
                f"Give --geotransform WEST NORTH GSD."
            )
        for name in ("x", "y"):
            unit = str(stack[name].attrs.get("units", "m"))
            if length_unit_m(unit) != 1:
                raise ValueError(
                    f"`{name}` must be in metres; got {unit!r} in {path}. Project the frames, or give "
                    "--geotransform WEST NORTH GSD."
                )
        x, y = stack["x"].values.astype(float), stack["y"].values.astype(float)
        if len(x) < 2 or len(y) < 2:
            raise ValueError(f"`frames` must have at least 2 × 2 pixels; got {len(y)} × {len(x)} in {path}.")
        gsd = float(x[1] - x[0])
        even = np.allclose(np.diff(x), gsd, rtol=_STEP) and np.allclose(np.diff(y), -gsd, rtol=_STEP)
        if not (gsd > 0 and even):
            raise ValueError(f"`frames` must have x rising and y changing in equal steps; got others: {path}")
        return float(x[0]) - gsd / 2, float(y[0]) + gsd / 2, gsd


def open_stack(path: Path) -> Stack:
    """Open a NetCDF-4 file or Zarr folder of frames.

    Parameters
    ----------
    path
        Its variable ``pan``, or its only one over time, y, x. Scale, offset and fill value are applied. The
        CRS is that of the grid mapping, or the attribute ``crs``.

    Raises
    ------
    ValueError
        If it cannot be read, or holds no such variable, or too much.
    """
    is_zarr = path.suffix.lower() == ".zarr"
    if not is_zarr:
        check_netcdf(path, "frames")
    try:
        stack = (
            xr.open_zarr(path, decode_timedelta=True)
            if is_zarr
            else xr.open_dataset(path, engine="h5netcdf", decode_timedelta=True)
        )
    except Exception as error:  # whatever a damaged file makes the decoders say
        raise ValueError(f"`frames` must be a readable NetCDF-4 or Zarr stack; got {path}.") from error
    names = [str(n) for n, v in stack.data_vars.items() if v.dims[-3:] == ("time", "y", "x")]
    name = "pan" if "pan" in names else names[0] if len(names) == 1 else ""
    if not name:
        raise ValueError(
            f"`frames` must hold one variable over time, y, x, or one called pan; got {names or 'none'} "
            f"in {path}"
        )
    sizes = stack.sizes
    if stack[name].ndim != 3 or sizes["y"] * sizes["x"] > MAX_CELLS or sizes["time"] > _MAX_FRAMES:
        raise ValueError(
            f"`frames` must be over time, y, x with at most {_MAX_FRAMES:,} frames of {MAX_CELLS:,} cells; "
            f"got {dict(stack[name].sizes)} in {path}"
        )
    if "y" in stack.coords and sizes["y"] > 1 and stack["y"].values[1] > stack["y"].values[0]:
        stack = stack.isel(y=slice(None, None, -1))
    return Stack(stack, name, _crs_of(stack, stack[name], path))


def _crs_of(stack: xr.Dataset, frames: xr.DataArray, path: Path) -> str | None:
    """CRS of a variable: of its grid mapping, as text in an attribute, or None."""
    named = str(frames.attrs.get("grid_mapping", frames.encoding.get("grid_mapping", "")))
    mapping = named.split(":")[0].strip() or next((n for n in ("spatial_ref", "crs") if n in stack), "")
    if mapping and mapping not in stack.variables:
        raise ValueError(f"`grid_mapping` must name a variable of the file; got {mapping!r} in {path}.")
    about = dict(stack[mapping].attrs) if mapping else {}
    text = next((about[key] for key in ("crs_wkt", "spatial_ref", "proj4") if key in about), None)
    if text is None and about:
        text = _crs_of_parameters(about, path)
    if text is None:
        text = frames.attrs.get("crs", stack.attrs.get("crs"))
    return None if text is None else any_crs(str(text)).to_wkt()


def _crs_of_parameters(about: Mapping[str, Any], path: Path) -> str:
    """CRS by CF's parameters of a projection, as WKT."""
    try:
        return pyproj.CRS.from_cf(dict(about)).to_wkt()
    except (pyproj.exceptions.CRSError, KeyError, TypeError, ValueError) as error:
        raise ValueError(
            f"`grid_mapping` must be a projection of CF; got {about.get('grid_mapping_name')!r} in {path}. "
            "Write its attribute crs_wkt."
        ) from error
