"""Solve the shipped wire-grid tables: the paper's grids A and B, both metals, 211 wavelengths.

    python tools/make_wiregrid_tables.py [NAME …] [--workers N]

Needs the extra ``em``. Takes about five CPU minutes a table; solved wavelengths are kept in the user's cache,
so a run that was stopped goes on where it was. Writes ``src/glintrack/data/devices/NAME.nc``.
"""

import argparse
from pathlib import Path

from glintrack.core.spectral import wavelength_grid
from glintrack.devices import PAPER_GRIDS, wire_grid
from glintrack.io import netcdf

FOLDER = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "devices"


def main() -> None:
    """Solve the tables named on the command line, all by default."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("names", nargs="*", default=list(PAPER_GRIDS), help=f"among {', '.join(PAPER_GRIDS)}")
    parser.add_argument("--workers", type=int, help="processes [default: all cores]")
    arguments = parser.parse_args()
    FOLDER.mkdir(parents=True, exist_ok=True)
    for name in arguments.names:
        table = wire_grid.solve(
            PAPER_GRIDS[name],
            wavelength_grid(),
            workers=arguments.workers,
            progress=lambda done, name=name: print(f"\r{name} {done:.1%}", end="", flush=True),
        )
        solved = table[list(wire_grid.SOLVED)].drop_vars(
            ("polarization_angle", "stokes_out", "stokes_in"), errors="ignore"
        )
        solved.attrs["made_by"] = f"python tools/make_wiregrid_tables.py {name}"
        netcdf.write_dataset(FOLDER / f"{name}.nc", solved)
        print(f"\nwrote {FOLDER / f'{name}.nc'}")


if __name__ == "__main__":
    main()
