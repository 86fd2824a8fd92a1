"""Rectification beside orthority's: the same frame, camera, pose, grid and heights, in turns in one run.

``python benchmarks/ortho.py [--quick] [--json FILE]``. The median of the alternations counts; ``ratio`` is
orthority's time over ours. Arrays: both get the frame and the places of the grid's cells in memory and give
the rectified array (orthority: projection in NumPy, then OpenCV's remap; ours: one compiled pass, cubic with
a = −1/2 where OpenCV has −3/4). Files: both read the image and the DEM and write a compressed GeoTIFF
(orthority: GTiff; ours: COG with overviews). The largest difference between the two results is printed beside
the times. Without orthority only our own times are given.
"""

import argparse
import importlib.util
import json
import math
import tempfile
import time
import warnings
from pathlib import Path

import numpy as np
import rasterio
from rasterio.transform import from_origin

from glintrack.camera import Camera, Pose, ground_points, look_at, omega_phi_kappa
from glintrack.cli_ortho import ortho
from glintrack.ortho import rectify_onto

PEER = importlib.util.find_spec("orthority") is not None
ORIGIN = (604000.0, 5792000.0)
CRS = "EPSG:32632"


def median_ms(works, repeats: int) -> list[float]:
    """Median time of each, run in turns after one warm-up."""
    for work in works:
        work()
    times = np.empty((repeats, len(works)))
    for k in range(repeats):
        for which, work in enumerate(works):
            start = time.perf_counter()
            work()
            times[k, which] = 1e3 * (time.perf_counter() - start)
    return np.median(times, axis=0).tolist()


def scene(rows: int, columns: int):
    """A camera 50° off nadir at 3000 m slant range, and the ground it sees over rolling terrain."""
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


def arrays(rows: int, columns: int, bands: int, method: str, repeats: int) -> dict:
    """Frame in, rectified array out."""
    camera, pose, x, y, z = scene(rows, columns)
    r, c = np.mgrid[:rows, :columns]
    waves = [40 * np.sin(r / (20 + k)) + 40 * np.cos(c / (25 + k)) for k in range(bands)]
    frame = np.ascontiguousarray(np.stack(waves, axis=-1), np.float32)
    works = [lambda: rectify_onto(frame, camera, pose, x, y, z, method)]
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


def files(rows: int, columns: int, folder: Path, repeats: int) -> dict:
    """Image and DEM files in, GeoTIFF out."""
    camera, pose, x, y, _ = scene(rows, columns)
    r, c = np.mgrid[:rows, :columns]
    frame = (100 + 40 * np.sin(r / 20) + 40 * np.cos(c / 25)).astype(np.float32)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        write(folder / "frame.tif", frame, None, None)
    step, margin = 10.0, 400.0
    dem_x, dem_y = (
        np.arange(x.min() - margin, x.max() + margin, step),
        np.arange(y.max() + margin, y.min() - margin, -step),
    )
    corner = from_origin(dem_x[0] - step / 2, dem_y[0] + step / 2, step, step)
    write(folder / "dem.tif", hill(dem_x[None], dem_y[:, None]).astype(np.float32), CRS, corner)
    size = f"rows = {rows}\ncolumns = {columns}\n"
    (folder / "camera.toml").write_text(f"focal_length_mm = 68\npitch_um = {camera.pitch_m * 1e6!r}\n{size}")
    angles = zip(("omega_deg", "phi_deg", "kappa_deg"), map(math.degrees, omega_phi_kappa(pose)), strict=True)
    keys = [("easting_m", pose.east_m), ("northing_m", pose.north_m), ("height_m", pose.up_m), *angles]
    (folder / "pose.toml").write_text(f'crs = "{CRS}"\n' + "\n".join(f"{k} = {v!r}" for k, v in keys))
    gsd = 2640.0 / columns / 4

    def ours():
        paths = {name: folder / f"{name}.toml" for name in ("camera", "pose")}
        ortho(folder / "frame.tif", **paths, output=folder / "ours.tif", dem=folder / "dem.tif", gsd=gsd)

    works = [ours]
    if PEER:
        from orthority import Ortho

        theirs = peer_camera(camera, pose)

        def peer():
            job = Ortho(folder / "frame.tif", folder / "dem.tif", theirs, CRS)
            job.process(
                folder / "peer.tif", resolution=(gsd, gsd), interp="bilinear", dem_interp="bilinear",
                write_mask=False, compress="deflate", build_ovw=True, overwrite=True,
            )  # fmt: skip

        works.append(peer)
    return row(f"file {rows}x{columns} bilinear", median_ms(works, repeats), "Ortho.process", "")


def write(path: Path, values: np.ndarray, crs, transform) -> None:
    rows, columns = values.shape
    profile = {
        "driver": "GTiff",
        "height": rows,
        "width": columns,
        "count": 1,
        "dtype": "float32",
        "crs": crs,
    }
    if transform is not None:
        profile["transform"] = transform
    with rasterio.open(path, "w", **profile) as file:
        file.write(values, 1)


def row(name: str, times: list[float], peer: str, note: str) -> dict:
    ratio = times[1] / times[0] if len(times) > 1 else None
    return {
        "name": name, "value": times[0], "unit": "ms", "peer": f"orthority {peer}" if ratio else None,
        "peer_ms": times[1] if ratio else None, "ratio": ratio, "note": note,
    }  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--quick", action="store_true", help="Under a minute")
    parser.add_argument("--json", type=Path, help="Write the rows to this file")
    options = parser.parse_args()
    repeats = 5 if options.quick else 25
    rows = [arrays(560, 880, 1, method, repeats) for method in ("nearest", "bilinear", "cubic")]
    rows.append(arrays(560, 880, 4, "bilinear", repeats))
    if not options.quick:
        rows.append(arrays(2800, 4400, 3, "bilinear", 5))
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        rows.append(files(560, 880, Path(folder), 3 if options.quick else 9))
    print(f"{'what':34} {'ours ms':>9} {'orthority ms':>13} {'ratio':>7}  largest difference")
    for r in rows:
        peer = f"{r['peer_ms']:13.1f} {r['ratio']:7.1f}" if r["ratio"] else f"{'-':>13} {'-':>7}"
        print(f"{r['name']:34} {r['value']:9.1f} {peer}  {r['note']}")
    if options.json:
        options.json.write_text(json.dumps({"rows": rows}, indent=1))


if __name__ == "__main__":
    main()
