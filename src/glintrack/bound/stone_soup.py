"""Detections for a Stone Soup tracker (extra ``stonesoup``), drawn by the maps of a detector.

So another tracker can be tried on what this sensor and detector would give it, without flying: truth in,
`(time, detections)` out, as Stone Soup's own detectors yield them. States are ``[east, east speed, north,
north speed]``, as in `track.stone_soup`.
"""

from collections.abc import Callable, Iterable, Iterator
from datetime import datetime
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.bound.maps import probability_at
from glintrack.extras import require_extra

_M2_PER_KM2 = 1e6


def _stone_soup() -> SimpleNamespace:
    """What is needed of Stone Soup.

    Raises
    ------
    ValueError
        If it is not installed.
    """
    module = partial(require_extra, extra="stonesoup", purpose="draw detections for Stone Soup")
    return SimpleNamespace(
        TrueDetection=module("stonesoup.types.detection").TrueDetection,
        Clutter=module("stonesoup.types.detection").Clutter,
        LinearGaussian=module("stonesoup.models.measurement.linear").LinearGaussian,
    )


def drawn_detections(
    maps: xr.Dataset,
    truths: Iterable[Any],
    times: Iterable[datetime],
    lens_m: Callable[[datetime], Float[Array, "2"]],
    rng: np.random.Generator,
) -> Iterator[tuple[datetime, set[Any]]]:
    """What the detector of the maps would report of ground truths, scan by scan.

    Parameters
    ----------
    maps
        Of `calibrate`, with the standard deviations of detections.
    truths
        Stone Soup's ground truth paths; one takes part in a scan if it has a state at that very time.
    times
        Of the scans.
    lens_m
        East and north of the camera at a time. [m]
    rng
        Of all draws.

    Yields
    ------
    Time, and `TrueDetection` with its path, or `Clutter`, each with the linear measurement model of its
    covariance.

    Raises
    ------
    ValueError
        If Stone Soup is not installed, or the maps lack the standard deviations.
    """
    theirs = _stone_soup()
    missing = [n for n in ("detection_sigma_away_m", "detection_sigma_right_m") if n not in maps.attrs]
    if missing:
        raise ValueError(
            f"`maps` must have the attribute {missing[0]}, got none (too few vehicles were detected: "
            "calibrate with more frames)"
        )
    sigma = np.array([maps.attrs["detection_sigma_away_m"], maps.attrs["detection_sigma_right_m"]], float)
    paths = list(truths)
    for when in times:
        eye = np.asarray(lens_m(when), float)

        def detection(place: Array, kind: Any, when=when, eye=eye, **more: Any) -> Any:
            model = theirs.LinearGaussian(4, (0, 2), _covariance(place, eye, sigma))
            return kind(place[:, None], timestamp=when, measurement_model=model, **more)

        here = [(path, state) for path in paths for state in path if state.timestamp == when]
        found = set()
        if here:
            vectors = np.array([np.ravel(state.state_vector)[:4].astype(float) for _, state in here])
            place, velocity = vectors[:, [0, 2]], vectors[:, [1, 3]]
            seen = rng.random(len(here)) < probability_at(maps, place, velocity, eye)
            for k in np.flatnonzero(seen).tolist():
                spread = _covariance(place[k], eye, sigma)
                measured = rng.multivariate_normal(place[k], spread)
                found.add(detection(measured, theirs.TrueDetection, groundtruth_path=here[k][0]))
        found |= {detection(place, theirs.Clutter) for place in _false_places(maps, rng)}
        yield when, found


def _covariance(place: Float[Array, "2"], eye: Float[Array, "2"], sigma: Float[Array, "2"]) -> Array:
    """Covariance of east and north from the standard deviations away from the camera and across. [m²]"""
    away = place - eye
    length = float(np.hypot(*away))
    east, north = (0.0, 1.0) if length < 1e-6 else (away / length).tolist()
    axes = np.array([[east, north], [north, -east]])
    return axes.T @ np.diag(sigma**2) @ axes


def _false_places(maps: xr.Dataset, rng: np.random.Generator) -> Float[Array, "false 2"]:
    """False detections of one scan: a Poisson number in each cell, evenly over it. [m]"""
    x, y = (np.asarray(maps[name].attrs["edges"], float) for name in ("x", "y"))
    cell_km2 = (x[1] - x[0]) * (y[0] - y[1]) / _M2_PER_KM2
    counts = rng.poisson(maps["clutter"].values * cell_km2)
    row, column = (np.repeat(axis.ravel(), counts.ravel()) for axis in np.indices(counts.shape))
    within = rng.random((len(row), 2))
    return np.stack([x[column] + within[:, 0] * (x[1] - x[0]), y[row] - within[:, 1] * (y[0] - y[1])], axis=1)
