"""Polarized reflection at a surface: Fresnel's equations as Mueller matrices, and GGX microfacets.

Kernels for numba; all take scalars. A Mueller matrix of reflection has only four different elements in the
``incidence`` frame (0° perpendicular to the plane of incidence): m00 = m11 = ½(Rs+Rp), m01 = ½(Rs−Rp),
m22 = Re(rs rp*), and m23, which feeds V and is left out with it.
"""

import math

import numba as nb


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
def ggx_density(cos_half, alpha):
    """GGX density of microfacet normals. [sr⁻¹]

    References
    ----------
    Walter et al., "Microfacet Models for Refraction through Rough Surfaces", EGSR 2007, Eq. (33).
    """
    a2 = alpha * alpha
    d = cos_half * cos_half * (a2 - 1.0) + 1.0
    return a2 / (math.pi * d * d)


@nb.njit(cache=True)
def smith_masking(cosine, alpha):
    """Smith's G1 for GGX: the part of the microfacets that a direction sees. [1]

    References
    ----------
    Walter et al. (2007), Eq. (34).
    """
    if cosine <= 0.0:
        return 0.0
    tan2 = (1.0 - cosine * cosine) / (cosine * cosine)
    return 2.0 / (1.0 + math.sqrt(1.0 + alpha * alpha * max(tan2, 0.0)))


@nb.njit(cache=True)
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
