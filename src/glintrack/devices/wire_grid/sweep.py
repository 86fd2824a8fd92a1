"""Solve a pixel at many wavelengths: in parallel processes, from the cache where it can, resumable.

Every solved wavelength goes into the cache at once, named by the geometry, the finite elements, the
wavelength and the wires' permittivity there; an interrupted sweep continues where it stopped.
"""

import json
import os
import queue
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import IO

from glintrack.core.extras import MissingExtraError, missing_extra
from glintrack.devices.wire_grid.design import WireGridDesign
from glintrack.io import cache

_FORMAT = 1  # of a cached row


def sweep(
    design: WireGridDesign,
    wavelength_um: Sequence[float],
    permittivity: Sequence[complex],
    *,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
    folder: Path | None = None,
) -> list[dict]:
    """One row of `pixel_response.measure` a wavelength, in order.

    Parameters
    ----------
    design
        The pixel.
    wavelength_um, permittivity
        Where to solve [µm], and ε of the wires there [1].
    workers
        Processes; all cores by default.
    progress
        Called with the finished fraction.
    folder
        Cache; `cache.cache_folder` by default.
    """
    geometry = design.model_dump_json(exclude={"metal"})
    folder = (cache.cache_folder("wiregrid") if folder is None else folder) / cache.content_stem(geometry)
    stems = [
        cache.content_stem(f"{_FORMAT} {geometry} {um!r} {complex(eps)!r}")
        for um, eps in zip(wavelength_um, permittivity, strict=True)
    ]
    rows: dict[int, dict] = {}
    for i, stem in enumerate(stems):
        kept = cache.find(stem, ".json", folder)
        if kept is not None:
            rows[i] = json.loads(kept.read_text(encoding="utf-8"))
    missing = [i for i in range(len(stems)) if i not in rows]
    if not missing:
        return [rows[i] for i in range(len(stems))]
    require_solver()

    def keep(i: int, row: dict) -> None:
        cache.keep(stems[i], ".json", folder, json.dumps(row).encode())
        rows[i] = row
        if progress is not None:
            progress(len(rows) / len(stems))

    tasks = {i: (wavelength_um[i], complex(permittivity[i])) for i in missing}
    _solve_all(design, tasks, min(workers or os.cpu_count() or 1, len(missing)), keep)
    return [rows[i] for i in range(len(stems))]


def has_solver() -> bool:
    """Whether the extra ``em`` is installed."""
    return find_spec("ngsolve") is not None


def require_solver() -> None:
    """Refuse to solve without NGSolve, and say what to install."""
    if not has_solver():
        needed = missing_extra("ngsolve", "em", "solve Maxwell's equations")
        raise MissingExtraError(f"{needed}; shipped tables need none: wire_grid.load")


def _solve_all(design: WireGridDesign, tasks: dict, workers: int, keep: Callable[[int, dict], None]) -> None:
    """Let ``workers`` processes take tasks from one queue until it is empty."""
    waiting: queue.SimpleQueue = queue.SimpleQueue()
    for i, task in tasks.items():
        waiting.put((i, task))
    with tempfile.TemporaryFile("w+", encoding="utf-8") as errors:
        processes = [start_worker(design, errors) for _ in range(workers)]
        try:
            with ThreadPoolExecutor(workers) as pool:
                turns = [pool.submit(_serve, process, waiting, keep, errors) for process in processes]
                try:
                    for turn in turns:
                        turn.result()
                except BaseException:  # an interrupt, or one worker failed: the others need not go on
                    for process in processes:
                        process.kill()
                    raise
        finally:
            for process in processes:
                process.kill()
                process.wait()


def start_worker(design: WireGridDesign, errors: IO[str]) -> subprocess.Popen:
    """Start a process that solves wavelengths of one design, see `worker`."""
    # read when the libraries load: more threads a process only fight over the cores
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NGS_NUM_THREADS": "1"}
    process = subprocess.Popen(
        [sys.executable, "-m", "glintrack.devices.wire_grid.worker"],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=errors,
        text=True,
        env=environment,
    )
    tell(process, design.model_dump_json(exclude={"metal"}))
    return process


def _serve(process: subprocess.Popen, waiting: queue.SimpleQueue, keep: Callable, errors: IO[str]) -> None:
    """Hand tasks to one process until none is left."""
    while True:
        try:
            i, (wavelength_um, eps) = waiting.get_nowait()
        except queue.Empty:
            return
        tell(process, json.dumps([wavelength_um, eps.real, eps.imag]))
        line = next((line for line in process.stdout or () if line.startswith("{")), None)
        if line is None:
            errors.seek(0)
            raise RuntimeError(f"solving {wavelength_um:g} µm failed: {errors.read().strip()[-2000:]}")
        keep(i, json.loads(line))


def tell(process: subprocess.Popen, line: str) -> None:
    """Send a worker one line."""
    try:
        assert process.stdin is not None
        process.stdin.write(line + "\n")
        process.stdin.flush()
    except OSError:
        pass  # it has died; the missing answer tells
