"""Polarized reflection at a surface: Fresnel's equations as Mueller matrices, and microfacets.

Kernels for numba; all take scalars. A Mueller matrix of reflection has only four different elements in the
``incidence`` frame (0° perpendicular to the plane of incidence): m00 = m11 = ½(Rs+Rp), m01 = ½(Rs−Rp),
m22 = Re(rs rp*), and m23, which feeds V and is left out with it.

Facets have one of `DISTRIBUTIONS`: ``ggx``; ``gaussian`` slopes (Beckmann), both with Smith's
shadowing–masking; or ``priest_germer``, the Gaussian model of the polarimetric literature, which has none
(Priest and Germer, "Polarimetric BRDF in the microfacet model", Military Sensing Symposia, 2000;
their σ² is α²/2). The base under the facets depolarizes: Lambert, or Oren–Nayar.
"""

import math

import numba as nb

DISTRIBUTIONS = ("ggx", "gaussian", "priest_germer")
GGX, GAUSSIAN, PRIEST_GERMER = range(3)


@nb.njit(cache=True)
def fresnel(cos_incidence, n, k):
    """Mueller elements of specular reflection from air off a surface of index n + ik.

    Parameters
    ----------
    cos_incidence
        Cosine of the angle between ray and normal, 0 to 1. [1]
    n, k
        Complex refractive index; k = 0 for a dielectric. [1]

    Returns
    -------
    m00, m01, m22 in the ``incidence`` frame, both p axes being (travel × s). m22 < 0 at normal incidence: a
    mirror turns +45° into −45°.

    References
    ----------
    Born and Wolf, *Principles of Optics*, 7th ed., §1.5.2 and §14.4 (complex index).
    """
    c = min(max(cos_incidence, 0.0), 1.0)
    if k == 0.0 and n >= 1.0:  # a dielectric, the usual case, without complex numbers
        q = math.sqrt(n * n - 1.0 + c * c)
        rs = (c - q) / (c + q)
        rp = (n * n * c - q) / (n * n * c + q)
        return 0.5 * (rs * rs + rp * rp), 0.5 * (rs * rs - rp * rp), rs * rp
    # n2 cos θt = √(m² − sin²θ), complex for metals, from its real and imaginary parts
    re = n * n - k * k - (1.0 - c * c)
    im = 2.0 * n * k
    modulus = math.sqrt(re * re + im * im)
    a = math.sqrt(max(0.5 * (modulus + re), 0.0))
    b = math.sqrt(max(0.5 * (modulus - re), 0.0))
    # rs = (c − (a+ib)) / (c + (a+ib))
    s_norm = (c + a) * (c + a) + b * b
    rs_re = ((c - a) * (c + a) - b * b) / s_norm
    rs_im = -2.0 * c * b / s_norm
    # rp = (m² c − (a+ib)) / (m² c + (a+ib)), m² = e + ig
    e, g = (n * n - k * k) * c, im * c
    p_norm = (e + a) * (e + a) + (g + b) * (g + b)
    rp_re = ((e - a) * (e + a) + (g - b) * (g + b)) / p_norm
    rp_im = ((g - b) * (e + a) - (e - a) * (g + b)) / p_norm
    reflect_s = rs_re * rs_re + rs_im * rs_im
    reflect_p = rp_re * rp_re + rp_im * rp_im
    cross = rs_re * rp_re + rs_im * rp_im
    return 0.5 * (reflect_s + reflect_p), 0.5 * (reflect_s - reflect_p), cross


@nb.njit(cache=True)
def facet_density(distribution, cos_half, alpha):
    """Density of microfacet normals, of area per area of the mean surface. [sr⁻¹]

    References
    ----------
    Walter et al., "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007, Eqs. (25), (33).
    """
    a2, c2 = alpha * alpha, cos_half * cos_half
    if distribution == GGX:
        d = c2 * (a2 - 1.0) + 1.0
        return a2 / (math.pi * d * d)
    if cos_half < 1e-3:
        return 0.0
    return math.exp(-(1.0 - c2) / (c2 * a2)) / (math.pi * a2 * c2 * c2)


@nb.njit(cache=True)
def masking(distribution, cosine, alpha):
    """Smith's G1: the part of the microfacets that a direction sees. [1]

    References
    ----------
    Walter et al. (2007), Eqs. (34) and (27) with (23) for Gaussian slopes; Priest and Germer have none.
    """
    if cosine <= 0.0:
        return 0.0
    if distribution == PRIEST_GERMER:
        return 1.0
    tan2 = max((1.0 - cosine * cosine) / (cosine * cosine), 1e-12)
    if distribution == GGX:
        return 2.0 / (1.0 + math.sqrt(1.0 + alpha * alpha * tan2))
    spread = alpha * math.sqrt(tan2)
    if spread < 0.2:  # erf is 1 to double precision
        return 1.0
    a = 1.0 / spread
    return 2.0 / (1.0 + math.erf(a) + math.exp(-a * a) / (a * math.sqrt(math.pi)))


@nb.njit(cache=True)
def facet_lobe(distribution, cos_half, cos_view, cos_light, alpha):
    """D·G/(4 cos θv cos θl): what facets of reflectance 1 send from the light to the view. [sr⁻¹]"""
    shadow = masking(distribution, cos_view, alpha) * masking(distribution, cos_light, alpha)
    if shadow == 0.0:
        return 0.0
    return facet_density(distribution, cos_half, alpha) * shadow / (4.0 * cos_view * cos_light)


@nb.njit(cache=True, forceinline=True)
def sampled_facet(distribution, vx, vy, vz, alpha, u, v):
    """One facet normal (local frame, z up), and the weight to give to what it mirrors toward the view.

    Parameters
    ----------
    distribution
        Index into `DISTRIBUTIONS`.
    vx, vy, vz
        View direction. [1]
    alpha
        Roughness. [1]
    u, v
        A point of the unit square.

    Returns
    -------
    Normal x, y, z, and a weight whose mean over the square, times Fresnel's matrix, is the light reflected
    from a uniform unit hemisphere. GGX normals are drawn as the view sees them, the others by area.
    """
    radius, turn = math.sqrt(u), 2.0 * math.pi * v
    cos_turn, sin_turn = math.cos(turn), math.sin(turn)
    if distribution == GGX:
        hx, hy, hz = visible_normal(vx, vy, vz, alpha, radius * cos_turn, radius * sin_turn)
        seen = 1.0
    else:
        tangent = alpha * math.sqrt(-math.log(1.0 - u))
        hz = 1.0 / math.sqrt(1.0 + tangent * tangent)
        hx, hy = tangent * hz * cos_turn, tangent * hz * sin_turn
        seen = masking(distribution, vz, alpha) / (vz * hz)
    cosine = vx * hx + vy * hy + vz * hz
    if cosine <= 0.0:
        return hx, hy, hz, 0.0
    if distribution != GGX:
        seen *= cosine
    return hx, hy, hz, seen * masking(distribution, 2.0 * cosine * hz - vz, alpha)


@nb.njit(cache=True, fastmath={"contract", "reassoc", "arcp", "nsz"}, forceinline=True)
def visible_normal(vx, vy, vz, alpha, a, b):
    """One microfacet normal, drawn as the view direction sees them (local frame, z up). [1]

    Parameters
    ----------
    vx, vy, vz
        View direction. [1]
    alpha
        GGX roughness. [1]
    a, b
        A point of the unit disc, evenly distributed over its area. [1]

    References
    ----------
    Heitz, "Sampling the GGX Distribution of Visible Normals", JCGT 7(4), 2018.
    """
    hx, hy, hz = alpha * vx, alpha * vy, vz
    norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
    hx, hy, hz = hx * norm, hy * norm, hz * norm
    across2 = hx * hx + hy * hy
    if across2 > 1e-14:
        inverse = 1.0 / math.sqrt(across2)
        t1x, t1y = -hy * inverse, hx * inverse
    else:
        t1x, t1y = 1.0, 0.0
    t2x, t2y, t2z = -hz * t1y, hz * t1x, hx * t1y - hy * t1x
    s = 0.5 * (1.0 + hz)
    b = (1.0 - s) * math.sqrt(1.0 - a * a) + s * b
    c = math.sqrt(max(0.0, 1.0 - a * a - b * b))
    nx = alpha * (a * t1x + b * t2x + c * hx)
    ny = alpha * (a * t1y + b * t2y + c * hy)
    nz = max(1e-6, b * t2z + c * hz)
    norm = 1.0 / math.sqrt(nx * nx + ny * ny + nz * nz)
    return nx * norm, ny * norm, nz * norm


@nb.njit(cache=True)
def oren_nayar(cos_view, cos_light, cos_azimuth, slope_rad):
    """Reflectance factor of Lambertian V-grooves relative to Lambert's law. [1]

    Parameters
    ----------
    cos_view, cos_light
        Cosines of the angles to the mean normal. [1]
    cos_azimuth
        Cosine of the azimuth between both. [1]
    slope_rad
        Standard deviation of the grooves' slope angle; 0 is Lambert's law. [rad]

    References
    ----------
    Oren and Nayar, "Generalization of Lambert's Reflectance Model", SIGGRAPH 1994, the qualitative model.
    """
    s2 = slope_rad * slope_rad
    sin_view = math.sqrt(max(1.0 - cos_view * cos_view, 0.0))
    sin_light = math.sqrt(max(1.0 - cos_light * cos_light, 0.0))
    across = sin_view * sin_light / max(cos_view, cos_light, 1e-6)  # sin α tan β: β is the steeper one
    steep = 0.45 * s2 / (s2 + 0.09) * max(cos_azimuth, 0.0) * across
    return 1.0 - 0.5 * s2 / (s2 + 0.33) + steep
