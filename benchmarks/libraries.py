"""Own code where a library is at hand, beside that library: assignment and the values of an ENVI raster.

``python benchmarks/libraries.py [--quick] [--json FILE]``. Ours and the peer take turns in one run, in
processor time, which a loaded machine stretches less than the wall clock's; the median of the turns counts.
``ratio`` is the peer's time over ours. Both must give the same answer.
"""

import argparse
import json
import tempfile
import time
import warnings
from collections.abc import Callable
from pathlib import Path

import numpy as np
import rasterio
from scipy.sparse import coo_array
from scipy.sparse.csgraph import min_weight_full_bipartite_matching

from glintrack.core.records import RasterLayout
from glintrack.io.gdal import EnviWriter
from glintrack.track.association import associate

MISS_NAT = 1.9


def alternating(ours: Callable[[], object], peer: Callable[[], object], repeats: int) -> tuple[float, float]:
    """Median processor time of each, run in turns after one warm-up. [ms]"""
    ours(), peer()
    times = np.empty((repeats, 2))
    for k in range(repeats):
        for which, work in enumerate((ours, peer)):
            start = time.process_time()
            work()
            times[k, which] = 1e3 * (time.process_time() - start)
    return tuple(np.median(times, axis=0).tolist())


def matched(
    rows: np.ndarray, columns: np.ndarray, cost: np.ndarray, tracks: int, detections: int
) -> np.ndarray:
    """The assignment by SciPy's sparse matching, each track with a column of its own for a miss."""
    own = np.arange(tracks)
    values = np.concatenate([cost, np.full(tracks, MISS_NAT)])
    place = np.concatenate([rows, own]), np.concatenate([columns, detections + own])
    lift = 1.0 - values.min()  # no stored weight may be nought; every matching is as long, so the order stays
    table = coo_array((values + lift, place), shape=(tracks, detections + tracks)).tocsr()
    chosen = min_weight_full_bipartite_matching(table)[1]
    return np.where(chosen < detections, chosen, -1)


def assignment_rows(quick: bool, rng: np.random.Generator) -> list[dict]:
    """One-to-one assignment of gated pairs."""
    rows = []
    for count in (200, 2000) if quick else (200, 2000, 20000):
        side = np.sqrt(count / 200 * 660 * 420)  # 200 tracks on a packaged case's ground
        mean = np.column_stack([rng.uniform(0, side, (count, 2)), np.zeros((count, 2))])
        seen = mean[rng.random(count) < 0.85, :2]
        measured = np.concatenate([seen, rng.uniform(0, side, (count // 5, 2))])
        covariance = np.repeat(np.diag([1.0, 1.0, 4.0, 4.0])[None], count, axis=0)
        i, j = associate.gate(
            mean, covariance, measured, np.repeat(0.36 * np.eye(2)[None], len(measured), 0), 13.8
        )
        cost = rng.normal(0, 2, len(i))
        problem = (i, j, cost, np.full(count, MISS_NAT), len(measured))

        def ours(problem=problem):
            return associate.assign(*problem)

        def peer(i=i, j=j, cost=cost, count=count, measured=measured):
            return matched(i, j, cost, count, len(measured))

        if not np.array_equal(ours(), peer()):
            raise RuntimeError(f"`assign` must equal SciPy's matching, got another one for {count} tracks")
        times = alternating(ours, peer, 5 if count > 2000 else 25)
        rows.append(row(f"assignment, {count} tracks", times, "scipy.sparse.csgraph matching"))
    return rows


def envi_rows(quick: bool, rng: np.random.Generator) -> list[dict]:
    """Values of a cube in camera geometry, 64 rows at a time."""
    bands = 10 if quick else 60
    wavelength_um = tuple(np.linspace(0.4, 1.0, bands).tolist())
    names = tuple(f"{um:.2f} um" for um in wavelength_um)
    layout = RasterLayout(
        "r", "1", 480, 640, "wavelength", names, "stokes", tuple("IQU"), (64, bands), wavelength_um
    )
    cube = rng.random((3, bands, 480, 640), dtype=np.float32)
    profile = {"driver": "ENVI", "interleave": "bil", "dtype": "float32", "count": 3 * bands}
    with tempfile.TemporaryDirectory() as folder:
        ours_at, peer_at = Path(folder) / "ours.img", Path(folder) / "peer.img"

        def ours() -> None:
            writer = EnviWriter(ours_at, layout)
            for first in range(0, 480, 64):
                writer.write(first, 0, cube[:, :, first : first + 64])
            writer.close()

        def peer() -> None:
            with rasterio.open(peer_at, "w", height=480, width=640, **profile) as file:
                for first in range(0, 480, 64):
                    block = cube[:, :, first : first + 64]
                    window = rasterio.windows.Window(0, first, 640, block.shape[2])
                    file.write(block.reshape(-1, *block.shape[2:]), window=window)

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", rasterio.errors.NotGeoreferencedWarning)
            times = alternating(ours, peer, 5)
        if ours_at.read_bytes() != peer_at.read_bytes():
            raise RuntimeError("`EnviWriter` must write what GDAL writes, got other bytes")
    return [row(f"ENVI cube of {cube.nbytes / 1e6:.0f} MB", times, "rasterio")]


def row(name: str, times: tuple[float, float], peer: str) -> dict:
    """One line of the table."""
    return {"name": name, "value": times[0], "unit": "ms", "peer": peer, "ratio": times[1] / times[0]}


def main() -> None:
    """Run, print and perhaps write the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="a few seconds")
    parser.add_argument("--json", type=Path, help="write the rows to this file")
    arguments = parser.parse_args()
    rng = np.random.default_rng(0)
    rows = assignment_rows(arguments.quick, rng) + envi_rows(arguments.quick, rng)
    for r in rows:
        print(f"{r['name']:36s} {r['value']:9.3f} {r['unit']}  {r['ratio']:8.2f} × {r['peer']}")
    if arguments.json:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1))
        print(f"wrote {arguments.json}")


if __name__ == "__main__":
    main()
