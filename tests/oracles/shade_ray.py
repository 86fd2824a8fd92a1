"""One ray shaded in plain NumPy, the reference of the kernels (docs/theory/rendering.md).

    L(λ) = τ(λ) [base + leaf + interface] + P(λ)

What the ray meets is given (`Hits`). Every integral is a quadrature, and no table is read but the sky's. Of
interfaces only smooth ones; mottle and the grooves of Oren and Nayar are left out.
"""

from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.render.light.gather import ENCLOSED, MET_AGAIN, SECOND, material_classes
from glintrack.render.light.lattice import OPEN, SPACE, node_of_normal
from glintrack.render.light.probes import BOUNCE_UNIT
from glintrack.render.light.sky import Sky
from glintrack.render.shading.diffuse import MIN_PROBE_WEIGHT
from glintrack.render.shading.hits import Hits
from glintrack.stokes import frame_angle, rotate

SUN_HALF_VECTOR_RADIUS = 0.5 * 4.65e-3  # of the sun's disc, as the half vector sees it [rad]
MIRROR_ROUGHNESS = 0.1  # a smoother surface mirrors along one ray
OPAQUE = 0.02  # extinction index from which no light comes back from below an interface
REFERENCE_UM = 0.65  # where energy left to the base is reckoned
ZENITH = np.array([0.0, 0.0, 1.0])


class Surface(NamedTuple):
    """One material: reflectance and transmittance, complex index over wavelength, GGX α, specular weight."""

    reflectance: Float[Array, "wavelength"]
    transmittance: Float[Array, "wavelength"]
    index: Array
    reference_index: complex
    alpha: float
    weight: float


def shade_ray(hits: Hits, ray: int, sky: Sky, materials: xr.Dataset) -> Float[Array, "wavelength 3"]:
    """Stokes radiance that one ray brings, in the ``detector`` frame. [W m⁻² sr⁻¹ µm⁻¹]"""
    look, axis = hits.direction[ray].astype(float), hits.detector_axis
    if hits.material[ray] < 0:
        return from_map(sky.sky_spectrum, sky.sky_map, look, axis)
    surface = surface_of(materials, int(hits.material[ray]), sky)
    normal = hits.normal[ray].astype(float)
    around = surroundings(hits, sky, materials)  # M
    light = base(hits, ray, sky, materials, surface, around)[:, None] * leaving(surface, look, normal, axis)
    light = light + interface(hits, ray, sky, materials, surface, around)
    light = light + polarized_part(hits, ray, sky, materials, surface)
    return transmittance(sky, look)[:, None] * light + from_map(sky.path_spectrum, sky.path_map, look, axis)


def base(
    hits: Hits, ray: int, sky: Sky, materials: xr.Dataset, surface: Surface, around: Array
) -> Float[Array, "wavelength"]:
    """ρ/π [T(θv) T(θl)/T̄ E_sun cos θl + T(θv) E_around(n)] + T_leaf/π [E_sun |cos θl| + E_around(−n)]."""
    look, normal = hits.direction[ray].astype(float), hits.normal[ray].astype(float)
    view, sunward = -look @ normal, sky.sun_direction @ normal
    sun = sky.sun_irradiance * abs(sunward) * hits.sun_visible[ray]
    passed = 1 - surface.weight * albedo(surface, np.array([view, max(sunward, 0.0)]))[0]
    nodes, weights = np.polynomial.legendre.leggauss(64)
    cosines = 0.5 * (nodes + 1)
    mean = weights @ (cosines * (1 - surface.weight * albedo(surface, cosines)[0]))  # T̄
    cell, part = int(hits.light_cell[ray]), hits.light_part[ray]
    if cell == OPEN:
        front = passed[0] * under_the_sky(sky, normal, float(hits.sky_view[ray]), around)
        back = under_the_sky(sky, -normal, 1.0, around)
    else:
        left = hits.sky_left[ray] / 255
        counts = here_and_off(hits, ray)
        front, back = (
            left * in_cell(hits, cell, part, sky, materials, counts, own, side, float(hits.sky_view[ray]))
            for side, own in ((False, None if surface.transmittance.any() else normal), (True, None))
        )
        if cell >= 0 and sunward > 0 and left == 1:
            hidden = hits.sky_here[ray] * (1 - hits.sun_visible[ray])
            front = front - hidden * hidden_with_the_sun(hits, cell, part, normal, sky)
        if hits.probe_bounced.shape[1] == 0:
            front = front + around * (1 - 0.5 * (1 + normal[2]) * hits.sky_view[ray])
            back = back + around * (1 - 0.5 * (1 - normal[2]))
        front = passed[0] * front
    if sunward > 0:
        front = front + passed[0] * passed[1] / mean * sun
    else:
        back = back + sun
    return (surface.reflectance * front + surface.transmittance * back) / np.pi


def in_cell(
    hits: Hits,
    code: int,
    part: Array,
    sky: Sky,
    materials: xr.Dataset,
    counts: tuple[float, float] = (1.0, 1.0),
    normal: Array | None = None,
    behind: bool = False,
    view: float = 1.0,
) -> Float[Array, "wavelength"]:
    """Irradiance at a cell's four probes, h Σ_b v_b G_b + g Σ_c b_c (S_c E_sun + …). [W m⁻² µm⁻¹]

    On a vehicle G_b is that of the facet's normal, and v_b counts by what each probe faces of the patch; from
    its sides light off surfaces counts (1 + (1 − V)(1 + 2 n_z))/((1 + n_z)(2 − V)) times, V its sky view.
    """
    space = code <= SPACE
    cell = SPACE - code if space else code
    rows = hits.probe_cells[cell ^ 7 if behind and space else cell]
    weights = shares_of(hits, rows, part)
    scale, (here, off), tilted = scale_of(sky), counts, counts[1]
    total = np.zeros(len(sky.wavelength_um))
    if space and normal is not None:
        faced_by = sky.irradiance_map @ sky.sky_spectrum.sum(axis=1)
        faced = weights[:, None] * faced_by[hits.probe_facing[rows]]
        seen = (faced * hits.probe_patches[rows] / 255.0).sum(axis=0)
        open_part = seen / np.maximum(faced.sum(axis=0), 1e-30)
        total += open_part @ (sky.irradiance_map[node_of_normal(*normal)] @ sky.sky_spectrum) * scale
        up = max(float(normal[2]), 0.0)
        here, tilted = 0.0, off * (1 + (1 - view) * (1 + 2 * up)) / ((1 + up) * (2 - view))
    for k, (row, weight) in enumerate(zip(rows, weights, strict=True)):
        by_patch = sky.irradiance_map[hits.probe_facing[row]] @ sky.sky_spectrum * scale
        total += here * weight * (hits.probe_patches[row] / 255.0 @ by_patch)
        if hits.probe_bounced.shape[1]:
            by_bounce = bounce_lights(hits, sky, materials)
            beside = weight * (off if k == 0 else tilted)
            total += beside * BOUNCE_UNIT * (hits.probe_bounced[row].astype(float) @ by_bounce)
    return total * (0.0 if behind and not space else 1.0)


def here_and_off(hits: Hits, ray: int) -> tuple[float, float]:
    """How much of the sky, and of what hides it, a place sees over what its probes see: h and g. [1]"""
    here = float(hits.sky_here[ray])
    seen = 0.5 * (1 + hits.normal[ray, 2]) * hits.sky_view[ray] / max(hits.sky_left[ray] / 255, 1e-3)
    return here, _off(here, seen)


def _off(here: float, seen: float) -> float:
    """How much of what hides the sky a place sees over what its probes see, by the parts of sky. [1]"""
    return float(np.clip((1 - seen) / max(1 - seen / max(here, 1e-3), 1e-3), 0.5, 2))


def shares_of(hits: Hits, rows: Array, part: Array) -> Float[Array, "4"]:
    """Weights of a cell's four probes, without those where no light comes."""
    x, y = part / 255.0
    weights = np.maximum(np.array([(1 - x) * (1 - y), x * (1 - y), (1 - x) * y, x * y]), MIN_PROBE_WEIGHT)
    weights = weights * (hits.probe_view[rows] >= 0)
    weights = weights if weights.any() else np.ones(4)
    return weights / weights.sum()


def scale_of(sky: Sky) -> Float[Array, "wavelength"]:
    """What makes the sky's maps give level ground the tables' irradiance."""
    level = sky.irradiance_map[len(sky.irradiance_map) // 2].sum(axis=0) @ sky.sky_spectrum
    return np.divide(sky.sky_irradiance, level, out=np.ones_like(level), where=level > 0)


def hidden_with_the_sun(hits: Hits, cell: int, part: Array, normal: Array, sky: Sky) -> Array:
    """0.85 v² of the cap about the sun and 0.55 v³ of the ring about that, v what probes see of the cap."""
    rows = hits.probe_cells[cell]
    cap = shares_of(hits, rows, part) @ (hits.probe_patches[rows, 0] / 255.0)
    by_patch = sky.irradiance_map[node_of_normal(*normal)] @ sky.sky_spectrum * scale_of(sky)
    return 0.85 * cap**2 * by_patch[0] + 0.55 * cap**3 * by_patch[1:5].sum(axis=0)


def bounce_lights(hits: Hits, sky: Sky, materials: xr.Dataset) -> Float[Array, "bounce wavelength"]:
    """b_c E for E_s and E_d, what went over two surfaces, and more between leaves (see `bounce`)."""
    kinds = material_classes(materials)
    level = sky.irradiance_map[len(sky.irradiance_map) // 2] @ sky.sky_spectrum * scale_of(sky)
    with_sun = 0.85 * level[0] + 0.55 * level[1:5].sum(axis=0)
    sun, by_sky = sky.sun_irradiance + with_sun / sky.sun_direction[2], sky.sky_irradiance - with_sun
    every = [surface_of(materials, m, sky) for m in range(materials.sizes["material"])]
    sent_on = np.mean(
        [every[m].reflectance + every[m].transmittance for m in hits.material if m >= 0], axis=0
    )
    on = 1 / (1 - ENCLOSED * np.clip(sent_on, 0, 1))
    spectra = [np.interp(sky.wavelength_um, kinds.wavelength_um, row) for row in kinds.spectra]
    leaf = np.interp(sky.wavelength_um, kinds.wavelength_um, kinds.leaf)
    among = 0.5 * leaf**2 * (1 / (1 - MET_AGAIN * leaf) - on)
    among_by_sky = leaf * MET_AGAIN * (leaf / (1 - MET_AGAIN * leaf) - sent_on * on)
    once = [b * light for light in (sun, by_sky, sent_on * on * by_sky) for b in spectra]
    twice = [b * other * on * sun for b in spectra for other in spectra[:SECOND]]
    return np.array([*once, *twice, among * sun, among_by_sky * by_sky])


def under_the_sky(sky: Sky, normal: Array, view_factor: float, around: Array) -> Float[Array, "wavelength"]:
    """Irradiance of a facet from the sky, seen in part, and from the surroundings. [W m⁻² µm⁻¹]"""
    below = 1 - 0.5 * (1 + normal[2]) * view_factor
    return view_factor * sky_irradiance(sky, normal) + below * around


def sky_irradiance(sky: Sky, normal: Array) -> Float[Array, "wavelength"]:
    """E_sky of a facet in the open: ∫ I cos θ dω, scaled so that level ground gets the tables'."""
    directions, solid_angle = hemisphere()
    radiance = on_disc(sky.sky_map, directions)[..., 0] @ sky.sky_spectrum
    open_facet, level = ((solid_angle * np.maximum(directions @ n, 0)) @ radiance for n in (normal, ZENITH))
    return sky.sky_irradiance * np.divide(open_facet, level, out=np.zeros_like(level), where=level > 0)


def leaving(surface: Surface, look: Array, normal: Array, axis: Array) -> Float[Array, "3"]:
    """(1, Q, U) of light that leaves a base: p-polarized by w D/(1 − w E)."""
    even, polarized = albedo(surface, np.array([-look @ normal]))
    clear = surface.reference_index.imag < OPAQUE
    degree = surface.weight * polarized[0] / (1 - surface.weight * even[0]) if clear else 0.0
    return turned(np.array([1.0, -degree, 0.0]), np.cross(look, normal), axis, -look)


def polarized_part(
    hits: Hits, ray: int, sky: Sky, materials: xr.Dataset, surface: Surface
) -> Float[Array, "wavelength 3"]:
    """C exp(−tan α) ½(Rs − Rp) / (4 (cos θs + cos θv)) of the sun's light, across their plane."""
    look, normal = hits.direction[ray].astype(float), hits.normal[ray].astype(float)
    view, sunward = -look @ normal, sky.sun_direction @ normal
    scale = float(materials["polarized_base"][hits.material[ray]]) if "polarized_base" in materials else 0.0
    half = (sky.sun_direction - look) / np.linalg.norm(sky.sun_direction - look)
    cosine = -look @ half
    if scale == 0 or sunward <= 0 or cosine > 1 - 1e-9:
        return np.zeros((len(sky.wavelength_um), 3))
    refracted = np.sqrt(1 - (1 - cosine**2) / 1.5**2)
    rs = ((cosine - 1.5 * refracted) / (cosine + 1.5 * refracted)) ** 2
    rp = ((1.5 * cosine - refracted) / (1.5 * cosine + refracted)) ** 2
    tangent = np.sqrt(1 - cosine**2) / cosine
    index = np.array([surface.reference_index])
    mirrored = reflected(index, cosine, np.array([[1.0, 0.0, 0.0]]))[0, 1]
    whole = scale * np.exp(-tangent) * 0.5 * (rs - rp) / (4 * max(sunward + view, 0.5))
    part = max(whole - np.pi * glint_lobe(surface, half @ normal, view, sunward) * mirrored, 0.0)
    sun = sky.sun_irradiance * sunward * hits.sun_visible[ray] / np.pi
    across = turned(np.array([0.0, 1.0, 0.0]), np.cross(look, half), hits.detector_axis, -look)
    return np.outer(sun, part * across)


def interface(
    hits: Hits, ray: int, sky: Sky, materials: xr.Dataset, surface: Surface, around: Array
) -> Float[Array, "wavelength 3"]:
    """What a smooth interface mirrors along one ray, and the sun's glint off its facets."""
    look, normal, axis = hits.direction[ray].astype(float), hits.normal[ray].astype(float), hits.detector_axis
    view, sunward = -look @ normal, sky.sun_direction @ normal
    if surface.weight == 0:
        return np.zeros((len(sky.wavelength_um), 3))
    if surface.alpha >= MIRROR_ROUGHNESS:
        raise ValueError(
            f"`roughness` must be below {MIRROR_ROUGHNESS} for a ray to be mirrored; got {surface.alpha:g}"
        )
    mirrored, s_axis = look + 2 * view * normal, np.cross(look, normal)
    if hits.mirror_material[ray] >= 0:  # the base of what stands there
        there, seen = surface_of(materials, int(hits.mirror_material[ray]), sky), float(hits.mirror_sky[ray])
        cell, part = int(hits.mirror_cell[ray]), hits.mirror_part[ray]
        followed = cell != OPEN and hits.probe_bounced.shape[1] > 0
        here, left = float(hits.mirror_here[ray]), hits.mirror_left[ray] / 255
        if cell == OPEN:
            by_sky = sky.sky_irradiance * seen
        else:
            by_sky = left * in_cell(hits, cell, part, sky, materials, (here, _off(here, seen)))
        lit = sky.sun_irradiance * hits.mirror_sun[ray] + by_sky + (0 if followed else around * (1 - seen))
        shown = np.outer(there.reflectance * lit / np.pi, [1.0, 0.0, 0.0])
    elif mirrored[2] > 0:
        shown = from_map(sky.sky_spectrum, sky.sky_map, mirrored, s_axis)
    else:
        shown = np.outer(around / np.pi, [1.0, 0.0, 0.0])
    light = surface.weight * turned(reflected(surface.index, view, shown), s_axis, axis, -look)
    if sunward <= 0 or hits.sun_visible[ray] == 0:
        return light
    half = sky.sun_direction - look
    half /= np.linalg.norm(half)
    beam = np.outer(sky.sun_irradiance * sunward * hits.sun_visible[ray], [1.0, 0.0, 0.0])
    lobe = glint_lobe(surface, half @ normal, view, sunward)
    return light + lobe * turned(
        reflected(surface.index, -look @ half, beam), np.cross(look, half), axis, -look
    )


def glint_lobe(surface: Surface, facing: float, view: float, sunward: float) -> float:
    """w D G / (4 cos θv cos θl) of an interface's facets, no narrower than the sun."""
    wide = np.hypot(surface.alpha, SUN_HALF_VECTOR_RADIUS)
    lobe = ggx(facing, wide) * smith(view, wide) * smith(sunward, wide) / (4 * view * sunward)
    return surface.weight * lobe


def surroundings(hits: Hits, sky: Sky, materials: xr.Dataset) -> Float[Array, "wavelength"]:
    """M: mean over the hits of ρ (E_sun cos θ · visible + E_sky · part of the hemisphere that is sky)."""
    hit = hits.material >= 0
    every = [surface_of(materials, m, sky).reflectance for m in range(materials.sizes["material"])]
    sun = np.maximum(hits.normal[hit] @ sky.sun_direction, 0) * hits.sun_visible[hit]
    above = 0.5 * (1 + hits.normal[hit][:, 2]) * hits.sky_view[hit]
    lit = np.outer(sun, sky.sun_irradiance) + np.outer(above, sky.sky_irradiance)
    return (np.array(every)[hits.material[hit]] * lit).mean(axis=0)


def fresnel(index: Array, cosine: Array) -> tuple[Array, Array]:
    """Amplitudes rs and rp of light from air, p axes being travel × s (Born and Wolf, §1.5.2)."""
    inner = np.sqrt(index**2 - 1 + cosine**2 + 0j)
    square = index**2
    return (cosine - inner) / (cosine + inner), (square * cosine - inner) / (square * cosine + inner)


def reflected(index: Array, cosine: float, light: Float[Array, "wavelength 3"]) -> Array:
    """Mueller's matrix of a mirror on light in the ``incidence`` frame."""
    rs, rp = fresnel(index, np.asarray(cosine))
    even, odd = 0.5 * (abs(rs) ** 2 + abs(rp) ** 2), 0.5 * (abs(rs) ** 2 - abs(rp) ** 2)
    i, q, u = light.T
    return np.stack([even * i + odd * q, odd * i + even * q, np.real(rs * np.conj(rp)) * u], axis=-1)


def albedo(surface: Surface, cosines: Array) -> tuple[Array, Array]:
    """E(θ) and D(θ) of a smooth interface: ½(Rs + Rp) and ½(Rs − Rp)."""
    rs, rp = fresnel(np.asarray(surface.reference_index), cosines)
    return 0.5 * (abs(rs) ** 2 + abs(rp) ** 2), 0.5 * (abs(rs) ** 2 - abs(rp) ** 2)


def ggx(cosine: float, alpha: float) -> float:
    """Density of facet normals (Walter et al. 2007, Eq. 33). [sr⁻¹]"""
    return alpha**2 / (np.pi * (cosine**2 * (alpha**2 - 1) + 1) ** 2)


def smith(cosine: float, alpha: float) -> float:
    """Smith's masking of GGX facets (Walter et al. 2007, Eq. 34). [1]"""
    return 2 / (1 + np.sqrt(1 + alpha**2 * (1 / cosine**2 - 1)))


def transmittance(sky: Sky, look: Array) -> Float[Array, "wavelength"]:
    """τ along a ray to the ground: its logarithm runs with the airmass."""
    airmass = 1 / np.cos(sky.view_zenith_rad)
    return np.exp([np.interp(-1 / look[2], airmass, row) for row in np.log(sky.transmittance)])


def from_map(spectrum: Array, disc: Array, direction: Array, axis: Array) -> Float[Array, "wavelength 3"]:
    """Light from a direction of an angular map, Σ spectrum × map, about another axis."""
    x, y, z = direction
    side = 1.0 if z >= 0 else -1.0  # north carried from the zenith (or the nadir) along a great circle
    north = np.array([-x * y, 1 + side * z - y * y, -y * (z + side)]) / (1 + side * z)
    return turned(spectrum.T @ on_disc(disc, direction), north, axis, -direction)


def on_disc(disc: Array, direction: Float[Array, "... 3"]) -> Float[Array, "... component 3"]:
    """Bilinear value of a stereographic map; beyond the horizon the horizon's."""
    last = len(disc) - 1
    place = (direction[..., :2] / (1 + abs(direction[..., 2:])) + 1) * 0.5 * last
    place = np.clip(place, 0, last - 1e-6)
    i, j = np.moveaxis(place.astype(int), -1, 0)
    a, b = np.moveaxis(place % 1, -1, 0)[..., None, None]
    low = (1 - b) * disc[i, j] + b * disc[i, j + 1]
    return (1 - a) * low + a * ((1 - b) * disc[i + 1, j] + b * disc[i + 1, j + 1])


def turned(light: Array, axis_from: Array, axis_to: Array, travel: Array) -> Array:
    """Stokes vectors about another axis; at normal incidence any axis will do."""
    if np.linalg.norm(axis_from) < 1e-6:
        return light
    return rotate(light, frame_angle(axis_from, axis_to, travel))


def hemisphere() -> tuple[Float[Array, "direction 3"], Float[Array, "direction"]]:
    """Directions over the sky and their solid angles. [1, sr]"""
    nodes, weights = np.polynomial.legendre.leggauss(24)
    up, azimuth = np.meshgrid(0.5 * (nodes + 1), (np.arange(48) + 0.5) * np.pi / 24, indexing="ij")
    across = np.sqrt(1 - up * up)
    directions = np.stack([across * np.sin(azimuth), across * np.cos(azimuth), up], axis=-1)
    return directions.reshape(-1, 3), np.repeat(0.5 * weights * np.pi / 24, 48)


def surface_of(materials: xr.Dataset, m: int, sky: Sky) -> Surface:
    """A material on the sky's wavelengths."""
    row, table = materials.isel(material=m), materials["wavelength"].values

    def over(name: str) -> Array:
        return np.interp(sky.wavelength_um, table, row[name].values)

    index = over("refractive_index_spectrum") + 1j * over("extinction_index_spectrum")
    reference = complex(index[np.argmin(np.abs(sky.wavelength_um - REFERENCE_UM))])
    alpha, weight = float(row["roughness"]), float(row["specular_weight"])
    return Surface(over("reflectance"), over("transmittance"), index, reference, alpha, weight)
