"""Solve the atmospheres of the packaged cases and put their tables into src/glintrack/data/atmosphere/.

    python tools/make_atmosphere_tables.py

Run it after anything that changes `AtmosphereDesign`'s content key or the numbers; the old files are removed.
The solver's threads add in an order of their own: new tables differ by up to 2e-4 of `path_gas`.
"""

import shutil
import tempfile
from pathlib import Path

from glintrack.atmosphere.tables import solve_in_worker
from glintrack.case.design import Case
from glintrack.case.packaged import find_case, list_cases

DATA = Path(__file__).parents[1] / "src" / "glintrack" / "data" / "atmosphere"


def main() -> None:
    """Solve and replace."""
    designs = [Case.from_toml(find_case(name)).atmosphere for name in list_cases()]
    with tempfile.TemporaryDirectory() as scratch:
        solved = {}
        for key, design in {one.content_key(): one for one in designs}.items():
            folder = Path(scratch) / key
            folder.mkdir()
            solved[key] = solve_in_worker(design, folder, lambda done: print(f"{done:.0%}", flush=True))
        for old in DATA.glob("tables_*.nc"):
            old.unlink()
        for key, tables in solved.items():
            target = DATA / f"tables_{key}.nc"
            shutil.copyfile(tables, target)
            print(f"wrote {target} ({target.stat().st_size / 1e3:.0f} kB)")


if __name__ == "__main__":
    main()
