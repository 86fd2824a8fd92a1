"""Light that goes over two surfaces: which rays go on, a wall on a sunlit plain, and the kernels' sums."""

import math

import numpy as np
import pytest

from glintrack.camera import Pose, look_at
from glintrack.render import shade, trace, unpack_sky
from glintrack.render.light.gather import (
    BOUNCES,
    BY_SKY,
    BY_SUN,
    CLASSES,
    EVERY,
    SECOND,
    TWICE_BY_SUN,
    Met,
    material_classes,
    rays_onward,
)
from glintrack.render.light.probes import BOUNCE_UNIT
from glintrack.render.tracer import build_tracer
from glintrack.scene import Mesh
from tests.conftest import box, flat_sky, materials, plane, small_camera, snapshot
from tests.oracles.shade_ray import bounce_lights, shade_ray

SOME_RAYS = 0.05  # of irradiance: the mean of many probes with some forty rays each
IRRADIANCE_TABLE = 3e-3  # of I: the kernels read irradiance of tilted facets between 1089 normals


def rays(probes=400, each=30, normal=(0.0, 0.0, 1.0), translucent=False):
    """Rays onward from where all rays of some probes end on facets of one normal."""
    count, sets = probes * each, np.arange(probes) % 4
    normals = np.broadcast_to(np.float32(normal), (count, 3))
    points = np.zeros((count, 3), np.float32)
    first = np.arange(0, count + 1, each)
    centre = np.stack(
        [2.0 * (np.arange(probes) % 20), 2.0 * (np.arange(probes) // 20), np.zeros(probes)], axis=1
    )
    ones = np.ones(count, np.float32)
    met = Met(np.zeros(count, np.int16), ones, points, normals, ones)
    return rays_onward(first, centre, sets, met, np.array([translucent]))


@pytest.mark.parametrize("normal", [(0, 0, 1), (0, 0, -1), (1, 0, 0), (0.48, -0.6, -0.64)])
def test_one_in_three_goes_on_with_the_cosines_spread(normal):
    """Means over a cosine-weighted hemisphere: of the cosine 2/3, of its square 1/2, of the rest 0."""
    onward = rays(normal=normal)
    assert len(onward.direction) == len(onward.of) / EVERY
    cosine = onward.direction @ np.float32(normal)
    assert (cosine >= 0).all() and not onward.behind.any()
    np.testing.assert_allclose(np.linalg.norm(onward.direction, axis=1), 1, atol=1e-5)
    np.testing.assert_allclose([cosine.mean(), (cosine**2).mean()], [2 / 3, 1 / 2], atol=0.01)
    np.testing.assert_allclose(onward.direction.mean(axis=0), np.multiply(normal, 2 / 3), atol=0.03)


def test_half_of_a_leafs_go_on_behind_it():
    onward = rays(translucent=True)
    assert onward.behind.mean() == 0.5
    np.testing.assert_array_equal(onward.direction[:, 2] < 0, onward.behind)
    np.testing.assert_array_equal(onward.start[:, 2] < 0, onward.behind)


def wall_beside_a_plain(ground, wall):
    """A long, high wall that runs along the sun's azimuth, so that neither side of it is lit."""
    house, field = box(60.0, 4000.0, 400.0), plane(9000.0)  # along north
    start = len(field.vertices)
    scene = Mesh(
        np.concatenate([field.vertices, house.vertices + np.float32([30.0, 0, 0])]),
        np.concatenate([field.faces, house.faces + start]).astype(np.int32),
        np.concatenate([field.material, np.ones(len(house.faces))]).astype(np.int16),
    )
    library = materials((ground, 1.5, 0.0, 0.0, 0.0), (wall, 1.5, 0.0, 0.0, 0.0))
    sky = unpack_sky(flat_sky(40, 0, sun=1000.0, sky_radiance=60.0, path=0.0, transmittance=1.0), 1000.0)
    classes = material_classes(library)
    still = snapshot(scene)
    tracer = build_tracer(still, shares=classes.shares)
    pose = look_at(Pose(-900.0, -300.0, 500.0), [-1.0, 0.0, 1.0])
    camera = small_camera(41, 41, 30.0, 1050.0)
    hits = trace(still, camera, pose, sky.sun_direction, library["roughness"].values, tracer=tracer)
    return hits, sky, library, classes


@pytest.mark.parametrize(("ground", "wall"), [(0.5, 0.6), (0.2, 0.8)])
def test_ground_at_the_foot_of_a_wall_is_lit_by_what_the_wall_gets_from_it(ground, wall):
    """Wall over E_sun: ½ ρ cos θ, once. Ground at its foot, that sees half a wall: ¼ ρ ρ' cos θ, twice."""
    hits, sky, _, classes = wall_beside_a_plain(ground, wall)
    b = classes.spectra[:, 0]
    bounced = BOUNCE_UNIT * hits.probe_bounced.astype(float)
    once = bounced[:, BY_SUN : BY_SUN + CLASSES] @ b
    twice = bounced[:, TWICE_BY_SUN : TWICE_BY_SUN + CLASSES * SECOND] @ np.outer(b, b[:SECOND]).ravel()
    cosine = sky.sun_direction[2]
    alive = hits.probe_view >= 0
    of_ground, of_wall = (
        np.unique(hits.probe_cells[hits.light_cell[(hits.material == m) & (hits.light_cell >= 0)]])
        for m in (0, 1)
    )
    near = hits.light_cell[(hits.material == 0) & (np.abs(hits.point[:, 0]) < 2) & (hits.light_cell >= 0)]
    foot = np.intersect1d(of_ground, np.unique(hits.probe_cells[near]))
    foot, of_wall = foot[alive[foot]], of_wall[alive[of_wall]]
    assert len(foot) > 10 and len(of_wall) > 10
    np.testing.assert_allclose(once[of_wall].mean(), 0.5 * ground * cosine, rtol=SOME_RAYS)
    np.testing.assert_allclose(once[foot].mean(), 0, atol=1e-3)
    expected = 0.25 * ground * wall * cosine
    np.testing.assert_allclose(twice[foot].mean(), expected, rtol=SOME_RAYS)


def test_surfaces_in_the_open_send_on_all_light_and_those_in_shade_none_of_the_sky_about_the_sun():
    """ρ (E_sun cos θ + E_sky) of sunlit level ground; less than ρ E_sky of what only the sky lights."""
    hits, sky, library, classes = wall_beside_a_plain(0.5, 0.6)
    lights, share, cosine = bounce_lights(hits, sky, library), classes.shares[0], sky.sun_direction[2]
    sent = np.zeros((2, BOUNCES))
    sent[0, BY_SUN : BY_SUN + CLASSES] = cosine * share
    sent[:, BY_SKY : BY_SKY + CLASSES] = share
    lit, shaded = sent @ lights
    np.testing.assert_allclose(lit, 0.5 * (cosine * sky.sun_irradiance + sky.sky_irradiance), rtol=1e-6)
    left = shaded / (0.5 * sky.sky_irradiance)
    assert (left > 0.6).all() and (left < 0.95).all()


def test_what_hides_the_sun_from_a_point_hides_the_sky_about_it():
    """A strip of shade of half a metre, between probes that all see the sun: less light than beside it."""
    house, field = box(0.5, 300.0, 0.2), plane(900.0)
    roof = house.vertices + np.float32([0.0, 0.0, 12.0])
    scene = Mesh(
        np.concatenate([field.vertices, roof]),
        np.concatenate([field.faces, house.faces + len(field.vertices)]).astype(np.int32),
        np.concatenate([field.material, np.ones(len(house.faces))]).astype(np.int16),
    )
    library = materials((0.3, 1.5, 0.0, 0.0, 0.0), (0.3, 1.5, 0.0, 0.0, 0.0))
    sky = unpack_sky(flat_sky(40, 90, sun=1000.0, sky_radiance=60.0, path=0.0, transmittance=1.0), 1000.0)
    still = snapshot(scene)
    tracer = build_tracer(still, shares=material_classes(library).shares)
    pose = look_at(Pose(0.0, -900.0, 500.0), [-10.0, 0.0, 0.0])
    hits = trace(still, small_camera(41, 161, 30.0, 1030.0), pose, sky.sun_direction,
                 library["roughness"].values, tracer=tracer)  # fmt: skip
    bands = len(sky.wavelength_um)
    light = shade(hits, sky, library, np.eye(bands)).values.reshape(-1, bands, 3)[:, 0, 0]
    ground = (hits.material == 0) & (hits.light_cell >= 0)
    dark = ground & (hits.sun_visible == 0)
    assert dark.sum() > 20 and (ground & (hits.sun_visible == 1)).sum() > 100
    for ray in np.flatnonzero(dark)[::7]:
        np.testing.assert_allclose(
            light[ray], shade_ray(hits, ray, sky, library)[0, 0], rtol=IRRADIANCE_TABLE
        )
    diffuse = light[dark].mean() * np.pi / 0.3
    whole = sky.irradiance_map[len(sky.irradiance_map) // 2].sum(axis=0) @ sky.sky_spectrum
    assert diffuse < 0.95 * whole[0]


def test_kernels_add_what_the_reference_adds():
    """Every term of probes' light, ray by ray."""
    hits, sky, library, _ = wall_beside_a_plain(0.5, 0.6)
    bands = len(sky.wavelength_um)
    light = shade(hits, sky, library, np.eye(bands)).values.reshape(-1, bands, 3)
    for ray in range(0, len(light), 37):
        expected = shade_ray(hits, ray, sky, library)
        np.testing.assert_allclose(light[ray], expected, atol=IRRADIANCE_TABLE * expected[:, 0].max(), rtol=0)
    assert math.isfinite(light.sum())
