"""Cache of hits on disk: cases with one geometry are traced once.

Hits depend on scene, flight, time, sun, camera and the code that traces; not on filters, tracker or reported
pose.
"""

import json
import shutil
import struct
from collections.abc import Callable, Container
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numcodecs import Blosc

from glintrack.camera import Camera, Pose
from glintrack.case.build import decides_hits
from glintrack.case.design import Case
from glintrack.case.identity import digest, without_paths
from glintrack.core.arrays import Array
from glintrack.core.distortion import Distortion
from glintrack.flight import FlightDesign
from glintrack.io import cache
from glintrack.render import Hits, TracedFrame, frame_rays

# of a frame of the quickstart: 33 MB for 493 000 elements, 68 at 3 × 3 rays
_BYTES_PER_ELEMENT, _GROWTH = 67.0, 0.33
_MIN_FREE_SHARE = 0.1  # of the disk, below which nothing is written
_HITS = ".hits"
_TRACING_CODE = (
    "scene", "render", "flight", "camera.py", "core", "io", "data/materials.toml", "data/vehicles.toml",
    "data/cities.toml", "data/traffic",
)  # fmt: skip
_TRACING_PACKAGES = ("embreex", "eclipse-sumo")


def geometry(case: Case) -> str:
    """Hash of all that determines a case's hits but the time."""
    content = {**decides_hits(case), "code": _code_key()}
    return cache.content_stem(json.dumps(without_paths(content), sort_keys=True))


def frame_times(flight: FlightDesign) -> Array:
    """Time of each frame, as `flight.Flight.times_s`. [s]"""
    return flight.start_s + np.arange(flight.frames) / flight.rate_hz


@dataclass
class HitsCache:
    """Frames of one geometry on disk.

    Parameters
    ----------
    folder
        Folder of all geometries.
    geometry
        From `geometry`.
    keep
        Whether new frames are written, or the times of those that are; existing ones are always read.
    """

    folder: Path
    geometry: str
    keep: bool | Container[float] = True
    read: int = 0
    traced: int = 0
    bytes_kept: int = 0
    _own: Path = field(init=False)

    def __post_init__(self):
        """Set the folder of the geometry."""
        self._own = self.folder / self.geometry

    def contains(self, time_s: float) -> bool:
        """Return True if there is a file of a frame, complete or not."""
        return any(self._own.glob(f"{_stem(time_s)}-*{_HITS}"))

    def get(self, time_s: float, observe: Callable[[], TracedFrame]) -> TracedFrame:
        """Read a frame from the cache, or trace and write it; for `simulate`."""
        stem = _stem(time_s)
        try:
            data = cache.read(stem, _HITS, self._own)
        except OSError:  # of another user, in a shared folder
            data = None
        if data is not None:
            self.read += 1
            return unpack(data)
        traced = observe()
        self.traced += 1
        if self.keep is True or (self.keep and time_s in self.keep):
            self._store(stem, pack(traced))
        return traced

    def _store(self, stem: str, data: bytes) -> None:
        """Write a file if there is room: a cache must not stop a case or fill a disk."""
        try:
            self._own.mkdir(parents=True, exist_ok=True)
            disk = shutil.disk_usage(self._own)
            if disk.free - len(data) > _MIN_FREE_SHARE * disk.total:
                cache.store(stem, _HITS, self._own, data)
                self.bytes_kept += len(data)
        except OSError:
            self.keep = False


def entry_size_bytes(elements: int, rays: float) -> float:
    """Approximate size of a frame on disk. [byte]"""
    return elements * _BYTES_PER_ELEMENT * rays**_GROWTH


def pack(traced: TracedFrame) -> bytes:
    """Serialize a frame's hits without loss, without directions, which follow from camera and pose."""
    hits = traced.hits._asdict().items()
    arrays = {name: value for name, value in hits if name != "look" and isinstance(value, np.ndarray)}
    codec, layout, parts = Blosc(cname="lz4", clevel=1, shuffle=Blosc.SHUFFLE), [], []
    for name, value in {**arrays, "seen": np.asarray(traced.seen)}.items():
        planes = np.ascontiguousarray(np.moveaxis(value, -1, 0))  # components apart, for compression
        parts.append(bytes(codec.encode(planes)) if planes.nbytes else b"")
        layout.append([name, planes.dtype.str, list(planes.shape), len(parts[-1])])
    distortion = traced.camera.distortion
    head = {
        "camera": asdict(traced.camera) | {"distortion": distortion and distortion.model_dump()},
        "pose": asdict(traced.pose),
        "arrays": layout,
    }
    text = json.dumps(head).encode()
    return b"".join([struct.pack("<q", len(text)), text, *parts])


def unpack(data: bytes) -> TracedFrame:
    """Restore a frame's hits exactly."""
    length = struct.unpack_from("<q", data)[0]
    head, place = json.loads(data[8 : 8 + length]), 8 + length
    arrays, codec = {}, Blosc()
    for name, dtype, shape, size in head["arrays"]:
        planes = np.empty(shape, dtype)  # writable, as the arrays of a traced frame
        if size:
            codec.decode(data[place : place + size], planes)
        arrays[name] = np.ascontiguousarray(np.moveaxis(planes, 0, -1))
        place += size
    lens = head["camera"].pop("distortion")
    camera = Camera(**head["camera"], distortion=lens and Distortion(**lens))
    pose, seen = Pose(**head["pose"]), arrays.pop("seen")
    hits = Hits(rows=camera.rows, columns=camera.columns, look=frame_rays(camera, pose), **arrays)
    return TracedFrame(hits, seen, camera, pose)


def _stem(time_s: float) -> str:
    return cache.content_stem(f"frame at {float(time_s)!r} s")


@lru_cache
def _code_key() -> str:
    """Hash of source, data and packages that determine frames."""
    return digest(_TRACING_CODE, _TRACING_PACKAGES)
