"""Hits and light kept on disk, addressed by what decides them: cases of one geometry trace only once.

Hits depend neither on filters nor on tracker nor on reported pose. What decides a frame's are the scene, the
flight and its time, the sun, the camera and the code that traces. Light is that in the sensor's channels
before the lens, and is decided by the sky and the materials as well: what is behind the lens shades nothing
anew.
"""

import json
import shutil
import struct
from collections.abc import Callable, Container, Mapping
from dataclasses import asdict, dataclass, field, fields
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
import xarray as xr
from numcodecs import Blosc

from glintrack.camera import Camera, Pose
from glintrack.case.build import decides_hits, sampling_of
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.distortion import Distortion
from glintrack.flight import FlightDesign
from glintrack.io import cache
from glintrack.io.digest import content_hash
from glintrack.render import Hits, Observer, Sampling, TracedFrame, frame_rays
from glintrack.study.plan import without_paths
from glintrack.study.source import digest

# of a frame of the quickstart, probes too: 25.7 MB for 493 000 elements, 56.8 at 3 × 3 rays
_BYTES_AN_ELEMENT, _GROWTH = 52.0, 0.36
_LIGHT_BYTES = 27.5  # of each, in three channels
_SUFFIX = ".hits"
_FREE_SHARE = 0.1  # of the disk: less than this left, and no more is kept
_TRACING_CODE = (
    "scene",
    "render",
    "flight",
    "camera.py",
    "core",
    "data/materials.toml",
    "data/traffic",
)
_TRACING_PACKAGES = ("embreex", "eclipse-sumo")
# directions of look follow from the rays, and where along it the range ends to the last bits
_DERIVED = ("look", "point")
_LIGHT_SUFFIX = ".light"
_SHADING_CODE = ("core", "render", "stokes.py")


def geometry(case: Case, sampling: Sampling | None = None) -> str:
    """Hash of all that decides a case's hits but the time; cases that share it share their frames.

    Parameters
    ----------
    case
        The design.
    sampling
        From `shared_samplings`; the case's own by default.
    """
    return _address(case, None if sampling is None else asdict(sampling))


def shared_samplings(cases: Mapping[str, Case]) -> dict[str, Sampling | None]:
    """How each case samples its elements if those of one geometry share hits: as the least noisy does."""
    own = {key: sampling_of(case) for key, case in cases.items()}
    places = {key: _address(cases[key], one.error) for key, one in own.items() if one is not None}
    least: dict[str, Sampling] = {}
    for key, place in places.items():
        one, known = own[key], least.get(place)
        if one is not None:
            least[place] = one if known is None else Sampling(
                one.error,
                max(one.electrons_per_radiance, known.electrons_per_radiance),
                min(one.dark_noise_e, known.dark_noise_e),
            )  # fmt: skip
    return {key: least[places[key]] if key in places else None for key in cases}


def _address(case: Case, rays: Any = None) -> str:
    content = {**decides_hits(case, rays), "code": _code()}
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
        return any(self._own.glob(f"{_stem(time_s)}-*{_SUFFIX}"))

    def get(self, time_s: float, observe: Callable[[], TracedFrame]) -> TracedFrame:
        """The frame from the cache, or traced and kept; for `simulate`."""
        try:
            data = cache.read(_stem(time_s), _SUFFIX, self._own)
        except OSError:  # another user's, in a shared folder
            data = None
        if data is not None:
            self.read += 1
            return unpack(data)
        traced = observe()
        self.traced += 1
        if self._wants(time_s):
            self._keep(_stem(time_s), _SUFFIX, partial(pack, traced))
        return traced

    def light(
        self, time_s: float, observer: Observer, channels: Array, shade: Callable[[], xr.DataArray]
    ) -> xr.DataArray:
        """Light of a frame in some channels from the cache, or shaded and kept; for `simulate`."""
        stem = _stem(time_s, _light_address(observer, channels))
        try:
            data = cache.read(stem, _LIGHT_SUFFIX, self._own)
        except OSError:
            data = None
        if data is not None:
            return unpack_light(data)
        found = shade()
        self.lit += 1
        if self._wants(time_s):
            self._keep(stem, _LIGHT_SUFFIX, partial(pack_light, found))
        return found

    def _wants(self, time_s: float) -> bool:
        return self.keeps is True or bool(self.keeps and time_s in self.keeps)

    def _keep(self, stem: str, suffix: str, packed: Callable[[], bytes]) -> None:
        """Put a file there if there is room: a cache never stops a case, nor fills a disk."""
        try:
            self._own.mkdir(parents=True, exist_ok=True)
            disk = shutil.disk_usage(self._own)
            data = packed()
            if disk.free - len(data) > _FREE_SHARE * disk.total:
                cache.keep(stem, suffix, self._own, data)
                self.bytes_kept += len(data)
        except OSError:
            self.keeps = False


def packed_bytes(elements: int, rays: float) -> float:
    """About what a frame and its light take on disk: samples are fewer than the rays of each element."""
    return elements * (_BYTES_AN_ELEMENT * rays**_GROWTH + _LIGHT_BYTES)


def pack(traced: TracedFrame) -> bytes:
    """A frame's hits without loss, less what follows from the rays themselves (`unpack` says how)."""
    hits = traced.hits
    codec = Blosc(cname="lz4", clevel=1, shuffle=Blosc.SHUFFLE)
    arrays = {f.name: getattr(hits, f.name) for f in fields(hits) if f.name not in _DERIVED}
    arrays = {name: value for name, value in arrays.items() if isinstance(value, np.ndarray)}
    arrays["seen"] = np.asarray(traced.seen)
    beyond = hits.point.view(np.int32) - _along(traced.pose, hits.direction, hits.range_m).view(np.int32)
    arrays["point_bits"] = (beyond << 1) ^ (beyond >> 31)  # small numbers without sign pack well
    layout, parts = [], []
    for name, value in arrays.items():
        planes = np.ascontiguousarray(
            value.T if value.ndim == 2 else value
        )  # x, y, z apart: they pack better
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
    """A frame's hits, bit for bit: a case must not score otherwise for having been flown after another."""
    length = struct.unpack_from("<q", data)[0]
    head, place = json.loads(data[8 : 8 + length]), 8 + length
    arrays, codec = {}, Blosc()
    for name, dtype, shape, size in head["arrays"]:
        planes = np.empty(shape, dtype)  # to be written to, as a traced frame's: so kernels are compiled
        if size:
            codec.decode(data[place : place + size], planes)
        arrays[name] = np.ascontiguousarray(planes.T) if planes.ndim == 2 else planes
        place += size
    lens = head["camera"].pop("distortion")
    camera = Camera(**head["camera"], distortion=lens and Distortion(**lens))
    pose = Pose(**head["pose"])
    look = frame_rays(camera, pose)
    counts = np.diff(arrays["first"])
    along = _along(pose, np.repeat(look, counts, axis=0), arrays["range_m"])
    folded = arrays.pop("point_bits").view(np.uint32)
    beyond = (folded >> 1).view(np.int32) ^ -(folded & 1).astype(np.int32)
    point = (along.view(np.int32) + beyond).view(np.float32)
    seen = arrays.pop("seen")
    hits = Hits(
        rows=camera.rows,
        columns=camera.columns,
        look=look,
        point=point,
        **arrays,
    )
    return TracedFrame(hits, seen, camera, pose)


def _along(pose: Pose, direction: Array, range_m: Array) -> Array:
    """Where each ray's range ends, nearly: `trace` takes the point from the facet. [m]"""
    reach = np.where(np.isfinite(range_m), range_m, 0)[:, None]
    return (pose.position + reach * direction.astype(float)).astype(np.float32)


def pack_light(light: xr.DataArray) -> bytes:
    """Light of a frame without loss; components lie apart, as `render.shade` has them."""
    values = np.ascontiguousarray(np.swapaxes(light.values, -1, -2))
    head = {"shape": values.shape, "dtype": values.dtype.str, "dims": light.dims, "attrs": light.attrs}
    text = json.dumps(head).encode()
    codec = Blosc(cname="lz4", clevel=1, shuffle=Blosc.SHUFFLE)
    return b"".join([struct.pack("<q", len(text)), text, bytes(codec.encode(values))])


def unpack_light(data: bytes) -> xr.DataArray:
    """The same light, bit for bit."""
    length = struct.unpack_from("<q", data)[0]
    head = json.loads(data[8 : 8 + length])
    values = np.empty(head["shape"], head["dtype"])
    Blosc().decode(data[8 + length :], values)
    coords = {"stokes": ["I", "Q", "U"]}
    return xr.DataArray(np.swapaxes(values, -1, -2), dims=head["dims"], coords=coords, attrs=head["attrs"])


def _light_address(observer: Observer, channels: Array) -> str:
    """Hash of what decides a frame's light beside its hits: sky, materials, channels and the code."""
    sky, materials = observer.sky, observer.city.materials
    arrays = [getattr(sky, f.name) for f in fields(sky)] + [materials[name].values for name in materials]
    parts = [f"{np.asarray(one).dtype.str}{np.shape(one)}".encode() for one in arrays]
    parts += [np.ascontiguousarray(one).tobytes() for one in arrays if np.asarray(one).dtype != object]
    parts += [str(one.tolist()).encode() for one in arrays if np.asarray(one).dtype == object]
    channels = np.ascontiguousarray(channels, float)
    return content_hash([_shading_code(), *parts, f"{channels.shape}".encode(), channels.tobytes()])


@lru_cache(maxsize=1)
def _shading_code() -> str:
    package = Path(__file__).parents[1]
    return digest([package / name for name in _SHADING_CODE], _TRACING_PACKAGES)


def _stem(time_s: float, light: str = "") -> str:
    return cache.content_stem(f"frame at {float(time_s)!r} s{light and f' lit by {light}'}")


@lru_cache(maxsize=1)
def _code() -> str:
    """Hash of source, data and packages that hits come from: other versions have frames of their own."""
    package = Path(__file__).parents[1]
    return digest([package / name for name in _TRACING_CODE], _TRACING_PACKAGES)
