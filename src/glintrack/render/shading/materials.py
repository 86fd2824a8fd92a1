"""Polarized reflection at a surface, and material tables for the pixel kernel.

Kernels for numba; all take scalars. A Mueller matrix of reflection has only four different elements in the
``pixels`` frame (0° perpendicular to the plane of incidence): m00 = m11 = ½(Rs+Rp), m01 = ½(Rs−Rp),
m22 = Re(rs rp*), and m23, which feeds V and is left out with it.

Facets have one of `DISTRIBUTIONS`: ``ggx``; ``gaussian`` slopes (Beckmann), both with Smith's
shadowing–masking; or ``priest_germer``, the Gaussian model of the polarimetric literature, which has none
(Priest and Germer, "Polarimetric BRDF in the microfacet model", Military Sensing Symposia, 2000;
their σ² is α²/2). The base under the facets depolarizes: Lambert, or Oren–Nayar.

Fresnel's matrix elements of a material, F(λ, θ), become Σ_j a_j(λ) g_j(θ) with one to six terms, so that
dispersion costs only a few more coefficients.

The base under an interface of weight w gets the light that the interface does not reflect, on the way in and
on the way out: f = ρ/π · T(θv) T(θl)/T̄ with T = 1 − w E, where E(θ) is the interface's directional albedo and
T̄ the mean of T over a uniform sky. This is reciprocal, and a white base under any interface returns all light
(Kelemen and Szirmay-Kalos, "A Microfacet Based Coupled Specular-Matte BRDF Model", Eurographics 2001).

Light of the base is unpolarized inside and refracted on its way out. In equilibrium nothing is polarized: a
white base and its interface in even, unpolarized light send unpolarized light. The base's light therefore
lacks the s-polarized light that the interface reflects, w D with D(θ) the directional albedo of ½(Rs − Rp)
about the mean normal, and has the degree w D/(1 − w E), p-polarized. For a smooth interface that is (Rs −
Rp)/(2 − Rs − Rp). A rough one is averaged over the same facets as its reflection. With w < 1 the rest of the
surface has no interface and adds unpolarized light. Below a metal there is no light.
"""

import math
from functools import lru_cache
from typing import NamedTuple

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.stokes import axis_turn

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
    m00, m01, m22 in the ``pixels`` frame, both p axes being (travel × s). m22 < 0 at normal incidence: a
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
    """Smith's G1: the visible part of the microfacets from a direction. [1]

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
    """D·G/(4 cos θv cos θl): reflection from the light to the view by facets of reflectance 1. [sr⁻¹]"""
    shadow = masking(distribution, cos_view, alpha) * masking(distribution, cos_light, alpha)
    if shadow == 0.0:
        return 0.0
    return facet_density(distribution, cos_half, alpha) * shadow / (4.0 * cos_view * cos_light)


@nb.njit(cache=True, forceinline=True)
def sample_facet(distribution, vx, vy, vz, alpha, x, y):
    """Draw a facet normal (local frame, z up), and the weight of its reflection toward the view.

    Parameters
    ----------
    distribution
        Index into `DISTRIBUTIONS`.
    vx, vy, vz
        View direction. [1]
    alpha
        Roughness. [1]
    x, y
        A point of the unit disc.

    Returns
    -------
    Normal x, y, z, and a weight. Its mean over the disc, times Fresnel's matrix, is the light reflected
    from a uniform unit hemisphere. GGX normals are drawn by visible area, the others by area.

    References
    ----------
    Heitz, "Sampling the GGX Distribution of Visible Normals", JCGT 7(4), 2018.
    """
    if distribution == GGX:
        wx, wy, wz = alpha * vx, alpha * vy, vz
        norm = 1.0 / math.sqrt(wx * wx + wy * wy + wz * wz)
        wx, wy, wz = wx * norm, wy * norm, wz * norm
        across = math.sqrt(wx * wx + wy * wy)
        t1x, t1y = (-wy / across, wx / across) if across > 1e-7 else (1.0, 0.0)
        s = 0.5 * (1.0 + wz)
        b = (1.0 - s) * math.sqrt(1.0 - x * x) + s * y
        c = math.sqrt(max(0.0, 1.0 - x * x - b * b))
        hx = alpha * (x * t1x - b * wz * t1y + c * wx)
        hy = alpha * (x * t1y + b * wz * t1x + c * wy)
        hz = max(1e-6, b * (wx * t1y - wy * t1x) + c * wz)
        norm = 1.0 / math.sqrt(hx * hx + hy * hy + hz * hz)
        hx, hy, hz, seen = hx * norm, hy * norm, hz * norm, 1.0
    else:
        u = x * x + y * y
        tangent = alpha * math.sqrt(-math.log(1.0 - u))
        hz = 1.0 / math.sqrt(1.0 + tangent * tangent)
        hx, hy = tangent * hz * x / math.sqrt(u), tangent * hz * y / math.sqrt(u)
        seen = masking(distribution, vz, alpha) / (vz * hz)
    cosine = vx * hx + vy * hy + vz * hz
    if cosine <= 0.0:
        return hx, hy, hz, 0.0
    if distribution != GGX:
        seen *= cosine
    return hx, hy, hz, seen * masking(distribution, 2.0 * cosine * hz - vz, alpha)


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


_INTERVALS = 256  # of every table over angle; linear interpolation is good to 1e-5
COSINES = np.linspace(0.0, 1.0, _INTERVALS + 1)
MIRROR_ROUGHNESS = 0.1  # GGX α below which a surface's lobe is narrow enough to follow with one ray
REFERENCE_UM = 0.65  # of the base's energy and of scalar indices
_TERMS = 6
_TERM_ERROR = 3e-4  # of reflectance, left out of a dispersive material
_OPAQUE = 0.02  # extinction index from which no light comes back from below the interface
_ALBEDO_COSINES = 33
_ALBEDO_SAMPLES = 512


class MaterialTables(NamedTuple):
    """Plain arrays for kernels; an optical class is a set of materials with the same interface.

    Parameters
    ----------
    optics
        Optical class of each material.
    weight, mottle, groove, polarized
        Specular weight, mottle [1], slope of Oren–Nayar's grooves [rad], and scale of the base's own
        polarization (`polarized_base`) [1] of each material.
    toward, variation
        Material toward whose base this one varies, −1 for none; and standard deviations of the reflectance
        between vehicles, of that material's share, and of the interface, and the least share. [1]
    leaf
        True for a material that transmits light.
    alpha, distribution, terms
        Roughness, facet model (index into `DISTRIBUTIONS`) and number of Fresnel terms of each class.
    fresnel
        m00, m01, m22 of each term over `COSINES`.
    dispersion, reference
        a_j(λ) of each class on the wavelengths, and at `REFERENCE_UM`.
    albedo
        Directional albedo E of each class over `COSINES`.
    at_angle
        Over the view's cosine: factor of ρ/π of the base under the sun, T/√T̄ (to be multiplied by the same of
        the light's cosine), and under the sky, T times the albedo of grooves; reflection of the interface,
        w E; and degree of p-polarization of the base's light.
    """

    optics: Int[Array, "material"]
    weight: Float[Array, "material"]
    mottle: Float[Array, "material"]
    groove: Float[Array, "material"]
    polarized: Float[Array, "material"]
    toward: Int[Array, "material"]
    variation: Float[Array, "material 4"]
    leaf: Bool[Array, "material"]
    alpha: Float[Array, "optics"]
    distribution: Int[Array, "optics"]
    terms: Int[Array, "optics"]
    fresnel: Float[Array, "optics term cosine 3"]
    dispersion: Float[Array, "optics term wavelength"]
    reference: Float[Array, "optics term"]
    albedo: Float[Array, "optics cosine"]
    at_angle: Float[Array, "material cosine 4"]


def unpack_surfaces(materials: xr.Dataset, wavelength_um: Float[Array, "wavelength"]) -> MaterialTables:
    """Convert a dataset of schema ``materials`` to tables for wavelengths inside its range.

    Optional variables: ``distribution`` (index into `materials.DISTRIBUTIONS`), ``groove_slope`` [rad],
    ``polarized_base``, ``toward`` and the three variations.
    """

    def column(name: str) -> Array:
        if name in materials:
            return materials[name].values.astype(float)
        return np.zeros(materials.sizes["material"])

    def over_wavelength(name: str) -> Array:
        """Index of each material on the grid."""
        if f"{name}_spectrum" not in materials:
            return np.repeat(column(name)[:, None], len(wavelength_um), axis=1)
        table = materials["wavelength"].values.astype(float)
        rows = materials[f"{name}_spectrum"].values.astype(float)
        return np.stack([np.interp(wavelength_um, table, row) for row in rows])

    index, extinction = over_wavelength("refractive_index"), over_wavelength("extinction_index")
    facets = column("roughness"), column("distribution").astype(int)
    weight, groove = column("specular_weight"), column("groove_slope")
    keys = [
        (n.tobytes(), k.tobytes(), float(a), int(s))
        for n, k, a, s in zip(index, extinction, *facets, strict=True)
    ]
    classes = list(dict.fromkeys(keys))
    optics = np.array([classes.index(key) for key in keys])
    reference = int(np.argmin(np.abs(wavelength_um - REFERENCE_UM)))
    parts = [_fresnel_terms(n, k) for n, k, _, _ in classes]
    indices = [(np.frombuffer(n)[reference], np.frombuffer(k)[reference]) for n, k, _, _ in classes]
    albedo, polarized = np.stack([
        _albedo(*index, a, s) for index, (_, _, a, s) in zip(indices, classes, strict=True)
    ], axis=1)  # fmt: skip
    passed = 1.0 - weight[:, None] * albedo[optics]
    clear = np.array([k < _OPAQUE for _, k in indices])
    polarized = weight[:, None] * (clear[:, None] * polarized)[optics]
    leaving = np.divide(polarized, passed, out=np.zeros_like(passed), where=passed > 0)
    leaving[:, 0] = leaving[:, 1]  # at grazing no light leaves
    mean = 2 * np.trapezoid(COSINES * passed, COSINES, axis=1)
    grooved = np.stack([_groove_albedo(float(g)) for g in groove])
    leaf = materials["transmittance"].values.max(axis=1) > 0 if "transmittance" in materials else optics < 0
    names, spreads = list(materials["material"].values), ("vehicle", "colour", "gloss")
    variation = np.stack([column(f"{name}_variation") for name in spreads], axis=1)
    others = materials["toward"].values if "toward" in materials else np.full(len(names), "")
    toward = np.array([names.index(other) if other else k for k, other in enumerate(others)])
    rho = materials["reflectance"].values
    step = rho[toward] - rho
    room = np.where(step > 0, rho, 1 - rho)  # until the base has no reflectance, or all
    least = -np.divide(room, abs(step), out=np.ones_like(rho), where=abs(step) > room).min(axis=1)
    return MaterialTables(
        optics=optics.astype(np.int64),
        weight=weight,
        mottle=column("mottle"),
        groove=groove,
        polarized=column("polarized_base"),
        toward=np.where(variation.any(axis=1), toward, -1),
        variation=np.column_stack([variation, least]).astype(np.float32),
        leaf=leaf,
        alpha=np.array([a for _, _, a, _ in classes]),
        distribution=np.array([s for *_, s in classes]),
        terms=np.array([t for t, _, _ in parts]),
        fresnel=np.stack([g for _, g, _ in parts]).astype(np.float32),
        dispersion=np.stack([a for _, _, a in parts]),
        reference=np.stack([a[:, reference] for _, _, a in parts]),
        albedo=np.ascontiguousarray(albedo, np.float32),  # of one layout, or the kernels compile twice
        at_angle=np.stack(
            [passed / np.sqrt(mean)[:, None], passed * grooved, 1 - passed, np.clip(leaving, 0, 1)], -1
        ).astype(np.float32),
    )


@nb.njit(cache=True, forceinline=True)
def between_cosines(cosine):
    """Node of `COSINES` before a cosine, and the part toward the next."""
    x = min(max(cosine, 0.0), 1.0) * _INTERVALS
    node = min(int(x), _INTERVALS - 1)
    return node, x - node


@nb.njit(cache=True)
def over_cosine(tables, row, cosine):
    """Interpolate linearly in one row of tables over `COSINES`."""
    node, part = between_cosines(cosine)
    return tables[row, node] + part * (tables[row, node + 1] - tables[row, node])


@lru_cache(maxsize=256)
def _fresnel_terms(index: bytes, extinction: bytes) -> tuple[int, Array, Array]:
    """Separate Fresnel's elements: number of terms, g (term, cosine, 3) and a (term, wavelength)."""
    n, k = np.frombuffer(index).copy(), np.frombuffer(extinction).copy()  # writeable, as those of `_albedo`
    shapes, shares = np.zeros((_TERMS, len(COSINES), 3)), np.zeros((_TERMS, len(n)))
    if np.ptp(n) == 0 and np.ptp(k) == 0:
        shapes[0], shares[0] = _fresnel_over_cosine(n[:1], k[:1])[0], 1.0
        return 1, shapes, shares
    exact = _fresnel_over_cosine(n, k).reshape(len(n), -1)
    left, strength, right = np.linalg.svd(exact, full_matrices=False)
    left = left * strength
    for count in range(1, _TERMS + 1):
        if np.abs(left[:, :count] @ right[:count] - exact).max() < _TERM_ERROR or count == len(strength):
            break
    shapes[:count], shares[:count] = right[:count].reshape(count, -1, 3), left[:, :count].T
    return count, shapes, shares


@nb.njit(cache=True)
def _fresnel_over_cosine(n, k):
    out = np.empty((len(n), 257, 3))
    for b in range(len(n)):
        for i in range(257):
            out[b, i, 0], out[b, i, 1], out[b, i, 2] = fresnel(i / 256, n[b], k[b])
    return out


def sample_disc(count: int) -> Float[Array, "sample 2"]:
    """Evenly spread points of the unit disc: Hammersley's of the square, shifted to the cells' centres."""
    i = np.arange(count)
    bits = max(int(np.ceil(np.log2(count))), 1)
    reverse = sum(((i >> b) & 1) / 2.0 ** (b + 1) for b in range(bits))
    turn = 2 * np.pi * (reverse + 0.5 / 2**bits)
    return np.sqrt((i + 0.5) / count)[:, None] * np.stack([np.cos(turn), np.sin(turn)], axis=1)


@lru_cache(maxsize=256)
def _albedo(n: float, k: float, alpha: float, distribution: int) -> Float[Array, "2 cosine"]:
    """I and Q (> 0: s) of an even, unpolarized sky after reflection, by the cosine of direction. [1]"""
    if alpha < MIRROR_ROUGHNESS and distribution == GGX:
        return _fresnel_over_cosine(np.array([n]), np.array([k]))[0, :, :2].T
    coarse = np.empty((_ALBEDO_COSINES, 2))
    # denser nodes toward grazing, with the largest curvature
    at = np.linspace(0, 1, _ALBEDO_COSINES) ** 2
    over_rows(_sample_albedo, len(at), at, n, k, alpha, distribution, sample_disc(_ALBEDO_SAMPLES), coarse)
    return np.minimum([np.interp(COSINES, at, column) for column in coarse.T], 1.0)


@nb.njit(nogil=True, cache=True)
def _sample_albedo(start, stop, cosines, n, k, alpha, distribution, samples, out):
    for i in range(start, stop):
        c = max(cosines[i], 1e-3)
        across = math.sqrt(1.0 - c * c)
        total, polarized = 0.0, 0.0
        for j in range(samples.shape[0]):
            hx, hy, hz, weight = sample_facet(
                distribution, across, 0.0, c, alpha, samples[j, 0], samples[j, 1]
            )
            if weight > 0.0:
                m00, m01, _ = fresnel(across * hx + c * hz, n, k)
                # from the facet's s axis, view × facet, to that of the mean plane, which is y
                turn, _ = axis_turn(-c * hy, c * hx - across * hz, across * hy, 0.0, 1.0, 0.0, across, 0.0, c)
                total += weight * m00
                polarized += weight * m01 * turn
        out[i, 0], out[i, 1] = total / samples.shape[0], polarized / samples.shape[0]


@lru_cache(maxsize=256)
def _groove_albedo(slope_rad: float) -> Float[Array, "cosine"]:
    """Mean of Oren–Nayar's factor over a uniform sky, by the view's cosine. [1]"""
    if slope_rad == 0:
        return np.ones(len(COSINES))
    light, weight = np.polynomial.legendre.leggauss(24)
    turns = (np.arange(24) + 0.5) * np.pi / 24
    views, lights = np.linspace(0, 1, 33), list(zip((light + 1) / 2, weight / 2, strict=True))
    out = [
        2 * sum(w * c * oren_nayar(view, c, np.cos(t), slope_rad) for c, w in lights for t in turns) / 24
        for view in views
    ]
    return np.interp(COSINES, views, out)
