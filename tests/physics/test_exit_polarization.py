"""Light of a base polarized by refraction on its way out, against closed forms in vectors of its own.

Unpolarized light inside leaves with its p part above its s part: of unit radiance the degree
(Rs − Rp)/(2 − Rs − Rp), Fresnel's reflectances taken at the angle of exit (Born and Wolf, §1.5.3).
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.camera import Pose, look_at, rays
from glintrack.core.spectral import channel_weights
from glintrack.render import shade, shade_blocks, trace, unpack_sky
from glintrack.render.light.sky import look_up_all
from glintrack.render.shading.materials import COSINES, DISTRIBUTIONS, unpack_surfaces
from glintrack.scene import load_materials
from glintrack.stokes import frame_angle, rotate
from tests.conftest import flat_sky, materials, plane, small_camera, snapshot
from tests.oracles.facets import reflection_mueller

TABLE_LOOKUP = 5e-4  # of I: Fresnel's tables over the cosine, read linearly
FURNACE_SAMPLES = 4e-3  # of I: what the interface's facets give is drawn twice, with other samples


def reflectances(cosine, n):
    """Rs and Rp of a dielectric, from Snell's law and Fresnel's sines and tangents."""
    angle = math.acos(min(cosine, 1.0))
    if angle < 1e-6:
        return ((n - 1) / (n + 1)) ** 2, ((n - 1) / (n + 1)) ** 2
    inside = math.asin(math.sin(angle) / n)
    return (
        (math.sin(angle - inside) / math.sin(angle + inside)) ** 2,
        (math.tan(angle - inside) / math.tan(angle + inside)) ** 2,
    )


def exit_stokes(look, normal, right, n, weight):
    """(Q, U)/I in the detector's frame of light that leaves along −look, p-polarized, from vectors alone."""
    travel = -look
    s, p = reflectances(float(travel @ normal), n)
    passed_s, passed_p = 1 - weight * s, 1 - weight * p
    degree = (passed_p - passed_s) / (passed_p + passed_s)
    field = normal - (normal @ travel) * travel  # the p axis: in the plane of look and normal
    field = field / max(float(np.linalg.norm(field)), 1e-12)
    first = right - (right @ travel) * travel
    first = first / np.linalg.norm(first)
    second = np.cross(travel, first)  # counter-clockwise looking at the source
    along, across = field @ first, field @ second
    return degree * (along**2 - across**2), degree * 2 * along * across


def sunlit(library, zenith_deg=60.0, heading=0.7, normals=None, sky_radiance=0.0):
    """Camera, pose, sky and hits of ground in the sun, whose mirror image is far from the frame."""
    pose = look_at(
        Pose(
            -1000 * math.tan(math.radians(zenith_deg)) * math.sin(heading),
            -1000 * math.tan(math.radians(zenith_deg)) * math.cos(heading),
            1000.0,
        ),
        [0, 0, 0],
    )
    camera = small_camera(7, 7, 300, 1000 / math.cos(math.radians(zenith_deg)))
    away = math.degrees(heading) + 180
    sky = unpack_sky(flat_sky(50.0, away, sun=1000.0, sky_radiance=sky_radiance), 1000.0)
    hits = trace(snapshot(plane(9000)), camera, pose, sky.sun_direction, library["roughness"].values)
    if normals is not None:
        hits = hits._replace(normal=normals(hits).astype(np.float32))
    return camera, pose, sky, hits


def expected(camera, pose, hits, n, weight):
    looks, right = rays(camera, pose).reshape(-1, 3), np.asarray(hits.detector_axis, float)
    return np.array([
        exit_stokes(look, normal, right, n, weight)
        for look, normal in zip(looks, hits.normal.astype(float), strict=True)
    ])  # fmt: skip


@pytest.mark.parametrize("zenith_deg", [0.0, 35.0, 60.0, 75.0])
@pytest.mark.parametrize(("n", "weight"), [(1.5, 1.0), (1.33, 1.0), (1.6, 0.12)])
def test_base_under_a_smooth_dielectric(zenith_deg, n, weight):
    library = materials((0.4, n, 0.0, 0.0, weight))
    camera, pose, sky, hits = sunlit(library, zenith_deg)
    light = shade(hits, sky, library, np.ones((1, 7)) / 7).values.reshape(-1, 3)
    of_i = light[:, 1:] / light[:, :1]
    np.testing.assert_allclose(of_i, expected(camera, pose, hits, n, weight), atol=TABLE_LOOKUP)


def test_the_degree_at_sixty_degrees_is_a_tenth():
    """n = 1.5: Rs = 0.1772, Rp = 0.0018, so 0.0963; p is upright where image right is level."""
    library = materials((0.4, 1.5, 0.0, 0.0, 1.0))
    _, _, sky, hits = sunlit(library, 60.0)
    i, q, u = shade(hits, sky, library, np.ones((1, 7)) / 7).values[3, 3, 0]
    assert q / i == pytest.approx(-0.0963, abs=TABLE_LOOKUP)
    assert u / i == pytest.approx(0, abs=TABLE_LOOKUP)


def tilted(hits):
    """Normals that still mirror the (black) sky."""
    rng = np.random.default_rng(11)
    normal = hits.normal + rng.uniform(-0.18, 0.18, hits.normal.shape) * [1, 1, 0]
    return normal / np.linalg.norm(normal, axis=1, keepdims=True)


@pytest.mark.parametrize("turn_deg", [0, 50, 115])
def test_every_way_of_asking_gives_the_same_on_facets_of_any_tilt(turn_deg):
    """Channels, spectra at pixels, the cube, and elements one by one; a camera turned about its axis."""
    n = 1.5
    library = materials((0.4, n, 0.0, 0.0, 1.0))
    camera, pose, sky, hits = sunlit(library, 55.0, normals=tilted)
    axis, look = np.asarray(hits.detector_axis, float), rays(camera, pose)[3, 3]
    turn = math.radians(turn_deg)
    axis = math.cos(turn) * axis + math.sin(turn) * np.cross(-look, axis)
    hits = hits._replace(detector_axis=axis)
    closed = expected(camera, pose, hits, n, 1.0)
    if turn_deg == 0:  # upright for a level camera; the facets' tilts give U either sign
        assert (closed[:, 0] < -0.02).all() and closed[:, 1].min() < -0.01 and closed[:, 1].max() > 0.01
    band = shade(hits, sky, library, channel_weights(sky.wavelength_um, np.ones((1, 7))))
    every = np.argwhere(np.ones((hits.rows, hits.columns), bool))
    spectra = shade(hits, sky, library, pixels=every, wavelength_um=sky.wavelength_um).values
    blocks = shade_blocks(hits, sky, library, wavelength_um=sky.wavelength_um, rows=2)
    cube = np.concatenate([block.values for _, block in blocks])
    alone = [shade(hits, sky, library, np.eye(7), pixel[None]).values[0] for pixel in every]
    for light in (band.values, spectra, cube, np.array(alone)):
        light = light.reshape(len(every), -1, 3)
        for channel in range(light.shape[1]):
            of_i = light[:, channel, 1:] / light[:, channel, :1]
            np.testing.assert_allclose(of_i, closed, atol=TABLE_LOOKUP)


@pytest.mark.parametrize("distribution", DISTRIBUTIONS[:2])
@pytest.mark.parametrize("weight", [0.12, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.12, 0.3, 0.5])
def test_a_white_base_in_a_furnace_is_unpolarized(roughness, weight, distribution):
    """In equilibrium all light is: what the base sends out p-polarized, the interface reflects s-polarized.

    This holds for any interface over any base that returns all light (Kirchhoff's law for each polarization),
    and fixes what a rough interface does on the way out by what it reflects.
    """
    library = materials((1.0, 1.5, 0.0, roughness, weight))
    library["distribution"] = ("material", np.array([DISTRIBUTIONS.index(distribution)]), {"units": "1"})
    for zenith_deg in (30.0, 60.0):
        _, _, sky, hits = sunlit(library, zenith_deg)
        sky = replace(unpack_sky(flat_sky(sky_radiance=1.0), 1000.0), sun_direction=sky.sun_direction)
        light = shade(hits, sky, library, np.ones((1, 7)) / 7).values.reshape(-1, 3)
        np.testing.assert_allclose(light[:, 1:], 0, atol=FURNACE_SAMPLES)


def test_a_metal_lets_no_light_out():
    """What a metal's diffuse part sends was scattered by its surface, not from below it."""
    library = materials((0.3, 1.44, 7.5, 0.0, 0.6))
    _, _, sky, hits = sunlit(library, 60.0)
    light = shade(hits, sky, library, np.ones((1, 7)) / 7).values.reshape(-1, 3)
    assert (light[:, 0] > 0).all() and np.abs(light[:, 1:]).max() < TABLE_LOOKUP * light[:, 0].max()


def test_a_bare_base_is_unpolarized():
    library = materials((0.4, 1.5, 0.0, 0.5, 0.0))
    _, _, sky, hits = sunlit(library, 60.0)
    light = shade(hits, sky, library, np.ones((1, 7)) / 7).values.reshape(-1, 3)
    assert np.abs(light[:, 1:]).max() < 1e-6 * light[:, 0].max()


def test_one_index_will_do_for_the_way_out():
    """The index at 0.65 µm in place of each wavelength's: within 0.007 of the base's light.

    Every dielectric of the library over 0.4 to 1.0 µm, to 70° from the normal.
    """
    library = load_materials()
    wavelength = np.linspace(0.4, 1.0, 31)
    cosines = np.cos(np.radians(np.arange(0, 71, 5)))
    for index, extinction in zip(
        library["refractive_index_spectrum"].values, library["extinction_index_spectrum"].values, strict=True
    ):
        if extinction.max() > 1:
            continue
        over = np.interp(wavelength, library["wavelength"].values, index)
        degree = np.array([[exit_degree(c, n) for c in cosines] for n in over])
        assert np.abs(degree - degree[np.argmin(np.abs(wavelength - 0.65))]).max() < 0.007


def exit_degree(cosine, n):
    s, p = reflectances(cosine, n)
    return (s - p) / (2 - s - p)


@pytest.mark.parametrize(
    ("alpha", "zenith_deg", "weight", "rounded"),
    [(0.12, 60, 1.0, 0.08), (0.25, 40, 0.7, 0.02), (0.5, 60, 1.0, 0.02)],
)
def test_rough_exit_against_an_integral_over_the_hemisphere(alpha, zenith_deg, weight, rounded):
    """w D/(1 − w E) with E and D by quadrature of the facets' Mueller matrix over the light."""
    zenith = math.radians(zenith_deg)
    view = np.array([math.sin(zenith), 0.0, math.cos(zenith)])
    z, w = np.polynomial.legendre.leggauss(60)
    turns = (np.arange(120) + 0.5) * math.pi / 120
    returned = np.zeros(2)  # I, and Q in the view's meridian
    for cosine, share in zip((z + 1) / 2, w / 2, strict=True):
        for turn in turns:  # the other half is its mirror image
            across = math.sqrt(1 - cosine * cosine)
            light = np.array([across * math.cos(turn), across * math.sin(turn), cosine])
            matrix = reflection_mueller(view, light, alpha, 1.5)
            returned += 2 * math.pi / 120 * share * cosine * matrix[:2, 0]
    expected_degree = -weight * returned[1] / (1 - weight * returned[0])
    surfaces = unpack_surfaces(materials((0.4, 1.5, 0.0, alpha, weight)), np.array([0.55, 0.65]))
    degree = np.interp(view[2], COSINES, surfaces.at_angle[0, :, 3])
    facets_drawn = 1e-3
    assert degree == pytest.approx(expected_degree, abs=facets_drawn)
    assert round(degree, 2) == rounded


def test_how_much_the_way_in_would_matter():
    """What is left out of the skylight that enters a smooth coat, n = 1.5, under the default sky (limits.md).

    Level, and tilted by 45° to, from and across the sun; light below the horizon is left out.
    """
    tables = solve_tables(AtmosphereDesign())
    sky = unpack_sky(tables, 2000.0)
    z, w = np.polynomial.legendre.leggauss(40)
    z, w = (z + 1) / 2, w / 2
    turn = (np.arange(80) + 0.5) * math.pi / 40
    z, turn = np.meshgrid(z, turn, indexing="ij")
    across = np.sqrt(1 - z * z)
    from_sky = np.stack([across * np.sin(turn), across * np.cos(turn), z], axis=-1).reshape(-1, 3)
    solid_angle = np.repeat(w * math.pi / 40, 80)
    components, north = look_up_all(sky.sky_map, from_sky)
    azimuth = tables.attrs["sun_azimuth_rad"] + np.array([0, 0.5, 1]) * math.pi
    tilted = np.stack([np.sin(azimuth), np.cos(azimuth), np.ones(3)], axis=1) / math.sqrt(2)
    normals = [np.array([0.0, 0.0, 1.0]), *tilted]
    polarized, uneven = [], []
    for band in (0.45, 0.65, 0.85):
        spectrum = sky.sky_spectrum[:, np.argmin(np.abs(sky.wavelength_um - band))]
        light = np.einsum("pks,k->ps", components, spectrum)
        for normal in normals:
            cosine = np.maximum(from_sky @ normal, 0)
            s, p = np.transpose([reflectances(c, 1.5) for c in cosine])
            in_plane = rotate(light, frame_angle(north, np.cross(from_sky, normal), -from_sky))
            share, passed = solid_angle * cosine, 1 - 0.5 * (s + p)
            entered = share @ (passed * light[:, 0])
            polarized.append(-share @ (0.5 * (s - p) * in_plane[:, 1]) / entered)
            uneven.append(entered / (share @ light[:, 0]) / (share @ passed / share.sum()) - 1)
    assert max(map(abs, polarized)) == pytest.approx(0.012, abs=0.001)
    assert max(map(abs, uneven)) == pytest.approx(0.034, abs=0.001)
