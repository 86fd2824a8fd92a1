"""Finite elements of wire grids: cost of a solve, and accuracy against time beside coupled-wave analysis.

    python validation/wire_grid.py [--quick] [--json FILE]

The peer, grcwa, expands the infinite grid in harmonics; it cannot do the finite pixel. Both find the
zero-order transmittance of the infinite grid A in aluminium (Lorentz–Drude) at 1 µm, E across the wires. The
error is against finite elements of order 10, which `tests/devices/test_fem.py` holds against an RCWA with
Li's factorization, which grcwa lacks. ``ratio`` is the peer's time over ours at equal error; there is none
where no run of the peer is as accurate. Needs the extra ``em`` and grcwa.
"""

import argparse
import json
import tempfile
import time
from pathlib import Path

import grcwa
import numpy as np

from glintrack.devices import PAPER_GRIDS, FemDesign, permittivity
from glintrack.devices.wire_grid import fem, sweep
from glintrack.devices.wire_grid.pixel_response import Pixel

GRID = PAPER_GRIDS["grid_a_physical"]
WAVELENGTH_UM = 1.0
HARMONICS = (21, 41, 81, 161, 241)
MESHES = (  # order, longest edge outside [µm] and in the wires [nm]
    (2, 0.1, 50),
    (3, 0.1, 50),
    (4, 0.1, 30),
    (5, 0.1, 20),
    (6, 0.1, 10),
)


def fem_transmittance(order: int, air_um: float, wire_nm: float) -> float:
    """|zero-order amplitude|² by finite elements, meshing included."""
    design = GRID.model_copy(
        update={"fem": FemDesign(order=order, air_element_um=air_um, wire_element_nm=wire_nm)}
    )
    eps = complex(permittivity(design.metal, WAVELENGTH_UM))
    solved = fem.solve(fem.unit_cell(design, WAVELENGTH_UM), WAVELENGTH_UM, "pass", eps, order)
    return abs(solved.output.mean_electric()) ** 2


def rcwa_transmittance(harmonics: int) -> float:
    """Transmittance by grcwa; below the Rayleigh wavelength only the zero order carries power."""
    d, points = GRID.period_nm * 1e-3, 1000
    eps = complex(permittivity(GRID.metal, WAVELENGTH_UM))
    # a second period a thousandth of the first keeps every harmonic along x
    model = grcwa.obj(harmonics, [d, 0], [0, 1e-3 * d], 1 / WAVELENGTH_UM, 0.0, 0.0, verbose=0)
    model.Add_LayerUniform(1.0, 1.0)
    model.Add_LayerGrid(GRID.wire_height_nm * 1e-3, points, 1)
    model.Add_LayerUniform(1.0, 1.0)
    model.Init_Setup()
    filled = np.ones((points, 1), dtype=complex)
    filled[: round(points * GRID.wire_width_nm / GRID.period_nm)] = eps
    model.GridLayer_geteps(filled.ravel())
    model.MakeExcitationPlanewave(1, 0, 0, 0, order=0)  # p: E along x at normal incidence
    return float(np.real(model.RT_Solve(normalize=1)[1]))


def timed(call, repeats: int) -> tuple[float, float]:
    """(value, least CPU time of ``repeats`` calls in seconds)."""
    best, value = np.inf, np.nan
    for _ in range(repeats):
        start = time.process_time()
        value = call()
        best = min(best, time.process_time() - start)
    return value, best


def accuracy_against_time(repeats: int) -> list[dict]:
    """Both methods' error and time, taken in turn."""
    reference = fem_transmittance(10, 0.1, 5)
    ours, theirs = [], []
    for mesh, harmonics in zip(MESHES, HARMONICS, strict=True):
        value, seconds = timed(lambda mesh=mesh: fem_transmittance(*mesh), repeats)
        ours.append((f"FEM order {mesh[0]}", abs(value - reference), seconds))
        value, seconds = timed(lambda harmonics=harmonics: rcwa_transmittance(harmonics), repeats)
        theirs.append((f"grcwa {harmonics} harmonics", abs(value - reference), seconds))
    rows = []
    for name, error, seconds in ours:
        equal = [t for _, e, t in theirs if e <= error]
        label = "grcwa at this error or a smaller one" if equal else "grcwa: none of its runs is as accurate"
        ratio = min(equal) / seconds if equal else None
        rows.append(row(f"{name}: time", 1e3 * seconds, "ms", label, ratio))
        rows.append(row(f"{name}: error of T", error, "1", "", None))
    for name, error, seconds in theirs:
        rows.append(row(f"{name}: time", 1e3 * seconds, "ms", "", None))
        rows.append(row(f"{name}: error of T", error, "1", "", None))
    return rows


def finite_pixel(repeats: int) -> list[dict]:
    """CPU time of one solve of the paper's pixels, mesh apart, and the process's memory."""
    rows = []
    for name, um in (("grid_a", 0.5), ("grid_a", 1.5), ("grid_b", 0.5), ("grid_b", 1.5)):
        design = PAPER_GRIDS[name]
        start = time.process_time()
        pixel = Pixel.of(design, um)
        meshing = time.process_time() - start
        eps, order = complex(permittivity(design.metal, um)), design.fem.order_at(um)
        for polarization in ("pass", "block"):
            _, seconds = timed(
                lambda p=polarization, x=pixel, e=eps, o=order, w=um: fem.solve(x.grid, w, p, e, o), repeats
            )
            rows.append(row(f"{name} {um} µm {polarization}", 1e3 * seconds, "ms", "", None))
        rows.append(row(f"{name} {um} µm meshes", 1e3 * meshing, "ms", "", None))
    return [*rows, row("peak memory of a worker", worker_peak_mb(), "MB", "", None)]


def worker_peak_mb() -> float:
    """Most memory a process of a sweep has held after a short and a long wave, as Linux counts it. [MB]"""
    design = PAPER_GRIDS["grid_b"]
    with tempfile.TemporaryFile("w+") as errors:
        process = sweep.start_worker(design, errors)
        for um in (0.5, 1.5):
            eps = complex(permittivity(design.metal, um))
            sweep.tell(process, json.dumps([um, eps.real, eps.imag]))
            process.stdout.readline()
        status = Path(f"/proc/{process.pid}/status").read_text()
        process.communicate()
    (line,) = (line for line in status.splitlines() if line.startswith("VmHWM"))
    return int(line.split()[1]) / 1e3


def row(name: str, value: float, unit: str, peer: str, ratio: float | None) -> dict:
    """One row of the report."""
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": ratio}


def main() -> None:
    """Measure, print, and write if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, help="write the rows here")
    arguments = parser.parse_args()
    repeats = 1 if arguments.quick else 3
    rows = finite_pixel(repeats) + accuracy_against_time(repeats)
    for one in rows:
        ratio = f"{one['ratio']:6.2f} × as fast as " if one["ratio"] is not None else ""
        against = f"  {ratio}{one['peer']}"
        print(f"{one['name']:32s} {one['value']:10.4g} {one['unit']:3s}{against}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
