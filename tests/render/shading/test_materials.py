"""Microfacets against closed forms and quadratures: density, masking, reciprocity, energy, named models."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from glintrack.render.shading.materials import (
    COSINES,
    DISTRIBUTIONS,
    facet_density,
    facet_lobe,
    fresnel,
    masking,
    oren_nayar,
    sample_disc,
    sample_facet,
    unpack_surfaces,
)
from glintrack.scene import load_materials
from tests.conftest import materials
from tests.oracles.facets import reflection_mueller

every_model = pytest.mark.parametrize("distribution", range(len(DISTRIBUTIONS)), ids=DISTRIBUTIONS)
IDENTITY = np.eye(3)


def hemisphere(count=96):
    """Directions and their solid angles: Gauss in height, even in azimuth."""
    z, w = np.polynomial.legendre.leggauss(count)
    z, w = (z + 1) / 2, w / 2
    turn = (np.arange(2 * count) + 0.5) * math.pi / count
    z, turn = np.meshgrid(z, turn, indexing="ij")
    across = np.sqrt(1 - z * z)
    directions = np.stack([across * np.cos(turn), across * np.sin(turn), z], axis=-1).reshape(-1, 3)
    return directions, np.repeat(w * math.pi / count, 2 * count)


def unit(zenith, azimuth):
    return np.array(
        [math.sin(zenith) * math.cos(azimuth), math.sin(zenith) * math.sin(azimuth), math.cos(zenith)]
    )


@every_model
@pytest.mark.parametrize("alpha", [0.15, 0.5, 0.9])
def test_projected_facets_make_up_the_surface(distribution, alpha):
    """∫ D cos θ dω = 1 (Walter et al. 2007, Eq. 4)."""
    directions, solid_angle = hemisphere(200)
    density = np.array([facet_density(distribution, c, alpha) for c in directions[::400, 2]])
    total = (density * directions[::400, 2]) @ (solid_angle[::400] * 400)
    assert total == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize("distribution", [0, 1], ids=DISTRIBUTIONS[:2])
@pytest.mark.parametrize("cosine", [0.2, 0.6, 0.95])
def test_what_a_direction_sees_is_its_projected_area(distribution, cosine):
    """∫ G1 D max(v·h, 0) dω = cos θv (Walter et al. 2007, Eq. 22: Smith's masking conserves area)."""
    directions, solid_angle = hemisphere(150)
    view = np.array([math.sqrt(1 - cosine**2), 0, cosine])
    toward = np.maximum(directions @ view, 0)
    density = np.array([facet_density(distribution, c, 0.4) for c in directions[:, 2]])
    seen = masking(distribution, cosine, 0.4) * (density * toward) @ solid_angle
    assert seen == pytest.approx(cosine, rel=2e-3)


@every_model
def test_samples_give_what_quadrature_gives(distribution):
    """Albedo of a perfect mirror's facets: drawn facets against the integral of the lobe."""
    alpha, cosine = 0.35, 0.7
    view = np.array([math.sqrt(1 - cosine**2), 0, cosine])
    directions, solid_angle = hemisphere(150)
    half = directions + view
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    lobe = [
        facet_lobe(distribution, h, cosine, l, alpha) * l
        for h, l in zip(half[:, 2], directions[:, 2], strict=True)
    ]
    drawn = np.mean([sample_facet(distribution, *view, alpha, x, y)[3] for x, y in sample_disc(4096)])
    assert drawn == pytest.approx(np.array(lobe) @ solid_angle, rel=5e-3)


angles = st.floats(0.02, 1.5)
turns = st.floats(0, 2 * math.pi)


@settings(max_examples=60, deadline=None)
@given(
    angles,
    angles,
    turns,
    st.floats(0.1, 0.9),
    st.floats(1.05, 3.0),
    st.floats(0, 8),
    st.sampled_from(DISTRIBUTIONS),
)
def test_helmholtz_reciprocity(zenith_a, zenith_b, azimuth, alpha, n, k, distribution):
    """M(a ← b) = X M(b ← a)ᵀ X, X turning U's sign with the direction of travel (van de Hulst, §5.22)."""
    a, b = unit(zenith_a, 0.0), unit(zenith_b, azimuth)
    there = reflection_mueller(a, b, alpha, n, k, distribution)
    back = reflection_mueller(b, a, alpha, n, k, distribution)
    turned = np.diag([1.0, 1.0, -1.0])
    np.testing.assert_allclose(there, turned @ back.T @ turned, atol=1e-9 * (1 + np.abs(there).max()))


@settings(max_examples=60, deadline=None)
@given(angles, angles, turns, turns, st.floats(0, 1), st.sampled_from(DISTRIBUTIONS))
def test_reflected_light_is_physical(zenith_a, zenith_b, azimuth, angle, degree, distribution):
    """S0² ≥ S1² + S2² for light of any degree and angle of polarization."""
    light = np.array([1.0, degree * math.cos(angle), degree * math.sin(angle)])
    out = reflection_mueller(unit(zenith_a, 0), unit(zenith_b, azimuth), 0.4, 1.5, 0.3, distribution) @ light
    rounding = 1e-9 * (1 + out[0] ** 2)
    assert out[0] >= 0 and out[0] ** 2 >= out[1] ** 2 + out[2] ** 2 - rounding


def test_priest_and_germers_form():
    """f00 = exp(−tan²θ/2σ²)/(8π σ² cos⁴θ cos θi cos θr) · ½(Rs + Rp) (Priest and Germer 2000)."""
    sigma, light, view = 0.2, unit(0.6, 0.0), unit(0.5, 2.6)
    half = (light + view) / np.linalg.norm(light + view)
    cos_half, incidence = half[2], math.acos(light @ half)
    t = math.asin(math.sin(incidence) / 1.5)
    rs = (math.sin(incidence - t) / math.sin(incidence + t)) ** 2
    rp = (math.tan(incidence - t) / math.tan(incidence + t)) ** 2
    expected = math.exp(-((math.tan(math.acos(cos_half)) / sigma) ** 2) / 2) * (rs + rp) / 2
    expected /= 8 * math.pi * sigma**2 * cos_half**4 * light[2] * view[2]
    got = reflection_mueller(view, light, math.sqrt(2) * sigma, 1.5, 0.0, "priest_germer")[0, 0]
    assert got == pytest.approx(expected, rel=1e-9)


def test_mirrored_light_at_brewsters_angle_is_horizontal():
    """In the ``meridian`` frame horizontal means Q < 0."""
    brewster = math.atan(1.5)
    out = reflection_mueller(unit(brewster, 0), unit(brewster, math.pi), 0.2, 1.5) @ [1, 0, 0]
    assert out[1] == pytest.approx(-out[0], rel=1e-9)


def test_an_unknown_model_is_refused():
    with pytest.raises(ValueError, match=r"`distribution` must be one of ggx, gaussian, .*; got 'phong'"):
        reflection_mueller(unit(0.1, 0), unit(0.1, 0), 0.2, 1.5, distribution="phong")


def test_oren_nayar():
    """Lambert's law without slopes; Eq. 30 of Oren and Nayar (1994) at 60° toward the light for σ = 30°."""
    assert oren_nayar(0.3, 0.8, 0.2, 0.0) == 1.0
    s2 = math.radians(30) ** 2
    a, b = 1 - 0.5 * s2 / (s2 + 0.33), 0.45 * s2 / (s2 + 0.09)
    c, s = math.cos(math.radians(60)), math.sin(math.radians(60))
    assert oren_nayar(c, c, 1.0, math.radians(30)) == pytest.approx(a + b * s * s / c)
    assert oren_nayar(c, c, -1.0, math.radians(30)) == pytest.approx(a)


@pytest.mark.parametrize("name", ["glass", "paint_red", "water", "metal"])
def test_few_terms_hold_the_dispersion(name):
    """Σ a_j(λ) g_j(θ) against Fresnel at every wavelength."""
    library, wavelength = load_materials(), np.linspace(0.4, 2.5, 43)
    surfaces = unpack_surfaces(library, wavelength)
    m = library["material"].values.tolist().index(name)
    optical = surfaces.optics[m]
    table = np.einsum("jw,jcs->wcs", surfaces.dispersion[optical], surfaces.fresnel[optical])
    n, k = (
        np.interp(wavelength, library["wavelength"].values, library[f"{x}_index_spectrum"].values[m])
        for x in ("refractive", "extinction")
    )
    exact = np.array([[fresnel(c, *nk) for c in COSINES] for nk in zip(n, k, strict=True)])
    terms_left_out = 5e-3 if name == "metal" else 5e-4
    np.testing.assert_allclose(table, exact, atol=terms_left_out)
    assert surfaces.terms[optical] <= 6


@pytest.mark.parametrize("rows", [1, 2])
def test_tables_of_any_number_of_materials_have_one_layout(rows):
    """Numba compiles the shading of pixels, half a minute, for each layout that its tables come in."""
    library = materials(*[(0.3, 1.5, 0.0, 0.1 * row, 1.0) for row in range(rows)])
    surfaces = unpack_surfaces(library, np.array([0.55, 0.65]))
    assert [name for name, values in surfaces._asdict().items() if not values.flags.c_contiguous] == []


@pytest.mark.parametrize("slope_deg", [0.0, 25.0])
@pytest.mark.parametrize("weight", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("roughness", [0.0, 0.2, 0.5])
def test_base_and_interface_return_no_more_than_arrives(roughness, weight, slope_deg):
    """White base: w E + what leaves the base is 1 for Lambert at every angle, and less for grooves."""
    library = materials((1.0, 1.5, 0, roughness, weight))
    library["groove_slope"] = ("material", np.array([math.radians(slope_deg)]), {"units": "rad"})
    surfaces = unpack_surfaces(library, np.array([0.55, 0.65]))
    total = weight * surfaces.albedo[0] + surfaces.at_angle[0, :, 1]
    assert total.max() <= 1 + 1e-6
    if slope_deg == 0:
        np.testing.assert_allclose(total, 1, atol=1e-6)
