"""The part of a base's light that first surfaces of all tilts polarize, where a base has one: Umov's law.

    R_p = C exp(−tan α) ½(Rs − Rp)(α, n = 1.5) / (4 (cos θs + cos θv)),

α half the phase angle: polarized reflectance as Maignan et al. fitted it to what PARASOL saw of land (Eq. 21,
with e^−NDVI in C). It has no wavelength: the degree times the reflectance is the same at each, which is
Umov's law. Light is polarized across the plane of sun and look, and not at all toward the sun's own
direction. Intensity stays that of the base: only the sun's light is polarized, and only what is looked at
directly. What was fitted is all that a surface polarizes: what its interface's facets reflect of the sun to
the same side (`rough.add_glint`) is taken off, to nothing at least. Where cos θs + cos θv is under ½, both
near grazing, where nothing was measured, it counts as ½.

References
----------
Maignan, Bréon, Fédèle and Bouvier, Remote Sensing of Environment 113, 2642 (2009).
"""

import math

import numba as nb

from glintrack.render.shading.pbrdf import facet_lobe, fresnel
from glintrack.render.shading.rough import SUN_HALF_VECTOR_RADIUS, fresnel_term, plane_of_incidence
from glintrack.stokes import rotate_qu

INDEX, LEAST_COSINES = 1.5, 0.5


@nb.njit(cache=True)
def polarized_reflectance(scale, cos_sun, cos_view, cos_half):
    """Polarized reflectance R_p, π times radiance over the sun's irradiance of the facet. [1]

    Parameters
    ----------
    scale
        C. [1]
    cos_sun, cos_view
        Of the angles of sun and look from the normal. [1]
    cos_half
        Of half the phase angle, α. [1]
    """
    c = min(max(cos_half, 1e-3), 1.0)
    tangent = math.sqrt(1.0 - c * c) / c
    _, polarized, _ = fresnel(c, INDEX, 0.0)
    return scale * math.exp(-tangent) * polarized / (4.0 * max(cos_sun + cos_view, LEAST_COSINES))


@nb.njit(cache=True, forceinline=True)
def add_polarized(hit, surfaces, share, sun, axis, out):
    """Add Q and U per unit of the sun's irradiance to the head of ``out``."""
    hx, hy, hz = sun[0] - hit.dx, sun[1] - hit.dy, sun[2] - hit.dz
    norm = 1.0 / math.sqrt(max(hx * hx + hy * hy + hz * hz, 1e-12))
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    m, cos_half = hit.material, -(hit.dx * hx + hit.dy * hy + hit.dz * hz)
    k, mirrored = surfaces.optics[m], 0.0
    if surfaces.weight[m] > 0:
        for term in range(surfaces.terms[k]):
            mirrored += surfaces.reference[k, term] * fresnel_term(surfaces.fresnel, k, term, cos_half)[1]
        facing, view = hit.nx * hx + hit.ny * hy + hit.nz * hz, max(hit.cos_view, 1e-3)
        wide = math.hypot(surfaces.alpha[k], SUN_HALF_VECTOR_RADIUS)
        mirrored *= facet_lobe(surfaces.distribution[k], facing, view, hit.cos_sun, wide) * surfaces.weight[m]
    scale = surfaces.polarized[m]
    whole = polarized_reflectance(scale, hit.cos_sun, hit.cos_view, cos_half) / math.pi
    strength = max(whole - mirrored, 0.0) * hit.cos_sun
    c_out, s_out = plane_of_incidence(hit.dx, hit.dy, hit.dz, hx, hy, hz, axis)[3:]
    q, u = rotate_qu(strength * share * hit.sunlight, 0.0, c_out, s_out)
    out[0, 1] += q
    out[0, 2] += u
