"""What the detector `mosaic` loses to its background: the same flight with parts of it told by the truth.

``python scripts/measure_background.py [--flight quickstart:11] [--channel all]`` flies
(`scripts/record_flight.py`) and prints the probability of detection of visible moving vehicles in single
frames, at 20 and 40 false detections a frame, from frame 10 on, by `mosaic` without a tracker, and at 20
that of those near another vehicle and of those alone:

- as it is;
- with no vehicle learnt as ground, or none that moves: the truth masks them, with what they hide;
- with elements laid onto the true surface instead of the terrain, and drawn where the first frame saw them;
- with a map that is sharper, remembers longer, or has finer cells.

Each is scored by a law fitted to itself (`scripts/calibrate_mosaic.py`), so that none has another's law.
"""

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from unittest.mock import patch

import numba as nb
import numpy as np
from calibrate_mosaic import _label, fit, frame_for, joined
from record_flight import Recording, recorded
from scipy.spatial import KDTree

from glintrack.bounds.found import score_detections, threshold
from glintrack.case.build import build_scenario
from glintrack.core.heights import height_at
from glintrack.metrics.definitions import is_in_window, is_moving, is_visible
from glintrack.track.detect import mosaic, mosaic_calibration, mosaic_model
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detector import Association
from glintrack.track.detect.mosaic_geometry import element_places
from glintrack.track.detect.mosaic_peaks import FEATURES

SETTLED_FRAMES = 10
FALSE_PER_FRAME = 20, 40
NEAR_M, ALONE_M = 10.0, 15.0  # to the nearest other vehicle
GROWN_M = 0.8  # about a vehicle's box: an element's half
STEP_M = 0.4  # along lines of sight
SURFACE_M = 0.75


def measured(
    recording: Recording, channel: str, truth_masks: Callable | None = None, without: Sequence[str] = ()
) -> list[float]:
    """P_D at each of `FALSE_PER_FRAME`, and at the first of those near another and of those alone.

    The law is fitted without some of `mosaic_peaks.FEATURES`.
    """
    detector, state, last_s, frames = mosaic.MosaicDetector(DetectDesign()), None, None, []
    learn = mosaic_model.update_ground
    for k, (frame, truth) in enumerate(zip(recording.seen(), recording.truths, strict=True)):
        frame = frame_for(frame, channel, 0.0 if last_s is None else frame.time_s - last_s)
        state, last_s = detector.start(frame) if state is None else state, frame.time_s
        found = detector.detect(state, frame)
        if k >= SETTLED_FRAMES:
            frames.append(_seen(found.detail, frame.pose, truth, recording.extent_m))

        def masked(ground, seen, camera, mask, *times, frame=frame, truth=truth):
            more = truth_masks(ground, frame.pose, truth) if truth_masks else False
            return learn(ground, seen, camera, mask | more, *times)

        with patch.object(mosaic, "update_ground", masked):
            nobody = Association(np.zeros(len(found), bool), np.empty((0, 2)))
            state = detector.update(state, frame, found, nobody)
    kept = [k for k, name in enumerate(FEATURES) if name not in without]
    found = joined([one[0] for one in frames])
    law = fit([replace(found, features=found.features[:, kept])])
    vehicles, false, apart_m = [], [], []
    for _, features, standing_m, wanted, vehicle_m, length_m in frames:
        odds = law[0] + features[:, kept] @ law[1:]
        scored = score_detections(standing_m, odds, vehicle_m, length_m)
        vehicles.append(scored.vehicle[wanted])
        false.append(scored.false)
        apart_m.append(KDTree(vehicle_m).query(vehicle_m[wanted], k=2)[0][:, 1])
    first, second = (
        np.concatenate([threshold(false, most).detected(one) for one in vehicles]) for most in FALSE_PER_FRAME
    )
    nearest_m = np.concatenate(apart_m)
    near, alone = nearest_m < NEAR_M, nearest_m >= ALONE_M
    return [float(found.mean()) for found in (first, second, first[near], first[alone])]


def _seen(seen: mosaic.Seen, pose, truth, extent_m):
    """Labelled peaks, all peaks, and where and how long the vehicles are, of which some count."""
    off_m = pose.position[:2] - seen.place_m
    standing_m = seen.place_m + mosaic_calibration.HEIGHT_M / pose.up_m * off_m
    wanted = np.asarray(is_in_window(truth, extent_m) & is_moving(truth) & is_visible(truth))
    vehicle_m = np.stack([truth["east"].values, truth["north"].values], axis=1)
    labelled = _label(seen, pose, truth, extent_m)
    return labelled, seen.peaks.features, standing_m, wanted, vehicle_m, truth["length"].values


def vehicles_masked(ground: mosaic_model.Ground, pose, truth) -> np.ndarray:
    """Coarse cells of the ground that vehicles cover, or hide from the camera."""
    rows, columns = ground.differed_s.shape
    side = mosaic_model.COARSE
    east = ground.corner_m[0] + mosaic_model.CELL_M * (side * (np.arange(columns) + 0.5) - 0.5)
    north = ground.corner_m[1] - mosaic_model.CELL_M * (side * (np.arange(rows) + 0.5) - 0.5)
    mask = np.zeros((rows, columns), bool)
    names = ("east", "north", "heading", "length", "width", "height")
    for x, y, heading, length, width, height in zip(*(truth[n].values for n in names), strict=True):
        hidden = -height / pose.up_m * (pose.position[:2] - [x, y])
        reach = length + np.hypot(*hidden) + 2 * GROWN_M
        column, row = np.flatnonzero(abs(east - x) < reach), np.flatnonzero(abs(north - y) < reach)
        for share in (0.0, 0.5, 1.0):
            e, n = np.meshgrid(east[column] - x - share * hidden[0], north[row] - y - share * hidden[1])
            along = e * np.sin(heading) + n * np.cos(heading)
            across = e * np.cos(heading) - n * np.sin(heading)
            inside = (abs(along) < length / 2 + GROWN_M) & (abs(across) < width / 2 + GROWN_M)
            mask[np.ix_(row, column)] |= inside
    return mask


def movers_masked(ground: mosaic_model.Ground, pose, truth) -> np.ndarray:
    """The same of those that move."""
    return vehicles_masked(ground, pose, truth.isel(vehicle=np.flatnonzero(is_moving(truth))))


def places_on(surface, terrain) -> Callable:
    """`element_places` that meets a surface, and draws what it meets where the first frame saw it."""
    first, east, north = [], surface["x"].values, surface["y"].values
    ground = height_at(terrain, *np.meshgrid(east, north))
    standing = np.maximum(surface["height"].values - ground, 0.0)

    def places(camera, pose, terrain, corner_m, cell_m):
        x, y = element_places(camera, pose, terrain, corner_m, cell_m)
        first.append(np.asarray(pose.position, float))
        lenses = np.asarray(pose.position, float), first[0]
        _raise(x, y, standing, ground, (east[0], north[0], east[1] - east[0]), (*corner_m, cell_m), lenses)
        return x, y

    return places


@nb.njit
def _raise(x, y, standing, ground, raster, cells, lenses):
    """Move places on the ground to where the second lens sees what the first lens meets above them."""
    now, then = lenses
    rows, columns = standing.shape
    top = standing.max()
    for i in range(x.shape[0]):
        for j in range(x.shape[1]):
            east, north = cells[0] + cells[2] * x[i, j], cells[1] - cells[2] * y[i, j]
            c, r = (east - raster[0]) / raster[2] + 0.5, (raster[1] - north) / raster[2] + 0.5
            if not (0 <= c < columns and 0 <= r < rows):
                continue
            level, h = ground[int(r), int(c)], top
            right, up = (now[0] - east) / (now[2] - level), (now[1] - north) / (now[2] - level)
            while h > 0.3:
                c = (east + h * right - raster[0]) / raster[2] + 0.5
                r = (raster[1] - north - h * up) / raster[2] + 0.5
                if 0 <= c < columns and 0 <= r < rows and standing[int(r), int(c)] >= h:
                    break
                h -= STEP_M
            if h <= 0.3:
                continue
            share = h / (then[2] - level - h)
            east, north = east + h * right, north + h * up
            x[i, j] = (east - share * (then[0] - east) - cells[0]) / cells[2]
            y[i, j] = (cells[1] - north + share * (then[1] - north)) / cells[2]


def main() -> None:
    """Fly, measure, print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--flight", default="quickstart:11", help="CASE:SEED")
    parser.add_argument("--channel", default="all", choices=("pan", "dolp", "all"))
    args = parser.parse_args()
    recording = recorded(args.flight)
    surface = build_scenario(recording.case).observer.surface_model(SURFACE_M)
    rows: tuple[tuple[str, dict, Callable | None], ...] = (
        ("as it is", {}, None),
        ("no vehicle learnt", {}, vehicles_masked),
        ("none that moves learnt", {}, movers_masked),
        ("true surface", {"element_places": places_on(surface, recording.terrain)}, None),
        ("reach 1.4, memory 5 s", {"REACH": 1.4, "MEMORY_S": 5.0}, None),
        ("the same, cells of 0.5 m", {"REACH": 1.4, "MEMORY_S": 5.0, "CELL_M": 0.5, "COARSE": 3}, None),
    )
    print("| background | P_D at 20 false a frame | at 40 | at 20: another within 10 m | none within 15 m |")
    print("|" + " --- |" * 5)
    for name, changes, masks in rows:
        with patch.multiple(mosaic_model, **changes) if changes else patch.dict({}):
            found = measured(recording, args.channel, masks)
        print(f"| {name} | " + " | ".join(f"{p:.3f}" for p in found) + " |", flush=True)


if __name__ == "__main__":
    main()
