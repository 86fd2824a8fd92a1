"""Compare finite elements of an infinite wire grid with rigorous coupled-wave analysis (RCWA).

    python validation/wire_grid.py

The RCWA is `tests/oracles/rcwa_1d.py`, with Li's factorization. It cannot do the finite pixel, which our
shipped tables hold. Needs the extra ``em``.
"""

import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))
from glintrack.devices import PAPER_GRIDS, FemDesign, permittivity
from glintrack.devices.wire_grid import fem
from tests.oracles.rcwa_1d import rcwa

GRIDS = (("grid_a_physical", 0.65), ("grid_a_physical", 1.5), ("grid_b_physical", 0.5))  # name, [µm]
FINE = FemDesign(air_element_um=0.1, wire_element_nm=7, order=6)
# E along the wires (block, TE) or across them (pass, TM), with the harmonics that RCWA needs
WAYS = (("block", "TE", 80), ("pass", "TM", 150))


def transmittances(name: str, um: float, way: tuple[str, str, int]) -> tuple[float, float]:
    """Zero-order transmittance of the infinite grid by finite elements and by RCWA. [1]"""
    design = PAPER_GRIDS[name].model_copy(update={"fem": FINE})
    eps = complex(permittivity(design.metal, um))
    polarization, field, harmonics = way
    solved = fem.solve(fem.unit_cell(design, um), um, polarization, eps, design.fem.order_at(um))
    shape = [1e-3 * x for x in (design.period_nm, design.wire_width_nm, design.wire_height_nm)]
    return abs(solved.output.mean_electric()) ** 2, float(rcwa(um, *shape, eps, harmonics, field)[0])


def main() -> None:
    """Print the table."""
    print("| grid | µm | state | finite elements | RCWA | difference |\n|" + " --- |" * 6)
    for name, um in GRIDS:
        for way in WAYS:
            ours, peer = transmittances(name, um, way)
            print(f"| {name} | {um} | {way[0]} | {ours:.6f} | {peer:.6f} | {ours - peer:+.1e} |")


if __name__ == "__main__":
    main()
