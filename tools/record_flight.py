"""Fly a case once and keep in memory what its detectors may see, to try any of them on the same light.

A recording holds three sensors behind the same lens, of the same light, poses and truth:

- ``own``: the case's own;
- ``unpolarized``: the same behind a depolarizer (S1 = S2 = 0): what is found without polarization;
- ``pan``: every element panchromatic.

Nobody asks for spectra. A flight of `quickstart` takes about 1 GB. `tools/calibrate.py mosaic` and
`benchmarks/detectors.py` use it.
"""

import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr

from glintrack import track
from glintrack.camera import Camera, Pose
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.arrays import Array
from glintrack.core.records import Mosaic
from glintrack.dataset.plan import STANDARD_CITIES
from glintrack.loop import frame_rngs, simulate
from glintrack.ortho import orthorectify
from glintrack.results.epoch import Epoch
from glintrack.sensor import array_readout, build_sensor, frame_of, mosaic_of, serve, smear
from glintrack.track.detect.detections import no_detections

SENSORS = ("own", "unpolarized", "pan")


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

    def sensor_frames(self, sensor: str = "own") -> Iterator[track.Frame]:
        """Yield the frames for a tracker."""
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


def record_case(case: Case) -> Recording:
    """Fly a case without trackers."""
    case = case.replace({"channels": ("pan",), "track.query.policy": "none"})
    others = {
        "unpolarized": case.sensor.replace({"optics.depolarizer": True}),
        "pan": case.sensor.replace({"layout": "pan", "demosaic": "superpixel"}),
    }
    frames, truths, kept, built = [], [], {}, {}

    def watch(epoch: Epoch) -> None:
        true_frame, city = epoch.true_frame, epoch.city
        pose, sensors = true_frame.reported_pose, {}
        if not built:
            built.update((n, build_sensor(d, epoch.sky.wavelength_um)) for n, d in others.items())
        for name in SENSORS:
            sensor = built.get(name, true_frame.sensor)
            light = smear(true_frame.light, true_frame.motion)(sensor.channels).values
            kept.setdefault("cameras", {})[name] = sensor.camera
            measured = array_readout(light, sensor, frame_rngs(case.seed, epoch.index).noise)
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


def record_flight(flight: str, changes: Sequence[str] = ()) -> Recording:
    """Record a packaged case, or a city with the flight of `quickstart`.

    Parameters
    ----------
    flight
        ``NAME:SEED``. A packaged case flies with the seed as its noise's. ``embedded`` is a city of its own
        for each seed: paints, roofs and trees, and traffic that SUMO drives; ``berlin`` and ``wildau`` are
        the networks of the standard dataset.
    changes
        Keys of the case changed, each as ``KEY=VALUE`` in TOML.
    """
    name, seed = flight.split(":")
    own = {"seed": int(seed)}
    if name == "embedded":  # longer than the recording that is shipped, so that SUMO drives
        own |= {"scene.seed": int(seed), "scene.traffic_duration_s": 130.0, "flight.start_s": 20.0}
    elif name in ("berlin", "wildau"):
        own |= {f"scene.{key}": value for key, value in STANDARD_CITIES[name].items()}
    packaged = "quickstart" if name in ("embedded", "berlin", "wildau") else name
    pairs = [change.split("=", 1) for change in changes]
    values = {key: tomllib.loads(f"value = {value}")["value"] for key, value in pairs}
    return record_case(Case.from_toml(find_case(packaged)).replace({**own, **values}))
