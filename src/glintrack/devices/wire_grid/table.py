"""Wire-grid polarizers: solved tables, and the quantities of Eqs. (7)–(9) that follow from them.

A table is a Dataset over ``wavelength``. `load` reads the shipped ones, `solve` makes new ones in parallel
processes. Every solved wavelength is cached, so that an interrupted sweep continues where it stopped. Angles
ψ of the light's polarization are from the axis *across* the wires, the pass axis.
"""

import json
import os
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numpy.typing import ArrayLike

from glintrack import stokes
from glintrack.core import spectral
from glintrack.core.installation import VERSION, MissingExtraError, data_file, missing_extra, read_data
from glintrack.devices.optical_constants import permittivity
from glintrack.devices.wire_grid.design import PAPER_GRIDS, WireGridDesign
from glintrack.io import cache

ANGLES_DEG = tuple(range(0, 100, 10))  # ψ of the paper's Figure 6
SOLVED: Mapping[str, str] = read_data("devices", "wire_grid.toml")["outputs"]
_FORMAT = 1  # of a cached row
Task = tuple[float, complex]  # wavelength [µm] and permittivity of the wires [1]


def load(name: str) -> xr.Dataset:
    """Shipped table of one of the paper's grids, 211 wavelengths.

    Parameters
    ----------
    name
        ``"grid_a"`` or ``"grid_b"`` (the paper's conductor), ``"grid_a_physical"`` or ``"grid_b_physical"``
        (aluminium by Lorentz–Drude, Rakić 1998).

    Returns
    -------
    See `complete`.
    """
    if name not in PAPER_GRIDS:
        raise ValueError(f"`name` must be one of {', '.join(PAPER_GRIDS)}; got {name!r}.")
    return complete(xr.load_dataset(data_file("devices", f"{name}.nc"), engine="h5netcdf"))


def response(
    design: WireGridDesign, wavelength_um: ArrayLike, progress: Callable[[float], None] | None = None
) -> xr.Dataset:
    """Table of a design: shipped if it is one of the paper's and the wavelengths are in it, else solved."""
    um = spectral.check_wavelengths(wavelength_um)
    for name, known in PAPER_GRIDS.items():
        if design == known:
            table = load(name)
            nearest = np.abs(table["wavelength"].values[:, None] - um).argmin(axis=0)
            if np.allclose(table["wavelength"].values[nearest], um, rtol=0, atol=1e-9):
                return table.isel(wavelength=nearest)
    return solve(design, um, progress=progress)


def solve(
    design: WireGridDesign,
    wavelength_um: ArrayLike,
    *,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
    cache: Path | None = None,
) -> xr.Dataset:
    """Solve Maxwell's equations for a grid; needs the extra ``em``.

    Parameters
    ----------
    wavelength_um
        Rising, within 0.4 to 2.5 µm and the metal's data. [µm]
    workers
        Processes; all cores by default. Each takes about 0.4 GB.
    progress
        Called with the finished fraction.
    cache
        Folder of solved wavelengths; the user's cache by default. A stopped sweep goes on from there.

    Returns
    -------
    See `complete`.

    Raises
    ------
    ValueError
        If a wavelength lies outside the metal's data, or the extra is not installed.
    """
    um = spectral.check_wavelengths(wavelength_um)
    eps = permittivity(design.metal, um)
    rows = _sweep(design, um.tolist(), eps.tolist(), workers=workers, progress=progress, folder=cache)
    table = xr.Dataset(
        {
            name: ("wavelength", np.array([row[name] for row in rows]), {"units": "1", "long_name": what})
            for name, what in SOLVED.items()
        },
        coords={"wavelength": ("wavelength", um, {"units": "um"})},
        attrs={
            "title": "Response of a pixel-sized wire-grid polarizer",
            "design": design.model_dump_json(),
            "source": "2-D finite elements of Maxwell's equations, glintrack.devices.wire_grid.fem; metal: "
            + _describe_metal(design),
            "licence": "BSD-3-Clause",
            "order": json.dumps(sorted({design.fem.order_at(x) for x in um.tolist()})),
            "elements": json.dumps(sorted({row["elements"] for row in rows})),
            "versions": json.dumps({"glintrack": VERSION, "ngsolve": rows[0]["ngsolve"]}),
        },
    )
    return complete(table)


def field_maps(design: WireGridDesign, wavelength_um: float) -> xr.Dataset:
    """Field in the cross-section at one wavelength, solved now (extra ``em``); see `fem.field_maps`."""
    _require_solver()
    (um,) = spectral.check_wavelengths(wavelength_um)
    return import_module("glintrack.devices.wire_grid.fem").field_maps(design, float(um))


def complete(table: xr.Dataset) -> xr.Dataset:
    """Add what follows from the solved variables.

    Returns
    -------
    The table with, over ``wavelength``: ``pass_transmittance_per_aperture`` and
    ``block_transmittance_per_aperture``, the response to light that falls on the aperture alone (Eq. (7)
    times port over aperture; it may exceed 1, as the removed run loses light through the sides);
    ``extinction_ratio``, Eq. (8); ``diattenuation``, Eq. (9); ``retardance``, the phase of the pass amplitude
    less that of the block one, e^(−iωt) [rad]; ``transmittance`` T(λ, ψ) over ``polarization_angle`` [rad];
    ``mueller``, of the linear diattenuator with its pass axis along the reference axis, and
    ``mueller_per_aperture``, which sensors use.
    """
    design = WireGridDesign.model_validate_json(table.attrs["design"])
    share = design.aperture_um / design.port_um
    passed, blocked = table["pass_transmittance"].values, table["block_transmittance"].values
    psi = np.radians(ANGLES_DEG)
    retardance = np.angle(table["field_ratio_real"].values + 1j * table["field_ratio_imag"].values)
    matrices = []
    for p, b, r in zip(passed.tolist(), blocked.tolist(), retardance.tolist(), strict=True):
        scale = max(1.0, p, b)  # Eq. (7) may exceed 1, as the removed run loses light to the sides
        matrices.append(scale * stokes.linear_diattenuator(p / scale, b / scale, 0.0, r))
    wave, one, mueller = "wavelength", {"units": "1"}, ("wavelength", "stokes_out", "stokes_in")
    # T(λ, ψ) = T(0°) cos²ψ + T(90°) sin²ψ, Eq. (7): exact where nothing varies along the wires
    by_angle = np.multiply.outer(passed, np.cos(psi) ** 2) + np.multiply.outer(blocked, np.sin(psi) ** 2)
    diattenuation = (passed - blocked) / (passed + blocked)
    return table.assign(
        pass_transmittance_per_aperture=(wave, passed / share, one),
        block_transmittance_per_aperture=(wave, blocked / share, one),
        extinction_ratio=(wave, passed / blocked, {"units": "1", "long_name": "Eq. (8)"}),
        diattenuation=(wave, diattenuation, {"units": "1", "long_name": "Eq. (9)"}),
        retardance=(wave, retardance, {"units": "rad"}),
        transmittance=((wave, "polarization_angle"), by_angle, one),
        mueller=(mueller, np.array(matrices), one),
        mueller_per_aperture=(mueller, np.array(matrices) / share, one),
    ).assign_coords(
        polarization_angle=("polarization_angle", psi, {"units": "rad"}),
        stokes_out=("stokes_out", list(stokes.COMPONENTS)),
        stokes_in=("stokes_in", list(stokes.COMPONENTS)),
    )


def _describe_metal(design: WireGridDesign) -> str:
    metal = design.metal
    if metal.model == "conductivity":
        return f"conductor of {metal.conductivity_s_per_m:g} S/m (ε = 1 + iσ/(ωε₀))"
    if metal.table is not None:
        return f"n and k tabulated in {metal.table.name}"
    return f"{metal.name} by the Lorentz–Drude model of Rakić et al., Applied Optics 37, 5271 (1998)"


def _sweep(
    design: WireGridDesign,
    wavelength_um: Sequence[float],
    permittivity: Sequence[complex],
    *,
    workers: int | None = None,
    progress: Callable[[float], None] | None = None,
    folder: Path | None = None,
) -> list[dict]:
    """One row of `fem.measure` for each wavelength [µm] and ε of the wires there [1], in order."""
    geometry = design.model_dump_json(exclude={"metal"})
    folder = (cache.cache_folder("wiregrid") if folder is None else folder) / cache.content_stem(geometry)
    stems = [
        cache.content_stem(f"{_FORMAT} {geometry} {um!r} {complex(eps)!r}")
        for um, eps in zip(wavelength_um, permittivity, strict=True)
    ]
    rows: dict[int, dict] = {}
    for i, stem in enumerate(stems):
        file = cache.find(stem, ".json", folder)
        if file is not None:
            rows[i] = json.loads(file.read_text(encoding="utf-8"))
    missing = [i for i in range(len(stems)) if i not in rows]
    if not missing:
        return [rows[i] for i in range(len(stems))]
    _require_solver()

    def add(i: int, row: dict) -> None:
        cache.store(stems[i], ".json", folder, json.dumps(row).encode())
        rows[i] = row
        if progress is not None:
            progress(len(rows) / len(stems))

    tasks = {i: (wavelength_um[i], complex(permittivity[i])) for i in missing}
    _solve_all(design, tasks, min(workers or os.cpu_count() or 1, len(missing)), add)
    return [rows[i] for i in range(len(stems))]


def can_solve() -> bool:
    """Return True if the extra ``em`` is installed."""
    return find_spec("ngsolve") is not None


def _require_solver() -> None:
    if not can_solve():
        needed = missing_extra("ngsolve", "em", "solve Maxwell's equations")
        raise MissingExtraError(f"{needed}; shipped tables need none: wire_grid.load")


def _solve_all(
    design: WireGridDesign, tasks: dict[int, Task], workers: int, keep: Callable[[int, dict], None]
) -> None:
    """Share tasks among processes that run `fem.main`; ``keep`` takes each answer as it comes."""
    # read when the libraries load: more threads a process only fight over the cores
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1", "NGS_NUM_THREADS": "1"}
    command, pipe = [sys.executable, "-m", "glintrack.devices.wire_grid.fem"], subprocess.PIPE
    options: dict[str, Any] = {"stdin": pipe, "stdout": pipe, "stderr": subprocess.STDOUT, "text": True}
    parts = [dict(list(tasks.items())[k::workers]) for k in range(workers)]
    with ExitStack() as stack, ThreadPoolExecutor(workers) as pool:
        started = [stack.enter_context(subprocess.Popen(command, env=environment, **options)) for _ in parts]
        pairs = zip(started, parts, strict=True)
        try:
            for turn in [pool.submit(_serve, *pair, design, keep) for pair in pairs]:
                turn.result()
        finally:  # after an interrupt, or where one worker failed, the others need not go on
            for process in started:
                process.kill()


def _serve(
    process: subprocess.Popen,
    tasks: dict[int, Task],
    design: WireGridDesign,
    keep: Callable[[int, dict], None],
) -> None:
    """Send one process its tasks and take the answers."""
    assert process.stdin is not None and process.stdout is not None
    lines = [json.dumps([um, eps.real, eps.imag]) for um, eps in tasks.values()]
    with suppress(OSError):  # it has died: an answer will be missing
        process.stdin.write("\n".join([design.model_dump_json(exclude={"metal"}), *lines, ""]))
        process.stdin.close()
    open_tasks, messages = list(tasks), []
    for line in process.stdout:
        if line.startswith("{"):
            keep(open_tasks.pop(0), json.loads(line))
        else:
            messages.append(line)
    if open_tasks:
        failure = "".join(messages).strip()[-2000:]
        raise RuntimeError(f"solving {tasks[open_tasks[0]][0]:g} µm failed: {failure}")
