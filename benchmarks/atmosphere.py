"""Solving and using an atmosphere's tables, beside the plain ways of doing the same.

``python benchmarks/atmosphere.py [--quick] [--json FILE]``. Alternates ours and the peer in the same run; the
median of the alternations counts. ``ratio`` is the peer's time over ours. Peers: the solver with
OpenBLAS left
to its own threads (the worker process holds it to one), and sky light interpolated band by band from the
expanded radiance, where ours interpolates the few maps once and multiplies by the spectra.
"""

import argparse
import json
import os
import resource
import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from glintrack.atmosphere import AtmosphereDesign, sky_stokes, solve_tables, tables


def alternating(ours, peer, repeats: int) -> tuple[float, float]:
    """Median time of each, run in turns. [s]"""
    times = np.empty((repeats, 2))
    for k in range(repeats):
        for which, work in enumerate((ours, peer)):
            start = time.perf_counter()
            work()
            times[k, which] = time.perf_counter() - start
    return tuple(np.median(times, axis=0).tolist())


def solve(design: AtmosphereDesign) -> None:
    """One solve in its worker process, no cache."""
    with tempfile.TemporaryDirectory() as folder:
        tables.solve_in_worker(design, Path(folder))


def solve_with_free_blas(design: AtmosphereDesign) -> None:
    """The same worker with OpenBLAS left to itself."""
    with tempfile.TemporaryDirectory() as folder:
        request, answer = Path(folder) / "design.json", Path(folder) / "tables.nc"
        request.write_text(design.model_dump_json(), encoding="utf-8")
        free = {name: value for name, value in os.environ.items() if name != "OPENBLAS_NUM_THREADS"}
        arguments = [str(request), str(answer), str(os.cpu_count() or 1)]
        command = [tables.sys.executable, "-m", "glintrack.atmosphere.worker", *arguments]
        subprocess.run(command, check=True, env=free, capture_output=True)


def look_up(solved, zenith, azimuth) -> None:
    """Sky light in many directions through the factors."""
    sky_stokes(solved, zenith, azimuth)


def look_up_by_band(solved, zenith, azimuth) -> None:
    """The same from the expanded radiance, one band after the other."""
    for band in range(solved.sizes["wavelength"]):
        one = solved.assign(
            sky_map=(
                ("sky_component", *solved["sky_map"].dims[1:]),
                solved["sky_radiance"].values[band][None],
            ),
            sky_spectrum=(("sky_component", "one"), np.ones((1, 1))),
        )
        sky_stokes(one, zenith, azimuth)


def measure(quick: bool) -> list[dict]:
    """Rows of the table."""
    one_altitude = AtmosphereDesign(altitudes_m=(3000.0,))
    small = one_altitude.replace({"wavelength_step_um": 0.06})
    rows = []
    cases = [("solve, 11 wavelengths", small, 1 if quick else 3)]
    if not quick:
        wide = one_altitude.replace({"wavelength_stop_um": 2.5})
        cases += [("solve, 61 wavelengths", one_altitude, 1), ("solve, 211 wavelengths", wide, 1)]
    for name, design, repeats in cases:
        mine, peer = alternating(lambda d=design: solve(d), lambda d=design: solve_with_free_blas(d), repeats)
        rows.append(row(name, mine, "s", "free OpenBLAS threads", peer / mine))
    peak_mb = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1e3
    rows.append(row("peak memory of a solve", peak_mb, "MB", "", None))
    solved = solve_tables(AtmosphereDesign())
    rng = np.random.default_rng(0)
    zenith, azimuth = np.arccos(rng.uniform(0.1, 1, 2000)), rng.uniform(0, 2 * np.pi, 2000)
    mine, peer = alternating(
        lambda: look_up(solved, zenith, azimuth), lambda: look_up_by_band(solved, zenith, azimuth), 3
    )
    rows.append(row("2000 directions, 61 bands", 1e3 * mine, "ms", "interpolated band by band", peer / mine))
    mine, _ = alternating(lambda: solve_tables(AtmosphereDesign()), lambda: None, 5)
    rows.append(row("default tables, shipped", 1e3 * mine, "ms", "", None))
    return rows


def row(name: str, value: float, unit: str, peer: str, ratio: float | None) -> dict:
    """One row of the report."""
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": ratio}


def main() -> None:
    """Measure, print, and write if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, help="write the rows here")
    arguments = parser.parse_args()
    rows = measure(arguments.quick)
    for one in rows:
        against = f"  {one['ratio']:6.2f} × faster than {one['peer']}" if one["ratio"] is not None else ""
        print(f"{one['name']:28s} {one['value']:10.2f} {one['unit']:3s}{against}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
