"""Free-response receiver operating characteristic: the same detections, tracked at each threshold.

The tracker runs without frames and spectra. With existence reporting the limit of the false share is swept,
else the score of initiation. Completeness against false tracks per frame: Presnar et al., Proc. SPIE 7672,
76720T (2010), §4.2.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import xarray as xr

from glintrack.case.design import Case
from glintrack.io.detections import DetectionTable
from glintrack.metrics import MATCH_DISTANCE_M, score_epochs, score_tables, summarize
from glintrack.metrics.rows import Areas
from glintrack.track import TrackDesign, TrackerState, report_epochs, start, step_detections
from glintrack.track.detect.detections import Detections
from glintrack.track.detect.frame import Grid
from glintrack.track.files import DETECTIONS_DESIGN, as_rows, track_detections

FROC_FALSE_SHARE = (0.01, 0.02, 0.04, 0.06, 0.08, 0.1, 0.13, 0.17, 0.22, 0.3)
FROC_SCORES = (0.0, 2.0, 4.0, 6.0, 9.0, 12.0, 16.0, 20.0, 30.0, 40.0)  # nat
_SCORES = ("completeness", "false_per_frame", "purity", "identity_switches")


def froc(
    table: DetectionTable,
    truth: xr.Dataset,
    thresholds: Iterable[float] = FROC_SCORES,
    design: TrackDesign | None = None,
    area_m: tuple[float, float, float, float] | None = None,
    match_distance_m: float = MATCH_DISTANCE_M,
) -> list[dict[str, float]]:
    """Free-response receiver operating characteristic: the tracker at each threshold of initiation.

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
    A dictionary for each threshold: ``confirm_score``, ``completeness``, ``false_per_frame``, ``custody``,
    ``purity`` and ``identity_switches``.
    """
    design, out = DETECTIONS_DESIGN if design is None else design, []
    for threshold in thresholds:
        changed = design.replace({"initiation.confirm_score": float(threshold)})
        rows = track_detections(table, changed, area_m).rows
        scores = summarize(score_epochs(rows, truth, area_m, match_distance_m))
        values = {name: scores[name] for name in (*_SCORES, "custody")}
        out.append({"confirm_score": float(threshold), **values})
    return out


def flight_froc(
    case: Case,
    channel: str,
    found: Sequence[tuple[float, Detections]],
    truth: xr.Dataset,
    grid: Grid,
    area_m: Areas,
    thresholds: Sequence[float] | None = None,
) -> xr.Dataset:
    """Scores of a channel's detections over the threshold of reporting.

    Parameters
    ----------
    case, channel
        The simulated case, and the channel of the detections.
    found
        Time of each frame, and its detections. [s]
    truth
        ``/truth`` of the result.
    grid, area_m
        Grid of the tracker, and the scored area, as in `metrics.score_rows`. [m]
    thresholds
        Values in addition to the design's own; by default `FROC_FALSE_SHARE` or `FROC_SCORES`.

    Returns
    -------
    ``completeness``, ``false_per_frame``, ``purity`` and ``identity_switches`` over rising ``threshold``. Its
    attribute ``key`` names it: ``reporting.max_false_share`` with existence reporting, else
    ``initiation.confirm_score``; the attribute ``own`` is the design's own. Empty if nothing was detected
    or there is no truth.
    """
    if not (any(len(one) for _, one in found) and truth.sizes.get("row")):
        return xr.Dataset()
    last_s = truth["time_s"].values.max()
    found = [(time_s, one) for time_s, one in found if time_s <= last_s]  # an interrupt cuts a frame in half
    design = case.track.replace({"detect.channel": channel, "query.policy": "none", "roads.prior": False})
    used = design.effective(any(one.log_likelihood_ratio is not None for _, one in found))
    if used.reporting.uses_existence:
        key, own, usual = "reporting.max_false_share", design.reporting.max_false_share, FROC_FALSE_SHARE
    else:
        key, own, usual = "initiation.confirm_score", design.initiation.confirm_score, FROC_SCORES
    swept = sorted({*map(float, usual if thresholds is None else thresholds), float(own)})
    if used.reporting.uses_existence:
        states = list(_states(design, found, grid))
        designs = [design.replace({key: one}) for one in swept]
        rows = [_rows(report_epochs(replace(one, design=new) for one in states)) for new in designs]
    else:
        designs = [used.replace({key: one}) for one in swept]
        rows = [_rows(report_epochs(_states(one, found, grid))) for one in designs]
    rate_hz = case.flight.rate_hz
    first_s = case.flight.start_s + (used.count_learning_frames(rate_hz) - 0.5) / rate_hz
    scores = [summarize(one) for one in score_tables(rows, truth, area_m, first_s=first_s)]
    return xr.Dataset(
        {name: ("threshold", [one[name] for one in scores], {"units": "1"}) for name in _SCORES},
        coords={"threshold": ("threshold", swept, {"units": "1", "key": key})},
        attrs={"own": float(own)},
    )


def _states(
    design: TrackDesign, found: Sequence[tuple[float, Detections]], grid: Grid
) -> Iterator[TrackerState]:
    """State of the tracker after each frame."""
    state = start(design)
    for time_s, one in found:
        state = step_detections(state, one, time_s, grid)
        yield state


def _rows(reports: Iterable[xr.Dataset]) -> xr.Dataset:
    return as_rows((tracks.attrs["time_s"], tracks) for tracks in reports)
