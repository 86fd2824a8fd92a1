"""The process that solves tables: ``python -m glintrack.atmosphere.worker DESIGN.json TABLES.nc THREADS``.

It exists so that sasktran2 finds OpenBLAS held to one thread before numpy loads (twice as fast), without the
caller's own numpy being touched. Each finished part is told on standard output as a fraction.
"""

import sys
from pathlib import Path

from glintrack.atmosphere.assemble import assemble_tables
from glintrack.atmosphere.cache import write_tables
from glintrack.atmosphere.design import AtmosphereDesign


def main(design_path: str, tables_path: str, threads: str) -> None:
    """Solve the design of one file into another."""
    design = AtmosphereDesign.model_validate_json(Path(design_path).read_text(encoding="utf-8"))
    tables = assemble_tables(design, int(threads), lambda fraction: print(f"{fraction:.4f}", flush=True))
    write_tables(tables, Path(tables_path))


if __name__ == "__main__":
    main(*sys.argv[1:4])
