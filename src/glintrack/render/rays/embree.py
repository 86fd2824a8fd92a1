"""Embree 4, as shipped in the `embreex` wheel, called through its C interface from numba kernels.

The scene is built through ctypes; rays are traced from compiled loops, in packets of as many as this
processor's vectors hold: Embree takes wider ones apart ray by ray. LLVM is told its symbols by name, so
that numba can cache the kernels. Filter functions for leaf cards are compiled once and called by Embree for
every card a ray meets. Layouts follow Embree 4.4's ``rtcore_ray.h`` (`RTCRayHit16` and narrower): each
field holds n lanes.
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
from glintrack.render.rays.surfaces import LEAST_LIGHT, NO_HIT, Intersections, Past, is_hole
from glintrack.scene import Mesh

_TRIANGLES, _INSTANCE = 0, 121  # RTCGeometryType
_FLOAT3, _UINT3, _FLOAT4X4_COLUMNS = 0x9003, 0x5003, 0x9244  # RTCFormat
_INDEX_BUFFER, _VERTEX_BUFFER = 0, 1
_DYNAMIC, _ROBUST = 1, 4  # RTCSceneFlags
_QUALITY_LOW, _QUALITY_MEDIUM, _QUALITY_HIGH = 0, 1, 2
_COHERENT = 1 << 16  # RTCRayQueryFlags
_MANY_FACES = 5000  # a better tree is worth its time
WIDTHS = {16: 34, 8: 33, 4: 32}  # rays of a packet; the RTCDeviceProperty that tells if the processor has it
_LEAST_RAYS = 1024  # of a thread's slice

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
    """Find the wheel's Embree, make its symbols known to LLVM, and declare what we call from Python.

    Raises
    ------
    ValueError
        If the wheel is missing or holds no Embree 4.
    """
    spec = importlib.util.find_spec("embreex")
    if spec is None or spec.origin is None:
        raise ValueError(
            "`embreex` must be installed to trace rays, got no such package (pip install embreex)"
        )
    importlib.import_module("embreex.rtcore")  # loads TBB and Embree by their relative paths
    folder = Path(spec.origin).parent
    path = _library_file(folder)
    binding.load_library_permanently(str(path))
    library = ctypes.CDLL(str(path))
    pointer, word, integer, size = ctypes.c_void_p, ctypes.c_uint, ctypes.c_int, ctypes.c_size_t
    for name, result, arguments in (
        ("rtcNewDevice", pointer, [ctypes.c_char_p]),
        ("rtcReleaseDevice", None, [pointer]),
        ("rtcGetDeviceError", integer, [pointer]),
        ("rtcGetDeviceProperty", ctypes.c_ssize_t, [pointer, integer]),
        ("rtcNewScene", pointer, [pointer]),
        ("rtcReleaseScene", None, [pointer]),
        ("rtcSetSceneFlags", None, [pointer, integer]),
        ("rtcSetSceneBuildQuality", None, [pointer, integer]),
        ("rtcCommitScene", None, [pointer]),
        ("rtcNewGeometry", pointer, [pointer, integer]),
        ("rtcReleaseGeometry", None, [pointer]),
        ("rtcSetSharedGeometryBuffer", None, [pointer, integer, word, integer, pointer, size, size, size]),
        ("rtcCommitGeometry", None, [pointer]),
        ("rtcEnableGeometry", None, [pointer]),
        ("rtcDisableGeometry", None, [pointer]),
        ("rtcAttachGeometryByID", None, [pointer, pointer, word]),
        ("rtcSetGeometryInstancedScene", None, [pointer, pointer]),
        ("rtcSetGeometryUserData", None, [pointer, pointer]),
        ("rtcSetGeometryIntersectFilterFunction", None, [pointer, pointer]),
        ("rtcSetGeometryOccludedFilterFunction", None, [pointer, pointer]),
        ("rtcSetGeometryTransform", None, [pointer, word, integer, pointer]),
    ):
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library


def _library_file(package: Path) -> Path:
    """Embree's shared library, where wheels for Linux (.so), Windows (.dll) and macOS (.dylib) hold it.

    Raises
    ------
    ValueError
        If there is none beside or in the package's folder.
    """
    places = package.parent / "embreex.libs", package / ".dylibs"
    names = "libembree4*.so*", "embree4*.dll", "libembree4*.dylib"
    found = sorted(file for place in places for name in names for file in place.glob(name))
    if not found:
        raise ValueError(
            f"`embreex` must carry libembree4 or embree4.dll, got none beside {package} "
            "(need embreex>=4.4,<4.5)"
        )
    return found[0]


def _release(library: ctypes.CDLL, device: int, scenes: list[int]) -> None:
    """Release the memory of scenes and of their device."""
    for scene in reversed(scenes):  # first those that hold others
        library.rtcReleaseScene(scene)
    library.rtcReleaseDevice(device)


class EmbreeTracer:
    """A `Tracer` by Embree; ``threads`` are for building, tracing uses as many as numba is set to."""

    def __init__(
        self,
        static: Mesh,
        models: tuple[Mesh, ...],
        fixed_transforms: Array | None = None,
        fixed_models: Array | None = None,
        gaps: tuple[Float[Array, "_"], ...] | None = None,
        threads: int = 2,
    ):
        self._built: list[int] = []  # scenes of Embree, also of one that was interrupted while it built
        self._library = load_library()
        self._device = self._library.rtcNewDevice(b"threads=%d" % threads)
        self._release = weakref.finalize(self, _release, self._library, self._device, self._built)
        self.lanes = self._widest_packet()  # rays of a packet, one of `WIDTHS`
        self._coherent = _QueryArguments(flags=_COHERENT, feature_mask=0xFFFFFFFF)
        self._mixed = _QueryArguments(feature_mask=0xFFFFFFFF)
        self._kept: list[Array] = []  # buffers that Embree shares with us
        meshes = (static, *models)
        gaps = gaps or tuple(np.zeros(len(mesh.faces), np.float32) for mesh in meshes)
        self._submodels = [self._build_mesh(mesh, gap) for mesh, gap in zip(meshes, gaps, strict=True)]
        # what stands still and what moves are two scenes, traced one after the other: to build the tree over
        # ten thousand trees anew for every frame would take 40 ms, a second look at 200 vehicles costs little
        self._still = self._new_scene(_ROBUST)
        self._library.rtcSetSceneBuildQuality(self._still, _QUALITY_HIGH)
        self._place(self._new_instance(self._still, 0), 0, np.eye(3, 4))
        if fixed_transforms is not None and fixed_models is not None:
            for k, (model, transform) in enumerate(zip(fixed_models, fixed_transforms, strict=True)):
                self._place(self._new_instance(self._still, k + 1), int(model) + 1, transform)
        self._library.rtcCommitScene(self._still)
        self._moving = self._new_scene(_DYNAMIC | _ROBUST)
        self._library.rtcSetSceneBuildQuality(self._moving, _QUALITY_LOW)
        self._first_moving = len(fixed_models) + 1 if fixed_models is not None else 1
        self._slots: list[int] = []
        self._enabled = 0
        self.update(np.zeros((0, 3, 4)), np.zeros(0, int))

    def close(self) -> None:
        """Release Embree's memory; the tracer cannot be used afterwards."""
        self._release()

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
            raise ValueError(f"`scene` must be valid geometry for Embree, got RTC error {error}")

    def intersect(
        self, origins: Array, directions: Array, coherent: bool = False, past: Past = "all"
    ) -> Intersections:
        """Nearest hits of rays, see `Tracer.intersect`."""
        out = Intersections.empty(len(directions))
        arguments = ctypes.addressof(self._coherent if coherent else self._mixed)
        query = (*self._scenes(past), arguments, origins, directions)
        self._over_packets(_intersect, len(directions), *query, out)
        return out

    def transmittance(
        self, origins: Array, directions: Array, wanted: Array, coherent: bool = False, past: Past = "all"
    ) -> Array:
        """Part of the light that comes along each ray, see `Tracer.transmittance`."""
        out = np.zeros(len(wanted), np.float32)
        query = (*self._scenes(past), origins, directions, coherent)
        self._over_packets(_transmit, len(wanted), *query, wanted, out)
        return out

    def _over_packets(self, kernel: Callable[..., None], rays: int, *arguments) -> None:
        """Trace all packets of so many rays, on as many threads as numba is set to."""
        packets, least = -(-rays // self.lanes), _LEAST_RAYS // self.lanes
        over_rows(kernel, packets, self.lanes, *arguments, least=least)

    def _widest_packet(self) -> int:
        """Rays that this processor traces at once; one by one it does with any packet."""
        has = self._library.rtcGetDeviceProperty
        return next((lanes for lanes, asked in WIDTHS.items() if has(self._device, asked)), min(WIDTHS))

    def _build_mesh(self, mesh: Mesh, gap: Float[Array, "face"]) -> int:
        """Scene of one mesh: a geometry of its closed faces and one, with filters, of its cards."""
        call = self._library
        closed = int(np.count_nonzero(gap == 0))
        if gap[:closed].any():
            raise ValueError("`gaps` must be sorted, faces without holes first, got them mixed")
        # Embree reads 16 bytes at the last vertex: one spare row keeps that inside our memory
        vertices = np.ascontiguousarray(np.vstack([mesh.vertices, np.zeros((1, 3))]), np.float32)
        scene = self._new_scene(_ROBUST)
        # the best quality splits faces, and a card met in two pieces would take its share of the light twice
        best = len(mesh.faces) > _MANY_FACES and closed == len(mesh.faces)
        call.rtcSetSceneBuildQuality(scene, _QUALITY_HIGH if best else _QUALITY_MEDIUM)
        if closed:
            self._attach(scene, 0, vertices, mesh.faces[:closed])
        if closed < len(mesh.faces):
            self._attach(scene, closed, vertices, mesh.faces[closed:], gap[closed:])
        call.rtcCommitScene(scene)
        return scene

    def _attach(self, scene: int, number: int, vertices: Array, faces: Array, gap: Array | None = None):
        """Add faces as the geometry ``number``, which is that of the first of them in their mesh."""
        call = self._library
        faces = np.ascontiguousarray(faces, np.uint32)
        geometry = call.rtcNewGeometry(self._device, _TRIANGLES)
        shared = call.rtcSetSharedGeometryBuffer
        shared(geometry, _VERTEX_BUFFER, 0, _FLOAT3, vertices.ctypes.data, 0, 12, len(vertices) - 1)
        shared(geometry, _INDEX_BUFFER, 0, _UINT3, faces.ctypes.data, 0, 12, len(faces))
        self._kept += [vertices, faces]
        if gap is not None:
            gap = np.ascontiguousarray(gap, np.float32)
            self._kept.append(gap)
            pass_holes, weaken_light = leaf_filters()
            call.rtcSetGeometryUserData(geometry, gap.ctypes.data)
            call.rtcSetGeometryIntersectFilterFunction(geometry, pass_holes.address)
            call.rtcSetGeometryOccludedFilterFunction(geometry, weaken_light.address)
        call.rtcCommitGeometry(geometry)
        call.rtcAttachGeometryByID(scene, geometry, number)
        call.rtcReleaseGeometry(geometry)  # the scene keeps it alive

    def _scenes(self, past: Past) -> tuple[int, int]:
        """What stands still, and what moves (0 if nothing does, or rays go past the first alone)."""
        return self._still, self._moving if self._enabled and past == "all" else 0

    def _new_scene(self, flags: int) -> int:
        scene = self._library.rtcNewScene(self._device)
        self._built.append(scene)
        self._library.rtcSetSceneFlags(scene, flags)
        return scene

    def _new_instance(self, scene: int, slot: int) -> int:
        """An instance without a model yet."""
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
def _find_lanes(packet, lanes, rays, index, valid):
    """Ray in each lane of a packet, −1 for none, and Embree's mask of lanes."""
    for k in range(lanes):
        i = packet * lanes + k
        index[k] = i if i < rays else -1
        valid[k] = -1 if i < rays else 0


@nb.njit(cache=True)
def _aligned(words, boundary_bytes):
    """Index of the first word of an over-long buffer that lies on the boundary."""
    return ((boundary_bytes - words.ctypes.data % boundary_bytes) % boundary_bytes) // 4


@nb.njit(cache=True)
def _new_packet(lanes, origins, directions):
    """Fields of a packet, as numbers and as words, with what its rays share, and a mask of lanes; aligned."""
    spare = np.empty(_FIELDS * lanes + 32, np.float32)
    offset = _aligned(spare, 64)
    ray = spare[offset : offset + _FIELDS * lanes].reshape(_FIELDS, lanes)
    words = ray.view(np.uint32)
    spare_valid = np.empty(lanes + 32, np.int32)
    offset = _aligned(spare_valid, 64)
    for k in range(lanes):
        ray[_NEAR, k] = ray[_TIME, k] = 0.0
        words[_MASK, k] = words[_INSTANCE_ID, k] = NO_HIT
        words[_ID, k] = k
        words[_FLAGS, k] = 0
        for c in range(3):
            ray[_ORIGIN + c, k] = origins[0, c]
            ray[_DIRECTION + c, k] = directions[0, c]
    return ray, words, spare_valid[offset : offset + lanes]


@nb.njit(cache=True)
def _fill_rays(lanes, ray, index, origins, directions):
    """Write what differs from ray to ray into a packet's lanes; empty ones get the first ray."""
    if origins.shape[0] > 1:
        for k in range(lanes):
            i = max(index[k], 0)
            for c in range(3):
                ray[_ORIGIN + c, k] = origins[i, c]
    if directions.shape[0] > 1:
        for k in range(lanes):
            i = max(index[k], 0)
            for c in range(3):
                ray[_DIRECTION + c, k] = directions[i, c]
    for k in range(lanes):
        ray[_RANGE, k] = np.float32(math.inf)


@nb.njit(nogil=True, cache=True)
def _intersect(start, stop, lanes, still, moving, arguments, origins, directions, out):
    """Trace packets ``start`` to ``stop``."""
    rays = directions.shape[0]
    ray, words, valid = _new_packet(lanes, origins, directions)
    index = np.empty(lanes, np.int64)
    for packet in range(start, stop):
        _find_lanes(packet, lanes, rays, index, valid)
        _fill_rays(lanes, ray, index, origins, directions)
        for k in range(lanes):
            words[_GEOMETRY, k] = NO_HIT
        _meet(lanes, valid, still, ray, arguments)
        if moving != 0:  # only what is nearer than the first hits replaces them
            _meet(lanes, valid, moving, ray, arguments)
        for k in range(lanes):
            i = index[k]
            if i >= 0:
                hit = words[_GEOMETRY, k] != NO_HIT
                out.range_m[i] = ray[_RANGE, k] if hit else np.float32(math.inf)
                out.face[i] = words[_FACE, k] + words[_GEOMETRY, k] if hit else NO_HIT
                out.slot[i] = words[_INSTANCE_ID, k] if hit else NO_HIT
                out.barycentric[i, 0] = ray[_U, k]
                out.barycentric[i, 1] = ray[_V, k]


@nb.njit(nogil=True, cache=True)
def _transmit(start, stop, lanes, still, moving, origins, directions, coherent, wanted, light):
    """Trace packets ``start`` to ``stop``."""
    rays = wanted.shape[0]
    ray, _, valid = _new_packet(lanes, origins, directions)
    index = np.empty(lanes, np.int64)
    context = np.empty(CONTEXT_WORDS, np.float32)
    context.view(np.uint32)[:LIGHT_WORD] = NO_HIT
    arguments = np.zeros(5, np.uint64)  # RTCOccludedArguments: flags and feature mask, context, no callbacks
    # a coherent packet is walked once for each octant of directions in it, with all its lanes: cards would
    # take their share of the light more than once
    coherent = coherent and directions.shape[0] == 1
    arguments[0] = (np.uint64(NO_HIT) << np.uint64(32)) | np.uint64(_COHERENT if coherent else 0)
    arguments[1] = context.ctypes.data
    for packet in range(start, stop):
        _find_lanes(packet, lanes, rays, index, valid)
        any_wanted = False
        for k in range(lanes):
            if index[k] >= 0 and not wanted[index[k]]:
                valid[k] = 0
            context[LIGHT_WORD + k] = 1.0
            any_wanted |= valid[k] != 0
        if not any_wanted:
            continue
        _fill_rays(lanes, ray, index, origins, directions)
        _block(lanes, valid, still, ray, arguments)
        any_left = False
        for k in range(lanes):
            if valid[k] != 0 and ray[_RANGE, k] < 0:  # Embree marks a blocked ray by a range of −inf
                valid[k] = 0
                context[LIGHT_WORD + k] = 0.0
            any_left |= valid[k] != 0
        if moving != 0 and any_left:
            _block(lanes, valid, moving, ray, arguments)
        for k in range(lanes):
            i = index[k]
            if i >= 0 and wanted[i]:
                light[i] = 0.0 if ray[_RANGE, k] < 0 else context[LIGHT_WORD + k]


_RAY_ID, _HIT_U, _HIT_V, _HIT_FACE, _HIT_GEOMETRY = 10, 3, 4, 5, 6  # fields, in words of n lanes
LIGHT_WORD = 16  # of the query's context, after what Embree keeps there: light left of ray id 0
CONTEXT_WORDS = LIGHT_WORD + 16
_ANY_LENGTH = 1 << 30  # of a buffer whose length the callback does not know


@intrinsic
def _pointer(typing_context, address):
    """An address as a pointer that `carray` takes."""
    del typing_context, address

    def code(context, builder, signature, arguments):
        del context, signature
        return builder.inttoptr(arguments[0], ir.IntType(8).as_pointer())

    return types.voidptr(types.uint64), code


@nb.njit(cache=True)
def _floats(address, length):
    return carray(_pointer(address), length, np.float32)  # pyright: ignore


@nb.njit(cache=True)
def _unsigned(address, length):
    return carray(_pointer(address), length, np.uint32)  # pyright: ignore


@nb.njit(cache=True)
def _signed(address, length):
    return carray(_pointer(address), length, np.int32)  # pyright: ignore


def _pass_holes(arguments):
    """Let rays of look go on through the holes of cards."""
    words = carray(arguments, 6, np.uint64)
    lanes = np.int64(words[5] & np.uint64(0xFFFFFFFF))
    valid = _signed(words[0], lanes)
    gaps = _floats(words[1], _ANY_LENGTH)
    hit = _floats(words[4], 9 * lanes)
    numbers = _unsigned(words[4], 9 * lanes)
    for i in range(lanes):
        if valid[i] != 0:
            k = np.int64(numbers[_HIT_FACE * lanes + i])
            face = k + np.int64(numbers[_HIT_GEOMETRY * lanes + i])
            if is_hole(face, hit[_HIT_U * lanes + i], hit[_HIT_V * lanes + i], gaps[k]):
                valid[i] = 0


def _weaken_light(arguments):
    """Take a card's share of the light and let the rest go on, unless next to nothing is left."""
    words = carray(arguments, 6, np.uint64)
    lanes = np.int64(words[5] & np.uint64(0xFFFFFFFF))
    valid = _signed(words[0], lanes)
    gaps = _floats(words[1], _ANY_LENGTH)
    light = _floats(words[2], CONTEXT_WORDS)
    ray = _unsigned(words[3], 12 * lanes)
    numbers = _unsigned(words[4], 9 * lanes)
    for i in range(lanes):
        if valid[i] != 0:
            k = LIGHT_WORD + np.int64(ray[_RAY_ID * lanes + i])
            light[k] *= gaps[np.int64(numbers[_HIT_FACE * lanes + i])]
            if light[k] >= LEAST_LIGHT:
                valid[i] = 0


@lru_cache(maxsize=1)
def leaf_filters():
    """Compiled filters for a geometry's intersect and occluded queries; they live as long as the process."""
    compile_filter = nb.cfunc(types.void(types.voidptr), cache=True)
    return compile_filter(_pass_holes), compile_filter(_weaken_light)
