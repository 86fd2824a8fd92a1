"""The paper's wire grids: transmission, extinction ratio and diattenuation of A and B, in both aluminiums.

    python examples/01_wiregrid.py [PICTURE.png]

Prints the paper's figures beside ours; draws its Figures 6, 7 and 8 from the shipped tables.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

from glintrack import viz_wiregrid
from glintrack.devices import wiregrid

PAPER = (  # statement, the paper's figure, ours from (grid, measured-aluminium grid)
    ("A at 1.5 µm, T(90°)", "0.069", "grid_a", lambda t: t["block_transmittance"].sel(wavelength=1.5)),
    ("B at 1.5 µm, T(90°)", "0.002", "grid_b", lambda t: t["block_transmittance"].sel(wavelength=1.5)),
    ("A at 1.5 µm, T(0°)", "about 0.7", "grid_a", lambda t: t["pass_transmittance"].sel(wavelength=1.5)),
    ("B at 1.5 µm, T(0°)", "about 0.7", "grid_b", lambda t: t["pass_transmittance"].sel(wavelength=1.5)),
    ("B, least diattenuation", "> 0.95", "grid_b", lambda t: t["diattenuation"].min()),
    (
        "A, diattenuation at 0.49 µm",
        "0 near 0.5",
        "grid_a",
        lambda t: t["diattenuation"].sel(wavelength=0.49),
    ),
)


def main(picture: Path = Path("wiregrid.png")) -> None:
    """Print the comparison, draw both grids."""
    print(f"{'':30s} {'paper':>12s} {'its conductor':>14s} {'aluminium':>10s}")
    for statement, published, name, value in PAPER:
        ours = (float(value(wiregrid.load(n))) for n in (name, f"{name}_physical"))
        print(f"{statement:30s} {published:>12s} {next(ours):14.4f} {next(ours):10.4f}")
    figure, axes = plt.subplots(2, 3, figsize=(15, 8), layout="constrained")
    for row, (grid, letter) in zip(axes, (("grid_a", "A"), ("grid_b", "B")), strict=True):
        viz_wiregrid.transmission(row[0], wiregrid.load(grid))
        for name, label in ((grid, "the paper's conductor"), (f"{grid}_physical", "aluminium, Rakić 1998")):
            viz_wiregrid.extinction(row[1], wiregrid.load(name), label)
            viz_wiregrid.diattenuation(row[2], wiregrid.load(name), label)
        row[1].legend()
        row[2].legend(loc="lower right")
        row[0].set_title(f"Figure 6: grid {letter}, transmission")
    figure.savefig(picture, dpi=110)
    plt.close(figure)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
