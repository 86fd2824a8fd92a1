"""Receiver operating characteristic of one flight: its own detections, tracked again at each threshold.

What was detected stays as flown; the tracker begins anew with another score of initiation, without frames and
spectra. Completeness against false tracks a frame, Presnar et al., Proc. SPIE 7672, 76720T (2010), §4.2.
"""

from collections.abc import Sequence

import numpy as np
import xarray as xr

from glintrack.config import Case
from glintrack.io.detections import DetectionTable
from glintrack.track.files import ROC_SCORES, roc

UNITS = {
    "completeness": "1",
    "false_per_epoch": "1",
    "purity": "1",
    "identity_switches": "1",
}


def flight_roc(
    case: Case,
    channel: str,
    detections: xr.Dataset,
    truth: xr.Dataset,
    area_m: tuple[float, float, float, float],
    thresholds: Sequence[float] = ROC_SCORES,
) -> xr.Dataset:
    """Scores of a channel's detections over ``confirm_score``, the threshold of initiation.

    Parameters
    ----------
    case, channel
        The design that was flown, and whose detections they are.
    detections
        From `Recorder.detections`.
    truth
        ``/truth`` of the result.
    area_m
        West, south, east, north of the ground grid. [m]
    thresholds
        The design's own is added to them. [nat]

    Returns
    -------
    ``completeness``, ``false_per_epoch``, ``purity`` and ``identity_switches`` over rising ``confirm_score``;
    empty if nothing was detected or there is no truth.
    """
    if not (detections.sizes.get("row") and truth.sizes.get("row")):
        return xr.Dataset()
    flown = detections["time_s"].values <= truth["time_s"].values.max()  # an interrupt cuts a frame in half
    detections = detections.isel(row=np.flatnonzero(flown))
    design = case.track.model_copy(update={"channel": channel, "query_policy": "none", "road_prior": False})
    scores = sorted({*map(float, thresholds), float(design.confirm_score)})
    found = roc(_table(detections), truth, scores, design, area_m)
    return xr.Dataset(
        {name: ("confirm_score", [one[name] for one in found], {"units": u}) for name, u in UNITS.items()},
        coords={"confirm_score": ("confirm_score", scores, {"units": "1", "long_name": "score [nat]"})},
        attrs={"flown_confirm_score": design.confirm_score},
    )


def _table(rows: xr.Dataset) -> DetectionTable:
    """Rows of a result as the tracker takes somebody's detections: without features."""
    covariance = np.empty((rows.sizes["row"], 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = rows["east_var"].values, rows["north_var"].values
    covariance[:, 0, 1] = covariance[:, 1, 0] = rows["east_north_cov"].values
    position = np.stack([rows["east"].values, rows["north"].values], axis=-1)
    return DetectionTable(rows["time_s"].values, position, covariance, np.empty((len(position), 0)), ())
