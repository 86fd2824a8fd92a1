"""Cache of hits and light on disk: cases with one geometry are traced once.

Hits depend on scene, flight, time, sun, camera and the code that traces; not on filters, tracker or reported
pose. Light is the radiance in the sensor's channels before the lens; it depends on sky and materials too.
"""

import json
import shutil
import struct
from collections.abc import Callable, Container, Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numcodecs import Blosc

from glintrack.camera import Camera, Pose
from glintrack.case.build import decides_hits
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.distortion import Distortion
from glintrack.flight import FlightDesign
from glintrack.io import cache
from glintrack.io.atomic import content_hash
from glintrack.render import Hits, Observer, TracedFrame, frame_rays
from glintrack.study.plan import digest, without_paths

# of a frame of the quickstart: 33 MB for 493 000 elements, 68 at 3 × 3 rays
_BYTES_PER_ELEMENT, _GROWTH = 67.0, 0.33
_LIGHT_BYTES = 27.5  # of each element, in three channels
_MIN_FREE_SHARE = 0.1  # of the disk, below which nothing is written
_HITS, _LIGHT = ".hits", ".light"
_TRACING_CODE = ("scene", "render", "flight", "camera.py", "core", "data/materials.toml", "data/traffic")
_SHADING_CODE = ("core", "render", "stokes.py")
_TRACING_PACKAGES = ("embreex", "eclipse-sumo")


def geometry(case: Case) -> str:
    """Hash of all that determines a case's hits but the time."""
    content = {**decides_hits(case), "code": _code_key(_TRACING_CODE)}
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
        if (data := self._load(stem, _HITS)) is not None:
            self.read += 1
            return unpack(data)
        traced = observe()
        self.traced += 1
        self._store(time_s, stem + _HITS, lambda: pack(traced))
        return traced

    def light(
        self, time_s: float, observer: Observer, channels: Array, shade: Callable[[], xr.DataArray]
    ) -> xr.DataArray:
        """Read the light of a frame from the cache, or shade and write it; for `simulate`."""
        stem = _stem(time_s, _light_key(observer, channels))
        if (data := self._load(stem, _LIGHT)) is not None:
            return unpack_light(data)
        light = shade()
        self._store(time_s, stem + _LIGHT, lambda: pack_light(light))
        return light

    def _load(self, stem: str, suffix: str) -> bytes | None:
        try:
            return cache.read(stem, suffix, self._own)
        except OSError:  # of another user, in a shared folder
            return None

    def _store(self, time_s: float, name: str, pack: Callable[[], bytes]) -> None:
        """Write a file if there is room: a cache must not stop a case or fill a disk."""
        if not (self.keep is True or (self.keep and time_s in self.keep)):
            return
        stem, _, suffix = name.rpartition(".")
        try:
            self._own.mkdir(parents=True, exist_ok=True)
            disk, data = shutil.disk_usage(self._own), pack()
            if disk.free - len(data) > _MIN_FREE_SHARE * disk.total:
                cache.store(stem, f".{suffix}", self._own, data)
                self.bytes_kept += len(data)
        except OSError:
            self.keep = False


def entry_size_bytes(elements: int, rays: float) -> float:
    """Approximate size of a frame and its light on disk. [byte]"""
    return elements * (_BYTES_PER_ELEMENT * rays**_GROWTH + _LIGHT_BYTES)


def pack(traced: TracedFrame) -> bytes:
    """Serialize a frame's hits without loss, without directions, which follow from camera and pose."""
    hits = traced.hits._asdict().items()
    arrays = {name: value for name, value in hits if name != "look" and isinstance(value, np.ndarray)}
    distortion = traced.camera.distortion
    head = {
        "camera": asdict(traced.camera) | {"distortion": distortion and distortion.model_dump()},
        "pose": asdict(traced.pose),
    }
    return _pack(head, {**arrays, "seen": np.asarray(traced.seen)})


def unpack(data: bytes) -> TracedFrame:
    """Restore a frame's hits exactly."""
    head, arrays = _unpack(data)
    lens = head["camera"].pop("distortion")
    camera = Camera(**head["camera"], distortion=lens and Distortion(**lens))
    pose = Pose(**head["pose"])
    seen = arrays.pop("seen")
    hits = Hits(rows=camera.rows, columns=camera.columns, look=frame_rays(camera, pose), **arrays)
    return TracedFrame(hits, seen, camera, pose)


def pack_light(light: xr.DataArray) -> bytes:
    """Serialize the light of a frame without loss."""
    apart = np.swapaxes(light.values, -1, -2)
    return _pack({"dims": light.dims, "attrs": light.attrs}, {"light": apart})


def unpack_light(data: bytes) -> xr.DataArray:
    """Restore the light of a frame exactly."""
    head, arrays = _unpack(data)
    values, coords = np.swapaxes(arrays["light"], -1, -2), {"stokes": ["I", "Q", "U"]}
    return xr.DataArray(values, coords, head["dims"], attrs=head["attrs"])


def _pack(head: Mapping[str, Any], arrays: Mapping[str, Array]) -> bytes:
    """Header and arrays as compressed bytes, with the components of vectors apart, for compression."""
    codec = Blosc(cname="lz4", clevel=1, shuffle=Blosc.SHUFFLE)
    layout, parts = [], []
    for name, value in arrays.items():
        planes = np.ascontiguousarray(np.moveaxis(value, -1, 0))
        parts.append(bytes(codec.encode(planes)) if planes.nbytes else b"")
        layout.append([name, planes.dtype.str, list(planes.shape), len(parts[-1])])
    text = json.dumps({**head, "arrays": layout}).encode()
    return b"".join([struct.pack("<q", len(text)), text, *parts])


def _unpack(data: bytes) -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and arrays of `_pack`."""
    length = struct.unpack_from("<q", data)[0]
    head, place = json.loads(data[8 : 8 + length]), 8 + length
    arrays, codec = {}, Blosc()
    for name, dtype, shape, size in head["arrays"]:
        planes = np.empty(shape, dtype)  # writable, as the arrays of a traced frame
        if size:
            codec.decode(data[place : place + size], planes)
        arrays[name] = np.ascontiguousarray(np.moveaxis(planes, 0, -1))
        place += size
    return head, arrays


def _light_key(observer: Observer, channels: Array) -> str:
    """Hash of all that determines a frame's light but its hits: sky, materials, channels and code."""
    sky, materials = observer.sky, observer.city.materials
    arrays = [getattr(sky, f.name) for f in fields(sky)] + [materials[name].values for name in materials]
    parts: list[str | bytes] = [_code_key(_SHADING_CODE)]
    for one in map(np.asarray, [*arrays, np.asarray(channels, float)]):
        parts.append(f"{one.dtype.str}{one.shape}".encode())
        values = str(one.tolist()).encode() if one.dtype == object else np.ascontiguousarray(one).tobytes()
        parts.append(values)
    return content_hash(parts)


def _stem(time_s: float, light: str = "") -> str:
    return cache.content_stem(f"frame at {float(time_s)!r} s{light and f' lit by {light}'}")


@lru_cache
def _code_key(parts: tuple[str, ...]) -> str:
    """Hash of source, data and packages that determine frames."""
    return digest(parts, _TRACING_PACKAGES)
