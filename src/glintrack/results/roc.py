"""Receiver operating characteristic: detections, somebody's or a flight's own, tracked at each threshold.

What was detected stays; the tracker begins anew with another score of initiation, without frames and spectra.
Completeness against false tracks a frame, Presnar et al., Proc. SPIE 7672, 76720T (2010), §4.2.
"""

from collections.abc import Iterable, Sequence

import numpy as np
import xarray as xr

from glintrack.config import Case
from glintrack.io.detections import DetectionTable
from glintrack.metrics import MATCH_DISTANCE_M, score_epochs, summarize
from glintrack.track import TrackDesign
from glintrack.track.files import DETECTIONS_DESIGN, track_detections

ROC_SCORES = (0.0, 2.0, 4.0, 6.0, 9.0, 12.0, 16.0, 20.0, 30.0, 40.0)  # nat

UNITS = {
    "completeness": "1",
    "false_per_epoch": "1",
    "purity": "1",
    "identity_switches": "1",
}


def roc(
    table: DetectionTable,
    truth: xr.Dataset,
    thresholds: Iterable[float] = ROC_SCORES,
    design: TrackDesign | None = None,
    area_m: tuple[float, float, float, float] | None = None,
    match_distance_m: float = MATCH_DISTANCE_M,
) -> list[dict[str, float]]:
    """Receiver operating characteristic: the tracker at each threshold of initiation.

    Parameters
    ----------
    table, design, area_m
        As in `track_detections`.
    truth
        As in `metrics.score_rows`.
    thresholds
        Values of ``confirm_score``, the log-likelihood ratio at which a track is confirmed. [nat]
    match_distance_m
        As in `metrics.score_rows`. [m]

    Returns
    -------
    Of each threshold, in their order: ``confirm_score``, then ``completeness``, ``false_per_epoch``,
    ``custody``, ``purity`` and ``identity_switches``.
    """
    design = DETECTIONS_DESIGN if design is None else design
    names = ("completeness", "false_per_epoch", "custody", "purity", "identity_switches")
    out = []
    for threshold in thresholds:
        changed = design.replace({"initiation.confirm_score": float(threshold)})
        rows = track_detections(table, changed, area_m).rows
        scores = summarize(score_epochs(rows, truth, area_m, match_distance_m))
        out.append({"confirm_score": float(threshold), **{name: scores[name] for name in names}})
    return out


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
    design = case.track.replace({"detect.channel": channel, "query.policy": "none", "roads.prior": False})
    scores = sorted({*map(float, thresholds), float(design.initiation.confirm_score)})
    found = roc(_table(detections), truth, scores, design, area_m)
    return xr.Dataset(
        {name: ("confirm_score", [one[name] for one in found], {"units": u}) for name, u in UNITS.items()},
        coords={"confirm_score": ("confirm_score", scores, {"units": "1", "long_name": "score [nat]"})},
        attrs={"flown_confirm_score": design.initiation.confirm_score},
    )


def _table(rows: xr.Dataset) -> DetectionTable:
    """Rows of a result as the tracker takes somebody's detections: without features."""
    covariance = np.empty((rows.sizes["row"], 2, 2))
    covariance[:, 0, 0], covariance[:, 1, 1] = rows["east_var"].values, rows["north_var"].values
    covariance[:, 0, 1] = covariance[:, 1, 0] = rows["east_north_cov"].values
    position = np.stack([rows["east"].values, rows["north"].values], axis=-1)
    return DetectionTable(rows["time_s"].values, position, covariance, np.empty((len(position), 0)), ())
