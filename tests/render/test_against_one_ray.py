"""The kernels against one ray in plain NumPy (`oracles.shade_ray`), ray by ray on small scenes."""

import math
from dataclasses import replace

import numpy as np
import pytest

from glintrack.camera import Pose, look_at
from glintrack.render import shade, trace, unpack_sky
from glintrack.render.shading.hits import Hits
from tests.conftest import box, flat_sky, materials, nadir, plane, small_camera, snapshot
from tests.oracles.shade_ray import shade_ray

# reflectance, n, k, roughness, specular weight
MATT, COAT, GLASS = (0.3, 1.5, 0.0, 0.0, 0.0), (0.4, 1.5, 0.0, 0.02, 1.0), (0.0, 1.5, 0.0, 0.0, 1.0)
PARTLY, METAL = (0.2, 1.5, 0.0, 0.05, 0.3), (0.1, 1.44, 7.5, 0.03, 1.0)
SINGLE_PRECISION = 2e-5  # of I: float32 sums, and Fresnel's tables linear between 257 cosines
IRRADIANCE_TABLE = 3e-3  # of I: the kernels read irradiance of tilted facets between 1089 normals


def rayleigh(zenith, azimuth):
    """A sky that is brighter to the south and polarized by up to 40 %, at a slant."""
    return 1.0 + 0.3 * math.cos(azimuth - math.pi), 0.3 * math.sin(zenith), 0.25 * math.sin(azimuth)


def sky_with(stokes=lambda zenith, azimuth: (1.0, 0.0, 0.0)):
    return unpack_sky(
        flat_sky(40, 150, sun=1000.0, sky_radiance=60.0, path=8.0, transmittance=0.8, stokes=stokes), 1000.0
    )


def town():
    """A box on the ground that throws a shadow, and the slanted view of both."""
    place = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    scene = snapshot(plane(400.0), [box(30.0, 20.0, 15.0)], [place], [0])
    return replace(scene, fixed=1), look_at(Pose(500.0, -500.0, 800.0), [0.0, 0.0, 5.0])


def compare(scene, pose, sky, library, tolerance, camera=None) -> Hits:
    camera = camera or small_camera(13, 17, 60.0, 1070.0)
    hits = trace(scene, camera, pose, sky.sun_direction, library["roughness"].values)
    bands = len(sky.wavelength_um)
    light = shade(hits, sky, library, np.eye(bands)).values.reshape(-1, bands, 3)[:, ::3]
    for ray, ours in enumerate(light):
        expected = shade_ray(hits, ray, sky, library)[::3]
        np.testing.assert_allclose(ours, expected, atol=tolerance * expected[:, 0].max(), rtol=0)
    return hits


@pytest.mark.parametrize("ground", [MATT, COAT, GLASS, PARTLY, METAL])
def test_level_ground_under_an_uneven_polarized_sky(ground):
    """Sun, sky, path, glint, mirrored sky and what leaves the base, at every slant of a wide frame."""
    pose = look_at(Pose(300.0, -700.0, 900.0), [0.0, 0.0, 0.0])
    compare(snapshot(plane(9000.0)), pose, sky_with(rayleigh), materials(ground), SINGLE_PRECISION,
            small_camera(9, 9, 900.0, 1180.0))  # fmt: skip


@pytest.mark.parametrize("body", [MATT, COAT, METAL])
def test_a_box_its_shadow_and_what_it_mirrors(body):
    """Sunlit and shaded walls, ground in its shadow, and a body that mirrors the ground."""
    scene, pose = town()
    hits = compare(scene, pose, sky_with(), materials(MATT, body), IRRADIANCE_TABLE)
    on_ground, walls = hits.material == 0, np.abs(hits.normal[:, 2]) < 0.5
    assert (hits.sun_visible[on_ground] == 0).any() and (hits.sun_visible[on_ground] == 1).any()
    assert walls.any() and (hits.sky_view[on_ground] < 1).any()
    if body is not MATT:
        assert (hits.mirror_material[walls] == 0).any()


def test_rays_above_the_horizon_bring_the_sky():
    pose = look_at(Pose(0.0, 0.0, 100.0), [0.0, 1000.0, 400.0])
    hits = compare(snapshot(plane()), pose, sky_with(rayleigh), materials(MATT), SINGLE_PRECISION)
    assert (hits.material < 0).all()


def test_leaves_let_light_through_from_behind():
    """A card over the camera's side of the sun: lit from its back."""
    library = materials(MATT, MATT)
    library["transmittance"].values[1] = 0.25
    leaf = plane(40.0, 0.0, 1)
    tilt = math.radians(75)  # its upper side turns away from the sun in the south-south-east
    turned = [[1, 0, 0, 0], [0, math.cos(tilt), math.sin(tilt), 0], [0, -math.sin(tilt), math.cos(tilt), 60]]
    scene = snapshot(plane(900.0), [leaf], [turned], [0])
    pose = look_at(Pose(0.0, 600.0, 500.0), [0.0, 0.0, 60.0])
    sky = sky_with()
    hits = trace(scene, small_camera(), pose, sky.sun_direction, library["roughness"].values)
    assert (hits.material == 1).any()
    compare(scene, pose, sky, library, IRRADIANCE_TABLE)


def test_a_rough_interface_is_refused():
    sky, library = sky_with(), materials((0.2, 1.5, 0.0, 0.3, 1.0))
    hits = trace(snapshot(plane()), small_camera(1, 1), nadir(), sky.sun_direction, np.array([0.3]))
    with pytest.raises(ValueError, match=r"`roughness` must be below 0.1 for a ray to be mirrored; got 0.3"):
        shade_ray(hits, 0, sky, library)
