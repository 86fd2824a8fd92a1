"""Radiance against closed forms: Lambert, Fresnel, Brewster, frames, energy."""

import math

import numpy as np
import pytest

from glintrack import stokes
from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.camera import Pose, look_at
from glintrack.core.spectral import channel_weights
from glintrack.render import build_tracer, shade, shade_blocks, trace, unpack_sky
from glintrack.render.shading.materials import DISTRIBUTIONS, fresnel
from glintrack.scene import SceneDesign, build_scene, load_materials
from tests.conftest import flat_sky, materials, nadir, plane, small_camera, snapshot

TABLE_LOOKUP = 2e-3  # bilinear angular tables and float32 output
GLASS = (0.0, 1.5, 0.0, 0.0, 1.0)


def render(tables, library, camera, pose, static=None):
    sky = unpack_sky(tables, 1000.0)
    hits = trace(snapshot(static or plane()), camera, pose, sky.sun_direction, library["roughness"].values)
    weights = channel_weights(sky.wavelength_um, np.ones((1, 7)))
    return shade(hits, sky, library, weights).values[:, :, 0]


def test_lambertian_panel_in_the_sun_and_under_a_sky():
    """L = τ ρ (E_sun cos θ + E_sky)/π + L_path."""
    tables = flat_sky(sun_zenith_deg=40, sun=1000, sky_radiance=50, path=7, transmittance=0.8)
    light = render(tables, materials((0.5, 1.5, 0, 0, 0)), small_camera(), nadir())
    expected = 0.8 * 0.5 * (1000 * math.cos(math.radians(40)) + math.pi * 50) / math.pi + 7
    np.testing.assert_allclose(light[..., 0], expected, rtol=2e-3)
    np.testing.assert_allclose(light[..., 1:], 0, atol=1e-6 * expected)


def test_white_furnace():
    """A white Lambertian body in a uniform unit sky cannot be told from the sky."""
    light = render(flat_sky(sky_radiance=1), materials((1.0, 1.5, 0, 0, 0)), small_camera(), nadir())
    np.testing.assert_allclose(light[..., 0], 1, rtol=1e-3)


@pytest.mark.parametrize("heading", [0.0, 0.4, 2.0])
def test_glass_at_brewsters_angle_is_fully_and_horizontally_polarized(heading):
    brewster = math.atan(1.5)
    position = [1000 * math.tan(brewster) * math.sin(heading), 1000 * math.tan(brewster) * math.cos(heading)]
    pose = look_at(Pose(*position, 1000.0, heading_rad=1.0), [0, 0, 0])
    light = render(flat_sky(sky_radiance=10), materials(GLASS), small_camera(3, 3, 0.01, 1800), pose)
    centre = light[1, 1]
    reflected_s = ((1 - 1.5**2) / (1 + 1.5**2)) ** 2  # at Brewster's angle Rs = ((n²−1)/(n²+1))²
    assert centre[0] == pytest.approx(10 * reflected_s / 2, rel=TABLE_LOOKUP)
    assert stokes.dolp(centre) == pytest.approx(1, abs=TABLE_LOOKUP)
    # image right is horizontal for a gimballed view, so horizontal light has Q = +I in `detector`
    assert centre[1] == pytest.approx(centre[0], rel=TABLE_LOOKUP)


def test_glass_seen_from_straight_above_is_unpolarized():
    light = render(flat_sky(sky_radiance=10), materials(GLASS), small_camera(3, 3, 0.01), nadir())
    assert light[1, 1, 0] == pytest.approx(10 * 0.04, rel=TABLE_LOOKUP)
    assert stokes.dolp(light[1, 1]) < 1e-4


def test_metal_mirror_against_fresnels_formula():
    n, k, angle = 1.4, 7.6, math.radians(50)
    pose = look_at(Pose(0, -1000 * math.tan(angle), 1000.0), [0, 0, 0])
    light = render(
        flat_sky(sky_radiance=10), materials((0, n, k, 0, 1)), small_camera(3, 3, 0.01, 1556), pose
    )
    m, c = n + 1j * k, math.cos(angle)
    q = np.sqrt(m**2 - math.sin(angle) ** 2)
    rs, rp = abs((c - q) / (c + q)) ** 2, abs((m**2 * c - q) / (m**2 * c + q)) ** 2
    np.testing.assert_allclose(light[1, 1, 0], 10 * (rs + rp) / 2, rtol=TABLE_LOOKUP)
    np.testing.assert_allclose(light[1, 1, 1], 10 * (rs - rp) / 2, rtol=5 * TABLE_LOOKUP)


def test_a_metal_whose_index_changes_against_fresnels_formula_at_each_wavelength():
    """n from 0.3 to 2.7 and k from 2.5 to 8 over the visible and beyond: several terms in colour."""
    angle = math.radians(50)
    pose = look_at(Pose(0, -1000 * math.tan(angle), 1000.0), [0, 0, 0])
    library, sky = materials((0, 1.0, 5.0, 0, 1)), unpack_sky(flat_sky(sky_radiance=10), 1000.0)
    ends = {"refractive_index_spectrum": (0.3, 2.7), "extinction_index_spectrum": (2.5, 8.0)}
    for name, values in ends.items():
        library[name][:] = np.array([values])
    um = sky.wavelength_um
    n, k = (np.interp(um, library["wavelength"].values, np.array(values)) for values in ends.values())
    hits = trace(snapshot(plane()), small_camera(3, 3, 0.01, 1556), pose, sky.sun_direction, np.zeros(1))
    light = shade(hits, sky, library, wavelength_um=um).values[1, 1]
    m, c = n + 1j * k, math.cos(angle)
    q = np.sqrt(m**2 - math.sin(angle) ** 2)
    rs, rp = abs((c - q) / (c + q)) ** 2, abs((m**2 * c - q) / (m**2 * c + q)) ** 2
    np.testing.assert_allclose(light[:, 0], 10 * (rs + rp) / 2, rtol=2 * TABLE_LOOKUP)
    np.testing.assert_allclose(light[:, 1], 10 * (rs - rp) / 2, atol=10 * TABLE_LOOKUP)


def test_polarized_sky_in_a_mirror_by_jones_vectors():
    """Level glass, look north 40° off nadir: the sky seen is north, 40° from the zenith, polarized +45°."""
    angle = math.radians(40)
    tables = flat_sky(sky_radiance=10, stokes=lambda z, a: (1.0, 0.0, 1.0))
    pose = look_at(Pose(0, -1000 * math.tan(angle), 1000.0), [0, 0, 0])
    light = render(tables, materials(GLASS), small_camera(3, 3, 0.01, 1305), pose)[1, 1]
    # travel of the sky's light, its meridian axes (e1 in the vertical plane, e2 = k × e1)
    k_in = np.array([0, -math.sin(angle), -math.cos(angle)])
    e1 = np.array([0, math.cos(angle), -math.sin(angle)])
    field = (e1 + np.cross(k_in, e1)) / math.sqrt(2)
    # s is east-west; p components by the Fresnel (Verdet) convention p = k × s on both sides
    s, k_out = np.array([1.0, 0, 0]), np.array([0, -math.sin(angle), math.cos(angle)])
    c, ct = math.cos(angle), math.sqrt(1 - (math.sin(angle) / 1.5) ** 2)
    rs, rp = (c - 1.5 * ct) / (c + 1.5 * ct), (1.5 * c - ct) / (1.5 * c + ct)
    out = rs * (field @ s) * s + rp * (field @ np.cross(k_in, s)) * np.cross(k_out, s)
    right, up = np.array([1.0, 0, 0]), np.cross(k_out, [1.0, 0, 0])
    expected = np.array([out @ out, (out @ right) ** 2 - (out @ up) ** 2, 2 * (out @ right) * (out @ up)])
    np.testing.assert_allclose(light, 10 * expected, atol=10 * 0.04 * 5e-3)


def test_heading_turns_detector_stokes_and_not_the_scene():
    """A nadir camera turned by α sees (S1, S2) turned by 2α; in `meridian`-like world axes nothing moves."""
    tables = flat_sky(
        sky_radiance=10, stokes=lambda z, a: (1.0, 0.5 * math.cos(2 * a), -0.5 * math.sin(2 * a))
    )
    # this sky's zenith is polarized along north whatever the azimuth it is read at
    library = materials(GLASS)
    still = render(tables, library, small_camera(3, 3, 0.01), nadir())[1, 1]
    alpha = 0.3
    turned = render(tables, library, small_camera(3, 3, 0.01), nadir(heading_rad=alpha))[1, 1]
    # heading is clockwise from north, so the detector's +x turns by −α counter-clockwise seen from above,
    # and by −α seen looking at the source from the detector
    np.testing.assert_allclose(turned, stokes.rotate(still, -alpha), atol=2e-3 * still[0])
    # light polarized along north stays so on a mirror at normal incidence: Q < 0 in a north-up frame
    assert still[1] < -0.4 * still[0] and abs(still[2]) < 2e-3 * still[0]


def test_turning_everything_about_the_vertical_changes_nothing():
    library = materials((0.2, 1.5, 0, 0.3, 0.7))
    out = []
    for turn in (0.0, 1.1):
        angle = math.radians(35)
        tables = flat_sky(
            sun_azimuth_deg=150 + math.degrees(turn), sun=1000, sky_radiance=60,
            stokes=lambda z, a, turn=turn: (1.0, 0.3 * math.sin(z) * math.cos(a - turn), 0.2 * math.sin(z)),
        )  # fmt: skip
        x, y = 1000 * math.tan(angle) * math.sin(turn + 1), 1000 * math.tan(angle) * math.cos(turn + 1)
        pose = look_at(Pose(x, y, 1000.0, heading_rad=turn), [0, 0, 0])
        out.append(render(tables, library, small_camera(5, 5, 20, 1220), pose))
    np.testing.assert_allclose(out[0], out[1], atol=3e-3 * out[0][..., 0].max())


def ggx_albedo(alpha, zenith, nodes=200):
    """Directional albedo of GGX with separable Smith masking and F = 1 by quadrature (Walter et al. 2007)."""
    x, w = np.polynomial.legendre.leggauss(nodes)
    mu, phi = np.meshgrid((x + 1) / 2, (np.arange(nodes) + 0.5) * 2 * math.pi / nodes, indexing="ij")
    view = np.stack([np.sqrt(1 - mu**2) * np.cos(phi), np.sqrt(1 - mu**2) * np.sin(phi), mu], axis=-1)
    half = view + [math.sin(zenith), 0, math.cos(zenith)]
    cosine = (half / np.linalg.norm(half, axis=-1, keepdims=True))[..., 2]
    density = alpha**2 / math.pi / (cosine**2 * (alpha**2 - 1) + 1) ** 2
    masking = [2 / (1 + np.sqrt(1 + alpha**2 * (1 - c * c) / c**2)) for c in (mu, math.cos(zenith))]
    integrand = density * masking[0] * masking[1] / (4 * math.cos(zenith))
    return float((integrand * w[:, None]).sum() * math.pi / nodes)


def test_sun_glint_integrates_to_the_albedo_of_ggx():
    """Flux of the glint over all views of a rough level mirror, against an independent quadrature."""
    alpha, zenith, rings, spokes = 0.25, math.radians(30), 12, 24
    sky = unpack_sky(flat_sky(sun_zenith_deg=30, sun=1.0), 1000.0)
    library = materials((0.0, 200.0, 0.0, alpha, 1.0))  # n = 200 reflects nearly all at every angle
    weights = channel_weights(sky.wavelength_um, np.ones((1, 7)))
    scene = snapshot(plane(10))
    tracer = build_tracer(scene)
    nodes, w = np.polynomial.legendre.leggauss(rings)
    total = 0.0
    for mu, wm in zip((nodes + 1) / 2, w / 2, strict=True):
        for phi in np.arange(spokes) * 2 * math.pi / spokes:
            across = 1000 * math.sqrt(1 - mu**2)
            pose = look_at(Pose(across * math.sin(phi), across * math.cos(phi), 1000 * mu), [0, 0, 0])
            hits = trace(
                scene, small_camera(1, 1, 0.01), pose, sky.sun_direction, np.array([alpha]), tracer=tracer
            )
            light = float(shade(hits, sky, library, weights)[0, 0, 0, 0])
            total += wm * 2 * math.pi / spokes * mu * light
    expected = ggx_albedo(alpha, zenith) * math.cos(zenith) * ((200 - 1) / (200 + 1)) ** 2
    quadrature = 5e-3  # 12 × 24 views
    assert total == pytest.approx(expected, rel=quadrature)


def test_pixels_equal_the_frame_and_identity_channels_equal_the_band():
    tables = flat_sky(sun=1000, sky_radiance=50, path=5, transmittance=0.9)
    library = materials((0.3, 1.5, 0, 0.4, 0.5))
    sky = unpack_sky(tables, 1000.0)
    hits = trace(snapshot(plane()), small_camera(), nadir(), sky.sun_direction, library["roughness"].values)
    weights = channel_weights(sky.wavelength_um, np.ones((1, 7)))
    frame = shade(hits, sky, library, weights)
    pixels = np.array([[0, 0], [3, 7], [20, 20]])
    some = shade(hits, sky, library, weights, pixels)
    np.testing.assert_allclose(some.values, frame.values[pixels[:, 0], pixels[:, 1]], rtol=1e-5)
    spectrum = shade(hits, sky, library, np.eye(7), pixels)
    np.testing.assert_allclose(spectrum.values.transpose(0, 2, 1) @ weights[0], some.values[:, 0], rtol=1e-5)


def test_physical_everywhere():
    tables = flat_sky(
        sun=1000, sky_radiance=50, stokes=lambda z, a: (1.0, 0.6 * math.sin(a), 0.6 * math.cos(a))
    )
    light = render(tables, materials((0.1, 1.5, 0, 0.2, 1.0)), small_camera(41, 41, 2500), nadir())
    assert np.all(light[..., 0] ** 2 >= (light[..., 1:] ** 2).sum(-1) * (1 - 1e-6))


def test_channels_of_wrong_length_are_refused():
    sky = unpack_sky(flat_sky(sun=1), 1000.0)
    hits = trace(snapshot(plane()), small_camera(), nadir(), sky.sun_direction, np.zeros(1))
    with pytest.raises(ValueError, match="`channels` must have at least one row of 7 weights"):
        shade(hits, sky, materials(GLASS), np.ones((1, 5)))


def test_blocks_equal_the_pixels_spectra():
    sky = unpack_sky(flat_sky(sun=1000, sky_radiance=50, path=5, transmittance=0.9), 1000.0)
    library = materials((0.3, 1.5, 0, 0.4, 0.5))
    hits = trace(snapshot(plane()), small_camera(), nadir(), sky.sun_direction, library["roughness"].values)
    blocks = dict(shade_blocks(hits, sky, library, wavelength_um=sky.wavelength_um, rows=8))
    assert sorted(blocks) == [0, 8, 16]
    cube = np.concatenate([blocks[first].values for first in sorted(blocks)])
    pixels = np.array([[0, 0], [13, 7], [20, 20]])
    some = shade(hits, sky, library, pixels=pixels, wavelength_um=sky.wavelength_um)
    assert some.dims == ("pixel", "wavelength", "stokes")
    np.testing.assert_allclose(cube[pixels[:, 0], pixels[:, 1]], some.values, rtol=1e-5)


def test_asking_for_nothing_or_for_wavelengths_without_a_sky_is_refused():
    sky = unpack_sky(flat_sky(sun=1), 1000.0)
    hits = trace(snapshot(plane()), small_camera(), nadir(), sky.sun_direction, np.zeros(1))
    with pytest.raises(ValueError, match="`channels` must have at least one row"):
        shade(hits, sky, materials(GLASS), np.ones((0, 7)))
    with pytest.raises(ValueError, match="`wavelength_um` must name at least one wavelength"):
        shade(hits, sky, materials(GLASS), wavelength_um=np.array([]))
    with pytest.raises(ValueError, match=r"must cover 0.4 to 1.2 µm; got data from 0.4 to 1 µm"):
        shade(hits, sky, materials(GLASS), wavelength_um=np.array([0.4, 1.2]))
    with pytest.raises(ValueError, match="either channels or wavelength_um"):
        shade(hits, sky, materials(GLASS))
    short = (
        materials(GLASS)
        .isel(wavelength=[0, 1])
        .assign_coords(wavelength=("wavelength", np.array([0.5, 2.5]), {"units": "um"}))
    )
    with pytest.raises(ValueError, match=r"`materials.reflectance` must cover 0.4 to 1 µm"):
        shade(hits, sky, short, np.ones((1, 7)))


def level_light(library, tables=None, direction_deg=0.0, change=lambda hits: hits):
    """Stokes vector of level ground seen from ``direction_deg`` off nadir, looking north."""
    sky = unpack_sky(tables or flat_sky(sun=1000, sky_radiance=50), 1000.0)
    pose = look_at(Pose(0, -1000 * math.tan(math.radians(direction_deg)), 1000.0), [0, 0, 0])
    hits = trace(
        snapshot(plane()), small_camera(3, 3, 0.01), pose, sky.sun_direction, library["roughness"].values
    )
    return shade(change(hits), sky, library, channel_weights(sky.wavelength_um, np.ones((1, 7)))).values[
        1, 1, 0
    ]


@pytest.mark.parametrize(("roughness", "weight"), [(0.5, 0.3), (0.2, 1.0), (0.0, 1.0)])
def test_a_white_base_under_any_interface_stays_white_in_a_furnace(roughness, weight):
    light = level_light(materials((1.0, 1.5, 0, roughness, weight)), flat_sky(sky_radiance=1), 40)
    one_percent = 0.01
    assert light[0] == pytest.approx(1, rel=one_percent)


def test_a_leaf_lets_through_what_shines_on_its_back():
    """L = τ E cos θ/π from behind, beside what its front reflects of the sky."""
    library = materials((0.1, 1.5, 0, 0.4, 0.0))
    library["transmittance"] = (("material", "wavelength"), np.full((1, 2), 0.3), {"units": "1"})

    def from_behind(hits):
        return hits._replace(normal=-hits.normal, look=-hits.look, sun_visible=0 * hits.sun_visible + 1)

    # seen from below: the sun and the sky on its back, its front dark
    tables = flat_sky(sun_zenith_deg=40, sun=1000, sky_radiance=50)
    light = level_light(library, tables, change=from_behind)
    arrives = 1000 * math.cos(math.radians(40)) + math.pi * 50
    # what is in view faces neither sun nor sky: no light comes from the surroundings
    assert light[0] == pytest.approx(0.3 * arrives / math.pi, rel=TABLE_LOOKUP)


def test_a_mirror_shows_the_base_of_what_it_meets():
    """Level glass that meets a white wall in the sun: L = F/π ρ (E_sun c + E_sky s), polarized as F is."""
    library = materials(GLASS, (0.8, 1.5, 0, 0, 0.0))

    def meets(hits):
        ones = np.ones_like(hits.sun_visible)
        return hits._replace(
            mirror_material=np.ones_like(hits.mirror_material), mirror_sun=0.6 * ones, mirror_sky=ones
        )

    light = level_light(library, flat_sky(sun=1000, sky_radiance=50), 50, meets)
    m00, m01, _ = fresnel(math.cos(math.radians(50)), 1.5, 0.0)
    shown = 0.8 * (1000 * 0.6 + math.pi * 50) / math.pi
    np.testing.assert_allclose(light, [m00 * shown, m01 * shown, 0], atol=TABLE_LOOKUP * shown * 0.1)


def test_what_is_not_sky_sends_the_mean_light_of_the_frame():
    """Half the sky hidden: ρ/π (½ E_sky + ½ M), M = ρ times what reaches the same ground."""

    def half_hidden(hits):
        return hits._replace(sky_view=0.5 * np.ones_like(hits.sky_view))

    light = level_light(materials((0.4, 1.5, 0, 0, 0)), flat_sky(sky_radiance=10), change=half_hidden)
    mean = 0.4 * 0.5 * math.pi * 10
    assert light[0] == pytest.approx(0.4 / math.pi * (0.5 * math.pi * 10 + 0.5 * mean), rel=TABLE_LOOKUP)


def test_a_tilted_facet_gets_the_sky_in_front_of_it():
    """A steep facet under a sky that is brighter where it looks."""

    def wall_to_north(hits):
        tilted = np.zeros_like(hits.normal)
        tilted[:, 1], tilted[:, 2] = math.sqrt(0.75), 0.5
        return hits._replace(normal=tilted, sky_view=np.ones_like(hits.sky_view))

    library = materials((0.5, 1.5, 0, 0, 0))
    tables = flat_sky(sky_radiance=10, stokes=lambda z, a: (1 + 0.5 * math.sin(z) * math.cos(a), 0.0, 0.0))
    light = level_light(library, tables, change=wall_to_north)
    # ∫ (1 + ½ ω·north) max(n·ω, 0) dω over z > 0, n 60° from up toward north, by quadrature
    z, w = np.polynomial.legendre.leggauss(200)
    z, w = (z + 1) / 2, w / 2
    turn = (np.arange(400) + 0.5) * math.pi / 200
    north = np.sqrt(1 - z[:, None] ** 2) * np.cos(turn)
    facing = np.maximum(0.5 * z[:, None] + math.sqrt(0.75) * north, 0)
    from_sky = (w[:, None] * (1 + 0.5 * north) * facing).sum() * math.pi / 200
    around = 0.5 * 0.75 * math.pi * (1 - 0.75)  # the frame's mean light fills the quarter that is not sky
    assert light[0] == pytest.approx(10 * 0.5 / math.pi * (from_sky + around), rel=5 * TABLE_LOOKUP)


def test_channels_equal_the_integral_of_the_spectrum_in_the_library():
    """Every material of the library, rough, smooth and dispersive: 0.1 % of I."""
    library = load_materials()
    sky = unpack_sky(solve_tables(AtmosphereDesign()), 2000.0)
    hits = trace(
        snapshot(plane()), small_camera(6, 9, 400, 2100), Pose(0, 0, 2000.0), sky.sun_direction, np.ones(1)
    )
    hits = hits._replace(material=(np.arange(54) % library.sizes["material"]).astype(np.int16))
    weights = channel_weights(sky.wavelength_um, np.exp(-(((sky.wavelength_um - [[0.5], [0.8]]) / 0.1) ** 2)))
    band = shade(hits, sky, library, weights).values
    spectrum = shade(hits, sky, library, wavelength_um=sky.wavelength_um).values
    integral = np.einsum("cl,yxls->yxcs", weights, spectrum)
    a_tenth_of_a_percent = 1e-3
    assert (np.abs(band - integral) / integral[..., :1]).max() < a_tenth_of_a_percent


def test_sunlight_comes_through_a_leaf_card_seen_from_below():
    """From `trace` to the light: L = τ E_sun cos θ/π."""
    library = materials((0.0, 1.5, 0, 0.4, 0.0), (0.1, 1.5, 0, 0.4, 0.0))
    through = np.array([[0.0, 0.0], [0.3, 0.3]])
    library["transmittance"] = (("material", "wavelength"), through, {"units": "1"})
    ground, leaf = plane(), plane(400, 50.0, 1)
    vertices, faces = (
        np.concatenate(both) for both in ((ground.vertices, leaf.vertices), (ground.faces, leaf.faces + 4))
    )
    card = snapshot(type(leaf)(vertices, faces, np.array([0, 0, 1, 1], np.int16)))
    sky = unpack_sky(flat_sky(sun_zenith_deg=40, sun=1000), 1000.0)
    tracer = build_tracer(card, np.array([0.0, 0.01]))
    pose = look_at(Pose(0, -20, 1), [0, 0, 50])
    camera = small_camera(5, 5, 2, 53)
    hits = trace(card, camera, pose, sky.sun_direction, np.full(2, 0.4), tracer=tracer)
    below = np.flatnonzero(hits.material == 1)  # the others look through holes
    light = shade(hits, sky, library, channel_weights(sky.wavelength_um, np.ones((1, 7)))).values.reshape(
        -1, 3
    )
    arrives = 1000 * math.cos(math.radians(40))
    assert len(below) > 20
    np.testing.assert_allclose(light[below, 0], 0.3 * arrives / math.pi, rtol=TABLE_LOOKUP)


@pytest.mark.slow
def test_no_light_of_a_city_is_more_than_fully_polarized():
    """S0² ≥ S1² + S2² over a frame of the default city, in a band and in single wavelengths."""
    city = build_scene(SceneDesign(trees=False))
    sky = unpack_sky(solve_tables(AtmosphereDesign()), 2000.0)
    pose, roughness = look_at(Pose(900.0, -1500.0, 2000.0), [0, 0, 0]), city.materials["roughness"].values
    hits = trace(city.at(10.0), small_camera(140, 220, 500, 2660), pose, sky.sun_direction, roughness)
    weights = np.concatenate([np.ones((1, len(sky.wavelength_um))), np.eye(len(sky.wavelength_um))[::12]])
    single_precision = 1e-6
    for distribution in range(len(DISTRIBUTIONS)):
        library = city.materials.assign(
            distribution=("material", np.full(len(roughness), distribution), {"units": "1"})
        )
        light = shade(hits, sky, library, channel_weights(sky.wavelength_um, weights)).values.astype(float)
        assert (light[..., 0] > 0).all(), DISTRIBUTIONS[distribution]
        polarized = (light[..., 1:] ** 2).sum(-1)
        assert (light[..., 0] ** 2 * (1 + single_precision) >= polarized).all(), DISTRIBUTIONS[distribution]
