"""Check times and frame rates of files: in seconds, with steps between which a vehicle can be followed."""

from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array

MIN_STEP_S, MAX_STEP_S = 1e-3, 10.0  # of recordings of traffic: no rate above 1 kHz, 360 m of a fast vehicle
MIN_RATE_HZ, MAX_RATE_HZ = 1 / MAX_STEP_S, 1 / MIN_STEP_S
_FEWEST = 3  # distinct times that show a step
_UNITS_S = {"s": 1.0, "sec": 1.0, "ms": 1e-3, "msec": 1e-3, "us": 1e-6, "µs": 1e-6, "ns": 1e-9, "min": 60.0}


def check_steps(times_s: ArrayLike, name: str, path: Path | str) -> None:
    """Ask whether times are in seconds, if their median step is no step between images of traffic.

    Parameters
    ----------
    times_s, name, path
        Times in any order [s], their name, and the file.

    Raises
    ------
    ValueError
        If the median step is below `MIN_STEP_S` or above `MAX_STEP_S`.
    """
    times = np.unique(np.asarray(times_s, dtype=float))
    if len(times) < _FEWEST:
        return
    step_s = float(np.median(np.diff(times)))
    if not 0.999 * MIN_STEP_S <= step_s <= MAX_STEP_S:  # times of a clock since 1970 are rounded
        remedy = "divide milliseconds by 1000" if step_s > 1 else "multiply minutes by 60, days by 86400"
        step = f"{step_s:,.0f}" if step_s >= 1000 else f"{step_s:.3g}"
        raise ValueError(
            f"`{name}` must have steps of {MIN_STEP_S:g} to {MAX_STEP_S:g} s; the times are {step} s apart "
            f"in {path}: is `{name}` in seconds? Else {remedy}."
        )


def check_rate(rate_hz: float) -> None:
    """Refuse a frame rate at which no vehicle can be followed.

    Raises
    ------
    ValueError
        If it is below 1 / `MAX_STEP_S` or above 1 / `MIN_STEP_S`.
    """
    if not MIN_RATE_HZ <= rate_hz <= MAX_RATE_HZ:
        raise ValueError(
            f"`rate` must be {MIN_RATE_HZ:g} to {MAX_RATE_HZ:,.0f} Hz; got {rate_hz:g}: is it in frames per "
            "second, and not their interval?"
        )


def times_of(stack: xr.Dataset, path: Path) -> Float[Array, "time"]:
    """Return the coordinate ``time`` of a stack, calendar dates from the first one. [s]

    Raises
    ------
    ValueError
        If its unit is unknown, a time is missing or before the last one, or its steps are not in seconds.
    """
    given = stack["time"]
    times, unit = given.values, str(given.attrs.get("units", "s")).strip()
    if times.dtype.kind in "mM":  # dates, or durations in a unit that xarray knows
        zero = times[0] if times.dtype.kind == "M" else np.timedelta64(0, "s")
        times = (times - zero) / np.timedelta64(1, "s")
    elif unit not in _UNITS_S:
        raise ValueError(f"`time` must be in one of {', '.join(_UNITS_S)}; got {unit!r} in {path}.")
    elif times.dtype.kind not in "iuf":
        raise ValueError(f"`time` must hold numbers of seconds; got {times.dtype} in {path}.")
    else:
        times = times.astype(float) * _UNITS_S[unit]
    if not np.isfinite(times).all():
        raise ValueError(f"`time` must be finite at every frame; got others in {path}.")
    if (np.diff(times) < 0).any():
        raise ValueError(f"`time` must not go backwards; got such times in {path}. Sort the frames by time.")
    check_steps(times, "time", path)
    return times
