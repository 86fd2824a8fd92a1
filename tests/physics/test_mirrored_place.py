"""Sky that rough ground mirrors beside a wall, against an integral over what the wall leaves of it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from glintrack.camera import Pose, look_at
from glintrack.render import shade, trace, unpack_sky
from glintrack.scene import Mesh
from tests.conftest import box, flat_sky, materials, plane, small_camera, snapshot

ALPHA, INDEX = 0.45, 1.5
HEIGHT_M, FACE_M = 16.0, 8.0  # of a long wall, and how far north its face stands
BLACK_AND_ROUGH, BLACK = (0.0, INDEX, 0.0, ALPHA, 1.0), (0.0, INDEX, 0.0, 0.5, 0.0)


def beside_a_wall(with_wall=True):
    parts = [plane(900.0)]
    if with_wall:
        wall = box(900.0, 4.0, HEIGHT_M)
        parts.append(replace(wall, vertices=wall.vertices + np.float32([0, FACE_M + 2.0, 0])))
    starts = np.cumsum([0, *(len(p.vertices) for p in parts)])
    return Mesh(
        np.concatenate([p.vertices for p in parts]),
        np.concatenate([p.faces + s for p, s in zip(parts, starts, strict=False)]).astype(np.int32),
        np.concatenate([p.material for p in parts]),
    )


def seen(mesh, east_m, north_m):
    """I of the ground at the origin, seen from a place 840 m up."""
    sky = unpack_sky(flat_sky(40.0, 90.0, sun=0.0, sky_radiance=60.0), 1000.0)
    library = materials(BLACK_AND_ROUGH, BLACK)
    camera = small_camera(1, 1, 0.5, 1300.0)
    pose = look_at(Pose(east_m, north_m, 840.0), [0.0, 0.0, 0.0])
    hits = trace(snapshot(mesh), camera, pose, sky.sun_direction, library["roughness"].values)
    assert hits.material.tolist() == [0]
    return float(shade(hits, sky, library, np.eye(len(sky.wavelength_um))).values[..., 0].ravel()[0])


def part_that_is_left(east_m, north_m):
    """Of what a GGX surface mirrors of an even sky, what does not come from the wall. [1]"""
    up = (np.arange(400) + 0.5) / 400
    turn = (np.arange(800) + 0.5) * 2 * math.pi / 800
    z, turn = np.meshgrid(up, turn, indexing="ij")
    across = np.sqrt(1 - z * z)
    light = np.stack([across * np.sin(turn), across * np.cos(turn), z], axis=-1)
    view = np.array([east_m, north_m, 840.0]) / math.hypot(east_m, north_m, 840.0)
    half = light + view
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    steep = ALPHA**2
    facets = (1 + (steep - 1) * half[..., 2] ** 2) ** -2
    masked = 2 * z / (z + np.sqrt(steep + (1 - steep) * z * z))
    cosine = half @ view
    inside = np.sqrt(1 - (1 - cosine**2) / INDEX**2)
    s = (cosine - INDEX * inside) / (cosine + INDEX * inside)
    p = (INDEX * cosine - inside) / (INDEX * cosine + inside)
    lobe = facets * masked * 0.5 * (s * s + p * p)
    behind_wall = (light[..., 1] > 0) & (z * FACE_M < HEIGHT_M * light[..., 1])
    return 1 - lobe[behind_wall].sum() / lobe.sum()


TOWARD, ALONG = (0.0, -1000.0), (-1000.0, 0.0)  # 50° off nadir


@pytest.mark.parametrize("place_m", [TOWARD, ALONG])
def test_a_wall_takes_what_is_mirrored_of_it(place_m):
    """The same part of the sky is hidden, but toward the wall more of what is mirrored."""
    left = seen(beside_a_wall(), *place_m) / seen(beside_a_wall(False), *place_m)
    # two metres between probes, patches of a sixth of the horizon, and two rays to each
    assert left == pytest.approx(part_that_is_left(*place_m), abs=0.12)


def test_the_integral_tells_the_sides_apart():
    assert part_that_is_left(*TOWARD) < 0.4 and part_that_is_left(*ALONG) > 0.65
