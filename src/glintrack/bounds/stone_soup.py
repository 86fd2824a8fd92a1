"""Detections for a Stone Soup tracker (extra ``stonesoup``), drawn by the maps of a detector.

So another tracker can be tried on what this sensor and detector would give it, without flying: truth in,
`(time, detections)` out, as Stone Soup's own detectors yield them. States are ``[east, east speed, north,
north speed]``, as in `track.stone_soup`.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.bounds.maps import probability_at
from glintrack.core.arrays import Array
from glintrack.core.extras import require_extra

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
        Sensor=module("stonesoup.sensor.sensor").Sensor,
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
    draw = _Draw.of(maps)
    paths = list(truths)
    for when in times:
        here = [(path, state) for path in paths for state in path if state.timestamp == when]
        eye = np.asarray(lens_m(when), float)
        yield when, draw.seen(here, eye, rng) | draw.false(eye, when, rng)


def map_sensor(maps: xr.Dataset, rng: np.random.Generator, **mounting: Any) -> Any:
    """A Stone Soup ``Sensor`` that detects as the maps say, for its simulators, platforms and sensor suites.

    Parameters
    ----------
    maps
        As of `drawn_detections`.
    rng
        Of all draws.
    **mounting
        Of Stone Soup's sensors: ``position``, east, north (and up) of the lens [m], or a
        ``movement_controller``.

    Returns
    -------
    Its ``measure(ground_truths, noise)`` gives `TrueDetection` and `Clutter`, the latter at the time of the
    ground truths; ``noise`` False leaves true detections where their vehicles are. Its ``measurement_model``
    is linear, with the covariance at the window's middle; each detection carries its own.

    Raises
    ------
    ValueError
        If Stone Soup is not installed, or the maps lack the standard deviations.
    """
    draw = _Draw.of(maps)

    class MapSensor(draw.theirs.Sensor):
        """Draws detections by maps of P_D and clutter."""

        def measure(self, ground_truths: Iterable[Any], noise: Any = True, **_: Any) -> set[Any]:
            if not isinstance(noise, bool):
                raise ValueError("`noise` must be True or False (the maps have the errors), got an array")
            here = [(truth, truth) for truth in ground_truths]
            if not here:
                return set()
            eye = np.ravel(self.position)[:2].astype(float)
            return draw.seen(here, eye, rng, noise) | draw.false(eye, here[0][1].timestamp, rng)

        @property
        def measurement_model(self) -> Any:
            middle = np.array([float(maps["x"].mean()), float(maps["y"].mean())])
            return draw.model(middle, np.ravel(self.position)[:2].astype(float))

    return MapSensor(**mounting)


@dataclass(frozen=True)
class _Draw:
    """What both draw of the maps; standard deviations away from the camera and across. [m]"""

    theirs: SimpleNamespace
    maps: xr.Dataset
    sigma: Float[Array, "2"]

    @classmethod
    def of(cls, maps: xr.Dataset) -> "_Draw":
        theirs, names = _stone_soup(), ("detection_sigma_away_m", "detection_sigma_right_m")
        missing = [name for name in names if name not in maps.attrs]
        if missing:
            raise ValueError(
                f"`maps` must have the attribute {missing[0]}, got none (too few vehicles were detected: "
                "calibrate with more frames)"
            )
        return cls(theirs, maps, np.array([maps.attrs[name] for name in names], float))

    def model(self, place: Float[Array, "2"], eye: Float[Array, "2"]) -> Any:
        """Linear measurement model of a detection there."""
        return self.theirs.LinearGaussian(4, (0, 2), _covariance(place, eye, self.sigma))

    def seen(
        self, here: list[tuple[Any, Any]], eye: Array, rng: np.random.Generator, noise: bool = True
    ) -> set[Any]:
        """Detections of (path, state)."""
        if not here:
            return set()
        vectors = np.array([np.ravel(state.state_vector)[:4].astype(float) for _, state in here])
        place, velocity = vectors[:, [0, 2]], vectors[:, [1, 3]]
        found = set()
        for k in np.flatnonzero(rng.random(len(here)) < probability_at(self.maps, place, velocity, eye)):
            path, state = here[int(k)]
            measured = place[k]
            if noise:
                measured = rng.multivariate_normal(measured, _covariance(measured, eye, self.sigma))
            found.add(
                self.theirs.TrueDetection(
                    measured[:, None],
                    timestamp=state.timestamp,
                    measurement_model=self.model(measured, eye),
                    groundtruth_path=path,
                )
            )
        return found

    def false(self, eye: Array, when: datetime, rng: np.random.Generator) -> set[Any]:
        """Clutter of one scan."""
        return {
            self.theirs.Clutter(place[:, None], timestamp=when, measurement_model=self.model(place, eye))
            for place in _false_places(self.maps, rng)
        }


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
