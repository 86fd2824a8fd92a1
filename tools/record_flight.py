"""Simulate a case without trackers and keep what detectors may see, to try any of them on the same light.

`write_recording` keeps what the detector `mosaic` needs, about 1 MB for each frame. Nobody asks for spectra.
`tools/calibrate.py` and the benchmarks of detectors and trackers use it.
"""

import json
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr

from glintrack import track
from glintrack.camera import Camera, Pose
from glintrack.case.design import Case
from glintrack.case.packaged import find_case
from glintrack.core.records import Mosaic
from glintrack.dataset.plan import STANDARD_CITIES
from glintrack.io.netcdf import read_dataset, write_dataset
from glintrack.loop import frame_rngs, simulate
from glintrack.ortho import orthorectify
from glintrack.results.epoch import Epoch
from glintrack.sensor import array_readout, frame_of, mosaic_of, serve, smear
from glintrack.track.detect.detections import no_detections
from glintrack.track.detect.frame import Grid


@dataclass(frozen=True)
class Recording:
    """One simulated flight.

    Parameters
    ----------
    case
        Design of the flight.
    frames
        Frames for a tracker, with reported poses.
    truths
        Truth of each frame, with ``visible_fraction``.
    extent_m
        Window of the city: west, south, east, north. [m]
    """

    case: Case
    frames: tuple[track.Frame, ...]
    truths: tuple[xr.Dataset, ...]
    extent_m: tuple[float, float, float, float]


class _Blind:
    """A detector that finds nothing."""

    def start(self, frame):
        return None

    def detect(self, state, frame):
        return no_detections()

    def update(self, state, frame, detections, association):
        return None


def record_case(case: Case) -> Recording:
    """Simulate a case without trackers."""
    case = case.replace({"channels": ("pan",), "track.query.policy": "none"})
    frames, truths, extents = [], [], []

    def watch(epoch: Epoch) -> None:
        true_frame, city = epoch.true_frame, epoch.city
        pose, sensor = true_frame.reported_pose, true_frame.sensor
        light = smear(true_frame.light, true_frame.motion)(sensor.channels).values
        measured = array_readout(light, sensor, frame_rngs(case.seed, epoch.index).noise)
        served = serve((), sensor, pose)
        image = orthorectify(
            frame_of(measured, sensor, served, epoch.time_s), camera=sensor.camera, terrain=city.terrain,
            gsd_m=case.ortho.gsd_m, area_m=city.extent_m, method=case.ortho.method, reported_pose=pose,
        )  # fmt: skip
        mosaic = mosaic_of(measured, sensor, served)
        frames.append(track.Frame(epoch.time_s, image, mosaic, sensor.camera, pose, city.terrain))
        truths.append(true_frame.truth)
        extents.append(city.extent_m)

    simulate(case, watch, trackers={"none": case.track}, detectors={"none": _Blind()})
    return Recording(case, tuple(frames), tuple(truths), extents[-1])


def case_of(flight: str, changes: Sequence[str] = ()) -> Case:
    """Make a packaged case, or a city with the flight of `quickstart`.

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
    return Case.from_toml(find_case(packaged)).replace({**own, **values})


def record_flight(flight: str, changes: Sequence[str] = ()) -> Recording:
    """Record a case (see `case_of`)."""
    return record_case(case_of(flight, changes))


def write_recording(path: Path, recording: Recording) -> None:
    """Write a recording without its images, of which detectors for mosaics need the grid."""
    first, elements = recording.frames[0], ("time", "row", "column")
    truths = [
        truth.assign(frame=("vehicle", np.full(truth.sizes["vehicle"], k)))
        for k, truth in enumerate(recording.truths)
    ]
    mosaics = [frame.mosaic for frame in recording.frames]
    poses = [[v for v in vars(one.pose).values() if not isinstance(v, str)] for one in recording.frames]
    kept = xr.concat(truths, "vehicle").assign(
        electrons=(elements, np.stack([one.electrons for one in mosaics])),
        sigma_e=(elements, np.stack([one.sigma_e for one in mosaics])),
        gains=(("side", "side2", "component"), first.mosaic.gains),
        pose=(("time", "angle"), poses),
        ground=first.terrain["height"].rename(y="north", x="east"),
        **{name: first.image[name] for name in "yx"},
    )
    about = {
        "layout": json.dumps(first.mosaic.layout), "extent_m": recording.extent_m,
        "lens": [first.camera.focal_length_m, first.camera.pitch_m],
    }  # fmt: skip
    write_dataset(path, kept.assign_coords(time=[one.time_s for one in recording.frames]).assign_attrs(about))


def read_recording(path: Path, case: Case) -> Recording:
    """Read a recording of a case."""
    kept = read_dataset(path, str(path))
    layout = tuple(tuple(row) for row in json.loads(kept.attrs["layout"]))
    names = [n for n, v in kept.data_vars.items() if v.dims == ("vehicle",) and n != "frame"]
    camera = Camera(*kept.attrs["lens"], *kept["electrons"].shape[1:])
    terrain = xr.Dataset({"height": kept["ground"].rename(north="y", east="x")})
    y, x = kept["y"].values, kept["x"].values
    grid = Grid((len(y), len(x)), (float(x[0]), float(y[0])), float(x[1] - x[0]))
    frames, truths = [], []
    for k, time_s in enumerate(kept["time"].values.tolist()):
        one = kept.isel(time=k)
        mosaic = Mosaic(one["electrons"].values, one["sigma_e"].values, layout, kept["gains"].values)
        pose = Pose(*one["pose"].values.tolist(), "reported")
        frames.append(track.Frame(time_s, None, mosaic, camera, pose, terrain, grid=grid))
        truths.append(kept[names].isel(vehicle=np.flatnonzero(kept["frame"].values == k)))
    return Recording(case, tuple(frames), tuple(truths), tuple(kept.attrs["extent_m"]))
