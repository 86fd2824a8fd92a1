"""One frame of the default city, in channels and as a cube, beside Mitsuba 3 rendering the same triangles.

``python benchmarks/render.py [--quick] [--json FILE] [--plot FILE] [--only PART]``. 880 × 560 elements, 200
moving vehicles, sun shadow, polarized sky by reflection, path. Alternates ours and the peer in the same run;
the median counts. ``ratio`` is the peer's time over ours; a row of a ratio of our own times has it in
``value``.

Mitsuba (``llvm_ad_mono_polarized``, ``direct`` with its default of one emitter and one surface sample) gets
the scene twice: with the 200 vehicles as instances, because they move, all else being one mesh a material
(``cube_61_vs_mitsuba_direct``); and with the vehicles as triangles too (``…_baked``), which it renders
faster but would have to build anew for every frame. Its sky is even and not polarized and its leaves have
no holes, which favours it. It knows one band at a time: ``--quick`` times one a turn and multiplies by 61,
else all 61 are rendered. At one sample its pictures are noisy where ours are not: the row of equal noise
extrapolates the samples that bring the standard deviation of its I to 1 % of the mean.
"""

import argparse
import json
import math
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.camera import Camera, Pose
from glintrack.core.spectral import channel_weights
from glintrack.flight import Flight, FlightDesign
from glintrack.render import Observer, Sky, build_tracer, frame_rays, shade, shade_blocks, trace, unpack_sky
from glintrack.render.light_around import light_around
from glintrack.render.observer import SURROUNDINGS
from glintrack.render.rays.lit import Lit
from glintrack.render.rays.resolve import NO_HIT, Surfaces, resolve
from glintrack.render.solid_heights import solid_heights
from glintrack.scene import City, Mesh, SceneDesign, Snapshot, build_scene
from glintrack.sensor import SensorDesign, build_sensor

VEHICLES, BANDS, TIME_S = 200, 61, 30.0
POLARIZERS_RAD = np.radians([0.0, 60.0, 120.0])
EQUAL_NOISE = 0.01
FORGET_PEAK = Path("/proc/self/clear_refs")  # Linux: writing 5 restarts the count of peak memory
CONTACT_M = 0.01  # a shadow ray that ends nearer than this has met its own surface, or one that touches it


@dataclass(frozen=True)
class Set:
    """What is rendered, by which observer."""

    observer: Observer
    snapshot: Snapshot
    pose: Pose
    pan: np.ndarray

    @property
    def city(self) -> City:
        """What is looked at."""
        return self.observer.city

    @property
    def sky(self) -> Sky:
        """By which light."""
        return self.observer.sky

    @property
    def camera(self) -> Camera:
        """Through what."""
        return self.observer.camera

    def trace(self, tracer, camera: Camera | None = None, oversampling: int = 1, snapshot=None):
        """One frame's hits, with another intersector, camera or scene if they are given."""
        return trace(
            self.snapshot if snapshot is None else snapshot,
            camera or self.camera,
            self.pose,
            self.sky.sun_direction,
            self.city.materials["roughness"].values,
            self.city.materials["material"].values.tolist().index(SURROUNDINGS),
            oversampling,
            tracer,
        )

    def shade(self, hits, channels, sky: Sky | None = None):
        """Stokes radiance of channels."""
        return shade(hits, sky or self.sky, self.city.materials, channels)


def build_set() -> Set:
    """The default city with 200 of its moving vehicles, seen 50° off nadir from 3 km."""
    city, tables = build_scene(SceneDesign()), solve_tables(AtmosphereDesign())
    flight = Flight(FlightDesign(), float(tables.attrs["sun_azimuth_rad"]))
    sky = unpack_sky(tables, flight.design.altitude_m)
    sensor = build_sensor(SensorDesign(), sky.wavelength_um)
    snapshot = at(city, TIME_S)
    return Set(Observer(city, sky, sensor.camera, snapshot), snapshot, flight.pose(0.0), sensor.pan_weights)


def at(city: City, time_s: float) -> Snapshot:
    """The city with all that stands and the first 200 that drive."""
    now = city.at(time_s)
    keep = slice(0, now.fixed + VEHICLES)
    return replace(
        now,
        transforms=now.transforms[keep],
        model=now.model[keep],
        paint=now.paint[keep],
        vehicle_id=now.vehicle_id[keep],
    )


def row(name: str, value: float | None, unit: str, peer: str = "", ratio: float | None = None) -> dict:
    """One row of the report."""
    return {"name": name, "value": value, "unit": unit, "peer": peer, "ratio": ratio}


def tell(what: str) -> None:
    """Progress, apart from the table."""
    print(f"… {what}", file=sys.stderr, flush=True)


def alternating(works: list, repeats: int, clock=time.perf_counter) -> np.ndarray:
    """Median time of each, run in turns after one warm-up. [ms]"""
    for work in works:
        work()
    times = np.empty((repeats, len(works)))
    for k in range(repeats):
        for which, work in enumerate(works):
            start = clock()
            work()
            times[k, which] = 1e3 * (clock() - start)
    return np.median(times, axis=0)


def elements(light: np.ndarray) -> list[np.ndarray]:
    """Pan and what passes three ideal polarizers, from I, Q and U of one channel."""
    i, q, u = light[..., 0], light[..., 1], light[..., 2]
    return [i, *(0.5 * (i + q * math.cos(2 * a) + u * math.sin(2 * a)) for a in POLARIZERS_RAD)]


def with_bands(one: Set, count: int) -> Sky:
    """The same light on a grid of so many wavelengths over 0.4 to 1.0 µm."""
    tables = solve_tables(AtmosphereDesign()).interp(wavelength=np.linspace(0.4, 1.0, count))
    return unpack_sky(tables, one.pose.up_m)


def own_rows(one: Set, tracer, quick: bool) -> list[dict]:
    """What needs no peer."""
    repeats = 2 if quick else 9
    hits = one.trace(tracer)
    fine, coarse = with_bands(one, 211), with_bands(one, 10)
    weights = {
        len(s.wavelength_um): channel_weights(s.wavelength_um, np.ones((1, len(s.wavelength_um))))
        for s in (fine, coarse)
    }
    other = at(one.city, TIME_S + 0.5)
    works = [
        lambda: elements(one.shade(one.trace(tracer), one.pan).values[:, :, 0]),
        lambda: one.trace(tracer),
        lambda: one.shade(hits, one.pan),
        lambda: one.shade(hits, weights[211], fine),
        lambda: one.shade(hits, weights[10], coarse),
        lambda: one.shade(one.trace(tracer, oversampling=3), one.pan),
    ]
    frame, traced, shaded, many, few, over = alternating(works, repeats)
    turns = [other, one.snapshot]

    def move():
        turns.reverse()
        tracer.place(turns[0])

    (moved,) = alternating([move], 10 * repeats)
    tracer.place(one.snapshot)
    return [
        row("channel_frame", frame, "ms: trace, pan and three polarizers"),
        row("trace", traced, "ms"),
        *trace_rows(one, tracer, repeats),
        row("shade_one_channel", shaded, "ms"),
        row("channels_211_over_10", many / few, "1"),
        row("move_200_vehicles", moved, "ms"),
        row("oversampling_3x3_over_1", over / frame, "1"),
        *self_shadow_rows(one, tracer),
    ]


def meet(one: Set, tracer):
    """Rays of look, what they meet, and the surfaces there."""
    directions = frame_rays(one.camera, one.pose)
    met = tracer.rays.intersect(one.pose.position.astype(np.float32)[None], directions, True)
    eye, sun = one.pose.position[None], one.sky.sun_direction
    return met, resolve(eye, directions, met, tracer.faces, one.snapshot, 0, sun, tracer.sheets)


def trace_rows(one: Set, tracer, repeats: int) -> list[dict]:
    """The parts of `trace`; and of look without trees, hedges and parked vehicles.

    Time of all cores together: parts that are run one after the other share cores in a frame.
    """
    moving = slice(one.snapshot.fixed, None)
    kept = {k: getattr(one.snapshot, k)[moving] for k in ("transforms", "model", "paint", "vehicle_id")}
    bare = build_tracer(replace(one.snapshot, **kept, fixed=0))
    bare.place(replace(one.snapshot, **kept, fixed=0))
    sun, origin = (
        np.array(one.sky.sun_direction, np.float32)[None],
        one.pose.position.astype(np.float32)[None],
    )
    directions = frame_rays(one.camera, one.pose)
    _, seen = meet(one, tracer)
    lit, scene = seen.sun_cosine != 0, Lit(tracer, one.snapshot, 0, sun[0])
    one.trace(tracer)  # finds the probes

    works = [
        lambda: tracer.rays.intersect(origin, directions, True),
        lambda: tracer.rays.transmitted(seen.lifted, sun, lit, True),
        lambda: bare.rays.intersect(origin, directions, True),
        lambda: meet(one, tracer),
        lambda: light_around(scene, seen, Surfaces.empty(0)),
        lambda: solid_heights(one.snapshot, tracer.sheets, one.city.extent_m),
    ]
    works.append(lambda: one.trace(tracer))
    times = alternating(works, repeats, time.process_time)
    look, sunward, bare_look, met, sky, heights, traced = times
    return [
        row("trace_all_cores", traced, "ms of all cores, as the rows after it"),
        row("trace_look", look, f"ms; {bare_look:.0f} without trees, hedges and parked vehicles"),
        row("trace_sun", sunward, "ms: rays to the sun"),
        row("trace_surfaces", met - look, "ms: directions of look, points, normals, materials"),
        row("trace_light_around", sky, "ms: probes of sky and surroundings"),
        row("trace_heights", heights, "ms: the map of heights, once a scene, no part of the first row"),
        row("trace_mirrors_and_rest", traced - met - sunward - sky, "ms"),
    ]


def self_shadow_rows(one: Set, tracer) -> list[dict]:
    """Pixels whose way to the sun ends within a centimetre, and those of them that no real contact shades.

    The ray starts on the facet itself and meets the triangle that was found, both in double precision: in a
    real contact it meets it ahead.
    """
    met, seen = meet(one, tracer)
    facing = np.flatnonzero((met[1] != NO_HIT) & (seen.sun_cosine > 0))
    sun = np.asarray(one.sky.sun_direction, float)
    along = np.broadcast_to(sun.astype(np.float32), (len(facing), 3))
    found = tracer.rays.intersect(seen.lifted[facing], np.ascontiguousarray(along))
    near = np.flatnonzero(found[0] < CONTACT_M)
    at = facing[near]
    own = corners(one.snapshot, tracer.faces, met[1][at], met[2][at])
    other = corners(one.snapshot, tracer.faces, found[1][near], found[2][near])
    u, v = met[3][at].T.astype(float)[..., None]
    point = own[:, 0] + u * (own[:, 1] - own[:, 0]) + v * (own[:, 2] - own[:, 0])
    e, f = other[:, 1] - other[:, 0], other[:, 2] - other[:, 0]
    distance, u, v = np.linalg.solve(
        np.stack([np.broadcast_to(-sun, e.shape), e, f], 2), (point - other[:, 0])[..., None]
    )[..., 0].T
    real = (distance > 0) & (u >= 0) & (v >= 0) & (u + v <= 1)
    rays = len(seen.material)
    return [
        row("contact_shadow", real.sum() / rays, f"of pixels: shaded by what is within {CONTACT_M} m"),
        row("false_self_shadow", (~real).sum() / rays, "of pixels"),
    ]


def corners(snapshot: Snapshot, faces, primitive: np.ndarray, slot: np.ndarray) -> np.ndarray:
    """Corners of faces that rays met, in double precision. [m]"""
    instance = slot.astype(int) - 1
    mesh = np.where(instance < 0, 0, np.asarray(snapshot.model)[instance] + 1)
    own = faces.vertices[faces.corners[faces.start[mesh] + primitive]].astype(float)
    place = np.asarray(snapshot.transforms)[instance]
    placed = np.einsum("kij,kcj->kci", place[:, :, :3], own) + place[:, None, :, 3]
    return np.where((instance < 0)[:, None, None], own, placed)


def load_mitsuba():
    """Mitsuba with the polarized LLVM variant, or the reason why not."""
    try:
        import mitsuba as mi

        mi.set_variant("llvm_ad_mono_polarized")
        import drjit as dr

        dr.eval(dr.arange(mi.Float, 4) + 1)
    except Exception as error:  # not installed, or Dr.Jit finds no LLVM
        return None, f"skipped: {' '.join(str(error).split())[:120]}"
    return mi, ""


def baked(snapshot: Snapshot, count_instances: int) -> Mesh:
    """The static mesh and the first instances as one mesh."""
    static = snapshot.static
    vertices, faces, materials = [static.vertices], [static.faces], [static.material]
    count = len(static.vertices)
    for k in range(count_instances):
        mesh, matrix = snapshot.models[int(snapshot.model[k])], snapshot.transforms[k]
        vertices.append((mesh.vertices @ matrix[:, :3].T + matrix[:, 3]).astype(np.float32))
        faces.append(mesh.faces + count)
        materials.append(np.where(mesh.material < 0, snapshot.paint[k], mesh.material).astype(np.int16))
        count += len(mesh.vertices)
    return Mesh(np.concatenate(vertices), np.concatenate(faces), np.concatenate(materials))


def mitsuba_scene(mi, one: Set, instances: bool):
    """The same triangles, lit by the sun and an even sky; vehicles as instances, or as triangles."""
    materials = one.city.materials
    band = int(np.argmin(np.abs(materials["wavelength"].values - 0.65)))
    reflectance, roughness = materials["reflectance"].values[:, band], materials["roughness"].values

    def bsdf(m: int) -> dict:
        value = {"type": "uniform", "value": float(reflectance[m])}
        alpha = max(float(roughness[m]), 0.02)
        return {"type": "pplastic", "distribution": "ggx", "alpha": alpha, "diffuse_reflectance": value}

    def parts(mesh: Mesh, prefix: str) -> dict:
        out = {}
        for m in np.unique(mesh.material):
            used, faces = np.unique(mesh.faces[mesh.material == m], return_inverse=True)
            props = mi.Properties()
            props["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": bsdf(int(m if m >= 0 else paint))})
            shape = mi.Mesh(f"{prefix}{m}", len(used), faces.size // 3, props=props)
            values = mi.traverse(shape)
            values["vertex_positions"] = np.ravel(mesh.vertices[used]).astype(np.float32)
            values["faces"] = np.ravel(faces).astype(np.uint32)
            values.update()
            out[f"{prefix}{m}".replace("-", "n")] = shape
        return out

    snapshot = one.snapshot
    paint = int(snapshot.paint[-1])
    first = snapshot.fixed if instances else len(snapshot.model)
    scene: dict = {"type": "scene", **parts(baked(snapshot, first), "still")}
    for model in np.unique(snapshot.model[first:]):
        group = parts(snapshot.models[int(model)], f"model{model}of")
        scene[f"group{model}"] = {"type": "shapegroup", **group}
    for k in range(first, len(snapshot.model)):
        whole = mi.ScalarTransform4f(np.vstack([snapshot.transforms[k], [0, 0, 0, 1]]).tolist())
        group = {"type": "ref", "id": f"group{int(snapshot.model[k])}"}
        scene[f"vehicle{k}"] = {"type": "instance", "to_world": whole, "shapes": group}
    toward = [-float(x) for x in one.sky.sun_direction]
    sun, sky = float(one.sky.sun_irradiance[25]), float(one.sky.sky_irradiance[25]) / math.pi
    scene["sun"] = {
        "type": "directional",
        "direction": toward,
        "irradiance": {"type": "uniform", "value": sun},
    }
    scene["sky"] = {"type": "constant", "radiance": {"type": "uniform", "value": sky}}
    camera, pose = one.camera, one.pose
    film = {"type": "hdrfilm", "width": camera.columns, "height": camera.rows, "pixel_format": "luminance"}
    scene["sensor"] = {
        "type": "perspective",
        "fov": math.degrees(2 * math.atan(camera.columns * camera.pitch_m / 2 / camera.focal_length_m)),
        "fov_axis": "x",
        "near_clip": 10.0,
        "far_clip": 1e5,
        "to_world": mi.ScalarTransform4f().look_at(
            origin=pose.position.tolist(), target=[0, 0, 0], up=[0, 0, 1]
        ),
        "film": {**film, "component_format": "float32", "rfilter": {"type": "box"}},
    }
    return mi.load_dict(scene)


def peer_rows(one: Set, tracer, quick: bool) -> list[dict]:
    """The cube of 61 bands beside Mitsuba."""
    identity, peer = np.eye(BANDS), "Mitsuba 3 llvm_ad_mono_polarized direct, 1 spp, 61 renders"

    kept = [one.shade(one.trace(tracer), identity)]

    def cube():
        kept[0] = shade(one.trace(tracer), one.sky, one.city.materials, identity, out=kept[0])

    def fresh():
        one.shade(one.trace(tracer), identity)

    def streamed():
        for _ in shade_blocks(one.trace(tracer), one.sky, one.city.materials, identity):
            pass

    into_kept, into_fresh, in_blocks = alternating([cube, fresh, streamed], 3, time.process_time)
    other_memory = [
        row(
            "cube_61_all_cores", into_kept, "ms of all cores, as the rows after it; memory of the cube before"
        ),
        row("cube_61_fresh_memory", into_fresh, "ms"),
        row("cube_61_in_blocks", in_blocks, "ms: each of 32 rows is given away before the next is made"),
    ]
    mi, reason = load_mitsuba()
    if mi is None:
        (ours,) = alternating([cube], 3)
        return [row("cube_61_vs_mitsuba_direct", ours, "ms", f"{peer}: {reason}"), *other_memory]
    integrator = mi.load_dict({"type": "stokes", "nested": {"type": "direct"}})
    seeds = iter(range(1, 1_000_000))
    scenes = {"direct": mitsuba_scene(mi, one, True), "baked": mitsuba_scene(mi, one, False)}

    def bands(scene, count: int, spp: int = 1):
        shots = (mi.render(scene, integrator=integrator, spp=spp, seed=next(seeds)) for _ in range(count))
        return [np.array(shot) for shot in shots]

    count = 1 if quick else BANDS
    works = [cube, *(lambda s=s: bands(s, count) for s in scenes.values())]
    ours, *peers = alternating(works, 2)
    said = f"{peer} ({'one timed, times 61' if quick else 'all timed'})"
    rows = []
    for name, took in zip(scenes, peers, strict=True):
        form = "vehicles as instances" if name == "direct" else "all as triangles"
        rows.append(
            row(f"cube_61_vs_mitsuba_{name}", ours, "ms", f"{said}, {form}", took * BANDS / count / ours)
        )
    return [
        *rows,
        *other_memory,
        equal_noise(ours, peers[1] / count, lambda spp: bands(scenes["baked"], 1, spp)[0]),
    ]


def equal_noise(ours: float, one_sample: float, render) -> dict:
    """The cube beside Mitsuba's faster scene with as many samples as its noise takes."""
    a, b = (render(16)[..., 1] for _ in range(2))
    bright = a[a > 0].mean()
    noise = float(np.std(a - b) / math.sqrt(2) / bright)
    (sixteen,) = alternating([lambda: render(16)], 1)
    spp = 16 * (noise / EQUAL_NOISE) ** 2
    took = BANDS * (one_sample + (spp - 1) * (sixteen - one_sample) / 15)
    said = f"Mitsuba, all as triangles, {spp:.0f} spp (from {noise:.3f} of mean I at 16 spp to {EQUAL_NOISE})"
    return row("cube_61_equal_noise", ours, "ms", said, took / ours)


def process_rows() -> list[dict]:
    """What is measured in a process of its own; its kernels were compiled by this one."""
    start = time.perf_counter()
    command = [sys.executable, __file__, "--child"]
    done = subprocess.run(command, capture_output=True, text=True, check=True)
    wall = time.perf_counter() - start
    said = json.loads(done.stdout.strip().splitlines()[-1])
    rows = [
        row("first_frame_warm_cache", said["frame_s"], "s, scene built"),
        row("fresh_process_to_first_frame", wall, "s, with imports and the city"),
    ]
    if "above_mb" in said:
        rows.append(row("memory_of_a_channel_frame", said["above_mb"], "MB above the scene's process"))
    return rows


def child_main() -> None:
    """First frame of this process, and the memory it takes above the built scene; one line of JSON."""
    one = build_set()
    tracer = one.observer.tracer
    before = memory_mb("VmRSS")
    if before is not None:
        FORGET_PEAK.write_text("5")
    start = time.perf_counter()
    elements(one.shade(one.trace(tracer), one.pan).values[..., 0, :])
    said = {"frame_s": time.perf_counter() - start}
    peak = memory_mb("VmHWM")
    if before is not None and peak is not None:
        said["above_mb"] = peak - before
    print(json.dumps(said))


def memory_mb(name: str) -> float | None:
    """One figure of this process's memory; None where there is no /proc. [MB]"""
    status = Path("/proc/self/status")
    if not status.exists():
        return None
    line = next(text for text in status.read_text().splitlines() if text.startswith(name))
    return float(line.split()[1]) / 1e3


def hills(triangles: int) -> Mesh:
    """Rolling ground of so many triangles over the window."""
    columns = max(int(math.sqrt(triangles * 660 / 420 / 2)), 2)
    rows = max(triangles // (2 * columns), 2)
    y, x = np.mgrid[0 : rows + 1, 0 : columns + 1]
    z = 1.5 * np.sin(x * 40.0 / columns) * np.cos(y * 25.0 / rows)
    vertices = np.stack([660 * (x / columns - 0.5), 420 * (y / rows - 0.5), z], axis=-1).reshape(-1, 3)
    i = (y[:-1, :-1] * (columns + 1) + x[:-1, :-1]).ravel()
    faces = np.concatenate(
        [np.stack([i, i + 1, i + columns + 2], 1), np.stack([i, i + columns + 2, i + columns + 1], 1)]
    )
    return Mesh(vertices.astype(np.float32), faces.astype(np.int32), np.zeros(len(faces), np.int16))


def scaling_rows(one: Set, tracer, quick: bool) -> tuple[list[dict], dict[str, list[tuple[float, float]]]]:
    """Time that all cores together take for a channel frame, against triangles and against pixels."""
    curves: dict[str, list[tuple[float, float]]] = {"triangles": [], "pixels": []}

    def took(ready, camera: Camera, snapshot: Snapshot) -> float:
        (ms,) = alternating(
            [lambda: one.shade(one.trace(ready, camera, snapshot=snapshot), one.pan)], 3, time.process_time
        )
        return ms

    for triangles in (10_000, 100_000) if quick else (10_000, 100_000, 1_000_000, 5_000_000):
        none = np.zeros(0, int)
        scene = Snapshot(hills(triangles), (), np.zeros((0, 3, 4)), none, none, none)
        ready = build_tracer(scene)
        curves["triangles"].append((len(scene.static.faces), took(ready, one.camera, scene)))
    for factor in (0.25, 0.5) if quick else (0.25, 0.5, 1.0, 2.0):
        camera = one.camera
        shape = round(camera.rows * factor), round(camera.columns * factor)
        scaled = Camera(camera.focal_length_m, camera.pitch_m / factor, *shape)
        curves["pixels"].append((shape[0] * shape[1], took(tracer, scaled, one.snapshot)))
    rows = [
        row(f"channel_frame_{n:.0f}_{name}", ms, "ms of all cores")
        for name, curve in curves.items()
        for n, ms in curve
    ]
    return rows, curves


def plot(curves: dict[str, list[tuple[float, float]]], path: Path) -> None:
    """Both curves, logarithmic."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.4), layout="constrained")
    for ax, (name, points) in zip(figure.subplots(1, 2), curves.items(), strict=True):
        ax.loglog(*zip(*points, strict=True), "o-", color="#1f5fa8")
        ax.set(
            xlabel=name,
            ylabel="channel frame, all cores together [ms]",
            ylim=(10, 2 * max(ms for _, ms in points)),
        )
        ax.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
    print(f"wrote {path}")


def main() -> None:
    """Measure, print, and write if asked."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, help="write the rows here")
    parser.add_argument("--plot", type=Path, help="draw the scaling here")
    parser.add_argument("--only", choices=("peer", "own", "process", "scaling"), help="this part alone")
    parser.add_argument("--child", action="store_true", help=argparse.SUPPRESS)
    arguments = parser.parse_args()
    if arguments.child:
        child_main()
        return
    tell("building the city")
    one = build_set()
    tracer = one.observer.tracer
    curves: dict[str, list[tuple[float, float]]] = {}

    def scaling() -> list[dict]:
        rows, found = scaling_rows(one, tracer, arguments.quick)
        curves.update(found)
        return rows

    parts = {
        "peer": ("Mitsuba and the cube", lambda: peer_rows(one, tracer, arguments.quick)),
        "own": ("channels", lambda: own_rows(one, tracer, arguments.quick)),
        "process": ("a fresh process", process_rows),
        "scaling": ("scaling", scaling),
    }
    rows = []
    for name, (said, work) in parts.items():
        if arguments.only in (None, name):
            tell(said)
            rows += work()
    for one_row in rows:
        against = f"  {one_row['ratio']:8.1f} ×" if one_row["ratio"] is not None else ""
        print(f"{one_row['name']:36s} {one_row['value']:10.4g} {one_row['unit']}{against}  {one_row['peer']}")
    if arguments.plot is not None and curves:
        plot(curves, arguments.plot)
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
