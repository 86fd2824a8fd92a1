"""One case, flown where a worker is: from plain values to the bytes of its files."""

import json
import os
import platform
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
import xarray as xr

from glintrack.bounds.run import FlightLadder
from glintrack.case.design import Case
from glintrack.io import netcdf
from glintrack.io.toml import to_toml
from glintrack.loop import simulate
from glintrack.render import Sampling
from glintrack.study.hits import HitsCache, geometry
from glintrack.study.source import source_key

Fly = Callable[[Case, "Task"], Mapping[str, Any]]
_NOT_OF_THE_CASE = (
    "build_s",
    "compile_s",
    "_ms_per_frame",
    "_ms_ahead",
)  # attributes that say how fast the host was


@dataclass(frozen=True)
class Task:
    """What a worker is told beside the case.

    Parameters
    ----------
    case_key
        Name of the case.
    cache
        Folder of kept hits; None keeps and reads none.
    keeps_hits
        Times of the frames that are kept once traced: other cases of the study need them too. [s]
    threads
        Of each kernel.
    sampling
        From `hits.shared_samplings`: how the cases that share hits sample their elements.
    source
        Of the driver's source (`source.source_key`): a worker with other code must not fly the case.
    """

    case_key: str
    cache: str | None = None
    keeps_hits: tuple[float, ...] = ()
    threads: int = 1
    source: str | None = None
    sampling: Sampling | None = None


def attempt(fly: Fly, case_json: str, task: Task) -> dict[str, Any]:
    """Fly a case and say how it went; what it raises comes back as text, so that no worker is lost to it.

    Returns
    -------
    ``scores`` by channel, ``files`` by name, ``seconds``, ``cpu_seconds`` (of the whole process), ``worker``
    and what ``fly`` adds, or ``error``: the traceback.
    """
    threads_before = numba.get_num_threads()
    numba.set_num_threads(min(task.threads, threads_before))
    start, start_cpu = time.perf_counter(), time.process_time()
    told: dict[str, Any] = {"worker": os.getpid()}
    try:
        _refuse_other_source(task.source)
        case = Case.model_validate_json(case_json)
        with _without_cluster_locks():
            told |= fly(case, task)
        told["files"] = {"case.toml": to_toml(case).encode(), **told.get("files", {})}
    except Exception as error:  # whatever it is, it belongs to this case, not to the study
        told["error"] = "".join(traceback.format_exception(error))
    finally:
        numba.set_num_threads(threads_before)
    took = {"seconds": time.perf_counter() - start, "cpu_seconds": time.process_time() - start_cpu}
    return told | took


def _without_cluster_locks() -> AbstractContextManager:
    """On a Dask worker xarray asks the cluster for a lock of what it writes, in memory too, and fails."""
    dask = sys.modules.get("dask")
    return nullcontext() if dask is None else dask.config.set(scheduler="threads")


def _refuse_other_source(expected: str | None) -> None:
    mine = source_key()
    if expected is not None and mine != expected:
        raise ValueError(
            f"`scheduler` must have workers with the driver's source of glintrack, {expected}, got {mine} "
            f"on {platform.node()} (install the same there)"
        )


def fly_case(case: Case, task: Task) -> dict[str, Any]:
    """Simulate a case with kept hits; scores, the ladder's rungs, and the whole result as NetCDF.

    Raises
    ------
    KeyboardInterrupt
        If the flight was interrupted: half a case is no result.
    """
    kept = HitsCache(Path(task.cache), geometry(case, task.sampling), task.keeps_hits) if task.cache else None
    steps = FlightLadder(case)
    tree = simulate(case, steps.measure, hits_cache=kept, sampling=task.sampling)
    if tree.attrs["interrupted"]:
        raise KeyboardInterrupt
    timing = {str(k): float(v) for k, v in tree.attrs.items() if str(k).endswith(_NOT_OF_THE_CASE)}
    for name in timing:
        del tree.attrs[name]
    ladders = steps.ladders(tree)
    told = {
        "scores": {ch: scores(case, tree, ch) | rungs(ladders.get(ch)) for ch in case.channels},
        "files": {"result.nc": _tree_bytes(tree), "timing.json": json.dumps(timing, indent=1).encode()},
    }
    if kept is not None:
        told |= {"frames_read": kept.read, "frames_traced": kept.traced, "bytes_kept": kept.bytes_kept}
    return told


def scores(case: Case, tree: xr.DataTree, channel: str) -> dict[str, Any]:
    """What a study compares of one channel: the run's scores, its data rate, and scores over time."""
    node = tree[channel]
    found: dict[str, Any] = {str(name): float(value) for name, value in node.attrs.items()}
    if "quality" in node.children:
        found |= {str(name): float(value) for name, value in node["quality"].attrs.items()}
    sensor = case.sensor
    bits_a_frame = sensor.rows * sensor.columns * sensor.bits
    found["data_rate_mbit_s"] = 1e-6 * bits_a_frame * case.flight.rate_hz
    over_time = {
        "completeness": "completeness",
        "completeness_visible": "completeness_visible",
        "false_per_epoch": "false_tracks",
        "held_per_km2": "held_per_km2",
        "false_per_km2": "false_per_km2",
    }
    found["over_time"] = {name: np.asarray(node[source]).tolist() for name, source in over_time.items()}
    return found


def rungs(ladder: xr.Dataset | None) -> dict[str, float]:
    """Share of all movers on each rung that was measured, by ``rung_NAME``."""
    if ladder is None:
        return {}
    values = zip(ladder["rung"].values, ladder["ladder"].values.astype(float), strict=True)
    return {f"rung_{name}": float(share) for name, share in values if np.isfinite(share)}


def _tree_bytes(tree: xr.DataTree) -> bytes:
    with tempfile.TemporaryDirectory(prefix="glintrack-") as scratch:
        path = Path(scratch) / "result.nc"
        netcdf.write_tree(path, tree)
        return path.read_bytes()
