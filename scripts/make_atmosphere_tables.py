"""Solve the default atmosphere and put its tables into src/glintrack/data/atmosphere/.

    python scripts/make_atmosphere_tables.py

Run it after anything that changes `AtmosphereDesign`'s content key or the numbers; the old file is removed.
"""

import shutil
import tempfile
from pathlib import Path

from glintrack.atmosphere import AtmosphereDesign
from glintrack.atmosphere.tables import solve_in_worker

DATA = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "atmosphere"


def main() -> None:
    """Solve and replace."""
    design = AtmosphereDesign()
    with tempfile.TemporaryDirectory() as scratch:
        solved = solve_in_worker(design, Path(scratch), lambda done: print(f"{done:.0%}", flush=True))
        for old in DATA.glob("tables_*.nc"):
            old.unlink()
        target = DATA / f"tables_{design.content_key()}.nc"
        shutil.copyfile(solved, target)
    print(f"wrote {target} ({target.stat().st_size / 1e3:.0f} kB)")


if __name__ == "__main__":
    main()
