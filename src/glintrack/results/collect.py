"""Collect a simulation's records from frame to frame into its result."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import numpy as np
import xarray as xr

from glintrack import metrics, track
from glintrack.case.area import ScoredArea
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.installation import VERSION
from glintrack.core.parallel import compilation
from glintrack.core.records import Rows, ServedQueries, SpectralQuery

_AT_ONCE = ("completeness_visible", "custody", "purity", "false_per_km2")


class UnscoredFrame(NamedTuple):
    """Truth and scored area of a frame, and the tracks reported without a lag."""

    truth: xr.Dataset
    area_m: metrics.Area
    live: xr.Dataset


@dataclass(frozen=True)
class Loop:
    """State of one channel's tracker, its queries for the next frame, and the record so far.

    Tracks may be reported with a fixed lag (`track.advance`): those of ``pending`` epochs wait, with their
    truth in ``unscored``. ``at_once`` scores the tracks without the lag, ``scores`` those with it.
    """

    state: track.TrackerState
    queries: tuple[SpectralQuery, ...] = ()
    tracks: Rows = field(default_factory=Rows)
    at_once: tuple[metrics.EpochScore, ...] = ()
    scores: tuple[metrics.EpochScore, ...] = ()
    pending: tuple[track.PendingEpoch, ...] = ()
    unscored: tuple[UnscoredFrame, ...] = ()
    asked: tuple[int, ...] = ()
    served: tuple[int, ...] = ()
    reference: xr.Dataset | None = None
    quality: tuple[dict[str, float], ...] = ()

    def advance(
        self,
        state: track.TrackerState,
        queries: tuple[SpectralQuery, ...],
        tracks: xr.Dataset,
        score: metrics.EpochScore,
        truth: tuple[xr.Dataset, metrics.Area],
        served: ServedQueries,
        image: xr.Dataset,
        quality: dict[str, float] | None = None,
    ) -> "Loop":
        """Add one frame; the first image is the reference for registration."""
        pending, reported = track.advance(self.pending, state, tracks)
        after = replace(
            self,
            state=state,
            queries=queries,
            at_once=(*self.at_once, score),
            pending=pending,
            unscored=(*self.unscored, UnscoredFrame(*truth, tracks)),
            asked=(*self.asked, len(served.queries)),
            served=(*self.served, int(served.is_served.sum())),
            reference=image if self.reference is None else self.reference,
            quality=self.quality if quality is None else (*self.quality, quality),
        )
        return after._score(reported)

    def finish(self) -> "Loop":
        """Report and score all pending tracks after the last frame."""
        return replace(self, pending=())._score(track.flush(self.pending))

    def _score(self, reported: Sequence[xr.Dataset]) -> "Loop":
        """Score the tracks of the earliest unscored frames, and add their rows."""
        scores, rows = list(self.scores), self.tracks
        for tracks, frame in zip(reported, self.unscored, strict=False):
            score = self.at_once[len(scores)]
            if tracks is not frame.live:
                score = metrics.score_epoch(tracks, frame.truth, frame.area_m, time_s=score.time_s)
            scores.append(score)
            # the vehicle matched to each track (−1: none), and whether the track is correct or false
            columns = {"vehicle_id": score.matched_vehicle, "valid": score.valid, "false": score.false}
            tracks = tracks.assign(
                {name: ("track", np.asarray(values), {"units": "1"}) for name, values in columns.items()}
            )
            rows = rows.append(rows_of(tracks, "track", score.time_s))
        return replace(self, scores=tuple(scores), tracks=rows, unscored=self.unscored[len(reported) :])


class Stopwatch:
    """Wall time by stage, without compiling. [s]"""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self.start()

    def start(self) -> None:
        """Start the first lap."""
        self._last, self._compiled = time.perf_counter(), compilation.seconds

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage, less what was spent compiling."""
        now, compiling = time.perf_counter(), compilation.seconds
        spent = compiling - self._compiled
        self.seconds[stage] = self.seconds.get(stage, 0.0) + max(now - self._last - spent, 0.0)
        self.seconds["compile"] = self.seconds.get("compile", 0.0) + spent
        self._last, self._compiled = now, compiling


def collect(
    case: Case,
    area: ScoredArea,
    times_s: Array,
    loops: Mapping[str, Loop],
    truths: Rows,
    exposures_ms: Sequence[float],
    seconds: Mapping[str, float],
    ahead: Mapping[str, float],
    interrupted: bool,
) -> xr.DataTree:
    """Scores over time, rows of tracks and truth, and the provenance of a run; see `simulate`.

    ``exposures_ms`` are those of the frames that all channels have completed; ``seconds`` and ``ahead`` the
    wall times of the loop's stages, and of the rendering thread's.
    """
    count = len(exposures_ms)
    nodes: dict[str, xr.Dataset] = {"/truth": truths.to_dataset()}
    for channel, loop in ((channel, loop.finish()) for channel, loop in loops.items()):
        design = loop.state.effective_design
        learnt = min(design.count_learning_frames(case.flight.rate_hz), count)
        nodes[f"/{channel}"] = _over_time(times_s[:count], exposures_ms, loop, learnt)
        if area.kind != "window" and learnt < count:
            rows = loop.tracks.to_dataset(), nodes["/truth"]
            of_window = metrics.score_epochs(*rows, area.window, first_s=times_s[learnt])
            nodes[f"/{channel}"].attrs["completeness_window"] = metrics.summarize(of_window)["completeness"]
        if loop.quality:
            found = {key: np.array([frame[key] for frame in loop.quality]) for key in metrics.QUALITY_UNITS}
            finite = {key: values[np.isfinite(values)] for key, values in found.items()}
            means = {f"mean_{k}": float(v.mean()) if v.size else np.nan for k, v in finite.items()}
            series = _time_series(times_s[: len(loop.quality)], found, metrics.QUALITY_UNITS)
            nodes[f"/{channel}/quality"] = series.assign_attrs(means)
        nodes[f"/{channel}/tracks"] = loop.tracks.to_dataset()
    attributes = {
        "case": case.name,
        "seed": case.seed,
        "area": area.kind,
        "glintrack_version": VERSION,
        "frames_asked": len(times_s),
        "frames_done": count,
        "interrupted": int(interrupted),
        "build_s": seconds.get("build", 0.0),
        "compile_s": seconds.get("compile", 0.0),
    }
    for stages, ending in ((seconds, "per_frame"), (ahead, "ahead")):
        for stage, s in stages.items():
            if stage not in ("build", "compile"):
                attributes[f"{stage}_ms_{ending}"] = 1e3 * s / max(count, 1)
    nodes["/"] = xr.Dataset(attrs=attributes)
    return xr.DataTree.from_dict(nodes)


def _over_time(times_s: Array, exposures_ms: Sequence[float], loop: Loop, learnt: int) -> xr.Dataset:
    """Scores of a channel over time, with the aggregate scores of the frames after learning as attributes."""
    area_km2 = np.array([s.area_km2 for s in loop.scores], float)
    valid, false = (np.array([getattr(s, of).sum() for s in loop.scores], float) for of in ("valid", "false"))
    per_epoch = {
        "completeness": metrics.completeness(loop.scores),
        "completeness_visible": metrics.completeness(loop.scores, "visible"),
        "purity": metrics.running_purity(loop.scores),
        "tracked_per_km2": valid / area_km2,
        "false_tracks": false,
        "false_per_km2": false / area_km2,
        "should": np.array([s.should.sum() for s in loop.scores], float),
        "valid": valid,
        "queries_asked": np.array(loop.asked, float),
        "queries_served": np.array(loop.served, float),
        "exposure_ms": np.array(exposures_ms, float),
    }
    lag_s, others = loop.state.effective_design.reporting.effective_lag_s, {"learning_frames": float(learnt)}
    if lag_s:
        live = metrics.summarize(loop.at_once[learnt:])
        others |= {"report_lag_s": lag_s} | {f"{name}_at_once": float(live[name]) for name in _AT_ONCE}
    units = {name: "km-2" for name in per_epoch if name.endswith("km2")} | {"exposure_ms": "ms"}
    summary = {k: float(v) for k, v in metrics.summarize(loop.scores[learnt:]).items()}
    return _time_series(times_s, per_epoch, units).assign_attrs(summary | others)


def scored_times(tree: xr.DataTree, channel: str) -> Array:
    """Select the times of a channel's scored frames: those after the background is learnt. [s]"""
    node = tree[channel] if channel in tree.children else xr.DataTree()
    times_s = np.asarray(node["time"].values, float) if "time" in node.coords else np.empty(0)
    return times_s[int(node.attrs.get("learning_frames", 0)) :]


def _time_series(times_s: Array, values: Mapping[str, Array], units: Mapping[str, str]) -> xr.Dataset:
    return xr.Dataset(
        {name: ("time", v, {"units": units.get(name, "1")}) for name, v in values.items()},
        coords={"time": ("time", np.asarray(times_s, float), {"units": "s"})},
    )


def rows_of(items: xr.Dataset, dim: str, time_s: float) -> xr.Dataset:
    """Rows of a table from one epoch's items (dim ``track`` or ``vehicle``), with time and id as columns."""
    table = {str(name): ("row", v.values, v.attrs) for name, v in items.data_vars.items() if v.dims == (dim,)}
    table[f"{dim}_id"] = ("row", items[dim].values, {"units": "1"})
    table["time_s"] = ("row", np.full(items.sizes[dim], float(time_s)), {"units": "s"})
    return xr.Dataset(table)
