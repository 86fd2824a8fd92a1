"""Compare the renderer with Mitsuba 3, ray by ray, on balls, a gabled house and a car.

    python validation/mitsuba.py [docs/gallery/mitsuba.png]

Needs the extra ``dev`` (mitsuba) and LLVM 19 (Debian's libllvm19). Both renderers get the same triangles,
the same rays, a directional sun and a sky of even radiance with Rayleigh's polarization; the ground is
black. Compared is what both model in the same way: one reflection, off surfaces that nothing else shades.
Interfaces are Mitsuba's ``conductor`` and ``roughconductor`` (GGX), with a real index where they stand
for glass and lacquer: such a surface reflects as a dielectric does and lets nothing in. A clear-coat over
a coloured base is Mitsuba's ``pplastic``, whose base light leaves polarized by refraction, as ours does.
"""

import argparse
import math
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import xarray as xr

sys.path.insert(0, str(Path(__file__).parents[1]))
from glintrack.camera import Camera, Pose, look_at, rays
from glintrack.render import shade, trace, unpack_sky
from glintrack.render.shading.materials import fresnel
from glintrack.scene import Mesh, Snapshot, load_materials
from glintrack.scene.materials import material_index
from glintrack.scene.vehicles import build_models
from validation.mitsuba_scene import add_meshes, load_mitsuba, stokes_on_axis

SUN_ZENITH, SUN_AZIMUTH = math.radians(40), math.radians(150)
SUN = np.array(
    [
        math.sin(SUN_ZENITH) * math.sin(SUN_AZIMUTH),
        math.sin(SUN_ZENITH) * math.cos(SUN_AZIMUTH),
        math.cos(SUN_ZENITH),
    ]
)
SUN_IRRADIANCE, SKY_RADIANCE, GREATEST_DOLP = 3.0, 0.3, 0.7
ABOVE_HORIZON = math.radians(2)  # of a mirrored ray: sky tables are not read across the horizon
LOBE_ABOVE_HORIZON = math.radians(30)  # of a rough lobe's middle: tables of lobes smear the horizon's edge
GLINT_FREE = math.radians(15)  # of the half vector: nearer, a smooth surface shows the sun's disc to us only
# reflectance of the base, n, k, GGX α, part with an interface
MATERIALS = {
    "ground": (0.0, 1.5, 0.0, 0.0, 0.0),
    "diffuse": (0.4, 1.5, 0.0, 0.0, 0.0),
    "glass": (0.0, 1.5, 0.0, 0.0, 1.0),
    "aluminium": (0.0, 1.44, 7.5, 0.0, 1.0),
    "rough_lacquer": (0.0, 1.5, 0.0, 0.25, 1.0),
    "rough_aluminium": (0.0, 1.44, 7.5, 0.25, 1.0),
    "coat_over_colour": (0.3, 1.5, 0.0, 0.12, 1.0),
}
NAMES = list(MATERIALS)
SIDE_PX = 450
VIEW = 3.0  # the frame over the object: what lights a surface from below is the mean of what is in view


@dataclass(frozen=True)
class Comparison:
    """Both pictures of one object, Stokes (y, x, 3) in the ``detector`` frame; NaN where not compared."""

    name: str
    ours: np.ndarray
    mitsuba: np.ndarray
    material: np.ndarray

    @property
    def intensity_error(self) -> np.ndarray:
        """Relative difference of I, for every pixel compared. [1]"""
        known = np.isfinite(self.ours[..., 0])
        return (self.ours[known][:, 0] - self.mitsuba[known][:, 0]) / self.mitsuba[known][:, 0]

    @property
    def polarization_error(self) -> np.ndarray:
        """Differences of Q and U over I, for every pixel compared. [1]"""
        known = np.isfinite(self.ours[..., 0])
        return (self.ours[known][:, 1:] - self.mitsuba[known][:, 1:]) / self.mitsuba[known][:, :1]


def ball(material: str, rings: int = 48) -> Mesh:
    """Make a sphere of 5 m, 6 m above the ground."""
    polar = np.linspace(0, math.pi, rings + 1)
    turn = np.arange(2 * rings) * math.pi / rings
    p, a = np.meshgrid(polar, turn, indexing="ij")
    vertices = 5 * np.stack([np.sin(p) * np.cos(a), np.sin(p) * np.sin(a), np.cos(p)], axis=-1)
    count, faces = 2 * rings, []
    for i in range(rings):
        for j in range(count):
            a0, a1 = i * count + j, i * count + (j + 1) % count
            faces += [(a0, a0 + count, a1 + count), (a0, a1 + count, a1)]
    faces = [f for f in faces if len({tuple(np.round(vertices.reshape(-1, 3)[v], 9)) for v in f}) == 3]
    return _mesh(vertices.reshape(-1, 3) + [0, 0, 6.0], faces, [material] * len(faces))


def house() -> Mesh:
    """Diffuse walls, one slope of rough lacquer, one of glass; gables east and west."""
    x, y, eaves, ridge = 6.0, 4.0, 5.0, 8.5
    vertices = [(i * x, j * y, z) for z in (0, eaves) for i, j in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    vertices += [(-x, 0, ridge), (x, 0, ridge)]
    walls = [(0, 1, 5), (0, 5, 4), (1, 2, 6), (1, 6, 5), (2, 3, 7), (2, 7, 6), (3, 0, 4), (3, 4, 7)]
    walls += [(5, 6, 9), (7, 4, 8)]
    south, north = [(4, 5, 9), (4, 9, 8)], [(6, 7, 8), (6, 8, 9)]
    materials = ["diffuse"] * len(walls) + ["rough_lacquer"] * 2 + ["glass"] * 2
    turn = math.radians(20)
    turned = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    return _mesh(np.array(vertices) @ turned.T, walls + south + north, materials)


def car() -> Mesh:
    """Make a saloon of the library: rough lacquer over black, glass, and the rest diffuse."""
    names = material_index(load_materials())
    model = build_models(names)[0]
    by_index = {i: name for name, i in names.items()}

    def stands_for(index: int) -> str:
        name = "paint" if index < 0 else by_index[index]
        return "rough_lacquer" if name == "paint" else "glass" if "glass" in name else "diffuse"

    turn = math.radians(-35)
    turned = np.array([[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]])
    materials = [stands_for(int(i)) for i in model.material]
    return _mesh(model.vertices @ turned.T + [0, 0, 0.02], model.faces, materials)


def _mesh(vertices, faces, materials) -> Mesh:
    index = np.array([NAMES.index(name) for name in materials], np.int16)
    return Mesh(np.asarray(vertices, np.float32), np.asarray(faces, np.int32), index)


def sky_stokes(look: np.ndarray) -> np.ndarray:
    """Stokes vector in ``meridian`` of the sky in unit directions of look: even, with Rayleigh's DoLP."""
    look = look / np.linalg.norm(look, axis=-1, keepdims=True)
    cosine = look @ SUN
    degree = GREATEST_DOLP * (1 - cosine**2) / (1 + cosine**2)
    field = np.cross(look, SUN)
    field /= np.maximum(np.linalg.norm(field, axis=-1, keepdims=True), 1e-9)
    travel = -look
    up = np.array([0.0, 0.0, 1.0]) - look[..., 2:] * look
    flat = np.linalg.norm(up, axis=-1, keepdims=True)
    first = np.where(flat > 1e-9, up / np.maximum(flat, 1e-9), np.array([0.0, -1.0, 0.0]))
    second = np.cross(travel, first)
    along, across = (field * first).sum(-1), (field * second).sum(-1)
    q, u = degree * (along**2 - across**2), degree * 2 * along * across
    return np.stack([np.ones_like(q), q, u], axis=-1)


def atmosphere() -> xr.Dataset:
    """Make the schema ``atmosphere`` of that sky and sun, grey, without air in between."""
    wavelength = np.array([0.4, 0.5, 0.6])
    zenith, azimuth = np.linspace(0, math.pi / 2, 91), np.linspace(0, 2 * math.pi, 180, endpoint=False)
    view, altitude = np.linspace(0, math.radians(85), 18), np.array([500.0, 5000.0])
    z, a = np.meshgrid(zenith, azimuth, indexing="ij")
    # at the zenith the vertical plane is that of the azimuth
    z = np.maximum(z, 1e-5)
    look = np.stack([np.sin(z) * np.sin(a), np.sin(z) * np.cos(a), np.cos(z)], axis=-1)
    ones, radiance, irradiance = np.ones(3), {"units": "W m-2 sr-1 um-1"}, {"units": "W m-2 um-1"}
    shape = {"units": "1", "stokes_frame": "meridian"}
    return xr.Dataset(
        {
            "sun_irradiance": ("wavelength", SUN_IRRADIANCE * ones, irradiance),
            "sky_irradiance": ("wavelength", math.pi * SKY_RADIANCE * ones, irradiance),
            "spherical_albedo": ("wavelength", 0 * ones, {"units": "1"}),
            "transmittance": (("wavelength", "altitude", "view_zenith"), np.ones((3, 2, 18)), {"units": "1"}),
            "sky_spectrum": (("sky_component", "wavelength"), SKY_RADIANCE * ones[None], radiance),
            "sky_map": (("sky_component", "zenith", "azimuth", "stokes"), sky_stokes(look)[None], shape),
            "path_spectrum": (("path_component", "wavelength"), 0 * ones[None], radiance),
            "path_gas": (("altitude", "wavelength"), np.ones((2, 3)), {"units": "1"}),
            "path_map": (
                ("path_component", "altitude", "view_zenith", "azimuth", "stokes"),
                np.zeros((1, 2, 18, 180, 3)),
                shape,
            ),
        },
        coords={
            "wavelength": ("wavelength", wavelength, {"units": "um"}),
            "zenith": ("zenith", zenith, {"units": "rad"}),
            "azimuth": ("azimuth", azimuth, {"units": "rad"}),
            "view_zenith": ("view_zenith", view, {"units": "rad"}),
            "altitude": ("altitude", altitude, {"units": "m"}),
            "stokes": ["I", "Q", "U"],
        },
        attrs={"sun_zenith_rad": SUN_ZENITH, "sun_azimuth_rad": SUN_AZIMUTH},
    )


def library() -> xr.Dataset:
    """Make the schema ``materials``."""
    table, one, wavelength = np.array(list(MATERIALS.values())), {"units": "1"}, np.array([0.4, 2.5])

    def column(i: int) -> tuple:
        return "material", table[:, i], one

    def spectrum(values: np.ndarray) -> tuple:
        return ("material", "wavelength"), np.repeat(values[:, None], 2, axis=1), one

    nothing = np.zeros(len(NAMES))
    return xr.Dataset(
        {
            "reflectance": spectrum(table[:, 0]),
            "transmittance": spectrum(nothing),
            "refractive_index_spectrum": spectrum(table[:, 1]),
            "extinction_index_spectrum": spectrum(table[:, 2]),
            "refractive_index": column(1),
            "extinction_index": column(2),
            "roughness": column(3),
            "specular_weight": column(4),
            "mottle": ("material", nothing, one),
            "gap_fraction": ("material", nothing, one),
        },
        coords={"material": NAMES, "wavelength": ("wavelength", wavelength, {"units": "um"})},
    )


def ours(mesh: Mesh, camera: Camera, pose: Pose):
    """Hits, and Stokes radiance (y, x, 3)."""
    sky, materials = unpack_sky(atmosphere(), 600.0), library()
    none = np.zeros(0, int)
    scene = Snapshot(mesh, (), np.zeros((0, 3, 4)), none, none, none)
    hits = trace(scene, camera, pose, sky.sun_direction, materials["roughness"].values, NAMES.index("ground"))
    return hits, shade(hits, sky, materials, np.array([[0.0, 1.0, 0.0]])).values[:, :, 0].astype(float)


def polarized_sky(mi, dr) -> None:
    """Register the emitter ``rayleigh_sky``: `sky_stokes` above the horizon, nothing below."""
    sun = [float(x) for x in SUN]

    def light(look):
        cosine = look[0] * sun[0] + look[1] * sun[1] + look[2] * sun[2]
        degree = GREATEST_DOLP * (1 - cosine * cosine) / (1 + cosine * cosine)
        field = dr.normalize(dr.cross(look, mi.Vector3f(*sun)))
        travel = -look
        first = mi.mueller.stokes_basis(travel)  # Mitsuba's own reference axis of light that travels so
        second = dr.cross(travel, first)
        along, across = dr.dot(field, first), dr.dot(field, second)
        above = look[2] > 0
        value = dr.select(above, SKY_RADIANCE, 0.0)
        out = dr.zeros(mi.Spectrum)
        out[0, 0] = value
        out[1, 0] = dr.select(above, value * degree * (along * along - across * across), 0)
        out[2, 0] = dr.select(above, value * degree * 2 * along * across, 0)
        return out

    class RayleighSky(mi.Emitter):
        def __init__(self, props):
            mi.Emitter.__init__(self, props)
            self.m_flags = mi.EmitterFlags.Infinite

        def set_scene(self, scene):
            pass

        def eval(self, si, active=True):
            return light(-si.wi)

        def sample_direction(self, it, sample, active=True):
            d = mi.warp.square_to_uniform_sphere(sample)
            ds = dr.zeros(mi.DirectionSample3f)
            ds.p, ds.n, ds.d, ds.dist = it.p + d * 2e4, -d, d, mi.Float(2e4)
            ds.pdf, ds.delta, ds.emitter = mi.Float(1 / (4 * math.pi)), mi.Bool(False), mi.EmitterPtr(self)
            return ds, light(d) * (4 * math.pi)

        def pdf_direction(self, it, ds, active=True):
            return mi.Float(1 / (4 * math.pi))

        def eval_direction(self, it, ds, active=True):
            return light(ds.d)

        def traverse(self, callback):
            pass

        def is_environment(self):
            return True

    mi.register_emitter("rayleigh_sky", RayleighSky)


def _bsdf(name: str) -> dict:
    reflectance, n, k, alpha, weight = MATERIALS[name]
    if weight == 0:
        return {"type": "diffuse", "reflectance": {"type": "uniform", "value": reflectance}}
    if reflectance > 0:
        # both have ρ/π T(θv) T(θl); ours over T's mean, so that a white base returns all light
        cosine = np.linspace(0, 1, 2001)
        passed = [1 - fresnel(c, n, k)[0] for c in cosine]
        base = reflectance / (2 * float(np.trapezoid(cosine * passed, cosine)))
        coat = {"type": "pplastic", "distribution": "ggx", "alpha": alpha, "int_ior": n, "ext_ior": 1.0}
        return {**coat, "diffuse_reflectance": {"type": "uniform", "value": base}}
    index = {"eta": {"type": "uniform", "value": n}, "k": {"type": "uniform", "value": k}}
    if alpha == 0:
        return {"type": "conductor", **index}
    return {"type": "roughconductor", "distribution": "ggx", "alpha": alpha, **index}


def mitsuba_scene(mi, mesh: Mesh, emitters: dict, bsdf=_bsdf):
    """Make one Mitsuba mesh per material of the same triangles."""
    scene = {"type": "scene", **emitters}
    twosided = lambda k: mi.load_dict({"type": "twosided", "bsdf": bsdf(NAMES[k])})  # noqa: E731
    return mi.load_dict(add_meshes(mi, scene, "part", mesh, twosided))


def mitsuba_stokes(
    mi, dr, scene, lens, directions, axis, samples: int, by_emitter: bool = False, part: int = 256
) -> np.ndarray:
    """Stokes (ray, 3) of given rays with direct light, in the axis given, sampled by surface or emitter."""
    ways = {"emitter_samples": int(by_emitter), "bsdf_samples": int(not by_emitter)}
    integrator = mi.load_dict({"type": "direct", **ways})
    total, count = np.zeros((len(directions), 3)), len(directions)
    for start in range(0, samples, part):
        some = min(part, samples - start)
        sampler = mi.load_dict({"type": "independent", "sample_count": some})
        sampler.seed(start + 1, count * some)
        d = mi.Vector3f(*(mi.Float(np.repeat(directions[:, i], some).astype(np.float32)) for i in range(3)))
        o = mi.Point3f(*(mi.Float(float(x)) for x in lens))
        ray = mi.RayDifferential3f(o, d, mi.Float(0), mi.Color0f())
        light, *_ = integrator.sample(scene, sampler, ray)
        total += stokes_on_axis(mi, dr, light, d, axis).reshape(3, count, some).sum(axis=2).T
    return total / samples


def compare(name: str, mesh: Mesh, samples: int = 512, side_px: int = SIDE_PX) -> Comparison:
    """Render one object with both; only what both model in the same way is kept."""
    mi, dr = load_mitsuba()
    polarized_sky(mi, dr)
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    middle, size = 0.5 * (low + high), float(np.linalg.norm(high - low))
    away = np.array([0.55, -0.6, 0.58]) / np.linalg.norm([0.55, -0.6, 0.58])
    lens = middle + 600.0 / away[2] * away
    pose = look_at(Pose(*lens.tolist()), middle)
    distance = float(np.linalg.norm(lens - middle))
    camera = Camera(1e-5 * side_px * distance / (VIEW * size), 1e-5, side_px, side_px)
    hits, stokes = ours(mesh, camera, pose)
    material = hits.material.reshape(side_px, side_px)
    seen = np.flatnonzero(comparable(hits))
    directions = rays(camera, pose).reshape(-1, 3)[seen]
    toward = [-float(x) for x in SUN]
    irradiance = {"type": "uniform", "value": SUN_IRRADIANCE}
    sun = {"sun": {"type": "directional", "direction": toward, "irradiance": irradiance}}
    view = (pose.position, directions, hits.detector_axis)
    # light adds up: the sun needs one sample, the sky many
    peer = mitsuba_stokes(mi, dr, mitsuba_scene(mi, mesh, sun), *view, 1, by_emitter=True)
    peer += mitsuba_stokes(mi, dr, mitsuba_scene(mi, mesh, {"sky": {"type": "rayleigh_sky"}}), *view, samples)
    table = np.array(list(MATERIALS.values()))[hits.material[seen]]
    smooth = (table[:, 4] > 0) & (table[:, 3] == 0)  # whose one mirrored ray is known to be free
    open_to_all = smooth | _unoccluded(mi, dr, mesh, pose.position, directions)
    open_to_all &= peer[:, 0] > 0  # black: a mirrored ray that met the object's own edge
    pictures = np.full((2, side_px * side_px, 3), np.nan)
    flat = stokes.reshape(-1, 3)
    pictures[0, seen[open_to_all]], pictures[1, seen[open_to_all]] = (
        flat[seen[open_to_all]],
        peer[open_to_all],
    )
    shape = (side_px, side_px, 3)
    return Comparison(name, pictures[0].reshape(shape), pictures[1].reshape(shape), material)


def comparable(hits) -> np.ndarray:
    """Rays that meet the object where a mirror's view is open and the sun's disc is not in it."""
    table = np.array(list(MATERIALS.values()))
    ground = NAMES.index("ground")
    on_object = (hits.material >= 0) & (hits.material != ground)
    smooth = (table[hits.material, 4] > 0) & (table[hits.material, 3] == 0)
    facing = np.einsum("ij,ij->i", hits.direction, hits.normal)
    mirrored = hits.direction[:, 2] - 2 * facing * hits.normal[:, 2]
    rough = table[hits.material, 3] > 0
    to_sky = (hits.mirror_material < 0) & (mirrored > math.sin(ABOVE_HORIZON))
    lobe_in_sky = mirrored > math.sin(LOBE_ABOVE_HORIZON)
    half = SUN - hits.direction
    half /= np.linalg.norm(half, axis=-1, keepdims=True)
    glint = (np.einsum("ij,ij->i", half, hits.normal) > math.cos(GLINT_FREE)) & (hits.sun_visible > 0)
    return on_object & (~smooth | (to_sky & ~glint)) & (~rough | lobe_in_sky)


def _unoccluded(mi, dr, mesh: Mesh, lens, directions, samples: int = 1024) -> np.ndarray:
    """Parts of the object that no other part occludes: white in uniform light, they are as bright as it."""
    white = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 1.0}}
    glow = {"sky": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}}}
    scene = mitsuba_scene(mi, mesh, glow, lambda name: white)
    light = mitsuba_stokes(mi, dr, scene, lens, directions, np.array([1.0, 0, 0]), samples)
    return light[:, 0] > 0.9995


def draw(comparisons: list[Comparison]):
    """Rows of pictures, three an object: ours, Mitsuba's, and the difference, for I, Q and U."""
    from matplotlib.figure import Figure

    rows = 3 * len(comparisons)
    figure = Figure(figsize=(8.4, 2.1 * rows), layout="constrained")
    axes = figure.subplots(rows, 3)
    for n, one in enumerate(comparisons):
        rows_seen, columns_seen = np.nonzero(np.isfinite(one.ours[..., 0]))
        crop = np.s_[
            rows_seen.min() - 2 : rows_seen.max() + 3, columns_seen.min() - 2 : columns_seen.max() + 3
        ]
        one = replace(one, ours=one.ours[crop], mitsuba=one.mitsuba[crop], material=one.material[crop])
        brightest = np.nanpercentile(one.ours[..., 0], 98)
        for s, letter in enumerate("IQU"):
            signed = s > 0
            style = {"cmap": "RdBu_r", "vmin": -0.5, "vmax": 0.5} if signed else {"cmap": "gray", "vmin": 0}
            for column, (whose, stokes) in enumerate((("glintrack", one.ours), ("Mitsuba 3", one.mitsuba))):
                ax = axes[3 * n + s, column]
                values = stokes[..., s] / one.mitsuba[..., 0] if signed else stokes[..., 0] / brightest
                shown = ax.imshow(values, interpolation="nearest", **style, **({} if signed else {"vmax": 1}))
                ax.set_title(f"{one.name}: {letter}{'/I' if signed else ''}, {whose}", fontsize=8)
            figure.colorbar(shown, ax=ax, shrink=0.8)
            ax = axes[3 * n + s, 2]
            difference = 100 * (one.ours[..., s] - one.mitsuba[..., s]) / one.mitsuba[..., 0]
            shown = ax.imshow(difference, interpolation="nearest", cmap="RdBu_r", vmin=-2, vmax=2)
            ax.set_title(f"difference of {letter} [% of I]", fontsize=8)
            figure.colorbar(shown, ax=ax, shrink=0.8)
        for ax in axes[3 * n : 3 * n + 3].ravel():
            ax.set_facecolor("#d8dde2")
            ax.set(xticks=[], yticks=[])
    return figure


def main(picture: Path = Path("mitsuba.png")) -> None:
    """Compare, print a table, draw."""
    objects = (
        ("ball of glass", ball("glass")),
        ("rough ball", ball("rough_aluminium")),
        ("coated ball", ball("coat_over_colour")),
        ("house", house()),
        ("car", car()),
    )
    comparisons = [compare(name, mesh, samples=4096) for name, mesh in objects]
    print(f"{'object':14s} {'surface':16s} {'rays':>6s} | mean of I |  99 % within: I     Q, U over I")
    for one in comparisons:
        known = np.isfinite(one.ours[..., 0])
        for m in np.unique(one.material[known]):
            mine = known & (one.material == m)
            peer = one.mitsuba[mine][:, :1]
            difference = (one.ours[mine] - one.mitsuba[mine]) / peer
            i, qu = (np.percentile(np.abs(d), 99) for d in (difference[:, 0], difference[:, 1:]))
            print(
                f"{one.name:14s} {NAMES[m]:16s} {mine.sum():6d} | "
                f"{difference[:, 0].mean():+9.4f} | {i:16.4f} {qu:15.4f}"
            )
    figure = draw(comparisons)
    figure.savefig(picture, dpi=80)
    print(f"wrote {picture}")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("picture", type=Path, nargs="?", default=Path("mitsuba.png"))
    main(parser.parse_args().picture)
