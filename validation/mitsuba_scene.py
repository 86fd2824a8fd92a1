"""Build a city in Mitsuba 3: the same triangles and leaf cards, our sky and sun as emitters.

A surface is Mitsuba's own: ``diffuse``, or a part w of ``pplastic`` (GGX facets over a base;
``roughconductor`` for metals) beside a part 1 − w of ``diffuse``. A leaf is a thin Lambertian sheet,
for which Mitsuba has no polarized plugin, so `leaf_sheet` registers one; its interface is ``roughconductor``
with a real index.
"""

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr

from glintrack.render import Sky
from glintrack.render.rays.surfaces import is_hole
from glintrack.render.shading.materials import fresnel
from glintrack.scene import Mesh, Snapshot

HOLE_CELLS = 6  # along the edges of a leaf card, as in `glintrack.render.rays.surfaces`
METAL = 0.02  # extinction index from which nothing comes back from below an interface


def load_mitsuba():
    """Mitsuba with a polarized variant; RuntimeError with the reason where there is none."""
    try:
        import mitsuba as mi
    except ImportError as error:
        raise RuntimeError("mitsuba is not installed (the extra oracles brings it)") from error
    try:
        mi.set_variant("llvm_ad_mono_polarized")
        import drjit as dr

        dr.eval(dr.arange(mi.Float, 4) + 1)
    except Exception as error:  # Dr.Jit finds no LLVM
        raise RuntimeError(
            f"Mitsuba's llvm variant does not run ({error}; apt-get install libllvm19)"
        ) from error
    return mi, dr


@dataclass(frozen=True)
class Surface:
    """One material at one wavelength.

    Parameters
    ----------
    rho, tau
        Reflectance of the base, and what a leaf lets through. [1]
    n, k, alpha, weight
        Index, GGX α and specular weight of the interface. [1]
    """

    rho: float
    tau: float
    n: float
    k: float
    alpha: float
    weight: float


def surfaces_at(materials: xr.Dataset, wavelength_um: float) -> list[Surface]:
    """Every material at one wavelength."""
    at = materials.interp(wavelength=wavelength_um)
    names = (
        "reflectance", "transmittance", "refractive_index_spectrum", "extinction_index_spectrum", "roughness",
        "specular_weight",
    )  # fmt: skip
    return [Surface(*map(float, row)) for row in zip(*(at[name].values for name in names), strict=True)]


def leaf_sheet(mi, dr) -> None:
    """Register the BSDF ``leaf_sheet``: a thin sheet that scatters ρ back and τ through, both evenly."""

    class LeafSheet(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            self.rho, self.tau = float(props["rho"]), float(props["tau"])
            both = mi.BSDFFlags.FrontSide | mi.BSDFFlags.BackSide
            self.m_components = [
                mi.BSDFFlags.DiffuseReflection | both,
                mi.BSDFFlags.DiffuseTransmission | both,
            ]
            self.m_flags = self.m_components[0] | self.m_components[1]

        def sample(self, ctx, si, sample1, sample2, active=True):
            share = self.rho / max(self.rho + self.tau, 1e-9)
            back = sample1 < share
            wo = mi.warp.square_to_cosine_hemisphere(sample2)
            same = dr.select(mi.Frame3f.cos_theta(si.wi) > 0, mi.Float(1), mi.Float(-1))
            bs = dr.zeros(mi.BSDFSample3f)
            bs.pdf = mi.warp.square_to_cosine_hemisphere_pdf(wo) * dr.select(back, share, 1 - share)
            wo.z *= dr.select(back, same, -same)
            bs.wo, bs.eta = wo, mi.Float(1)
            bs.sampled_component = dr.select(back, mi.UInt32(0), mi.UInt32(1))
            bs.sampled_type = dr.select(
                back,
                mi.UInt32(+mi.BSDFFlags.DiffuseReflection),
                mi.UInt32(+mi.BSDFFlags.DiffuseTransmission),
            )
            weight = dr.zeros(mi.Spectrum)
            weight[0, 0] = dr.select(active, mi.Float(self.rho + self.tau), 0)
            return bs, weight

        def _value(self, si, wo):
            ci, co = mi.Frame3f.cos_theta(si.wi), mi.Frame3f.cos_theta(wo)
            part = dr.select(ci * co > 0, mi.Float(self.rho), mi.Float(self.tau))
            return part * dr.abs(co) / math.pi

        def eval(self, ctx, si, wo, active=True):
            out = dr.zeros(mi.Spectrum)
            out[0, 0] = dr.select(active, self._value(si, wo), 0)
            return out

        def pdf(self, ctx, si, wo, active=True):
            return dr.select(active, self._value(si, wo) / max(self.rho + self.tau, 1e-9), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def traverse(self, callback):
            pass

        def to_string(self):
            return f"LeafSheet[{self.rho}, {self.tau}]"

    mi.register_bsdf("leaf_sheet", LeafSheet)


def _uniform(value: float) -> dict:
    return {"type": "uniform", "value": value}


def _mean_transmittance(s: Surface) -> float:
    """Mean transmittance of the interface for uniform light, T̄. [1]"""
    cosine = np.linspace(0, 1, 1001)
    return float(2 * np.trapezoid(cosine * [1 - fresnel(c, s.n, s.k)[0] for c in cosine], cosine))


def bsdf(s: Surface) -> dict:
    """Make the Mitsuba surface with the energy and the polarization of ours."""
    passed = _mean_transmittance(s)
    index = {"eta": _uniform(s.n), "k": _uniform(s.k)}
    facets = {"type": "roughconductor", "distribution": "ggx", "alpha": s.alpha, **index}
    if s.tau > 0:
        rest = 1 - s.weight
        whole = 1 - s.weight * (1 - passed)
        # the interface is on both sides, the base has what it leaves
        sheet = {"type": "leaf_sheet", "rho": s.rho * whole / rest, "tau": s.tau / rest}
        return {
            "type": "blendbsdf",
            "weight": s.weight,
            "a": sheet,
            "b": {"type": "twosided", "bsdf": facets},
        }
    diffuse = {"type": "diffuse", "reflectance": _uniform(s.rho)}
    if s.weight == 0:
        return {"type": "twosided", "bsdf": diffuse}
    if s.k > METAL:
        whole = 1 - s.weight * (1 - passed)
        diffuse = {"type": "diffuse", "reflectance": _uniform(min(s.rho * whole / (1 - s.weight), 1.0))}
        coat = facets
    else:
        coat = {
            "type": "pplastic", "distribution": "ggx", "alpha": s.alpha, "int_ior": s.n, "ext_ior": 1.0,
            "diffuse_reflectance": _uniform(s.rho / passed),
        }  # fmt: skip
    if s.weight >= 1:
        return {"type": "twosided", "bsdf": coat}
    mixed = {"type": "blendbsdf", "weight": s.weight, "a": diffuse, "b": coat}
    return {"type": "twosided", "bsdf": mixed}


def sky_emitter(mi, dr, sky: Sky, wavelength_um: float) -> None:
    """Register the emitter ``our_sky``: Stokes radiance of the sky at one wavelength, nothing below."""
    spectrum = np.array([np.interp(wavelength_um, sky.wavelength_um, row) for row in sky.sky_spectrum])
    disc = np.einsum("xyks,k->xys", sky.sky_map, spectrum)
    # a texture's first axis is the image's row: ours is (east, north)
    texture = mi.Texture2f(
        mi.TensorXf(np.ascontiguousarray(disc.transpose(1, 0, 2), dtype=np.float32)),
        wrap_mode=dr.WrapMode.Clamp,
    )
    cells = disc.shape[0]
    turns, heights = np.meshgrid((np.arange(256) + 0.5) / 256, (np.arange(64) + 0.5) / 64)
    across = np.sqrt(1 - heights**2)
    east, north = across * np.sin(2 * math.pi * turns), across * np.cos(2 * math.pi * turns)
    nodes = [np.rint((v / (1 + heights) + 1) * 0.5 * (cells - 1)).astype(int) for v in (east, north)]
    shape = np.maximum(disc[nodes[0], nodes[1], 0], 1e-6)
    chosen = mi.MarginalDiscrete2D0(mi.TensorXf(np.ascontiguousarray(shape, dtype=np.float32)))

    def radiance(look):
        scale = 1 / (1 + dr.abs(look.z))
        uv = [((c * scale + 1) * 0.5 * (cells - 1) + 0.5) / cells for c in (look.x, look.y)]
        intensity, q, u = texture.eval(mi.Point2f(*uv))
        above = look.z > 0
        g = look.y / (1 + dr.abs(look.z))
        carried = mi.Vector3f(-g * look.x, 1 - g * look.y, -g * (look.z + 1))  # `sky.north_axis`
        light = dr.zeros(mi.Spectrum)
        light[0, 0] = dr.select(above, intensity, 0)
        light[1, 0], light[2, 0] = dr.select(above, q, 0), dr.select(above, u, 0)
        travel = -look
        return mi.mueller.rotate_stokes_basis(travel, carried, mi.mueller.stokes_basis(travel)) @ light

    def density(look):
        turn = dr.atan2(look.x, look.y) / (2 * math.pi)
        uv = mi.Point2f(dr.select(turn < 0, turn + 1, turn), dr.clip(look.z, 0, 1))
        return dr.select(look.z > 0, chosen.eval(uv) / (2 * math.pi), 0)

    class OurSky(mi.Emitter):
        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.m_flags = mi.EmitterFlags.Infinite

        def set_scene(self, scene):
            pass

        def eval(self, si, active=True):
            return radiance(-si.wi)

        def sample_direction(self, it, sample, active=True):
            uv, pdf = chosen.sample(sample)
            flat = dr.sqrt(dr.maximum(1 - uv.y * uv.y, 0))
            sine, cosine = dr.sincos(2 * math.pi * uv.x)
            d = mi.Vector3f(flat * sine, flat * cosine, uv.y)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p, ds.n, ds.d, ds.dist = it.p + d * 2e4, -d, d, mi.Float(2e4)
            ds.pdf, ds.delta, ds.emitter = pdf / (2 * math.pi), mi.Bool(False), mi.EmitterPtr(self)
            return ds, radiance(d) / dr.maximum(ds.pdf, 1e-9)

        def pdf_direction(self, it, ds, active=True):
            return density(ds.d)

        def eval_direction(self, it, ds, active=True):
            return radiance(ds.d)

        def traverse(self, callback):
            pass

        def is_environment(self):
            return True

    mi.register_emitter("our_sky", OurSky)


def build(mi, snapshot: Snapshot, materials: xr.Dataset, sky: Sky, wavelength_um: float) -> tuple:
    """Make the scene at one wavelength, lit by the sun alone and by the sky alone: light adds up."""
    reflected = {f"m{i}": bsdf(s) for i, s in enumerate(surfaces_at(materials, wavelength_um))}
    surfaces = {name: mi.load_dict(one) for name, one in reflected.items()}
    sun = np.interp(wavelength_um, sky.wavelength_um, sky.sun_irradiance)
    toward = [-float(x) for x in sky.sun_direction]
    by_sun = {"sun": {"type": "directional", "direction": toward, "irradiance": _uniform(float(sun))}}
    scene: dict = {"type": "scene"}
    gap = materials["gap_fraction"].values.astype(np.float32)
    together = [(snapshot.static.vertices, snapshot.static.faces, snapshot.static.material)]
    for k, model in enumerate(snapshot.models):
        places = np.flatnonzero(np.asarray(snapshot.model) == k)
        paints = snapshot.paint[places]
        gaps = gap[np.where(model.material < 0, 0, model.material)]
        # as the tracer has it: a model's instances share the holes of painted faces
        still = paints[places < snapshot.fixed]
        gaps[model.material < 0] = gap[still].mean() if len(still) else 0.0
        vertices, faces, material = _with_holes(model, gaps)
        for i in places:
            turned = vertices @ snapshot.transforms[i, :, :3].T + snapshot.transforms[i, :, 3]
            together.append(
                (turned.astype(np.float32), faces, np.where(material < 0, snapshot.paint[i], material))
            )
    starts = np.cumsum([0, *(len(v) for v, _, _ in together[:-1])])
    vertices = np.concatenate([v for v, _, _ in together])
    faces = np.concatenate([f + s for (_, f, _), s in zip(together, starts, strict=True)])
    city = Mesh(vertices, faces, np.concatenate([m for *_, m in together]))
    add_meshes(mi, scene, "part", city, lambda m: surfaces[f"m{m}"])
    return mi.load_dict(scene | by_sun), mi.load_dict(scene | {"sky": {"type": "our_sky"}})


def add_meshes(mi, scene: dict, prefix: str, mesh: Mesh, surface) -> dict:
    """Add the faces of each material to a scene, with ``surface(material)`` of Mitsuba, and return it."""
    for m in np.unique(mesh.material):
        used, faces = np.unique(mesh.faces[mesh.material == m], return_inverse=True)
        props = mi.Properties()
        props["bsdf"] = surface(int(m))
        shape = mi.Mesh("part", len(used), faces.size // 3, props=props)
        values = mi.traverse(shape)
        values["vertex_positions"] = np.ravel(mesh.vertices[used]).astype(np.float32)
        values["faces"] = np.ravel(faces).astype(np.uint32)
        values.update()
        scene[f"{prefix}{m}".replace("-", "n")] = shape
    return scene


def stokes_on_axis(mi, dr, light, directions, axis) -> np.ndarray:
    """Stokes (3, ray) of a Mueller matrix of Mitsuba, about the detector's axis."""
    right = mi.Vector3f(*(float(x) for x in axis))
    target = dr.normalize(right - dr.dot(right, directions) * directions)
    basis = mi.mueller.stokes_basis(-directions)
    turned = mi.mueller.rotate_stokes_basis(-directions, basis, target) @ light
    return np.stack([np.array(turned[s, 0]) for s in range(3)])


def _with_holes(model: Mesh, gaps) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Make a tree's vertices, faces and materials; its cards are the strips between their holes."""
    order = np.argsort(gaps > 0, kind="stable")  # as the tracer numbers them
    corners, faces, material, gaps = model.vertices, model.faces[order], model.material[order], gaps[order]
    vertices, kept, kinds = [corners], [faces[gaps == 0]], [material[gaps == 0]]
    count, step = len(corners), 1 / HOLE_CELLS
    for f in np.flatnonzero(gaps > 0):
        a, b, c = corners[faces[f]].astype(float)
        for i in range(HOLE_CELLS):
            u, last = i * step, HOLE_CELLS - i
            shut = [not is_hole(f, (i + 0.3) * step, (j + 0.3) * step, gaps[f]) for j in range(last)]
            edges = np.flatnonzero(np.diff(np.array([False, *shut, False]).astype(int)))
            for low, high in edges.reshape(-1, 2):
                far = high - (high == last)  # the last cell of a row is a triangle
                strip = [(u, low), (u, high), (u + step, far), (u + step, low)]
                vertices.append(np.array([a + p * (b - a) + q * step * (c - a) for p, q in strip]))
                kept.append(np.array([(0, 1, 2), (0, 2, 3)] if far > low else [(0, 1, 2)]) + count)
                kinds.append(np.full(len(kept[-1]), material[f]))
                count += 4
    return np.concatenate(vertices), np.concatenate(kept), np.concatenate(kinds)


def trace_paths(mi, dr, scene, origins, directions, axis, samples: int, depth: int, part: int = 16) -> tuple:
    """Stokes (ray, 3) in the axis given, and the standard error of its I."""
    integrator = mi.load_dict({"type": "path", "max_depth": depth + 1, "rr_depth": depth + 1})
    count, parts = len(directions), max(samples // part, 2)
    total, squares = np.zeros((count, 3)), np.zeros(count)
    for start in range(parts):
        sampler = mi.load_dict({"type": "independent", "sample_count": part})
        sampler.seed(start + 1, count * part)
        d, o = (np.repeat(v, part, axis=0).T.astype(np.float32) for v in (directions, origins))
        d, o = mi.Vector3f(*d), mi.Point3f(*o)
        light, *_ = integrator.sample(scene, sampler, mi.RayDifferential3f(o, d, mi.Float(0), mi.Color0f()))
        mean = stokes_on_axis(mi, dr, light, d, axis).reshape(3, count, part).mean(axis=2).T
        total += mean
        squares += mean[:, 0] ** 2
    mean = total / parts
    return mean, np.sqrt(np.maximum(squares / parts - mean[:, 0] ** 2, 0) / (parts - 1))


def first_met(mi, scene, origins, directions) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] and normal of the faces that rays meet."""
    ray = mi.Ray3f(mi.Point3f(*origins.T.astype(np.float32)), mi.Vector3f(*directions.T.astype(np.float32)))
    met = scene.ray_intersect(ray)
    normal = np.array(met.sh_frame.n)
    return np.array(met.t), normal.T if normal.shape[0] == 3 else normal
