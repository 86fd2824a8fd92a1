"""Embree 4, as shipped in the `embreex` wheel, called through its C interface from numba kernels.

The scene is built through ctypes. Rays are traced from compiled loops, in packets of the width of this
processor's vectors, because Embree splits wider ones ray by ray. LLVM gets Embree's symbols by name, so that
numba can cache the kernels. Filter functions for leaf cards are compiled once and called by Embree for every
card that a ray meets. Layouts follow Embree 4.4's ``rtcore_ray.h`` (`RTCRayHit16` and narrower): each field
holds n lanes.
"""

import ctypes
import importlib.util
import math
import weakref
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import numba as nb
import numpy as np
from jaxtyping import Float
from llvmlite import binding, ir
from numba import carray, types  # pyright: ignore
from numba.extending import intrinsic

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.rays.surfaces import (
    MIN_LIGHT,
    NO_HIT,
    NO_MODELS,
    NO_TRANSFORMS,
    Intersections,
    Past,
    is_hole,
)
from glintrack.scene import Mesh

_TRIANGLES, _INSTANCE = 0, 121  # RTCGeometryType
_FLOAT3, _UINT3, _FLOAT4X4_COLUMNS = 0x9003, 0x5003, 0x9244  # RTCFormat
_INDEX_BUFFER, _VERTEX_BUFFER = 0, 1
_DYNAMIC, _ROBUST = 1, 4  # RTCSceneFlags
_QUALITY_LOW, _QUALITY_MEDIUM, _QUALITY_HIGH = 0, 1, 2
_COHERENT = 1 << 16  # RTCRayQueryFlags
_MANY_FACES = 5000  # a better tree is worth its time
WIDTHS = {16: 34, 8: 33, 4: 32}  # rays of a packet: RTCDeviceProperty of the processor's support
_MIN_RAYS = 1024  # of a thread's slice

# fields of RTCRayHitN
_ORIGIN, _NEAR, _DIRECTION, _TIME, _RANGE, _MASK, _ID, _FLAGS = 0, 3, 4, 7, 8, 9, 10, 11
_U, _V, _FACE, _GEOMETRY, _INSTANCE_ID, _FIELDS = 15, 16, 17, 18, 19, 21

_QUERY = types.void(types.uintp, types.uintp, types.uintp, types.uintp)
_intersect16, _occluded16, _intersect8, _occluded8, _intersect4, _occluded4 = (
    types.ExternalFunction(f"rtc{name}{lanes}", _QUERY)
    for lanes in WIDTHS
    for name in ("Intersect", "Occluded")
)


class _QueryArguments(ctypes.Structure):
    """RTCIntersectArguments and RTCOccludedArguments, which share their layout; for `intersect`."""

    _fields_ = [
        ("flags", ctypes.c_int),
        ("feature_mask", ctypes.c_uint),
        ("context", ctypes.c_void_p),
        ("filter", ctypes.c_void_p),
        ("callback", ctypes.c_void_p),
        ("min_width_distance_factor", ctypes.c_float),
    ]


def load_library() -> ctypes.CDLL:
    """Find the wheel's Embree, register its symbols with LLVM, and declare the functions called from Python.

    Raises
    ------
    ValueError
        If the wheel is missing or holds no Embree 4.
    """
    spec = importlib.util.find_spec("embreex")
    if spec is None or spec.origin is None:
        raise ValueError("`embreex` must be installed to trace rays; got none. Run: pip install embreex")
    importlib.import_module("embreex.rtcore")  # loads TBB and Embree by their relative paths
    path = _library_file(Path(spec.origin).parent)
    binding.load_library_permanently(str(path))
    library = ctypes.CDLL(str(path))
    pointer, word, integer, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_size_t
    for names, result, arguments in (
        ("NewDevice", pointer, [ctypes.c_char_p]),
        ("NewScene", pointer, [pointer]),
        ("NewGeometry", pointer, [pointer, integer]),
        ("GetDeviceError", integer, [pointer]),
        ("GetDeviceProperty", ctypes.c_ssize_t, [pointer, integer]),
        ("ReleaseDevice ReleaseScene CommitScene ReleaseGeometry CommitGeometry", None, [pointer]),
        ("EnableGeometry DisableGeometry", None, [pointer]),
        ("SetSceneFlags SetSceneBuildQuality", None, [pointer, integer]),
        ("SetSharedGeometryBuffer", None, [pointer, integer, word, integer, pointer, size, size, size]),
        ("AttachGeometryByID", None, [pointer, pointer, word]),
        ("SetGeometryInstancedScene SetGeometryUserData", None, [pointer, pointer]),
        ("SetGeometryIntersectFilterFunction", None, [pointer, pointer]),
        ("SetGeometryOccludedFilterFunction", None, [pointer, pointer]),
        ("SetGeometryTransform", None, [pointer, word, integer, pointer]),
    ):
        for name in names.split():
            function = getattr(library, f"rtc{name}")
            function.restype, function.argtypes = result, arguments
    return library


def _library_file(package: Path) -> Path:
    """Path of Embree's shared library in wheels for Linux (.so), Windows (.dll) and macOS (.dylib)."""
    places = package.parent / "embreex.libs", package / ".dylibs"
    names = "libembree4*.so*", "embree4*.dll", "libembree4*.dylib"
    found = sorted(file for place in places for name in names for file in place.glob(name))
    if not found:
        raise ValueError(
            f"`embreex` must carry libembree4 or embree4.dll; got none beside {package}. "
            "Install embreex>=4.4,<4.5."
        )
    return found[0]


def _release(library: ctypes.CDLL, device: int, scenes: list[int]) -> None:
    """Release the memory of scenes and of their device."""
    for scene in reversed(scenes):  # first those that hold others
        library.rtcReleaseScene(scene)
    library.rtcReleaseDevice(device)


class EmbreeTracer:
    """A `Tracer` by Embree; two threads build the trees, tracing uses as many as numba is set to."""

    def __init__(
        self,
        static: Mesh,
        models: tuple[Mesh, ...],
        fixed_transforms: Array = NO_TRANSFORMS,
        fixed_models: Array = NO_MODELS,
        gaps: tuple[Float[Array, "_"], ...] | None = None,
    ):
        call = self._library = load_library()
        self._device, scenes = call.rtcNewDevice(b"threads=2"), list[int]()
        self._scenes = scenes  # also of one that was interrupted while it was built
        weakref.finalize(self, _release, call, self._device, scenes)
        has = call.rtcGetDeviceProperty
        # rays of a packet: the widest that this processor traces at once
        self.lanes = next((lanes for lanes, width in WIDTHS.items() if has(self._device, width)), min(WIDTHS))
        self._coherent = _QueryArguments(flags=_COHERENT, feature_mask=0xFFFFFFFF)
        self._mixed = _QueryArguments(feature_mask=0xFFFFFFFF)
        self._buffers: list[Array] = []  # that Embree shares with us
        meshes = (static, *models)
        gaps = gaps or tuple(np.zeros(len(mesh.faces), np.float32) for mesh in meshes)
        self._submodels = [self._build_mesh(mesh, gap) for mesh, gap in zip(meshes, gaps, strict=True)]
        # fixed and moving instances are two scenes, traced one after the other: to build the tree over ten
        # thousand trees for every frame would take 40 ms, a second look at 200 vehicles costs little
        self._still = self._new_scene(_ROBUST, _QUALITY_HIGH)
        self._place(self._new_instance(self._still, 0), 0, np.eye(3, 4))
        for k, (model, transform) in enumerate(zip(fixed_models, fixed_transforms, strict=True)):
            self._place(self._new_instance(self._still, k + 1), int(model) + 1, transform)
        call.rtcCommitScene(self._still)
        self._moving = self._new_scene(_DYNAMIC | _ROBUST, _QUALITY_LOW)
        self._first_moving, self._enabled, self._slots = len(fixed_models) + 1, 0, list[int]()
        self.update(NO_TRANSFORMS, NO_MODELS)

    def update(self, transforms: Array, models: Array) -> None:
        """Place the moving instances, see `Tracer.update`."""
        for k, (model, transform) in enumerate(zip(models, transforms, strict=True)):
            if k == len(self._slots):
                self._slots.append(self._new_instance(self._moving, self._first_moving + k))
            self._place(self._slots[k], int(model) + 1, transform)
        for slot in self._slots[len(models) : self._enabled]:
            self._library.rtcDisableGeometry(slot)
        self._enabled = len(models)
        self._library.rtcCommitScene(self._moving)
        error = self._library.rtcGetDeviceError(self._device)
        if error:
            raise ValueError(f"`scene` must be valid geometry for Embree; got RTC error {error}.")

    def intersect(
        self, origins: Array, directions: Array, coherent: bool = False, past: Past = "all"
    ) -> Intersections:
        """Find the nearest hits of rays, see `Tracer.intersect`."""
        out = Intersections.empty(len(directions))
        arguments = ctypes.addressof(self._coherent if coherent else self._mixed)
        self._over_packets(_intersect, len(directions), past, origins, directions, arguments, out)
        return out

    def transmittance(
        self, origins: Array, directions: Array, wanted: Array, coherent: bool = False, past: Past = "all"
    ) -> Array:
        """Transmittance along each ray, see `Tracer.transmittance`. [1]"""
        out = np.zeros(len(wanted), np.float32)
        self._over_packets(_transmit, len(wanted), past, origins, directions, coherent, wanted, out)
        return out

    def _over_packets(self, kernel: Callable[..., None], rays: int, past: Past, *query) -> None:
        """Trace all packets of so many rays, on as many threads as numba is set to."""
        moving = self._moving if self._enabled and past == "all" else 0
        packets, least = -(-rays // self.lanes), _MIN_RAYS // self.lanes
        over_rows(kernel, packets, self.lanes, self._still, moving, *query, least=least)

    def _build_mesh(self, mesh: Mesh, gap: Float[Array, "face"]) -> int:
        """Build the scene of a mesh: a geometry of its closed faces and one, with filters, of its cards."""
        closed = int(np.count_nonzero(gap == 0))
        if gap[:closed].any():
            raise ValueError("`gaps` must be sorted, faces without holes first; got them mixed.")
        # Embree reads 16 bytes at the last vertex: one spare row keeps that inside our memory
        vertices = np.ascontiguousarray(np.vstack([mesh.vertices, np.zeros((1, 3))]), np.float32)
        # the best quality splits faces, and a card met in two pieces would take its share of the light twice
        best = len(mesh.faces) > _MANY_FACES and closed == len(mesh.faces)
        scene = self._new_scene(_ROBUST, _QUALITY_HIGH if best else _QUALITY_MEDIUM)
        if closed:
            self._attach(scene, 0, vertices, mesh.faces[:closed])
        if closed < len(mesh.faces):
            self._attach(scene, closed, vertices, mesh.faces[closed:], gap[closed:])
        self._library.rtcCommitScene(scene)
        return scene

    def _attach(self, scene: int, number: int, vertices: Array, faces: Array, gap: Array | None = None):
        """Add faces as the geometry ``number``, which is that of the first of them in their mesh."""
        call = self._library
        faces = np.ascontiguousarray(faces, np.uint32)
        geometry = call.rtcNewGeometry(self._device, _TRIANGLES)
        shared = call.rtcSetSharedGeometryBuffer
        shared(geometry, _VERTEX_BUFFER, 0, _FLOAT3, vertices.ctypes.data, 0, 12, len(vertices) - 1)
        shared(geometry, _INDEX_BUFFER, 0, _UINT3, faces.ctypes.data, 0, 12, len(faces))
        self._buffers += [vertices, faces]
        if gap is not None:
            gap = np.ascontiguousarray(gap, np.float32)
            self._buffers.append(gap)
            pass_holes, weaken_light = leaf_filters()
            call.rtcSetGeometryUserData(geometry, gap.ctypes.data)
            call.rtcSetGeometryIntersectFilterFunction(geometry, pass_holes.address)
            call.rtcSetGeometryOccludedFilterFunction(geometry, weaken_light.address)
        call.rtcCommitGeometry(geometry)
        call.rtcAttachGeometryByID(scene, geometry, number)
        call.rtcReleaseGeometry(geometry)  # the scene keeps it alive

    def _new_scene(self, flags: int, quality: int) -> int:
        scene = self._library.rtcNewScene(self._device)
        self._scenes.append(scene)
        self._library.rtcSetSceneFlags(scene, flags)
        self._library.rtcSetSceneBuildQuality(scene, quality)
        return scene

    def _new_instance(self, scene: int, slot: int) -> int:
        """Attach an instance that has no model yet."""
        geometry = self._library.rtcNewGeometry(self._device, _INSTANCE)
        self._library.rtcAttachGeometryByID(scene, geometry, slot)
        self._library.rtcReleaseGeometry(geometry)  # the scene keeps it alive
        return geometry

    def _place(self, geometry: int, submodel: int, transform: Array) -> None:
        call = self._library
        columns = np.eye(4, dtype=np.float32)  # column-major 4×4
        columns[:, :3] = np.asarray(transform).T
        call.rtcSetGeometryInstancedScene(geometry, self._submodels[submodel])
        call.rtcSetGeometryTransform(geometry, 0, _FLOAT4X4_COLUMNS, columns.ctypes.data)
        call.rtcEnableGeometry(geometry)
        call.rtcCommitGeometry(geometry)


@nb.njit(cache=True)
def _meet(lanes, valid, scene, ray, arguments):
    """Nearest hits of a packet in a scene."""
    if lanes == 16:
        _intersect16(valid.ctypes.data, scene, ray.ctypes.data, arguments)
    elif lanes == 8:
        _intersect8(valid.ctypes.data, scene, ray.ctypes.data, arguments)
    else:
        _intersect4(valid.ctypes.data, scene, ray.ctypes.data, arguments)


@nb.njit(cache=True)
def _block(lanes, valid, scene, ray, arguments):
    """Mark the rays of a packet that meet anything in a scene."""
    if lanes == 16:
        _occluded16(valid.ctypes.data, scene, ray.ctypes.data, arguments.ctypes.data)
    elif lanes == 8:
        _occluded8(valid.ctypes.data, scene, ray.ctypes.data, arguments.ctypes.data)
    else:
        _occluded4(valid.ctypes.data, scene, ray.ctypes.data, arguments.ctypes.data)


@nb.njit(cache=True)
def _allocate_words(count):
    """Allocate words at a multiple of 64 bytes."""
    spare = np.empty(count + 16, np.uint32)
    first = (64 - spare.ctypes.data % 64) % 64 // 4
    return spare[first : first + count]


@nb.njit(cache=True)
def _new_packet(lanes):
    """Allocate the fields of a packet, as numbers and as words, and its mask of lanes."""
    words = _allocate_words(_FIELDS * lanes).reshape(_FIELDS, lanes)
    words[:] = 0
    words[_MASK] = words[_INSTANCE_ID] = NO_HIT
    words[_ID] = np.arange(lanes)
    return words.view(np.float32), words, _allocate_words(lanes).view(np.int32)


@nb.njit(cache=True)
def _fill_packet(packet, lanes, rays, origins, directions, ray, valid):
    """Write rays into a packet's lanes and mark those that hold one; the others get the first ray."""
    for k in range(lanes):
        i = packet * lanes + k
        valid[k] = -1 if i < rays else 0
        ray[_RANGE, k] = np.float32(math.inf)
        o = i if i < rays and origins.shape[0] > 1 else 0
        d = i if i < rays and directions.shape[0] > 1 else 0
        for c in range(3):
            ray[_ORIGIN + c, k], ray[_DIRECTION + c, k] = origins[o, c], directions[d, c]


@nb.njit(nogil=True, cache=True)
def _intersect(start, stop, lanes, still, moving, origins, directions, arguments, out):
    """Trace packets ``start`` to ``stop``."""
    rays = directions.shape[0]
    ray, words, valid = _new_packet(lanes)
    for packet in range(start, stop):
        _fill_packet(packet, lanes, rays, origins, directions, ray, valid)
        words[_GEOMETRY] = NO_HIT
        _meet(lanes, valid, still, ray, arguments)
        if moving != 0:  # only what is nearer than the first hits replaces them
            _meet(lanes, valid, moving, ray, arguments)
        first = packet * lanes
        for k in range(min(lanes, rays - first)):
            i, hit = first + k, words[_GEOMETRY, k] != NO_HIT
            out.range_m[i] = ray[_RANGE, k] if hit else np.float32(math.inf)
            out.face[i] = words[_FACE, k] + words[_GEOMETRY, k] if hit else NO_HIT
            out.slot[i] = words[_INSTANCE_ID, k] if hit else NO_HIT
            out.barycentric[i, 0] = ray[_U, k]
            out.barycentric[i, 1] = ray[_V, k]


@nb.njit(nogil=True, cache=True)
def _transmit(start, stop, lanes, still, moving, origins, directions, coherent, wanted, light):
    """Trace packets ``start`` to ``stop``."""
    rays = wanted.shape[0]
    ray, _, valid = _new_packet(lanes)
    context = np.empty(CONTEXT_WORDS, np.float32)
    context.view(np.uint32)[:LIGHT_WORD] = NO_HIT
    arguments = np.zeros(5, np.uint64)  # RTCOccludedArguments: flags and feature mask, context, no callbacks
    # a coherent packet is walked once for each octant of directions in it, with all its lanes: cards would
    # take their share of the light more than once
    coherent = coherent and directions.shape[0] == 1
    arguments[0] = (np.uint64(NO_HIT) << np.uint64(32)) | np.uint64(_COHERENT if coherent else 0)
    arguments[1] = context.ctypes.data
    for packet in range(start, stop):
        first, any_left = packet * lanes, False
        for i in range(first, min(first + lanes, rays)):
            any_left |= wanted[i]
        if not any_left:
            continue
        _fill_packet(packet, lanes, rays, origins, directions, ray, valid)
        for k in range(min(lanes, rays - first)):
            valid[k] = -1 if wanted[first + k] else 0
        context[LIGHT_WORD:] = 1.0
        _block(lanes, valid, still, ray, arguments)
        any_left = False
        for k in range(lanes):
            if ray[_RANGE, k] < 0:  # Embree marks a blocked ray by a range of −inf
                valid[k] = 0
            any_left |= valid[k] != 0
        if moving != 0 and any_left:
            _block(lanes, valid, moving, ray, arguments)
        for k in range(min(lanes, rays - first)):
            if wanted[first + k]:
                light[first + k] = 0.0 if ray[_RANGE, k] < 0 else context[LIGHT_WORD + k]


_RAY_ID, _HIT_U, _HIT_V, _HIT_FACE, _HIT_GEOMETRY = 10, 3, 4, 5, 6  # fields, in words of n lanes
LIGHT_WORD = 16  # of the query's context, after what Embree keeps there: light left of ray id 0
CONTEXT_WORDS = LIGHT_WORD + 16
_ANY_LENGTH = 1 << 30  # of a buffer of unknown length


@intrinsic
def _pointer(typing_context, address):
    """Convert an address to a pointer for `carray`."""
    del typing_context, address

    def code(context, builder, signature, arguments):
        del context, signature
        return builder.inttoptr(arguments[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.uint64), code


@nb.njit(cache=True)
def _buffer(address, length, kind):
    return carray(_pointer(address), length, kind)  # pyright: ignore


def _pass_holes(arguments):
    """Pass rays of look through the holes of cards."""
    words = carray(arguments, 6, np.uint64)
    lanes = np.int64(words[5] & np.uint64(0xFFFFFFFF))
    valid = _buffer(words[0], lanes, np.int32)
    gaps = _buffer(words[1], _ANY_LENGTH, np.float32)
    hit = _buffer(words[4], 9 * lanes, np.float32)
    numbers = _buffer(words[4], 9 * lanes, np.uint32)
    for i in range(lanes):
        if valid[i] != 0:
            k = np.int64(numbers[_HIT_FACE * lanes + i])
            face = k + np.int64(numbers[_HIT_GEOMETRY * lanes + i])
            if is_hole(face, hit[_HIT_U * lanes + i], hit[_HIT_V * lanes + i], gaps[k]):
                valid[i] = 0


def _weaken_light(arguments):
    """Multiply the light by a card's gap fraction; block the ray under `MIN_LIGHT`."""
    words = carray(arguments, 6, np.uint64)
    lanes = np.int64(words[5] & np.uint64(0xFFFFFFFF))
    valid = _buffer(words[0], lanes, np.int32)
    gaps = _buffer(words[1], _ANY_LENGTH, np.float32)
    light = _buffer(words[2], CONTEXT_WORDS, np.float32)
    ray = _buffer(words[3], 12 * lanes, np.uint32)
    numbers = _buffer(words[4], 9 * lanes, np.uint32)
    for i in range(lanes):
        if valid[i] != 0:
            k = LIGHT_WORD + np.int64(ray[_RAY_ID * lanes + i])
            light[k] *= gaps[np.int64(numbers[_HIT_FACE * lanes + i])]
            if light[k] >= MIN_LIGHT:
                valid[i] = 0


@lru_cache(maxsize=1)
def leaf_filters():
    """Compile the filters of intersect and occluded queries, which must live as long as the process."""
    compile_filter = nb.cfunc(types.void(types.voidptr), cache=True)
    return compile_filter(_pass_holes), compile_filter(_weaken_light)
