"""Hits and light kept on disk, addressed by what decides them: cases of one geometry trace only once.

Hits depend neither on filters nor on tracker nor on reported pose. What decides a frame's are the scene, the
flight and its time, the sun, the camera and the code that traces. Light is that in the sensor's channels
before the lens, and is decided by the sky and the materials as well: what is behind the lens shades nothing
anew.
"""

import json
import shutil
import struct
from collections.abc import Callable, Container, Iterable, Mapping
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

# of a frame of the quickstart, probes too: 33 MB for 493 000 elements, 68 at 3 × 3 rays
_BYTES_AN_ELEMENT, _GROWTH = 67.0, 0.33
_LIGHT_BYTES = 27.5  # of each element, in three channels
_MIN_FREE_SHARE = 0.1  # of the disk: less than this left, and no more is kept
_HITS, _LIGHT = ".hits", ".light"
_TRACING_CODE = (
    "scene",
    "render",
    "flight",
    "camera.py",
    "core",
    "data/materials.toml",
    "data/traffic",
)
_SHADING_CODE = ("core", "render", "stokes.py")
_TRACING_PACKAGES = ("embreex", "eclipse-sumo")


def geometry(case: Case) -> str:
    """Hash of all that decides a case's hits but the time; cases that share it share their frames."""
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
        Of all geometries.
    geometry
        From `geometry`.
    keeps
        Whether what has to be traced is kept for others, or the times of which it is; what is there is read
        in any case.
    """

    folder: Path
    geometry: str
    keeps: bool | Container[float] = True
    read: int = 0
    traced: int = 0
    lit: int = 0
    bytes_kept: int = 0
    _own: Path = field(init=False)

    def __post_init__(self):
        """One folder a geometry, so that no listing grows with the study."""
        self._own = self.folder / self.geometry

    def holds(self, time_s: float) -> bool:
        """Whether a frame is there, without a look at whether it is whole."""
        return any(self._own.glob(f"{_stem(time_s)}-*{_HITS}"))

    def get(self, time_s: float, observe: Callable[[], TracedFrame]) -> TracedFrame:
        """The frame from the cache, or traced and kept; for `simulate`."""
        data = self._read(_stem(time_s), _HITS)
        if data is not None:
            self.read += 1
            return unpack(data)
        traced = observe()
        self.traced += 1
        if self._wants(time_s):
            self._keep(_stem(time_s), _HITS, pack(traced))
        return traced

    def light(
        self, time_s: float, observer: Observer, channels: Array, shade: Callable[[], xr.DataArray]
    ) -> xr.DataArray:
        """Light of a frame in some channels from the cache, or shaded and kept; for `simulate`."""
        stem = _stem(time_s, _light_address(observer, channels))
        data = self._read(stem, _LIGHT)
        if data is not None:
            return unpack_light(data)
        found = shade()
        self.lit += 1
        if self._wants(time_s):
            self._keep(stem, _LIGHT, pack_light(found))
        return found

    def _read(self, stem: str, suffix: str) -> bytes | None:
        try:
            return cache.read(stem, suffix, self._own)
        except OSError:  # another user's, in a shared folder
            return None

    def _wants(self, time_s: float) -> bool:
        return self.keeps is True or bool(self.keeps and time_s in self.keeps)

    def _keep(self, stem: str, suffix: str, data: bytes) -> None:
        """Put a file there if there is room: a cache never stops a case, nor fills a disk."""
        try:
            self._own.mkdir(parents=True, exist_ok=True)
            disk = shutil.disk_usage(self._own)
            if disk.free - len(data) > _MIN_FREE_SHARE * disk.total:
                cache.keep(stem, suffix, self._own, data)
                self.bytes_kept += len(data)
        except OSError:
            self.keeps = False


def packed_bytes(elements: int, rays: float) -> float:
    """About what a frame and its light take on disk: samples are fewer than the rays of each element."""
    return elements * (_BYTES_AN_ELEMENT * rays**_GROWTH + _LIGHT_BYTES)


def pack(traced: TracedFrame) -> bytes:
    """A frame's hits without loss, less directions of look, which follow from camera and pose."""
    arrays = {f.name: getattr(traced.hits, f.name) for f in fields(traced.hits) if f.name != "look"}
    arrays = {name: value for name, value in arrays.items() if isinstance(value, np.ndarray)}
    distortion = traced.camera.distortion
    head = {
        "camera": asdict(traced.camera) | {"distortion": distortion and distortion.model_dump()},
        "pose": asdict(traced.pose),
    }
    return _pack(head, {**arrays, "seen": np.asarray(traced.seen)})


def unpack(data: bytes) -> TracedFrame:
    """A frame's hits, bit for bit: a case must not score otherwise for having been flown after another."""
    head, arrays = _unpack(data)
    lens = head["camera"].pop("distortion")
    camera = Camera(**head["camera"], distortion=lens and Distortion(**lens))
    pose = Pose(**head["pose"])
    seen = arrays.pop("seen")
    hits = Hits(rows=camera.rows, columns=camera.columns, look=frame_rays(camera, pose), **arrays)
    return TracedFrame(hits, seen, camera, pose)


def pack_light(light: xr.DataArray) -> bytes:
    """Light of a frame without loss; components lie apart, as `render.shade` has them."""
    apart = np.swapaxes(light.values, -1, -2)
    return _pack({"dims": light.dims, "attrs": light.attrs}, {"light": apart})


def unpack_light(data: bytes) -> xr.DataArray:
    """The same light, bit for bit."""
    head, arrays = _unpack(data)
    values, coords = np.swapaxes(arrays["light"], -1, -2), {"stokes": ["I", "Q", "U"]}
    return xr.DataArray(values, coords, head["dims"], attrs=head["attrs"])


def _pack(head: Mapping[str, Any], arrays: Mapping[str, Array]) -> bytes:
    """A header and arrays as compressed bytes; the components of a vector lie apart, which packs better."""
    codec = Blosc(cname="lz4", clevel=1, shuffle=Blosc.SHUFFLE)
    layout, parts = [], []
    for name, value in arrays.items():
        planes = np.ascontiguousarray(np.moveaxis(value, -1, 0))
        parts.append(bytes(codec.encode(planes)) if planes.nbytes else b"")
        layout.append([name, planes.dtype.str, list(planes.shape), len(parts[-1])])
    text = json.dumps({**head, "arrays": layout}).encode()
    return b"".join([struct.pack("<q", len(text)), text, *parts])


def _unpack(data: bytes) -> tuple[dict[str, Any], dict[str, Array]]:
    """The header and the arrays of `_pack`."""
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


def _light_address(observer: Observer, channels: Array) -> str:
    """Hash of what decides a frame's light beside its hits: sky, materials, channels and the code."""
    sky, materials = observer.sky, observer.city.materials
    arrays = [getattr(sky, f.name) for f in fields(sky)] + [materials[name].values for name in materials]
    return content_hash([_code_key(_SHADING_CODE), *_bytes_of([*arrays, np.asarray(channels, float)])])


def _bytes_of(arrays: Iterable[Any]) -> Iterable[bytes]:
    for one in map(np.asarray, arrays):
        yield f"{one.dtype.str}{one.shape}".encode()
        yield str(one.tolist()).encode() if one.dtype == object else np.ascontiguousarray(one).tobytes()


def _stem(time_s: float, light: str = "") -> str:
    return cache.content_stem(f"frame at {float(time_s)!r} s{light and f' lit by {light}'}")


@lru_cache
def _code_key(parts: tuple[str, ...]) -> str:
    """Hash of source, data and packages that frames come from: other versions have frames of their own."""
    return digest(parts, _TRACING_PACKAGES)
