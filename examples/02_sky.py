"""The polarized sky: published Rayleigh rows, fisheye maps with neutral points, spectra of sun, sky and path.

    python examples/02_sky.py [PICTURE.png]

Prints the Coulson/Natraj rows beside ours; the table's Q has the opposite sign of ours.
"""

import sys
from pathlib import Path

import matplotlib.pyplot as plt

from glintrack import viz_sky
from glintrack.atmosphere import AtmosphereDesign, rayleigh_slab, solve_tables

ROWS = (
    (0.0, 0.40, 60.0, (0.12752450, -0.06066038, 0.05293867)),
    (0.0, 0.92, 60.0, (0.05643322, -0.01979730, 0.03822653)),
    (0.8, 0.40, 60.0, (0.18923236, -0.06041229, 0.05293867)),
)


def main(picture: Path = Path("sky.png")) -> None:
    """Print the rows, draw the sky of the default design."""
    print("albedo    mu  azimuth |  published I, Q, U               | ours, meridian frame")
    for albedo, mu, azimuth_deg, published in ROWS:
        ours = rayleigh_slab(0.5, 0.2, albedo, mu, azimuth_deg)
        cells = "  ".join(f"{x:+.7f}" for x in published), "  ".join(f"{x:+.7f}" for x in ours)
        print(f"{albedo:6.2f} {mu:5.2f} {azimuth_deg:7.1f}° | {cells[0]} | {cells[1]}")
    tables = solve_tables(AtmosphereDesign())
    figure = plt.figure(figsize=(12, 12), layout="constrained")
    sky, below = figure.subfigures(2, 1, height_ratios=(2, 1))
    for row, um in enumerate((0.45, 0.70)):
        for column, quantity in enumerate(("I", "DoLP", "AoP")):
            axes = sky.add_subplot(2, 3, 3 * row + column + 1, projection="polar")
            sky.colorbar(viz_sky.fisheye(axes, tables, um, quantity), ax=axes, shrink=0.7)
    viz_sky.spectra(below.add_subplot(), tables)
    figure.savefig(picture, dpi=110)
    plt.close(figure)
    print(f"wrote {picture}")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:2]))
