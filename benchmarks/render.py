"""Time one frame of the default city, in channels and as a cube, and Mitsuba 3 on the same triangles.

``python benchmarks/render.py [--quick] [--json FILE]``. 880 × 560 elements, 200 moving vehicles, sun shadow,
polarized sky by reflection, path. Ours and the peer alternate in the same run; the median counts. ``ratio``
is the peer's time over ours.

Mitsuba (``llvm_ad_mono_polarized``, ``direct`` with its default of one emitter and one surface sample) gets
the scene twice: with the 200 vehicles as instances, because they move, all else being one mesh a material
(``cube_61_vs_mitsuba_direct``); and with the vehicles as triangles too (``…_baked``), which it renders
faster but would have to build again for every frame. Its sky is even and not polarized and its leaves have
no holes, which favours it. It knows one band at a time: ``--quick`` times one a turn and multiplies by 61,
else all 61 are rendered. At one sample its pictures are noisy where ours are not: the row of equal noise
extrapolates the samples that bring the standard deviation of its I to 1 % of the mean.
"""

import argparse
import json
import math
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))
from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.camera import Pose
from glintrack.core.spectral import channel_weights
from glintrack.flight import Flight, FlightDesign
from glintrack.render import Observer, Sky, shade, unpack_sky
from glintrack.scene import City, Mesh, SceneDesign, Snapshot, build_scene
from glintrack.sensor import SensorDesign, build_sensor
from validation.mitsuba_scene import add_meshes, load_mitsuba

VEHICLES, BANDS, TIME_S = 200, 61, 30.0
POLARIZERS_RAD = np.radians([0.0, 60.0, 120.0])
EQUAL_NOISE = 0.01


@dataclass(frozen=True)
class View:
    """Observer, scene and pose of the frame, and the weights of the panchromatic channel."""

    observer: Observer
    snapshot: Snapshot
    pose: Pose
    pan: np.ndarray

    def trace(self):
        """Trace the frame."""
        return self.observer.trace(self.snapshot, self.pose)

    def shade(self, hits, channels, sky: Sky | None = None):
        """Stokes radiance of channels."""
        return shade(hits, sky or self.observer.sky, self.observer.city.materials, channels)


def build_view() -> View:
    """Build the default city with 200 of its moving vehicles, seen 50° off nadir from 3 km."""
    city, tables = build_scene(SceneDesign()), solve_tables(AtmosphereDesign())
    flight = Flight(FlightDesign(), float(tables.attrs["sun_azimuth_rad"]))
    sky = unpack_sky(tables, flight.design.altitude_m)
    sensor = build_sensor(SensorDesign(), sky.wavelength_um)
    snapshot = with_vehicles(city, TIME_S)
    return View(Observer(city, sky, sensor.camera, snapshot), snapshot, flight.pose(0.0), sensor.pan_weights)


def with_vehicles(city: City, time_s: float) -> Snapshot:
    """All that stands and the first 200 moving vehicles."""
    now = city.at(time_s)
    keep = slice(0, now.fixed + VEHICLES)
    columns = ("transforms", "model", "paint", "vehicle_id")
    return replace(now, **{name: getattr(now, name)[keep] for name in columns})


def row(name: str, value: float, unit: str, peer: str | None = None, ratio: float | None = None) -> dict:
    """One row of the report."""
    return {"name": name, "value": float(value), "unit": unit, "peer": peer, "ratio": ratio}


def alternating(works: list, repeats: int, clock=time.perf_counter) -> np.ndarray:
    """Median time of each work, run in turns after one warm-up. [ms]"""
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


def own_rows(view: View, quick: bool) -> list[dict]:
    """Rows without a peer."""
    hits = view.trace()
    skies = {}
    for count in (211, 10):
        tables = solve_tables(AtmosphereDesign()).interp(wavelength=np.linspace(0.4, 1.0, count))
        sky = unpack_sky(tables, view.pose.up_m)
        skies[count] = channel_weights(sky.wavelength_um, np.ones((1, count))), sky
    works = [
        lambda: elements(view.shade(view.trace(), view.pan).values[:, :, 0]),
        view.trace,
        lambda: view.shade(hits, view.pan),
        lambda: view.shade(hits, *skies[211]),
        lambda: view.shade(hits, *skies[10]),
    ]
    frame, traced, shaded, many, few = alternating(works, 2 if quick else 9)
    return [
        row("channel_frame", frame, "ms: trace, pan and three polarizers"),
        row("trace", traced, "ms"),
        row("shade_one_channel", shaded, "ms"),
        row("channels_211_over_10", many / few, "1"),
    ]


def merge_instances(snapshot: Snapshot, count_instances: int) -> Mesh:
    """Merge the static mesh and the first instances."""
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


def mitsuba_scene(mi, view: View, instances: bool):
    """Build the same triangles, lit by the sun and an even sky; vehicles as instances, or as triangles."""
    materials, sky, camera = view.observer.city.materials, view.observer.sky, view.observer.camera
    snapshot, pose = view.snapshot, view.pose
    band = int(np.argmin(np.abs(materials["wavelength"].values - 0.65)))
    reflectance, roughness = materials["reflectance"].values[:, band], materials["roughness"].values
    paint = int(snapshot.paint[-1])

    def surface(m: int):
        m = m if m >= 0 else paint
        value = {"type": "uniform", "value": float(reflectance[m])}
        alpha = max(float(roughness[m]), 0.02)
        coat = {"type": "pplastic", "distribution": "ggx", "alpha": alpha, "diffuse_reflectance": value}
        return mi.load_dict({"type": "twosided", "bsdf": coat})

    first = snapshot.fixed if instances else len(snapshot.model)
    scene = add_meshes(mi, {"type": "scene"}, "still", merge_instances(snapshot, first), surface)
    for model in np.unique(snapshot.model[first:]):
        group = add_meshes(
            mi, {"type": "shapegroup"}, f"model{model}of", snapshot.models[int(model)], surface
        )
        scene[f"group{model}"] = group
    for k in range(first, len(snapshot.model)):
        whole = mi.ScalarTransform4f(np.vstack([snapshot.transforms[k], [0, 0, 0, 1]]).tolist())
        group = {"type": "ref", "id": f"group{int(snapshot.model[k])}"}
        scene[f"vehicle{k}"] = {"type": "instance", "to_world": whole, "shapes": group}
    toward = [-float(x) for x in sky.sun_direction]
    sun, glow = float(sky.sun_irradiance[25]), float(sky.sky_irradiance[25]) / math.pi
    scene["sun"] = {
        "type": "directional",
        "direction": toward,
        "irradiance": {"type": "uniform", "value": sun},
    }
    scene["sky"] = {"type": "constant", "radiance": {"type": "uniform", "value": glow}}
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


def peer_rows(view: View, quick: bool) -> list[dict]:
    """Rows of the cube of 61 bands: Mitsuba at equal samples and at equal noise."""
    identity, peer = np.eye(BANDS), "Mitsuba 3 llvm_ad_mono_polarized direct, 1 spp, 61 renders"

    def cube():
        view.shade(view.trace(), identity)

    try:
        mi, _ = load_mitsuba()
    except RuntimeError as reason:
        (ours,) = alternating([cube], 3)
        return [row("cube_61_vs_mitsuba_direct", ours, "ms", f"{peer}: {reason}")]
    integrator = mi.load_dict({"type": "stokes", "nested": {"type": "direct"}})
    seeds = iter(range(1, 1_000_000))
    scenes = {"direct": mitsuba_scene(mi, view, True), "baked": mitsuba_scene(mi, view, False)}

    def bands(scene, count: int, spp: int = 1):
        shots = (mi.render(scene, integrator=integrator, spp=spp, seed=next(seeds)) for _ in range(count))
        return [np.array(shot) for shot in shots]

    count = 1 if quick else BANDS
    ours, *peers = alternating([cube, *(lambda s=s: bands(s, count) for s in scenes.values())], 2)
    said = f"{peer} ({'one timed, times 61' if quick else 'all timed'})"
    rows = []
    for name, took in zip(scenes, peers, strict=True):
        form = "vehicles as instances" if name == "direct" else "all as triangles"
        ratio = float(took * BANDS / count / ours)
        rows.append(row(f"cube_61_vs_mitsuba_{name}", ours, "ms", f"{said}, {form}", ratio))
    return [*rows, equal_noise(ours, peers[1] / count, lambda spp: bands(scenes["baked"], 1, spp)[0])]


def equal_noise(ours: float, one_sample: float, render) -> dict:
    """Row of the cube and Mitsuba's faster scene at as many samples as its noise takes."""
    a, b = (render(16)[..., 1] for _ in range(2))
    bright = a[a > 0].mean()
    noise = float(np.std(a - b) / math.sqrt(2) / bright)
    (sixteen,) = alternating([lambda: render(16)], 1)
    spp = 16 * (noise / EQUAL_NOISE) ** 2
    took = BANDS * (one_sample + (spp - 1) * (sixteen - one_sample) / 15)
    said = f"Mitsuba, all as triangles, {spp:.0f} spp (from {noise:.3f} of mean I at 16 spp to {EQUAL_NOISE})"
    return row("cube_61_equal_noise", ours, "ms", said, float(took / ours))


def main() -> None:
    """Measure, print, and optionally write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawTextHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="under a minute")
    parser.add_argument("--json", type=Path, help="write the rows here")
    arguments = parser.parse_args()
    view = build_view()
    rows = own_rows(view, arguments.quick) + peer_rows(view, arguments.quick)
    for one in rows:
        against = f"  {one['ratio']:8.1f} ×" if one["ratio"] is not None else ""
        print(f"{one['name']:36s} {one['value']:10.4g} {one['unit']}{against}  {one['peer'] or ''}")
    if arguments.json is not None:
        arguments.json.write_text(json.dumps({"rows": rows}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
