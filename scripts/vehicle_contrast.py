"""How far vehicles stand out in pan and in DoLP, and what takes it away: the light, the mosaic or the noise.

    python scripts/vehicle_contrast.py [--frames 8] [--cases "toward the sun" …] [--csv FILE]

Frames of the quickstart's city at 2 Hz are rectified three ways: the light itself over each superpixel, the
mean of many exposures (the mosaic without its noise), and one exposure, as flown; the last two by each
demosaicker over the same readings. A cell's change is its distance from its median over the frames, in units
of how much the cells about it change (the median over 21 × 21 of it). The threshold is such that one of a
hundred cells far from any vehicle passes; a vehicle stands out if a cell within 2 m of its centre does. No
tracker has a part in it.
"""

import argparse
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.ndimage import median_filter

from glintrack import Case, simulate
from glintrack.case.packaged import find_case
from glintrack.ortho import orthorectify
from glintrack.render import keep_frames
from glintrack.sensor import build_sensor, frame_of, light_on_elements, noiseless_frame, read_out, serve

EXPOSURES = 16  # leave a quarter of the noise
FALSE_SHARE = 0.01
REACH_M, FAR_M = 2.0, 9.0
DEMOSAICKERS = ("bilinear", "ppid", "eari", "superpixel")
CASES = {
    "toward the sun": {},
    "away from the sun": {"flight": {"azimuth_from_sun_deg": 168.0}},
    "toward, no trees": {"scene": {"trees": False}},
    "nadir": {"flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0}},
    "toward, 8.5 µm, 0.75 m": {
        "sensor": {"pitch_um": 8.5, "rows": 1120, "columns": 1760},
        "ortho": {"gsd_m": 0.75},
    },
}


def build_case(changes: dict, frames: int) -> Case:
    """The quickstart with some keys changed, and a detector that costs little."""
    values = Case.from_toml(find_case("quickstart")).model_dump()
    values["flight"]["frames"] = frames
    values["channels"], values["track"]["query"]["policy"] = ["pan"], "none"
    values["track"]["detect"]["detector"] = "background"
    for table, keys in changes.items():
        values[table] |= keys
    return Case.model_validate(values)


def rectified(case: Case) -> tuple[dict[str, np.ndarray], list[np.ndarray], tuple]:
    """Images (frame, y, x) by way and product, where visible vehicles are in each, and the grid."""
    images: dict[str, list[np.ndarray]] = {}
    places, grid, sensors, rng = [], [], {}, np.random.default_rng(case.seed)

    def keep(epoch) -> None:
        for name in DEMOSAICKERS if not sensors else ():
            design = case.sensor.replace({"demosaic": name})
            sensors[name] = build_sensor(design, epoch.sky.wavelength_um)
        sensor = sensors["bilinear"]
        light = keep_frames(epoch.observer.radiance(epoch.hits))
        planes = light_on_elements(light(sensor.channels).values, sensor)
        read = [read_out(planes, sensor, rng) for _ in range(EXPOSURES)]
        nobody = serve((), sensor, epoch.reported_pose)
        ways = {"light": noiseless_frame(light, sensor)}
        for name, one in sensors.items():
            once = [frame_of(readings, one, nobody, epoch.time_s) for readings in read]
            mean = once[0].copy()
            for product in ("pan", "stokes_radiance"):
                mean[product] = once[0][product].copy(data=np.mean([f[product].values for f in once], axis=0))
            ways |= {f"{name}, mean": mean, f"{name}, as flown": once[0]}
        for way, frame in ways.items():
            image = orthorectify(
                frame, epoch.camera, epoch.reported_pose, epoch.city.terrain, case.ortho.gsd_m,
                epoch.city.extent_m, case.ortho.method,
            )  # fmt: skip
            for product in ("pan", "dolp"):
                images.setdefault(f"{way}/{product}", []).append(image[product].values)
            grid[:] = [image["x"].values, image["y"].values]
        truth = epoch.city.truth(epoch.time_s)
        visible = epoch.score.visible
        all_m = np.stack([truth["east"].values, truth["north"].values], axis=1)
        places.append((all_m, all_m[visible]))

    simulate(case, keep)
    return {name: np.stack(stack) for name, stack in images.items()}, places, tuple(grid)


def standing_out(stack: np.ndarray, places: list, grid: tuple) -> tuple[float, float]:
    """Share of visible vehicles that stand out, and the median change of vehicles. [1]"""
    east, north = grid
    change = np.abs(stack - np.nanmedian(stack, axis=0))
    change = np.where(np.isfinite(change), change, 0)
    scale = median_filter(np.median(change, axis=0), 21)
    change /= np.maximum(scale, 1e-9)
    far, best = [], []
    for image, (every, visible) in zip(change, places, strict=True):
        near = np.zeros(image.shape, bool)
        for e, n in every:
            y, x = np.flatnonzero(np.abs(north - n) < FAR_M), np.flatnonzero(np.abs(east - e) < FAR_M)
            if len(y) and len(x):
                near[y[0] : y[-1] + 1, x[0] : x[-1] + 1] = True
        far.append(image[~near & (scale > 1e-6)])
        for e, n in visible:
            y, x = np.flatnonzero(np.abs(north - n) < REACH_M), np.flatnonzero(np.abs(east - e) < REACH_M)
            if len(y) and len(x):
                best.append(image[y[0] : y[-1] + 1, x[0] : x[-1] + 1].max())
    threshold = np.quantile(np.concatenate(far), 1 - FALSE_SHARE)
    return float(np.mean(np.array(best) > threshold)), float(np.median(best) / threshold)


def main() -> None:
    """Print the table and, if asked, write it."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--cases", nargs="*", default=list(CASES))
    parser.add_argument("--csv", type=Path)
    given = parser.parse_args()
    rows = []
    for name in given.cases:
        stacks, places, grid = rectified(build_case(CASES[name], given.frames))
        for label, stack in stacks.items():
            way, product = label.split("/")
            share, strength = standing_out(stack, places, grid)
            rows.append((name, way, product, sum(len(v) for _, v in places), share, strength))
            print(f"{name:24s} {way:20s} {product:5s} {rows[-1][3]:5d} vehicles, {share:.3f} stand out, "
                  f"median {strength:.2f} thresholds", flush=True)  # fmt: skip
    if given.csv:
        columns = ["case", "way", "product", "vehicles", "share", "median_over_threshold"]
        pd.DataFrame(rows, columns=columns).to_csv(given.csv, index=False, float_format="%.4g")


if __name__ == "__main__":
    main()
