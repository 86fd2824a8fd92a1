"""How much of the bright sky about the sun shaded points see where the probes around them see the sun.

    python scripts/measure_narrow_shade.py

Rays from random shaded points of the default city's roads, lawns and roofs (`compare_city`'s view toward the
sun, 40° and 62° from the zenith) to the cap and the ring about the sun, beside what the lattice of probes has
there. By the lattice's open part v of the cap: points, the cap's open part, the ring's, the ring's of the
lattice, and what `shading.probe_light` makes of both, v − 0.85 v² and the lattice's ring less 0.55 v³.
"""

import argparse
import itertools
import sys
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from scripts import compare_city

from glintrack.render import build_tracer
from glintrack.render.bounce import material_classes
from glintrack.render.shading.probe_light import CAP_LOST, RING_LOST
from glintrack.render.sky_patches import QUARTERS, clear_sky, even_directions, patch_of

RAYS, POINTS, SEED = 4096, 300, 5
CLASSES = ("road in shade", "grass in shade", "roof in shade")
BINS = (0.0, 0.1, 0.3, 0.6, 0.9, 1.001)


def open_parts(view, tracer, rays) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Open part of the cap and of each quarter of the ring: by rays from points, and by the lattice; h."""
    hits, sun = view.hits, np.asarray(view.sky.sun_direction)
    directions = even_directions(RAYS).astype(np.float32)
    patch = patch_of(directions, sun)
    directions, patch = directions[patch <= QUARTERS], patch[patch <= QUARTERS]
    brightness, seen = clear_sky(directions.astype(float), sun), np.zeros((len(rays), 1 + QUARTERS))
    for k, ray in enumerate(rays):
        normal = hits.normal[ray].astype(float)
        weight = np.maximum(directions @ normal, 0) * brightness
        start = np.broadcast_to(np.float32(hits.point[ray] + 3e-3 * normal), directions.shape)
        light = tracer.rays.transmitted(np.ascontiguousarray(start), directions, weight > 0)
        every = np.bincount(patch, weights=weight, minlength=1 + QUARTERS)
        seen[k] = np.bincount(patch, weights=weight * light, minlength=1 + QUARTERS) / np.maximum(every, 1e-9)
    x, y = (hits.light_part[rays] / 255.0).T
    cells = hits.probe_cells[hits.light_cell[rays]]
    weight = np.stack([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y], axis=1)
    weight = np.maximum(weight, 1e-3) * (hits.probe_view[cells] >= 0)
    weight /= np.maximum(weight.sum(axis=1, keepdims=True), 1e-9)
    lattice = (hits.probe_patches[cells][:, :, : 1 + QUARTERS] / 255.0 * weight[..., None]).sum(axis=1)
    return seen, lattice, hits.sky_here[rays]


def best(wanted, base, lost) -> float:
    """The c by which base − c lost is nearest to what is wanted."""
    return float(((base - wanted) * lost).sum() / (lost**2).sum())


def main() -> None:
    """Print a row for each part of the cap that the lattice has open, and what fits best."""
    found = []
    for _, snapshot, materials, window, sky in compare_city.scenes(argparse.Namespace(cut=None, quick=False)):
        view = compare_city.view_of(snapshot, materials, window, sky, 0.0, 12_000, None)
        shares = material_classes(materials).shares
        tracer = build_tracer(snapshot, materials["gap_fraction"].values, shares, window)
        tracer.place(snapshot)
        sunward = view.hits.normal[view.rays] @ np.asarray(sky.sun_direction) > 0
        known = view.hits.light_cell[view.rays] >= 0
        for kind, mine in compare_city.classes_of(view, materials).items():
            if kind in CLASSES:
                rays = np.random.default_rng(SEED).permutation(view.rays[mine & sunward & known])[:POINTS]
                found.append(open_parts(view, tracer, rays))
    seen, lattice, here = (np.concatenate(part) for part in zip(*found, strict=True))
    v, cap, ring, around = lattice[:, 0], seen[:, 0], seen[:, 1:].mean(axis=1), lattice[:, 1:].mean(axis=1)
    print(" v of the lattice | points |   h  |   cap  made of v |  ring  lattice  made of both")
    for low, high in itertools.pairwise(BINS):
        mine = (v >= low) & (v < high)
        by_cap = (here * (v - CAP_LOST * v**2))[mine].mean()
        by_ring = (here * (around - RING_LOST * v**3))[mine].mean()
        print(f"   {low:.1f} to {min(high, 1):.1f}    | {mine.sum():6d} | {here[mine].mean():.2f} "
              f"| {cap[mine].mean():5.2f} {by_cap:10.2f} "
              f"| {ring[mine].mean():5.2f} {around[mine].mean():8.2f} {by_ring:13.2f}")  # fmt: skip
    for name, h in (("with h", here), ("without", np.ones_like(here))):
        print(f"best {name:8s} CAP_LOST {best(cap, h * v, h * v**2):.2f} "
              f"RING_LOST {best(ring, h * around, h * v**3):.2f}")  # fmt: skip


if __name__ == "__main__":
    main()
