"""Collect a simulation's records from frame to frame into its result."""

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from importlib.metadata import version
from typing import NamedTuple

import numpy as np
import xarray as xr

from glintrack import metrics, track
from glintrack.core.arrays import Array
from glintrack.core.parallel import compilation
from glintrack.core.records import Rows, ServedQueries, SpectralQuery

Extent = tuple[float, float, float, float]  # west, south, east, north [m]
_AT_ONCE = ("completeness_visible", "custody", "purity", "false_per_km2")


class UnscoredFrame(NamedTuple):
    """Truth and window of a frame, and the tracks reported without a lag."""

    truth: xr.Dataset
    extent_m: Extent
    live: xr.Dataset


@dataclass(frozen=True)
class Loop:
    """One channel's loop: the tracker's state, what it asks of the next frame, and the record so far.

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

    @classmethod
    def begin(
        cls,
        design: track.TrackDesign,
        seed: int,
        roads: Sequence[Array] = (),
        detector: track.Detector | None = None,
    ) -> "Loop":
        """Start a tracker, perhaps with a road map or a detector of one's own."""
        return cls(track.start(design, seed, roads, detector))

    def turned(
        self,
        state: track.TrackerState,
        queries: tuple[SpectralQuery, ...],
        tracks: xr.Dataset,
        score: metrics.EpochScore,
        truth: tuple[xr.Dataset, Extent],
        served: ServedQueries,
        image: xr.Dataset,
        quality: dict[str, float] | None = None,
    ) -> "Loop":
        """The loop after one more frame; the first frame is what later ones may be registered to."""
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
        return after._scored(reported)

    def finished(self) -> "Loop":
        """The loop after the last frame, with all tracks reported."""
        return replace(self, pending=())._scored(track.flush(self.pending))

    def _scored(self, reported: Sequence[xr.Dataset]) -> "Loop":
        """The loop with the tracks of the earliest frames that waited."""
        scores, rows = list(self.scores), self.tracks
        for tracks, frame in zip(reported, self.unscored, strict=False):
            score = self.at_once[len(scores)]
            if tracks is not frame.live:
                score = metrics.score_epoch(tracks, frame.truth, frame.extent_m, time_s=score.time_s)
            scores.append(score)
            rows = rows.append(rows_of(_judged(tracks, score), "track", score.time_s))
        return replace(self, scores=tuple(scores), tracks=rows, unscored=self.unscored[len(reported) :])


class Stopwatch:
    """Wall time by stage, compiling apart. [s]"""

    def __init__(self):
        self.seconds: dict[str, float] = {}
        self._last, self._compiled = time.perf_counter(), compilation.seconds

    def start(self) -> None:
        """Count from now on: what went before is no stage's."""
        self._last, self._compiled = time.perf_counter(), compilation.seconds

    def lap(self, stage: str) -> None:
        """Add the time since the last lap to a stage, less what was spent compiling."""
        now, compiling = time.perf_counter(), compilation.seconds
        spent = compiling - self._compiled
        self.seconds[stage] = self.seconds.get(stage, 0.0) + max(now - self._last - spent, 0.0)
        self.seconds["compile"] = self.seconds.get("compile", 0.0) + spent
        self._last, self._compiled = now, compiling


def collect(
    name: str,
    seed: int,
    times_s: Array,
    loops: Mapping[str, Loop],
    truths: Rows,
    exposures_ms: Sequence[float],
    seconds: Mapping[str, float],
    ahead: Mapping[str, float],
    interrupted: bool,
) -> xr.DataTree:
    """Scores over time, rows of tracks and truth, and the provenance of a run; see `simulate`.

    ``exposures_ms`` are those of the frames that all loops have turned; ``seconds`` and ``ahead`` what the
    stages of the loop took, and what those before it did beside.
    """
    count = len(exposures_ms)
    nodes: dict[str, xr.Dataset] = {}
    for channel, loop in ((channel, loop.finished()) for channel, loop in loops.items()):
        nodes[f"/{channel}"] = _over_time(times_s[:count], exposures_ms, loop)
        if loop.quality:
            nodes[f"/{channel}/quality"] = _quality(times_s, loop.quality)
        nodes[f"/{channel}/tracks"] = loop.tracks.to_dataset()
    nodes["/truth"] = truths.to_dataset()
    per_frame = {
        f"{stage}_ms_per_frame": 1e3 * s / max(count, 1)
        for stage, s in seconds.items()
        if stage not in ("build", "compile")
    }
    per_frame |= {
        f"{stage}_ms_ahead": 1e3 * s / max(count, 1) for stage, s in ahead.items() if stage != "compile"
    }
    nodes["/"] = xr.Dataset(
        attrs={
            "case": name,
            "seed": seed,
            "glintrack_version": version("glintrack"),
            "frames_asked": len(times_s),
            "frames_done": count,
            "interrupted": int(interrupted),
            "build_s": seconds.get("build", 0.0),
            "compile_s": seconds.get("compile", 0.0),
            **per_frame,
        }
    )
    return xr.DataTree.from_dict(nodes)


def _over_time(times_s: Array, exposures_ms: Sequence[float], loop: Loop) -> xr.Dataset:
    per_epoch = {
        "completeness": metrics.completeness(loop.scores),
        "completeness_visible": metrics.completeness(loop.scores, "visible"),
        "purity": metrics.running_purity(loop.scores),
        "held_per_km2": np.array([s.valid.sum() / s.area_km2 for s in loop.scores], float),
        "false_tracks": np.array([s.false.sum() for s in loop.scores], float),
        "false_per_km2": np.array([s.false.sum() / s.area_km2 for s in loop.scores], float),
        "should": np.array([s.should.sum() for s in loop.scores], float),
        "valid": np.array([s.valid.sum() for s in loop.scores], float),
        "queries_asked": np.array(loop.asked, float),
        "queries_served": np.array(loop.served, float),
    }
    lag_s, at_once = loop.state.effective_design.reporting.effective_lag_s, {}
    if lag_s:
        live = metrics.summarize(loop.at_once)
        at_once = {"report_lag_s": lag_s} | {f"{name}_at_once": float(live[name]) for name in _AT_ONCE}
    exposure = (("time",), np.array(exposures_ms, float), {"units": "ms"})
    return xr.Dataset(
        {
            name: (("time",), values, {"units": "km-2" if name.endswith("km2") else "1"})
            for name, values in per_epoch.items()
        }
        | {"exposure_ms": exposure},
        coords={"time": ("time", np.asarray(times_s, float), {"units": "s"})},
        attrs={k: float(v) for k, v in metrics.summarize(loop.scores).items()} | at_once,
    )


def _judged(tracks: xr.Dataset, score: metrics.EpochScore) -> xr.Dataset:
    """The tracks of one epoch with the vehicle matched to each (−1: none), and if it is right or false."""
    columns = {"vehicle_id": score.matched_vehicle, "valid": score.valid, "false": score.false}
    return tracks.assign(
        {name: ("track", values.astype(np.int64), {"units": "1"}) for name, values in columns.items()}
    )


def _quality(times_s: Array, quality: Sequence[Mapping[str, float]]) -> xr.Dataset:
    """Quality of each frame, and its mean over the frames as attributes ``mean_…``."""
    found = {name: np.array([frame[name] for frame in quality]) for name in metrics.QUALITY_UNITS}
    whole = {name: values[np.isfinite(values)] for name, values in found.items()}
    return xr.Dataset(
        {name: (("time",), v, {"units": metrics.QUALITY_UNITS[name]}) for name, v in found.items()},
        coords={"time": ("time", np.asarray(times_s[: len(quality)], float), {"units": "s"})},
        attrs={f"mean_{name}": float(v.mean()) if v.size else np.nan for name, v in whole.items()},
    )


def rows_of(items: xr.Dataset, dim: str, time_s: float) -> xr.Dataset:
    """One epoch's items (dim ``track`` or ``vehicle``) as rows of a table, with time and id as columns."""
    table = {str(name): ("row", v.values, v.attrs) for name, v in items.data_vars.items() if v.dims == (dim,)}
    table[f"{dim}_id"] = ("row", items[dim].values, {"units": "1"})
    table["time_s"] = ("row", np.full(items.sizes[dim], float(time_s)), {"units": "s"})
    return xr.Dataset(table)
