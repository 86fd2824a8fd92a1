"""Fly a case once and keep what its detectors may see, to try any of them again on the same light.

``python scripts/record_flight.py quickstart:31 braunschweig:31 --out FOLDER`` writes FOLDER/CASE-SEED.pkl for
each (read only what you wrote yourself: it is a pickle). A recording holds three sensors behind the same
lens, of the same light, poses and truth:

- ``flown``: the case's own;
- ``unpolarized``: the same with S1 = S2 = 0 in all light, which shows what is found without polarization;
- ``pan``: every element panchromatic.

Nobody asks for spectra. `scripts/calibrate_mosaic.py` and `scripts/compare_detectors.py` read recordings.
"""

import argparse
import pickle
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack import track
from glintrack.arrays import Array
from glintrack.camera import Camera, Pose
from glintrack.config import Case, find_case
from glintrack.ortho import orthorectify
from glintrack.records import Mosaic
from glintrack.results.epoch import Epoch
from glintrack.sensor import build_sensor, detector_readout, frame_of, mosaic_of, serve
from glintrack.simulate import frame_rngs, simulate
from glintrack.track.detect.detections import no_detections

SENSORS = ("flown", "unpolarized", "pan")


@dataclass(frozen=True)
class Recording:
    """One flight as three sensors saw it.

    Parameters
    ----------
    case
        The design flown.
    cameras
        Of the mosaics, by sensor.
    frames
        Time, reported pose and, by sensor, rectified image and mosaic.
    truths
        Of each frame, with ``visible_fraction``.
    terrain, lanes, extent_m
        Of the city.
    """

    case: Case
    cameras: dict[str, Camera]
    frames: tuple[tuple[float, Pose, dict[str, tuple[xr.Dataset, Mosaic]]], ...]
    truths: tuple[xr.Dataset, ...]
    terrain: xr.Dataset
    lanes: tuple[Array, ...]
    extent_m: tuple[float, float, float, float]

    def seen(self, sensor: str = "flown") -> Iterator[track.Frame]:
        """The frames for a tracker."""
        camera = self.cameras[sensor]
        for time_s, pose, pictures in self.frames:
            image, mosaic = pictures[sensor]
            yield track.Frame(time_s, image, mosaic, camera, pose, self.terrain)


class _Blind:
    """A detector that finds nothing."""

    def start(self, frame):
        return None

    def detect(self, state, frame):
        return no_detections()

    def update(self, state, frame, detections, association):
        return None


def fly(case: Case) -> Recording:
    """Fly a case without trackers."""
    case = case.replace({"channels": ("pan",), "track.query.policy": "none"})
    plain = case.sensor.replace({"layout": "pan", "demosaic": "superpixel"})
    frames, truths, kept, bare = [], [], {}, []

    def watch(epoch: Epoch) -> None:
        true_frame, city = epoch.true_frame, epoch.city
        pose, sensors = true_frame.reported_pose, {}
        if not bare:
            bare.append(build_sensor(plain, epoch.sky.wavelength_um))
        for name in SENSORS:
            sensor = bare[0] if name == "pan" else true_frame.sensor
            light = true_frame.radiance(sensor.channels).values
            if name == "unpolarized":
                light = light * np.array([1.0, *[0.0] * (light.shape[-1] - 1)], light.dtype)
            kept.setdefault("cameras", {})[name] = sensor.camera
            measured = detector_readout(light, sensor, frame_rngs(case.seed, epoch.index).noise)
            served = serve((), sensor, pose)
            frame = frame_of(measured, sensor, served, epoch.time_s)
            image = orthorectify(
                frame, camera=sensor.camera, terrain=city.terrain, gsd_m=case.ortho.gsd_m,
                area_m=city.extent_m, method=case.ortho.method, reported_pose=pose,
            )  # fmt: skip
            sensors[name] = image, mosaic_of(measured, sensor, served)
        frames.append((epoch.time_s, pose, sensors))
        truths.append(true_frame.truth)
        kept.update(
            terrain=city.terrain, lanes=tuple(np.asarray(l) for l in city.lanes), extent_m=city.extent_m
        )

    simulate(case, watch, trackers={"none": case.track}, detectors={"none": _Blind()})
    return Recording(case, frames=tuple(frames), truths=tuple(truths), **kept)


def recording_of(name: str, seed: int, folder: Path, frames: int | None = None) -> Recording:
    """The recording of a packaged case, flown if it is not in the folder yet."""
    path = folder / f"{name}-{seed}.pkl"
    if not path.exists():
        changes = {"seed": seed} | ({"flight.frames": frames} if frames else {})
        recording = fly(Case.from_toml(find_case(name)).replace(changes))
        folder.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(vars(recording), 5))
    return Recording(**pickle.loads(path.read_bytes()))


def main() -> None:
    """Fly what is not there yet."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("flights", nargs="+", help="CASE:SEED, packaged cases")
    parser.add_argument("--out", type=Path, required=True, help="folder of recordings")
    parser.add_argument("--frames", type=int, help="fly only so many of each")
    args = parser.parse_args()
    for flight in args.flights:
        name, seed = flight.split(":")
        print(flight, file=sys.stderr, flush=True)
        recording_of(name, int(seed), args.out, args.frames)


if __name__ == "__main__":
    main()
