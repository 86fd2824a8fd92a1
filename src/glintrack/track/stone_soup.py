"""Convert detections and tracks to and from Stone Soup (extra ``stonesoup``).

Stone Soup's state is ``[east, east speed, north, north speed]`` here, its times are datetimes after an epoch.
"""

from collections.abc import Iterable
from datetime import datetime, timedelta
from typing import Any

import numpy as np
import xarray as xr

from glintrack import track
from glintrack.core.installation import require_extra
from glintrack.io.atomic import content_hash
from glintrack.track.reporting import tracks_to_dataset


def to_detections(found: track.Detections, time_s: float, epoch: datetime) -> list[Any]:
    """Convert detections to Stone Soup, each with a linear measurement model of its own covariance.

    Parameters
    ----------
    found
        Detections of one frame, as in `TrackerState.detections`.
    time_s, epoch
        Time after the epoch. [s]

    Returns
    -------
    Detections in the same order, with ``extent_m`` and ``contrast`` in ``metadata``. Stone Soup's trackers
    take a ``set`` of them.

    Raises
    ------
    ValueError
        If Stone Soup is not installed.
    """
    install = {"extra": "stonesoup", "purpose": "pass detections to Stone Soup"}
    detection = require_extra("stonesoup.types.detection", **install).Detection
    model = require_extra("stonesoup.models.measurement.linear", **install).LinearGaussian
    when = epoch + timedelta(seconds=float(time_s))
    # Stone Soup predicts a measurement once for all detections that share a model
    models = {one.tobytes(): model(4, (0, 2), one) for one in found.covariance}
    return [
        detection(
            found.position[k][:, None],
            timestamp=when,
            measurement_model=models[found.covariance[k].tobytes()],
            metadata={"extent_m": float(found.extent[k]), "contrast": float(found.contrast[k])},
        )
        for k in range(len(found))
    ]


def from_detections(detections: Iterable[Any], sigma_m: float | None = None) -> track.Detections:
    """Convert detections of Stone Soup, in any order.

    Parameters
    ----------
    detections
        East and north of each [m]. A measurement model must be linear and give the covariance.
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
        vector, model = np.ravel(detection.state_vector).astype(float), detection.measurement_model
        if vector.shape != (2,):
            raise ValueError(f"`detections` must hold east and north; got {len(vector)} numbers.")
        if model is None and sigma_m is None:
            raise ValueError("`sigma_m` must be given for detections without a measurement model; got none.")
        if model is not None and not hasattr(model, "matrix"):
            raise ValueError(
                f"`detections` must have a linear measurement model; got {type(model).__name__}. "
                "Convert them to east and north first."
            )
        position[k] = vector
        covariance[k] = (sigma_m or 0) ** 2 * np.eye(2) if model is None else np.asarray(model.covar(), float)
    meta = [detection.metadata or {} for detection in found]
    extent = np.array([m.get("extent_m", 4.0) for m in meta], float)
    return track.Detections(
        position, covariance, extent, np.array([m.get("contrast", 1.0) for m in meta], float)
    )


def from_tracks(
    tracks: Iterable[Any],
    time_s: float,
    epoch: datetime,
    position: tuple[int, int] = (0, 2),
    velocity: tuple[int, int] = (1, 3),
) -> xr.Dataset:
    """Convert Stone Soup tracks at one time to a Dataset of the schema ``tracks``, which `metrics` scores.

    Parameters
    ----------
    tracks
        Tracks with Gaussian states.
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
    order = [*position, *velocity]  # east, north, east speed, north speed
    ids = np.array([int(content_hash(str(one.id), 14), 16) for one in tracks], np.int64)
    return tracks_to_dataset(
        float(time_s), ids, mean[:, order], covariance[:, order][:, :, order], ~np.array(measured, bool)
    )
