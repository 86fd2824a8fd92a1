"""Requirements on the labelled arrays between stages, and their check."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from pydantic import TypeAdapter

from glintrack.core.installation import read_data

RADIANCE = "W m-2 sr-1 um-1"
COUNT = "count"  # of an uncalibrated camera
# tracking channels, as people read them
CHANNEL_WORDS = {"pan": "pan", "dolp": "DoLP", "all": "all elements"}
IRRADIANCE = "W m-2 um-1"
EARTH_RADIUS_M = 6_371_000.0  # mean
MOVING_SPEED_M_S = 1.0  # a vehicle of the truth at least this fast is moving
MIN_SCORED_S = 5.0  # duration from which scores are meaningful: the background is learnt first


@dataclass(frozen=True)
class Variable:
    """Requirements on one array: dims in order, unit, range, and whether NaN marks missing data.

    ``or_units`` is the unit of an uncalibrated camera, if the array may come from one; ``choices`` are the
    allowed texts of an array of text.
    """

    dims: tuple[str, ...]
    units: str
    lowest: float = -np.inf
    highest: float = np.inf
    nan_allowed: bool = False
    or_units: str = ""
    choices: tuple[str, ...] = ()


_TABLES = read_data("schemas.toml")
COORDINATE_UNITS: Mapping[str, str] = _TABLES["coordinates"]
SCHEMAS: Mapping[str, Mapping[str, Variable]]
SCHEMAS = TypeAdapter(dict[str, dict[str, Variable]]).validate_python(_TABLES["schemas"])


def check(dataset: xr.Dataset, schema: str) -> xr.Dataset:
    """Return ``dataset`` if it satisfies the named schema.

    Parameters
    ----------
    dataset
        Arrays that one stage passes to another.
    schema
        Key of `SCHEMAS`.

    Raises
    ------
    ValueError
        If not, with the variable, the requirement and what was found.
    """
    for name, variable in SCHEMAS[schema].items():
        _check_variable(dataset, f"{schema}.{name}", name, variable)
    for name, units in COORDINATE_UNITS.items():
        if name in dataset.coords and dataset.variables[name].dims == (name,):
            units_found = dataset.variables[name].attrs.get("units")
            expected = "element" if schema == "frame" and name in ("x", "y") else units
            if units_found != expected:
                raise ValueError(f"`{schema}.{name}` must have units {expected!r}; got {units_found!r}.")
    return dataset


def _check_variable(dataset: xr.Dataset, label: str, name: str, variable: Variable) -> None:
    if name not in dataset:
        raise ValueError(f"`{label}` must be present; got only {sorted(map(str, dataset.data_vars))}.")
    array = dataset.variables[name]
    if array.dims != variable.dims:
        raise ValueError(f"`{label}` must have dims {variable.dims}; got {array.dims}.")
    if array.attrs.get("units") not in {variable.units, variable.or_units or variable.units}:
        raise ValueError(f"`{label}` must have units {variable.units!r}; got {array.attrs.get('units')!r}.")
    if "stokes" in variable.dims:
        stokes = list(map(str, dataset["stokes"].values)) if "stokes" in dataset.coords else None
        if stokes not in (["I", "Q", "U"], ["I", "Q", "U", "V"]):
            raise ValueError(f"`{label}` must have a stokes coordinate I Q U [V]; got {stokes}.")
        if array.attrs.get("stokes_frame") not in ("detector", "meridian", "incidence"):
            raise ValueError(
                f"`{label}` must name its stokes_frame (detector, meridian or incidence); "
                f"got {array.attrs.get('stokes_frame')!r}."
            )
    if array.size == 0:
        return
    values = array.values
    if variable.choices:
        if wrong := set(values.tolist()) - set(variable.choices):
            raise ValueError(
                f"`{label}` must be one of {', '.join(variable.choices)}; got {min(map(str, wrong))}."
            )
        return
    # two passes over the largest arrays: the extremes show what is not finite
    lowest, highest = (np.fmin, np.fmax) if variable.nan_allowed else (np.minimum, np.maximum)
    low, high = float(lowest.reduce(values, axis=None)), float(highest.reduce(values, axis=None))
    if variable.nan_allowed and np.isnan(low) and np.isnan(high):
        return
    if not (np.isfinite(low) and np.isfinite(high)):
        bad = np.isinf(values) if variable.nan_allowed else ~np.isfinite(values)
        raise ValueError(f"`{label}` must be finite; got {int(bad.sum())} that are not.")
    if low < variable.lowest or high > variable.highest:
        raise ValueError(
            f"`{label}` must lie within {variable.lowest:g} to {variable.highest:g}; got {low:g} to {high:g}."
        )
