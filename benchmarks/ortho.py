"""Time rectification and that of orthority: same frame, camera, pose, grid and heights, in turns.

``python benchmarks/ortho.py [--quick] [--json FILE]``. The median of the alternations counts; ``ratio`` is
orthority's time over ours, ``cpu`` the same of processor time, which other work on the machine disturbs less.

``array``: the frame and every cell's height in memory, a rectified array out. orthority's `camera.remap`
gets the places of the cells ready made, projects them in NumPy and calls OpenCV's remap for each band;
ours gets the grid's axes and does all in one compiled sweep, cubic with a = −1/2 where OpenCV has −3/4.

``job``: the frame and a DEM of 12 m in memory, the grid by its cell: what a user asks for. orthority
resamples the DEM to the grid (GDAL), crops it to what the frame sees, rectifies tiles of 512 in as many
threads as cores and puts them into an uncompressed file in memory; ours is `rectify_array`, which takes
heights between the DEM's nodes on the way and gives the array, NaN off the frame.

The largest difference between the two results is printed with the times. Without orthority only our
own times are given.
"""

import argparse
import importlib.util
import json
import math
import time
import warnings
from pathlib import Path

import numpy as np
import rasterio
import xarray as xr
from rasterio.io import MemoryFile
from rasterio.transform import from_origin

from glintrack.camera import Camera, Pose, ground_points, look_at, omega_phi_kappa
from glintrack.ortho import rectify_array, rectify_onto

PEER = importlib.util.find_spec("orthority") is not None
ORIGIN = (604000.0, 5792000.0)
CRS = "EPSG:32632"
DEM_M, DEM_MARGIN_M = 12.0, 400.0  # whole cells of every grid: both grids then coincide


def median_ms(works, repeats: int) -> np.ndarray:
    """Median of wall and processor time of each, run in turns after one warm-up. [ms]"""
    for work in works:
        work()
    times = np.empty((repeats, len(works), 2))
    for k in range(repeats):
        for which, work in enumerate(works):
            start = time.perf_counter(), time.process_time()
            work()
            times[k, which] = time.perf_counter() - start[0], time.process_time() - start[1]
    return 1e3 * np.median(times, axis=0)


def scene(rows: int, columns: int):
    """Make a camera 50° off nadir at 3000 m slant range, and its ground over rolling terrain."""
    camera = Camera(0.068, 17e-6 * 880 / columns, rows, columns)
    place = (ORIGIN[0] - 1500.0, ORIGIN[1] - 1741.0, 1928.0)
    pose = look_at(Pose(*place, heading_rad=0.7, kind="reported"), (*ORIGIN, 0.0))
    corners = np.array([[0, 0], [0, columns - 1], [rows - 1, 0], [rows - 1, columns - 1]])
    ground = ground_points(camera, pose, corners, 0.0)
    (west, south), (east, north) = ground[:, :2].min(axis=0), ground[:, :2].max(axis=0)
    x, y = np.meshgrid(np.linspace(west, east, columns), np.linspace(north, south, rows))
    return camera, pose, x, y, hill(x, y)


def hill(x, y):
    return 15 * np.sin((x - ORIGIN[0]) / 150) * np.cos((y - ORIGIN[1]) / 190)


def peer_camera(camera: Camera, pose: Pose):
    from orthority.camera import PinholeCamera

    size = (camera.columns, camera.rows)
    return PinholeCamera(
        im_size=size,
        focal_len=camera.focal_length_m,
        sensor_size=tuple(n * camera.pitch_m for n in size),
        xyz=tuple(pose.position.tolist()),
        opk=omega_phi_kappa(pose),
    )


def picture(rows: int, columns: int, bands: int) -> np.ndarray:
    r, c = np.mgrid[:rows, :columns]
    waves = [100 + 40 * np.sin(r / (20 + k)) + 40 * np.cos(c / (25 + k)) for k in range(bands)]
    return np.ascontiguousarray(np.stack(waves, axis=-1), np.float32)


def arrays(rows: int, columns: int, bands: int, method: str, repeats: int) -> dict:
    """Frame and heights in, rectified array out."""
    camera, pose, x, y, z = scene(rows, columns)
    frame = picture(rows, columns, bands)
    works = [lambda: rectify_onto(frame, camera, pose, x[:1], y[:, :1], z, method)]
    note = ""
    if PEER:
        from orthority.enums import Interp

        theirs, other = peer_camera(camera, pose), np.ascontiguousarray(np.moveaxis(frame, -1, 0))
        kind = Interp(method)
        works.append(lambda: theirs.remap(other, x, y, z, nodata=float("nan"), interp=kind)[0])
        ours, peer = works[0](), np.moveaxis(works[1](), 0, -1)
        note = f"{np.nanmax(np.abs(ours - peer)[2:-2, 2:-2]):.3f} of 160"
    found = median_ms(works, repeats)
    return row(f"array {rows}x{columns}x{bands} {method}", found, "camera.remap", note)


def jobs(rows: int, columns: int, bands: int, method: str, repeats: int) -> dict:
    """Frame and DEM in, rectified array out."""
    camera, pose, x, y, _ = scene(rows, columns)
    frame, gsd = picture(rows, columns, bands), 0.75 * 880 / columns
    dem_x, dem_y, heights = dem(x, y)
    # their grid is theirs to choose: it starts at the DEM's corner. Ours is laid on it.
    west, north = dem_x[0] - DEM_M / 2, dem_y[0] + DEM_M / 2
    area = (
        west + math.floor((x.min() - west) / gsd) * gsd, north - math.ceil((north - y.min()) / gsd) * gsd,
        west + math.ceil((x.max() - west) / gsd) * gsd, north - math.floor((north - y.max()) / gsd) * gsd,
    )  # fmt: skip
    metres = {"units": "m"}
    terrain = xr.Dataset(
        {"height": (("y", "x"), heights, metres)},
        coords={"y": ("y", dem_y, metres), "x": ("x", dem_x, metres)},
    )
    works = [lambda: rectify_array(frame, camera, pose, terrain, gsd, area, method)]
    note, name = "", f"job {rows}x{columns}x{bands} {method}"
    if not PEER:
        return row(name, median_ms(works, repeats), "", "")
    from orthority import Ortho

    place = from_origin(west, north, DEM_M, DEM_M)
    with MemoryFile() as image, MemoryFile() as ground:
        write(image, frame, None, None)
        write(ground, heights[..., None], CRS, place)
        with image.open() as source, ground.open() as dem_file:
            theirs = peer_camera(camera, pose)

            def peer():
                target = "/vsimem/peer.tif"
                Ortho(source, dem_file, theirs, CRS).process(
                    target, resolution=(gsd, gsd), interp=method, dem_interp="bilinear", write_mask=False,
                    creation_options={"tiled": True, "interleave": "pixel"}, build_ovw=False, overwrite=True,
                )  # fmt: skip
                return target

            works.append(peer)
            ours = works[0]()
            with rasterio.open(peer()) as file:
                ox, oy = file.transform.c, file.transform.f
                left, top = round((ox - area[0]) / gsd), round((area[3] - oy) / gsd)
                both = ours[top : top + file.height, left : left + file.width]
                difference = np.abs(np.moveaxis(file.read(), 0, -1)[: len(both), : both.shape[1]] - both)
            note = f"{np.nanmax(difference[4:-4, 4:-4]):.3f} of 160"
            return row(name, median_ms(works, repeats), "Ortho.process", note)


def dem(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Axes and heights of a raster about a grid."""
    dem_x = np.arange(x.min() - DEM_MARGIN_M, x.max() + DEM_MARGIN_M, DEM_M)
    dem_y = np.arange(y.max() + DEM_MARGIN_M, y.min() - DEM_MARGIN_M, -DEM_M)
    return dem_x, dem_y, hill(dem_x[None], dem_y[:, None]).astype(np.float32)


def write(target: MemoryFile, values: np.ndarray, crs, transform) -> None:
    """Write a raster in memory."""
    rows, columns, bands = values.shape
    profile = {"driver": "GTiff", "height": rows, "width": columns, "count": bands, "dtype": "float32"}
    profile |= {"crs": crs} if transform is None else {"crs": crs, "transform": transform}
    with target.open(**profile) as file:
        file.write(np.moveaxis(values, -1, 0))


def row(name: str, times: np.ndarray, peer: str, note: str) -> dict:
    """One line of the table; ``times`` are wall and processor time of ours and the peer's. [ms]"""
    found = {"name": name, "value": float(times[0, 0]), "unit": "ms", "cpu_ms": float(times[0, 1])}
    if len(times) == 1:
        return {**found, "peer": None, "peer_ms": None, "ratio": None, "cpu_ratio": None, "note": note}
    ratio, cpu_ratio = (times[1] / times[0]).tolist()
    beside = {"peer": f"orthority {peer}", "peer_ms": float(times[1, 0]), "peer_cpu_ms": float(times[1, 1])}
    return {**found, **beside, "ratio": ratio, "cpu_ratio": cpu_ratio, "note": note}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="Under a minute")
    parser.add_argument("--json", type=Path, help="Write the rows to this file")
    options = parser.parse_args()
    repeats = 5 if options.quick else 25
    rows = [arrays(560, 880, 1, method, repeats) for method in ("nearest", "bilinear", "cubic")]
    rows += [arrays(560, 880, 4, method, repeats) for method in ("nearest", "bilinear", "cubic")]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows += [jobs(560, 880, 1, method, repeats) for method in ("nearest", "bilinear", "cubic")]
        rows += [jobs(560, 880, 4, "bilinear", repeats), jobs(280, 440, 4, "bilinear", repeats)]
    print(f"{'what':30} {'ours ms':>8} {'orthority ms':>13} {'ratio':>7} {'cpu':>6}  largest difference")
    for r in rows:
        peer = "" if not r["ratio"] else f"{r['peer_ms']:13.1f} {r['ratio']:7.1f} {r['cpu_ratio']:6.1f}"
        print(f"{r['name']:30} {r['value']:8.2f} {peer}  {r['note']}")
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1))


if __name__ == "__main__":
    main()
