"""What a base polarizes by itself: closed form, Umov's law, direction, symmetries, energy, range."""

import math

import numpy as np
import pytest
import xarray as xr

from glintrack.camera import Pose, look_at
from glintrack.render import shade, trace, unpack_sky
from glintrack.render.shading.interface import MIN_COSINE_SUM, polarized_reflectance
from glintrack.scene import SceneDesign, load_materials
from glintrack.scene.materials import MAX_POLARIZED_REFLECTANCE, load_user_materials
from glintrack.stokes import frame_angle, rotate
from tests.conftest import flat_sky, materials, plane, small_camera, snapshot
from tests.oracles.shade_ray import shade_ray

C, SUN_ZENITH_DEG, SUN_AZIMUTH_DEG = 5.0, 40.0, 150.0
SINGLE_PRECISION = 2e-5  # of I


def sunlight_alone():
    return unpack_sky(
        flat_sky(SUN_ZENITH_DEG, SUN_AZIMUTH_DEG, sun=1000.0, sky_radiance=0.0, path=0.0, transmittance=1.0),
        1000.0,
    )


def library(scale, reflectance=0.12):
    """Matt ground, twice as bright at the longest wavelength as at the shortest."""
    one = materials((reflectance, 1.5, 0.0, 0.0, 0.0))
    table = one["wavelength"].values
    slope = 1 + (table - table[0]) / (table[-1] - table[0])
    one["reflectance"] = one["reflectance"] * xr.DataArray(slope, dims="wavelength")
    one["polarized_base"] = ("material", np.array([scale]), {"units": "1"})
    return one


def seen(azimuth_deg, zenith_deg, scale=C):
    """Hits on level ground, the sky, and light (element, wavelength, 3) toward a lens in some direction."""
    a, z = math.radians(azimuth_deg), math.radians(zenith_deg)
    place = 900 * np.array([math.sin(z) * math.sin(a), math.sin(z) * math.cos(a), math.cos(z)])
    sky, one = sunlight_alone(), library(scale)
    scene, pose = snapshot(plane(30_000.0)), look_at(Pose(*place), [0.0, 0.0, 0.0])
    hits = trace(scene, small_camera(5, 5, 3.0, 900.0), pose, sky.sun_direction, one["roughness"].values)
    bands = len(sky.wavelength_um)
    return hits, sky, one, shade(hits, sky, one, np.eye(bands)).values.reshape(-1, bands, 3).astype(float)


def fresnel_difference(angle):
    """½(Rs − Rp) by the angles a and b of incidence and refraction: sin²(a − b)/sin²(a + b), and tan²."""
    below = math.asin(math.sin(angle) / 1.5)
    less, more = angle - below, angle + below
    return 0.5 * ((math.sin(less) / math.sin(more)) ** 2 - (math.tan(less) / math.tan(more)) ** 2)


@pytest.mark.parametrize(
    ("azimuth_deg", "zenith_deg"), [(330, 50), (240, 50), (150, 65), (60, 20), (330, 75)]
)
def test_degree_times_reflectance_is_the_closed_form_at_every_wavelength(azimuth_deg, zenith_deg):
    """Umov: DoLP ρ = R_p, which has no wavelength; perpendicular to the plane of sun and look."""
    hits, sky, one, light = seen(azimuth_deg, zenith_deg)
    look, sun = hits.direction[12].astype(float), sky.sun_direction
    alpha = 0.5 * math.acos(-look @ sun)
    cosines = sun[2] - look[2]
    expected = C * math.exp(-math.tan(alpha)) * fresnel_difference(alpha) / (4 * max(cosines, MIN_COSINE_SUM))
    rho = np.interp(sky.wavelength_um, one["wavelength"].values, one["reflectance"].values[0])
    degree = np.hypot(light[12, :, 1], light[12, :, 2]) / light[12, :, 0]
    np.testing.assert_allclose(degree * rho, expected, rtol=1e-3)
    assert degree[0] > 1.2 * degree[-1]
    across = np.cross(look, sun)
    turned = rotate(light[12], frame_angle(hits.detector_axis[None], across[None], -look[None]))
    np.testing.assert_allclose(turned[:, 1] / light[12, :, 0], degree, rtol=1e-3)
    np.testing.assert_allclose(turned[:, 2] / light[12, :, 0], 0, atol=1e-4)


def test_no_light_is_polarized_that_comes_straight_back_and_none_is_added():
    hits, sky, _, light = seen(SUN_AZIMUTH_DEG, SUN_ZENITH_DEG)
    straight = np.argmax(-hits.direction @ sky.sun_direction)
    assert np.hypot(*light[straight, 0, 1:]) / light[straight, 0, 0] < 1e-4
    *_, other = seen(330, 50)
    *_, without = seen(330, 50, scale=0.0)
    np.testing.assert_allclose(other[..., 0], without[..., 0], rtol=1e-6)
    np.testing.assert_allclose(without[..., 1:], 0, atol=1e-6 * without[..., 0].max())


def test_left_of_the_sun_mirrors_right_of_it():
    """U changes its sign and Q does not, in an image with the sun's azimuth upright."""
    (*_, left), (*_, right) = seen(SUN_AZIMUTH_DEG + 70, 50), seen(SUN_AZIMUTH_DEG - 70, 50)
    np.testing.assert_allclose(left[12, :, 1], right[12, :, 1], rtol=1e-3)
    np.testing.assert_allclose(left[12, :, 2], -right[12, :, 2], rtol=1e-3)
    assert abs(left[12, 0, 2]) > 0.01 * left[12, 0, 0]


def test_sun_and_look_may_change_places():
    one, other = (polarized_reflectance(C, *pair, 0.7) for pair in ((0.3, 0.9), (0.9, 0.3)))
    assert one == other > 0


def test_kernels_add_what_the_reference_adds():
    hits, sky, one, light = seen(330, 60)
    for ray in (0, 7, 12, 24):
        expected = shade_ray(hits, ray, sky, one)
        np.testing.assert_allclose(light[ray], expected, atol=SINGLE_PRECISION * expected[:, 0].max(), rtol=0)


def test_greatest_polarized_reflectance_is_that_of_the_range_check():
    """The limit of what a material may ask for: light of a base is never polarized beyond its intensity."""
    cosines = np.linspace(0.01, 1, 2000)
    greatest = max(polarized_reflectance(1.0, 0.0, 0.0, c) for c in cosines)
    assert 0.97 * MAX_POLARIZED_REFLECTANCE < greatest <= MAX_POLARIZED_REFLECTANCE


def test_the_published_scale_gives_the_published_polarized_reflectance():
    """Facing the sun, with large angles of sun and look, 0.02 to 0.04 (Maignan et al. 2009, abstract)."""
    z = math.radians(65)
    assert 0.015 < polarized_reflectance(C, math.cos(z), math.cos(z), math.cos(z)) < 0.04
    assert polarized_reflectance(C, 0.9, 0.9, 0.999) < 5e-4  # very little at backscattering


def test_bases_are_not_polarized_unless_a_city_asks_for_it():
    assert not load_materials()["polarized_base"].any()
    names = load_materials()["material"].values
    carried = load_materials(True)["polarized_base"].values
    assert set(names[carried > 0]) == {"asphalt", "asphalt_worn", "concrete", "pavement", "kerb"}
    assert not SceneDesign().polarized_bases


@pytest.mark.parametrize(
    ("value", "message"),
    [(9.0, "must be at most 1.88"), (-1.0, "greater than or equal to 0"), (math.nan, "polarized_base")],
)
def test_what_is_refused(tmp_path, value, message):
    (tmp_path / "own.toml").write_text(
        f"[tar]\nconstant = 0.02\nrefractive_index = 1.5\nroughness = 0.5\nspecular_weight = 0.0\n"
        f"polarized_base = {value}\n"
    )
    with pytest.raises(ValueError, match=message):
        load_user_materials(tmp_path / "own.toml")
