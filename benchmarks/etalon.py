"""A sweep of the etalon, 211 wavelengths × 100 gaps, beside the tmm package doing the same.

``python benchmarks/etalon.py [--quick] [--json FILE]``. Alternates ours and the peer in the same run; the
median of the alternations counts. ``ratio`` is the peer's time over ours. ``--quick`` gives the peer a tenth
of the gaps and scales its time.
"""

import argparse
import json
import time
from pathlib import Path

import numpy as np
import tmm

from glintrack.core.spectral import wavelength_grid
from glintrack.devices import EtalonDesign, permittivity
from glintrack.devices.etalon import responses
from glintrack.devices.gap_sweep import reconstruct, sweep_weights

SPECTRA = 200


def alternating(ours, peer, repeats: int) -> tuple[float, float]:
    """Median time of each, run in turns after one warm-up. [s]"""
    ours(), peer()
    times = np.empty((repeats, 2))
    for k in range(repeats):
        for which, work in enumerate((ours, peer)):
            start = time.perf_counter()
            work()
            times[k, which] = time.perf_counter() - start
    return tuple(np.median(times, axis=0).tolist())


def tmm_sweep(design: EtalonDesign, gaps, wavelength):
    index = np.sqrt(permittivity(design.metal, wavelength))
    film, angle = design.metal_thickness_nm * 1e-3, np.radians(design.incidence_deg)
    out = np.empty((gaps.size, wavelength.size))
    for i, gap in enumerate(gaps):
        for j, (n, um) in enumerate(zip(index, wavelength, strict=True)):
            stack, d = [1.0, n, 1.0, n, design.window_index], [np.inf, film, gap, film, np.inf]
            out[i, j] = np.mean([tmm.coh_tmm(p, stack, d, angle, um)["T"] for p in polarizations(design)])
    return out


def polarizations(design: EtalonDesign) -> tuple[str, ...]:
    return ("s",) if design.incidence_deg == 0 else ("s", "p")


def one_by_one(readings, weights, wavelength, sigma):
    for row in readings:
        reconstruct(row, weights, wavelength, sigma)


def main() -> None:
    """Print the table and, if asked, write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    repeats, share = (2, 10) if arguments.quick else (5, 1)
    wavelength, gaps = wavelength_grid(), np.linspace(0.15, 0.45, 100)
    rows = []
    for degrees in (0.0, 30.0):
        design = EtalonDesign(incidence_deg=degrees)
        ours, peer = alternating(
            lambda design=design: responses(design, gaps, wavelength),
            lambda design=design: tmm_sweep(design, gaps[::share], wavelength),
            repeats,
        )
        name = f"etalon sweep, 211 wavelengths x 100 gaps, {degrees:g} deg"
        rows.append(row(name, ours, "tmm", peer * share))
    table = responses(EtalonDesign(), gaps, wavelength)
    weights = sweep_weights(table)
    exact = weights @ (1 + 0.5 * np.sin(8 * wavelength))
    sigma = exact.mean() / 100
    readings = exact + sigma * np.random.default_rng(0).standard_normal((SPECTRA, gaps.size))
    ours, peer = alternating(
        lambda: reconstruct(readings, weights, wavelength, sigma),
        lambda: one_by_one(readings[::share], weights, wavelength, sigma),
        repeats,
    )
    rows.append(row(f"spectra from sweeps, {SPECTRA}", ours, "one call a spectrum", peer * share))
    for one in rows:
        print(f"{one['name']:52s} {one['value'] * 1e3:9.1f} ms   {one['peer']:20s} ratio {one['ratio']:8.1f}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1), encoding="utf-8")


def row(name: str, ours: float, peer: str, peers: float) -> dict:
    return {"name": name, "value": ours, "unit": "s", "peer": peer, "ratio": peers / ours}


if __name__ == "__main__":
    main()
