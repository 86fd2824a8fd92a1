"""Compare the renderer with Mitsuba 3's full path in the default city, class by class of surface.

    python validation/mitsuba_city.py [--cut 150] [--rays 8000] [--samples 256] [--depth 8]
                                      [--samples-in-shade 1024] [--peer FOLDER] [--quick]

Two views (toward the sun and away from it), two wavelengths, two sun heights. Both programs get the same
triangles, the same sun and our own polarized sky; the same rays start again 5 cm before the points that ours
met. Mottle is left out of ours; Mitsuba's bases are its own. ``--peer`` keeps Mitsuba's side in a folder, so
that a changed renderer is compared in seconds.

Left out, by a rule that looks at no result: rays to the sky; rays that Mitsuba starts again on another face
(5 mm, 2°); points where the sun is neither up nor hidden (2 to 98 %: half shade of crowns, which ours makes
even and Mitsuba dapples); smooth surfaces within 3° (of the half vector) of the sun's mirror image.

A quarter of a ray's paths look for the sun's light, which in the shade few of them find: with 32 of them half
of the rays get less than 0.95 of what their mean would be, and the median of ours over theirs lies too high
by that alone. ``--samples-in-shade`` gives rays in the shade more paths, as many for the sun's light as
for the sky's.
"""

import argparse
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.special import ndtr

sys.path.insert(0, str(Path(__file__).parents[1]))

from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.camera import Camera, Pose, look_at
from glintrack.render import Hits, Sky, build_tracer, shade, trace, unpack_sky
from glintrack.render.light.gather import material_classes
from glintrack.render.light.lattice import SPACE
from glintrack.render.shading.materials import fresnel, unpack_surfaces
from glintrack.scene import Mesh, SceneDesign, Snapshot, build_scene
from validation import mitsuba_scene
from validation.mitsuba_scene import load_mitsuba, surfaces_at

HOURS, WAVELENGTHS_UM, VIEWS_DEG = (15.0, 17.0), (0.55, 0.85), (0.0, 180.0)
NEAR = 0.75, 1.35  # ratios of I that count as near
DISTANCE_M, OFF_NADIR_DEG = 3000.0, 50.0
_FAR_M = 3000.0
BEFORE_M, GLINT_DEG, SMOOTH = 0.05, 3.0, 0.1
CLASSES = {
    "road": ("asphalt", "asphalt_worn", "road_paint", "concrete", "pavement", "kerb"),
    "roof": ("roof_",),
    "grass": ("grass", "soil"),
    "wall": ("brick", "plaster", "siding", "wood"),
    "lorry side": ("brick", "plaster", "siding", "wood"),  # of vehicles: they have probes of their own
    "leaves": ("leaf",),
    "car roof": ("paint_",),
    "car side": ("paint_",),
    "car glass, sky": ("glass",),
    "car glass, surface": ("glass",),
    "tyre, plastic": ("tyre_rubber", "plastic_black"),
}


@dataclass(frozen=True)
class View:
    """One view of the city as ours sees it, and its rays."""

    hits: Hits
    sky: Sky
    rays: np.ndarray
    excluded: dict[str, int]


@dataclass(frozen=True)
class Pair:
    """Stokes radiance (ray, 3) of both at the ground and at the sensor, and Mitsuba's standard error."""

    ours: np.ndarray
    peer: np.ndarray
    ours_at_sensor: np.ndarray
    peer_at_sensor: np.ndarray
    error: np.ndarray


def cut(snapshot: Snapshot, side_m: float, ground: int, margin_m: float = 60.0) -> Snapshot:
    """Select the part of a scene within a square around its middle and a margin."""
    far = 0.5 * side_m + margin_m
    corners = snapshot.static.vertices[snapshot.static.faces][..., :2]
    inside = (corners.min(axis=1) < far).all(axis=1) & (corners.max(axis=1) > -far).all(axis=1)
    near = np.asarray((np.abs(snapshot.transforms[:, :2, 3]) < far).all(axis=1))
    level = float(snapshot.static.vertices[:, 2].min()) - 0.1  # what lies around the square is level ground
    plain = np.array([(x, y, level) for y in (-_FAR_M, _FAR_M) for x in (-_FAR_M, _FAR_M)], np.float32)
    count = len(snapshot.static.vertices)
    static = Mesh(
        np.concatenate([snapshot.static.vertices, plain]),
        np.concatenate(
            [snapshot.static.faces[inside], [[count, count + 1, count + 3], [count, count + 3, count + 2]]]
        ),
        np.concatenate([snapshot.static.material[inside], np.full(2, ground)]).astype(np.int16),
    )
    return replace(
        snapshot,
        static=static,
        transforms=snapshot.transforms[near],
        model=np.asarray(snapshot.model)[near],
        paint=np.asarray(snapshot.paint)[near],
        vehicle_id=np.asarray(snapshot.vehicle_id)[near],
        fixed=int(near[: snapshot.fixed].sum()),
    )


def view_of(snapshot, materials, window, sky: Sky, turn_deg: float, count: int, side_m: float | None) -> View:
    """Trace a view and choose its rays: all on moving vehicles up to a third, the others at random."""
    sun = np.asarray(sky.sun_direction)
    azimuth = math.atan2(sun[0], sun[1]) + math.radians(turn_deg)
    off = math.radians(OFF_NADIR_DEG)
    place = -DISTANCE_M * math.sin(off) * np.array([math.sin(azimuth), math.cos(azimuth)])
    pose = look_at(Pose(float(place[0]), float(place[1]), DISTANCE_M * math.cos(off)), np.zeros(3))
    camera = Camera(1.2, 3e-4 if side_m is None else 6e-5, 560, 880)
    names = materials["material"].values.tolist()
    shares = material_classes(materials).shares
    tracer = build_tracer(snapshot, materials["gap_fraction"].values, shares, window)
    hits = trace(
        snapshot, camera, pose, sun, materials["roughness"].values, names.index("grass"), tracer=tracer
    )
    on_scene = hits.material >= 0
    if side_m is not None:
        on_scene &= (np.abs(hits.point[:, :2]) < 0.5 * side_m).all(axis=1)
    partly = on_scene & (hits.sun_visible > 0.02) & (hits.sun_visible < 0.98)
    half = sun - hits.direction
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    smooth = materials["roughness"].values[hits.material] < SMOOTH
    glint = on_scene & smooth & ((half * hits.normal).sum(axis=1) > math.cos(math.radians(GLINT_DEG)))
    free = on_scene & ~partly & ~glint
    rng = np.random.default_rng(17)
    vehicles = rng.permutation(np.flatnonzero(free & (hits.vehicle_id >= 0)))[: count // 3]
    others = rng.permutation(np.flatnonzero(free & (hits.vehicle_id < 0)))[: count - len(vehicles)]
    left_out = {"sky or beyond the cut": ~on_scene, "half shade": partly, "glint": glint & ~partly}
    counts = {name: int(mask.sum()) for name, mask in left_out.items()}
    return View(hits, sky, np.sort(np.concatenate([vehicles, others])), counts)


def ours(view: View, materials, wavelength_um: float, sky: Sky) -> np.ndarray:
    """Stokes radiance of the chosen rays."""
    pixels = np.stack(np.unravel_index(view.rays, (view.hits.rows, view.hits.columns)), axis=1)
    light = shade(view.hits, sky, materials, pixels=pixels, wavelength_um=np.array([wavelength_um]))
    return light.values[:, 0].astype(float)


def refracted_at_mean_normal(view: View, materials, wavelength_um: float, sky: Sky) -> np.ndarray:
    """Stokes Q and U (ray, 2) of the base as Mitsuba has it, less those of ours.

    Both bases leave p-polarized by refraction, w D/(1 − w E). Under rough facets ours takes D and E over the
    facets, as it does for reflection (`shading.surfaces`); ``pplastic`` takes those of the mean normal, and
    Mitsuba's leaves have none.
    """
    hits, rays = view.hits, view.rays
    table = unpack_surfaces(materials, np.array([wavelength_um])).at_angle[..., 3].astype(float)
    cosines = np.linspace(0, 1, table.shape[1])
    look, normal, kind = (x[rays] for x in (hits.direction, hits.normal, hits.material))
    facing = np.abs((look * normal).sum(axis=1))
    more = np.zeros(len(rays))
    for m, s in enumerate(surfaces_at(materials, wavelength_um)):
        mine = kind == m
        if mine.any() and s.k < mitsuba_scene.METAL:
            r, d, _ = np.array([fresnel(c, s.n, s.k) for c in cosines]).T
            # `mitsuba_scene.leaf_sheet` lies bare beside the leaf's interface
            own = 0.0 if s.tau > 0 else s.weight * d / np.maximum(1 - s.weight * r, 1e-9)
            more[mine] = np.interp(facing[mine], cosines, own - table[m])
    plain = materials.assign(specular_weight=0 * materials["specular_weight"])
    up = normal - (normal * look).sum(axis=1)[:, None] * look
    right = hits.detector_axis - (look @ hits.detector_axis)[:, None] * look
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    turn = np.arctan2((up * np.cross(look, right)).sum(axis=1), (up * right).sum(axis=1))
    polarized = more * ours(view, plain, wavelength_um, sky)[:, 0]
    return polarized[:, None] * np.stack([np.cos(2 * turn), np.sin(2 * turn)], axis=1)


def compare(
    view: View, snapshot, materials, wavelength_um: float, options, key: str
) -> tuple[Pair, np.ndarray]:
    """Both programs' light, and which rays Mitsuba met on the same face."""
    sky, hits, rays = view.sky, view.hits, view.rays
    airless = replace(sky, path_spectrum=0 * sky.path_spectrum, transmittance=np.ones_like(sky.transmittance))
    ground, sensor = (ours(view, materials, wavelength_um, s) for s in (airless, sky))
    dark = {"reflectance": 0 * materials["reflectance"], "transmittance": 0 * materials["transmittance"]}
    black = materials.assign(**dark, specular_weight=0 * materials["specular_weight"])
    path = ours(view, black, wavelength_um, sky)
    # Mitsuba's own base on both sides
    other = refracted_at_mean_normal(view, materials, wavelength_um, airless)
    lit = np.maximum(ground[:, :1], 1e-12)  # a leaf may be quite dark
    through = (sensor[:, :1] - path[:, :1]) / lit
    ground[:, 1:] += other
    sensor[:, 1:] += through * other
    origins = hits.point[rays].astype(float) - BEFORE_M * hits.direction[rays]
    kept = Path(options.peer) / f"{key}.npz" if options.peer else None
    if kept is not None and kept.exists():
        stored = np.load(kept)
        if not (np.array_equal(stored["rays"], rays) and np.allclose(stored["origins"], origins, atol=1e-3)):
            raise SystemExit(f"`{kept}` holds other rays: remove it")
    else:
        mi, dr = load_mitsuba()
        mitsuba_scene.leaf_sheet(mi, dr)
        mitsuba_scene.sky_emitter(mi, dr, sky, wavelength_um)
        by_sun, by_sky = mitsuba_scene.build(mi, snapshot, materials, sky, wavelength_um)
        view_rays = origins, hits.direction[rays].astype(float), hits.detector_axis
        distance, normal = mitsuba_scene.first_met(mi, by_sun, *view_rays[:2])
        light, error = full_path(mi, dr, (by_sun, by_sky), view_rays, hits.sun_visible[rays] < 0.5, options)
        stored = {"light": light, "error": error, "distance": distance, "normal": normal}
        stored |= {"rays": rays, "origins": origins}
        if kept is not None:
            kept.parent.mkdir(parents=True, exist_ok=True)
            np.savez(kept, **stored)
    facing = np.abs((stored["normal"] * hits.normal[rays]).sum(axis=1))
    same = (np.abs(stored["distance"] - BEFORE_M) < 5e-3) & (facing > math.cos(math.radians(2)))
    same &= stored["light"][:, 0] > 0
    pair = Pair(ground, stored["light"], sensor, path + through * stored["light"], stored["error"])
    return pair, same


def full_path(mi, dr, scenes, view_rays, shaded: np.ndarray, options) -> tuple[np.ndarray, np.ndarray]:
    """Stokes radiance (ray, 3) by the sun and by the sky together, and the standard error of its I."""
    origins, directions, axis = view_rays
    light, error = np.zeros((len(shaded), 3)), np.zeros(len(shaded))
    many = options.samples_in_shade or options.samples
    # the sun has one direction: where its light arrives, it needs fewer samples
    in_shade = (many if options.samples_in_shade else many // 4, many)
    for mine, samples in ((~shaded, (options.samples // 4, options.samples)), (shaded, in_shade)):
        if not mine.any():
            continue
        for scene, paths in zip(scenes, samples, strict=True):
            found = mitsuba_scene.trace_paths(
                mi, dr, scene, origins[mine], directions[mine], axis, paths, options.depth
            )
            light[mine] += found[0]
            error[mine] = np.hypot(error[mine], found[1])
    return light, error


def classes_of(view: View, materials) -> dict[str, np.ndarray]:
    """Select the rays of each class, in sun and in shade."""
    hits, rays = view.hits, view.rays
    names = materials["material"].values
    name, lit = names[hits.material[rays]], hits.sun_visible[rays] > 0.5
    upward, mirrored = hits.normal[rays, 2] > 0.7, hits.mirror_material[rays] >= 0
    of_body = hits.light_cell[rays] <= SPACE
    wanted = {
        "wall": ~of_body, "lorry side": of_body,
        "car roof": upward, "car side": ~upward, "car glass, sky": ~mirrored, "car glass, surface": mirrored
    }  # fmt: skip
    found = {}
    for kind, starts in CLASSES.items():
        mine = np.array([n.startswith(starts) for n in name]) & wanted.get(kind, np.ones(len(rays), bool))
        if kind == "leaves" or "glass" in kind:
            found[kind] = mine
        else:
            found[f"{kind} in sun"], found[f"{kind} in shade"] = mine & lit, mine & ~lit
    return found


def degree(stokes: np.ndarray) -> np.ndarray:
    """Degree of linear polarization."""
    return np.hypot(stokes[..., 1], stokes[..., 2]) / stokes[..., 0]


def rows(pair: Pair, same: np.ndarray, classes: dict[str, np.ndarray]):
    """For each class: rays, I at the ground (5 %, median, 95 %, mean), at the sensor, DoLP error there.

    Then which part of the ratios lies within `NEAR`, which part a perfect estimate would have there beside
    Mitsuba's noise, and the median standard error of its I.
    """
    for kind, mine in classes.items():
        mine = mine & same
        if mine.sum() < 20:
            continue
        ratio = pair.ours[mine, 0] / pair.peer[mine, 0]
        at_sensor = np.median(pair.ours_at_sensor[mine, 0] / pair.peer_at_sensor[mine, 0])
        of_means = pair.ours[mine, 0].mean() / pair.peer[mine, 0].mean()
        wrong = degree(pair.ours_at_sensor[mine]) - degree(pair.peer_at_sensor[mine])
        low, middle, high = np.percentile(ratio, (5, 50, 95))
        near = ((ratio > NEAR[0]) & (ratio < NEAR[1])).mean()
        error = np.maximum(pair.error[mine] / pair.peer[mine, 0], 1e-9)
        perfect = (ndtr((1 / NEAR[0] - 1) / error) - ndtr((1 / NEAR[1] - 1) / error)).mean()
        noise = np.median(error)
        at_ground = low, middle, high, of_means
        of_degree = np.median(wrong), wrong.std()
        yield kind, int(mine.sum()), *at_ground, at_sensor, *of_degree, near, perfect, noise


def vehicles(pair: Pair, same: np.ndarray, view: View, least: int = 5) -> np.ndarray:
    """Error of the DoLP at the sensor of the mean light of each vehicle seen by enough rays."""
    ids = view.hits.vehicle_id[view.rays]
    wrong = []
    for one in np.unique(ids[ids >= 0]):
        mine = (ids == one) & same
        if mine.sum() >= least:
            both = pair.ours_at_sensor[mine].mean(axis=0), pair.peer_at_sensor[mine].mean(axis=0)
            wrong.append(degree(both[0]) - degree(both[1]))
    return np.array(wrong)


def print_table(title: str, pair: Pair, same, view: View, materials) -> None:
    """Print what was left out, and a row for each class."""
    print(f"\n{title}")
    counts = ", ".join(f"{name} {n}" for name, n in view.excluded.items())
    print(f"of {view.hits.material.size} rays left out: {counts}")
    print(f"of {same.size} chosen on another face: {(~same).sum()}")
    print(f"{'class':22s} {'rays':>5s} | I at the ground, ours / full path: 5 %  median  95 %  of means"
          " | at the sensor | DoLP error there: median   rms"
          f" | {NEAR[0]} to {NEAR[1]}, a perfect one | its error")  # fmt: skip
    for kind, count, low, middle, high, of_means, at_sensor, median, rms, near, perfect, noise in rows(
        pair, same, classes_of(view, materials)
    ):
        print(f"{kind:22s} {count:5d} | {low:39.2f} {middle:7.3f} {high:5.2f} {of_means:9.3f} | "
              f"{at_sensor:13.3f} | {median:+24.4f} {rms:5.3f} | "
              f"{near:12.2f} {perfect:14.2f} | {noise:.3f}")  # fmt: skip
    wrong = vehicles(pair, same, view)
    if len(wrong):
        print(f"{len(wrong)} vehicles: DoLP of their mean light off by {wrong.mean():+.4f}, "
              f"rms {np.sqrt((wrong**2).mean()):.4f}")  # fmt: skip


def scenes(options):
    """Build the city, its materials without mottle, and a sky for each hour."""
    city = build_scene(SceneDesign())
    materials = city.materials.assign(mottle=0 * city.materials["mottle"])
    snapshot = city.at(0.0)
    if options.cut:
        snapshot = cut(snapshot, options.cut, materials["material"].values.tolist().index("grass"))
    for hour in HOURS[: 1 if options.quick else None]:
        design = AtmosphereDesign(local_time_h=hour, wavelength_stop_um=0.9)
        yield hour, snapshot, materials, city.extent_m, unpack_sky(solve_tables(design), 2000.0)


def options_of(arguments: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--cut", type=float, help="side of a square about the middle, instead of all [m]")
    parser.add_argument("--rays", type=int, default=8000, help="of a view")
    parser.add_argument("--samples", type=int, default=256, help="paths a ray")
    parser.add_argument("--samples-in-shade", type=int, help="paths of rays in shade")
    parser.add_argument("--depth", type=int, default=8, help="reflections followed")
    parser.add_argument("--peer", help="folder that keeps what Mitsuba found")
    parser.add_argument("--quick", action="store_true", help="one sun height, toward the sun alone")
    return parser.parse_args(arguments)


def main() -> None:
    """Compare every view and print the tables."""
    options = options_of()
    for hour, snapshot, materials, window, sky in scenes(options):
        zenith = math.degrees(math.acos(sky.sun_direction[2]))
        for turn in VIEWS_DEG[: 1 if options.quick else None]:
            view = view_of(snapshot, materials, window, sky, turn, options.rays, options.cut)
            for wavelength in WAVELENGTHS_UM:
                key = f"{options.cut or 'whole'}_{hour:g}_{turn:g}_{wavelength:g}"
                pair, same = compare(view, snapshot, materials, wavelength, options, key)
                toward = "away from" if turn else "toward"
                title = f"{wavelength:g} µm, sun {zenith:.1f}° from the zenith, looking {toward} it"
                print_table(title, pair, same, view, materials)


if __name__ == "__main__":
    main()
