"""To and from Stone Soup (extra ``stonesoup``): its detections into our tracker, its tracks into our scores.

Stone Soup's state is ``[east, east speed, north, north speed]`` here, its times are datetimes after an epoch.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import xarray as xr

from glintrack import track
from glintrack.core import schema
from glintrack.core.arrays import Array
from glintrack.core.installation import require_extra
from glintrack.io.atomic import content_hash

_ORDER = [0, 2, 1, 3]  # of our state in theirs, and theirs in ours


def _stone_soup() -> SimpleNamespace:
    """What is needed of Stone Soup.

    Raises
    ------
    ValueError
        If it is not installed.
    """
    module = partial(require_extra, extra="stonesoup", purpose="pass detections and tracks to Stone Soup")
    return SimpleNamespace(
        Detection=module("stonesoup.types.detection").Detection,
        GaussianState=module("stonesoup.types.state").GaussianState,
        LinearGaussian=module("stonesoup.models.measurement.linear").LinearGaussian,
        Track=module("stonesoup.types.track").Track,
    )


def to_detections(found: track.Detections, time_s: float, epoch: datetime) -> list[Any]:
    """Stone Soup detections, each with a linear measurement model of its own covariance.

    Parameters
    ----------
    found
        Of one frame, as `track.detections` gives them.
    time_s, epoch
        Time after the epoch. [s]

    Returns
    -------
    In the same order, with ``extent_m`` and ``contrast`` in ``metadata``; ``set(…)`` is what Stone Soup's
    trackers take.
    """
    theirs, when = _stone_soup(), epoch + timedelta(seconds=float(time_s))
    return [
        theirs.Detection(
            found.position[k][:, None],
            timestamp=when,
            measurement_model=theirs.LinearGaussian(4, (0, 2), found.covariance[k]),
            metadata={"extent_m": float(found.extent[k]), "contrast": float(found.contrast[k])},
        )
        for k in range(len(found))
    ]


def from_detections(detections: Iterable[Any], sigma_m: float | None = None) -> track.Detections:
    """Our detections from Stone Soup's; their order does not matter.

    Parameters
    ----------
    detections
        East and north each [m]. A measurement model must be linear and give the covariance.
    sigma_m
        Standard deviation of a detection without a measurement model. [m]

    Raises
    ------
    ValueError
        If one is not a position, or has a model that is not linear, or none while ``sigma_m`` is not given.
    """
    found = sorted(detections, key=lambda d: tuple(np.ravel(d.state_vector).astype(float)))
    n = len(found)
    position, covariance = np.empty((n, 2)), np.empty((n, 2, 2))
    for k, detection in enumerate(found):
        vector = np.ravel(detection.state_vector).astype(float)
        if vector.shape != (2,):
            raise ValueError(f"`detections` must hold east and north, got {len(vector)} numbers")
        position[k] = vector
        covariance[k] = _covariance_of(detection, sigma_m)
    meta = [detection.metadata or {} for detection in found]
    extent = np.array([m.get("extent_m", 4.0) for m in meta], float)
    return track.Detections(
        position, covariance, extent, np.array([m.get("contrast", 1.0) for m in meta], float)
    )


def _covariance_of(detection: Any, sigma_m: float | None) -> Array:
    model = detection.measurement_model
    if model is None:
        if sigma_m is None:
            raise ValueError("`sigma_m` must be given for detections without a measurement model, got none")
        return sigma_m**2 * np.eye(2)
    if not hasattr(model, "matrix"):
        raise ValueError(
            f"`detections` must have a linear measurement model, got {type(model).__name__} "
            "(convert them to east and north first)"
        )
    return np.asarray(model.covar(), float)


def from_tracks(
    tracks: Iterable[Any],
    time_s: float,
    epoch: datetime,
    position: tuple[int, int] = (0, 2),
    velocity: tuple[int, int] = (1, 3),
) -> xr.Dataset:
    """Stone Soup tracks at one time, as a Dataset of the schema ``tracks``, which `metrics` scores.

    Parameters
    ----------
    tracks
        With Gaussian states.
    time_s, epoch
        Time after the epoch; a track whose last state is older coasts. [s]
    position, velocity
        Indices of east and north in their state. [m, m s⁻¹]
    """
    tracks = sorted(tracks, key=lambda one: one.id)
    when = epoch + timedelta(seconds=float(time_s))
    size = max(*position, *velocity) + 1
    mean, covariance = np.zeros((len(tracks), size)), np.zeros((len(tracks), size, size))
    for k, one in enumerate(tracks):
        mean[k] = np.ravel(one.state_vector)[:size].astype(float)
        covariance[k] = np.asarray(one.covar, float)[:size, :size]
    measured = [one.timestamp == when and hasattr(one.states[-1], "hypothesis") for one in tracks]
    e, n = position
    columns = {
        "east": (mean[:, e], "m"),
        "north": (mean[:, n], "m"),
        "east_speed": (mean[:, velocity[0]], "m s-1"),
        "north_speed": (mean[:, velocity[1]], "m s-1"),
        "east_var": (covariance[:, e, e], "m2"),
        "north_var": (covariance[:, n, n], "m2"),
        "east_north_cov": (covariance[:, e, n], "m2"),
        "coasted": (1.0 - np.array(measured, float), "1"),
    }
    dataset = xr.Dataset(
        {name: ("track", values, {"units": units}) for name, (values, units) in columns.items()},
        coords={"track": np.array([_number(one.id) for one in tracks], np.int64)},
        attrs={"time_s": float(time_s)},
    )
    return schema.check(dataset, "tracks")


def _number(name: str) -> int:
    """Id of a track as a number, the same for the same name; two of a million collide once in 10⁵ runs."""
    return int(content_hash(str(name), 14), 16)


@dataclass(frozen=True)
class Settings:
    """How `run_tracker` runs our tracker on Stone Soup's detections.

    Parameters
    ----------
    grid
        Area in which targets live.
    design
        Of the tracker; the default one if none.
    sigma_m
        As in `from_detections`.
    """

    grid: track.Grid
    design: track.TrackDesign | None = None
    sigma_m: float | None = None


def run_tracker(
    detector: Iterable[tuple[datetime, Iterable[Any]]], settings: Settings
) -> Iterator[tuple[datetime, set[Any]]]:
    """Our tracker in the place of one of Stone Soup's: the same loop, the same tracks.

    Parameters
    ----------
    detector
        Stone Soup detector or reader: times and sets of detections.
    settings
        Area and design.

    Yields
    ------
    Time, and Stone Soup tracks of what is confirmed, which grow by a `GaussianState` a step.
    """
    theirs = _stone_soup()
    state, tracks, epoch = track.start(settings.design), {}, None
    for when, detections in detector:
        epoch = when if epoch is None else epoch
        found = from_detections(detections, settings.sigma_m)
        state = track.step_detections(state, found, (when - epoch).total_seconds(), settings.grid)
        targets, now = state.targets, set()
        for k in np.flatnonzero(targets.confirmed):
            name = int(targets.id[k])
            belief = theirs.GaussianState(
                targets.mean[k][_ORDER][:, None],
                targets.covariance[k][np.ix_(_ORDER, _ORDER)],
                timestamp=when,
            )
            if name in tracks:
                tracks[name].append(belief)
            else:
                tracks[name] = theirs.Track([belief], id=str(name))
            now.add(tracks[name])
        yield when, now
