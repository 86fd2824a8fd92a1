"""Where sky view factors of a city's roads and roofs are off, and what a finer lattice of probes would have.

    python scripts/measure_sky_view.py [--points 1500] [--city embedded] [--seed 1]

Random points as the slow test has them, the sky view that `trace` gives beside 1024 rays from the very same
points: share of points off by over 0.05 and 0.1, the mean and the rms. Then 8192 rays beside fewer, which is
what such references call off of a perfect estimate. Then by what hides most of the sky there: parked
vehicles, leaves, other things nearer than 3 m, and farther ones. Last for lattices of 2, 1 and half a metre,
probes 0.3 and 0.12 m off the facet, with the rays that a probe has and with those of all its four sets:
probes alone, without the map of heights.
"""

import argparse

import numpy as np

from glintrack.camera import Camera, Pose, look_at
from glintrack.render import build_tracer, trace
from glintrack.render.bounce import Met
from glintrack.render.probe_lookup import BY_SIDES
from glintrack.render.probes import probe
from glintrack.render.rays.lit import Lit
from glintrack.render.sky_patches import even_directions, patch_rays
from glintrack.scene import SceneDesign, build_scene

KINDS = {"road": ("asphalt", "road_paint", "concrete", "pavement"), "roof": ("roof_",)}
RAYS, SOME_RAYS, FINE_RAYS, SEED, NEAR_M = 1024, 256, 8192, 99, 3.0
LATTICES = ((2.0, 0.3), (2.0, 0.12), (1.0, 0.12), (0.5, 0.12))  # step, and height off the facet [m]
SHIFT = np.array([0.31, 0.43])  # of a step, as `probe_map` has it


def exact(tracer, point, normal, count: int = RAYS, rng: np.random.Generator | None = None) -> np.ndarray:
    """Sky view factor of each point by many rays, spread evenly, or by ``rng`` at random."""
    directions, view = even_directions(count).astype(np.float32), np.empty(len(point))
    for k, (place, up) in enumerate(zip(point, normal, strict=True)):
        if rng is not None:
            height, turn = rng.random(count), 2 * np.pi * rng.random(count)
            across = np.sqrt(1 - height**2)
            directions = np.stack([across * np.cos(turn), across * np.sin(turn), height], 1).astype(
                np.float32
            )
        cosine = np.maximum(directions @ up, 0)
        start = np.broadcast_to(np.float32(place + 3e-3 * up), directions.shape)
        light = tracer.rays.transmitted(np.ascontiguousarray(start), directions, cosine > 0)
        view[k] = (cosine * light).sum() / cosine.sum()
    return view


def hidden_by(lit: Lit, vehicle, point, normal) -> np.ndarray:
    """What takes most of the sky from each point."""
    directions, names = even_directions(SOME_RAYS).astype(np.float32), []
    for place, up in zip(point, normal, strict=True):
        start = np.ascontiguousarray(np.broadcast_to(np.float32(place + 3e-3 * up), directions.shape))
        met = lit.meet(start, start, directions)
        blocked = np.maximum(directions @ up, 0) * (met.material >= 0)
        parked = (met.instance >= 0) & vehicle[np.maximum(met.instance, 0)]
        leaves = lit.tracer.sheets[np.maximum(met.material, 0)] & ~parked
        near = (met.range_m < NEAR_M) & ~parked & ~leaves
        parts = {"vehicles": parked, "leaves": leaves, "what else is near": near,
                 "what is far": ~(parked | leaves | near)}  # fmt: skip
        names.append(max(parts, key=lambda name: blocked[parts[name]].sum()))
    return np.array(names)


def by_lattice(step_m: float, lift_m: float, sets: int, rays, follow, point, normal) -> np.ndarray:
    """Sky view between the four probes of a lattice, each with so many sets of rays."""
    corner = np.array([(0, 0), (1, 0), (0, 1), (1, 1)])
    place = point[:, :2] / step_m - SHIFT
    first = np.floor(place)
    at = first[:, None] + corner
    part = np.where(corner == 1, (place - first)[:, None], 1 - (place - first)[:, None]).prod(axis=2)
    level = (at + SHIFT) * step_m
    fall = ((level - point[:, None, :2]) * normal[:, None, :2]).sum(axis=2) / normal[:, 2:]
    centre = np.dstack([level, point[:, 2:] - fall]) + lift_m * normal[:, None]
    facing = np.repeat(normal, 4, axis=0)[:, None].astype(np.float32)
    parity = ((at[..., 0].astype(int) & 1) | (at[..., 1].astype(int) & 1) << 1).ravel()
    places, none = centre.reshape(-1, 3).astype(np.float32), np.zeros((0, 0))
    found = [probe(places, facing, (parity + k) % 4, rays, none, follow) for k in range(sets)]
    view = np.mean([one.sky_view[:, 0] for one in found], axis=0).reshape(-1, 4)
    weight = np.maximum(part, 1e-3) * found[0].alive.reshape(-1, 4)
    return (weight * view).sum(axis=1) / np.maximum(weight.sum(axis=1), 1e-9)


def tell(what: str, error: np.ndarray, share: float | None = None) -> None:
    """One row."""
    of_points = "" if share is None else f"{share:5.2f} of points, "
    off, far_off = (abs(error) > 0.05).mean(), (abs(error) > 0.1).mean()
    print(f"  {what:36s} {of_points}off by 0.05 {off:.3f}, by 0.1 {far_off:.3f}, "
          f"mean {error.mean():+.4f}, rms {np.sqrt((error**2).mean()):.3f}")  # fmt: skip


def main() -> None:
    """Print both tables for roads and for roofs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--points", type=int, default=1500)
    parser.add_argument("--city", default=SceneDesign().city)
    parser.add_argument("--seed", type=int, default=SceneDesign().seed)
    options = parser.parse_args()
    count, city = options.points, build_scene(SceneDesign(city=options.city, seed=options.seed))
    now, materials = city.at(0.0).without_traffic(), city.materials
    tracer = build_tracer(now, materials["gap_fraction"].values, window=city.extent_m)
    camera, pose = Camera(1.2, 3e-4, 560, 880), look_at(Pose(0.0, -2300.0, 1930.0), np.zeros(3))
    sun, names = np.array([0.0, -0.6, 0.8]), materials["material"].values
    grass = names.tolist().index("grass")
    hits = trace(now, camera, pose, sun, materials["roughness"].values, grass, tracer=tracer)
    lit, rays = Lit(tracer, now, grass, sun), patch_rays(sun)
    vehicle = tracer.role[np.asarray(now.model)] == BY_SIDES

    def follow(origins, directions) -> Met:
        met = lit.meet(origins, origins, directions)
        return Met(met.material, met.sun_cosine, met.point, met.normal, met.range_m)

    west, south, east, north = city.extent_m
    x, y = hits.point[:, 0], hits.point[:, 1]
    inside = (hits.material >= 0) & (x > west) & (x < east) & (y > south) & (y < north)
    for kind, starts in KINDS.items():
        mine = inside & (hits.normal[:, 2] > 0.5)
        mine &= np.array([name.startswith(starts) for name in names[hits.material]])
        chosen = np.random.default_rng(SEED).choice(np.flatnonzero(mine), count, replace=False)
        point, normal = (v[chosen].astype(float) for v in (hits.point, hits.normal))
        expected, fine = exact(tracer, point, normal), exact(tracer, point, normal, FINE_RAYS)
        rng = np.random.default_rng(SEED)
        references = [
            (f"{RAYS} evenly", fine - expected),
            (f"{SOME_RAYS} evenly", fine - exact(tracer, point, normal, SOME_RAYS)),
            (f"{SOME_RAYS} at random", fine - exact(tracer, point, normal, SOME_RAYS, rng)),
        ]
        error, hider = hits.sky_view[chosen] - expected, hidden_by(lit, vehicle, point, normal)
        print(kind)
        tell("as rendered", error)
        for name, wrong in references:
            tell(f"{FINE_RAYS} rays, beside {name}", wrong)
        for one in np.unique(hider):
            tell(f"hidden most by {one}", error[hider == one], (hider == one).mean())
        for step, lift in LATTICES:
            for sets in (1, 4):
                view = by_lattice(step, lift, sets, rays, follow, point, normal)
                tell(f"lattice {step:g} m, {lift:g} m off, {sets} sets", view - expected)


if __name__ == "__main__":
    main()
