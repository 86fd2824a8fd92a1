"""Light on vehicles: each facet under its own tilt's sky, and the two halves of a long vehicle's sides."""

import math
from dataclasses import replace

import numpy as np
import pytest

from glintrack.camera import Pose, look_at
from glintrack.render import build_tracer, shade, trace, unpack_sky
from glintrack.render.light.gather import material_classes
from glintrack.render.light.lattice import SPACE
from glintrack.scene import Mesh
from tests.conftest import box, flat_sky, materials, plane, small_camera, snapshot
from tests.oracles.shade_ray import sky_irradiance
from tests.render.test_against_one_ray import compare, sky_with

WHITE, BLACK = (0.5, 1.5, 0.0, 0.0, 0.0), (0.0, 1.5, 0.0, 0.0, 0.0)
ROUGH = (0.0, 1.5, 0.0, 0.4, 1.0)
RAYS_BELOW = 0.15  # of light off the ground: a side has eight rays to it
NODES = 0.04  # of I: normals 6° apart, of a sky seven times as bright on one side as on the other
HERE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.0]]
NORTH = [[1, 0, 0, 0], [0, 1, 0, 45], [0, 0, 1, 0.0]]


def one_sided(zenith, azimuth):
    """A sky seven times as bright in the south as in the north."""
    return 1.0 + 0.75 * math.cos(azimuth - math.pi), 0.0, 0.0


def prism(tilt_deg: float, length_m: float = 4.0) -> Mesh:
    """A roof without walls: two slopes of a tilt, to north and south."""
    half, rise = 1.0, math.tan(math.radians(tilt_deg))
    x = 0.5 * length_m
    ends = [(s * x, y, z) for s in (-1, 1) for y, z in ((-half, 0.0), (half, 0.0), (0.0, rise))]
    faces = [(0, 3, 5), (0, 5, 2), (1, 2, 5), (1, 5, 4), (0, 2, 1), (3, 4, 5)]
    return Mesh(np.array(ends, np.float32), np.array(faces, np.int32), np.ones(len(faces), np.int16))


def beside_a_mast(vehicle: Mesh, *others: tuple[Mesh, list]):
    """A vehicle that moves on level ground, beside what stands; a mast far off makes probes be asked for."""
    standing = [(box(0.3, 0.3, 12.0), NORTH), *others]
    models, places = [m for m, _ in standing], [p for _, p in standing]
    count = len(models)
    ids, model = [*count * [-1], 7], list(range(count + 1))
    scene = snapshot(plane(400.0), [*models, vehicle], [*places, HERE], model, vehicle_id=ids)
    return replace(scene, fixed=count)


@pytest.mark.parametrize("tilt_deg", [15.0, 32.0, 45.0])
def test_a_sloping_roof_gets_the_sky_that_its_own_tilt_sees(tilt_deg):
    """Over black ground, against the integral over the hemisphere; axes alone are off by up to a fifth."""
    scene = beside_a_mast(prism(tilt_deg))
    sky, library = sky_with(one_sided), materials(BLACK, WHITE)
    pose = look_at(Pose(0.0, 10.0, 300.0), [0.0, 0.0, 0.0])
    camera = small_camera(91, 91, 24.0, 300.0)
    hits = trace(scene, camera, pose, sky.sun_direction, library["roughness"].values)
    assert (hits.light_cell[hits.material == 1] <= SPACE).all()
    hits.sun_visible[:] = 0
    bands = len(sky.wavelength_um)
    light = shade(hits, sky, library, np.eye(bands)).values.reshape(-1, bands, 3)[:, 0, 0]
    path = light[hits.material == 0].mean()
    for north in (True, False):
        slope = (hits.material == 1) & ((hits.normal[:, 1] > 0.1) if north else (hits.normal[:, 1] < -0.1))
        assert slope.sum() > 20
        expected = sky_irradiance(sky, hits.normal[slope][0].astype(float))[0]
        found = (light[slope].mean() - path) * math.pi / (0.5 * 0.8)
        assert found == pytest.approx(expected, rel=NODES)


def test_a_vehicle_is_lit_as_by_one_ray_in_plain_numpy():
    scene = beside_a_mast(prism(32.0, 9.0))
    pose = look_at(Pose(0.0, 40.0, 100.0), [0.0, 0.0, 0.0])
    library = materials(WHITE, WHITE)
    hits = compare(scene, pose, sky_with(one_sided), library, 3e-3, small_camera(21, 21, 10.0, 100.0))
    assert (hits.light_cell <= SPACE).any()


def test_the_upper_half_of_a_long_vehicle_sees_over_what_stands_beside_it():
    """A wall as high as half of it, 1 m off: the lower half is in its lee; a short vehicle has one probe."""
    wall = box(60.0, 0.5, 1.7), [[1, 0, 0, 0], [0, 1, 0, -2.5], [0, 0, 1, 0]]
    pose = look_at(Pose(0.0, -60.0, 60.0), [0.0, -1.2, 1.7])
    for length, told in ((9.0, True), (4.0, False)):
        scene = beside_a_mast(box(length, 2.4, 3.4), wall)
        hits = trace(scene, small_camera(81, 81, 6.0, 85.0), pose, np.array([0.0, 0.0, 1.0]), np.ones(2))
        side = (hits.vehicle_id == 7) & (hits.normal[:, 1] < -0.9)
        upper, lower = side & (hits.point[:, 2] > 1.75), side & (hits.point[:, 2] < 1.65)
        assert upper.any() and lower.any()
        more = hits.sky_view[upper].mean() - hits.sky_view[lower].mean()
        assert (more > 0.15) == told


def by_the_sun_alone(scene, ground, vehicle, place_m, azimuth_deg):
    """Hits and I of a frame in which only the sun shines, 45° up; light off surfaces is followed."""
    library, sky = materials(ground, vehicle), unpack_sky(flat_sky(45.0, azimuth_deg, sun=1000.0), 500.0)
    pose = look_at(Pose(*place_m), [0.0, 0.0, 0.0])
    camera = small_camera(91, 91, 8.0, math.dist(place_m, (0, 0, 0)))
    tracer = build_tracer(scene, shares=material_classes(library).shares)
    hits = trace(scene, camera, pose, sky.sun_direction, library["roughness"].values, tracer=tracer)
    return hits, shade(hits, sky, library, np.eye(len(sky.wavelength_um))).values[:, :, 0, 0].ravel()


@pytest.mark.parametrize("tilt_deg", [32.0, 45.0])
def test_a_sloping_roof_gets_half_of_one_minus_its_cosine_off_the_ground(tilt_deg):
    """Slopes north and south in a sun from the east, which grazes neither more than the other."""
    hits, light = by_the_sun_alone(beside_a_mast(prism(tilt_deg)), WHITE, WHITE, (0.0, 10.0, 300.0), 90.0)
    slope = (hits.material == 1) & (np.abs(hits.normal[:, 1]) > 0.1)
    assert slope.sum() > 40
    by_sun = 1000.0 * np.maximum(hits.normal @ [math.sqrt(0.5), 0.0, math.sqrt(0.5)], 0) * hits.sun_visible
    off_ground = light[slope] * math.pi / 0.5 - by_sun[slope]
    level = 0.5 * 1000.0 * math.cos(math.radians(45.0))
    expected = 0.5 * (1 - math.cos(math.radians(tilt_deg))) * level
    assert off_ground.mean() == pytest.approx(expected, rel=RAYS_BELOW)


def test_the_rough_side_of_a_vehicle_mirrors_the_shadow_that_it_stands_in():
    """Seen from 40° up, it shows the ground a step before it: in the sun, or in the vehicle's shadow."""
    scene = beside_a_mast(box(4.0, 1.8, 1.5))
    light = {}
    for azimuth_deg in (0.0, 180.0):
        hits, radiance = by_the_sun_alone(scene, WHITE, ROUGH, (0.0, -80.0, 70.0), azimuth_deg)
        side = (hits.material == 1) & (hits.normal[:, 1] < -0.9) & (hits.point[:, 2] < 0.6)
        assert side.sum() > 10 and (hits.mirror_material[side] == 0).all()
        assert ((hits.mirror_sun[side] > 0) == (azimuth_deg == 180.0)).all()
        light[azimuth_deg] = radiance[side].mean()
    assert light[0.0] < 0.1 * light[180.0]
