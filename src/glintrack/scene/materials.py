"""The material library: base reflectance spectra and Fresnel interfaces, as one Dataset.

``data/materials.toml`` defines the surface of each material and its spectrum in ``data/spectra``. Blank cells
at an end of a spectrum get the nearest measured value. Blanks inside (the atmosphere's water bands in field
spectra) are interpolated linearly.

Transmittance of a leaf follows from its reflectance by the generalised plate model: N layers of one absorbing
plate (Allen et al., J. Opt. Soc. Am. 59, 1376 (1969); 60, 542 (1970); Jacquemoud and Baret, Remote Sens.
Environ. 34, 75 (1990), "PROSPECT"). At each wavelength the plate's inner transmittance is fitted to the
measured reflectance. It is synthetic: reflectance is measured, transmittance is not.
"""

import math
from collections.abc import Iterable, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Literal

import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from glintrack.core import schema, spectral
from glintrack.core.arrays import Array
from glintrack.core.colour import SRGB_FROM_XYZ, encode_srgb
from glintrack.core.designs import Design, validate_design
from glintrack.core.installation import data_file, read_data
from glintrack.io.spectra import read_spectra
from glintrack.io.toml import read_toml
from glintrack.io.untrusted import is_file, resolve_path

DISTRIBUTIONS = ("ggx", "gaussian", "priest_germer")  # in the order of render.shading
REFERENCE_WAVELENGTH_UM = 0.65  # where the scalar refractive and extinction index hold
VARIATIONS = ("colour_variation", "gloss_variation", "vehicle_variation")
_LIMITS = {"n": (1e-3, 100.0), "k": (0.0, 100.0)}  # of columns that hold no share of the light
MAX_POLARIZED_REFLECTANCE = 0.0085  # of `polarized_base` = 1
MAX_POLARIZED_SHARE = 0.8  # of the light of a base; refraction polarizes it too
_Share = Annotated[float, Field(ge=0, le=1)]


class MaterialDesign(Design):
    """One table of the library; see the head of ``data/materials.toml`` for the three forms of the base."""

    spectrum: str | None = None
    mix: dict[str, _Share] | None = None
    constant: float | None = Field(default=None, ge=0, le=1)
    file: str | None = None
    column: str = "reflectance"
    optical_constants: str | None = None
    optical_constants_file: str | None = None
    refractive_index: float | None = Field(default=None, gt=0, le=100)
    extinction_index: float = Field(default=0.0, ge=0, le=100)
    roughness: float = Field(ge=0, le=1)
    specular_weight: float = Field(ge=0, le=1)
    distribution: Literal["ggx", "gaussian", "priest_germer"] = "ggx"
    diffuse: Literal["lambert", "oren_nayar"] = "lambert"
    groove_slope_deg: float = Field(default=0.0, ge=0, le=60)
    polarized_base: float = Field(default=0.0, ge=0, le=20)
    mottle: float = Field(default=0.0, ge=0, le=1)
    toward: str | None = None
    colour_variation: float = Field(default=0.0, ge=0, le=0.5)
    gloss_variation: float = Field(default=0.0, ge=0, le=0.5)
    vehicle_variation: float = Field(default=0.0, ge=0, le=0.5)
    share: float = Field(default=0.0, ge=0, le=1)
    gap_fraction: float = Field(default=0.0, ge=0, lt=1)
    leaf_absorptance: float | None = Field(default=None, gt=0, lt=1)
    transmittance_column: str | None = None
    preview_rgb: tuple[_Share, _Share, _Share] | None = None

    @model_validator(mode="after")
    def _one_base(self) -> "MaterialDesign":
        bases = ("spectrum", "mix", "constant", "file")
        indices = ("refractive_index", "optical_constants", "optical_constants_file")
        for forms in (bases, indices):
            given = [n for n in forms if getattr(self, n) is not None] or "none"
            if len(given) != 1:
                raise ValueError(f"a material must have exactly one of {', '.join(forms)}; got {given}.")
        if self.mix is not None and sum(self.mix.values()) > 1 + 1e-6:
            raise ValueError(f"`mix` must hold shares that sum to 1 at most; got {sum(self.mix.values()):g}.")
        if (self.diffuse == "oren_nayar") != (self.groove_slope_deg > 0):
            raise ValueError(
                "a material must get a groove_slope_deg above 0 with diffuse = 'oren_nayar' and only then"
            )
        if self.extinction_index and self.refractive_index is None:
            raise ValueError("a material must get its extinction_index with its refractive_index")
        if self.transmittance_column is not None and (self.file is None or self.leaf_absorptance is not None):
            raise ValueError(
                "a material must get its transmittance_column from its file, and no leaf_absorptance"
            )
        return self


@lru_cache(maxsize=2)
def load_materials(polarized_bases: bool = False, variation: float = 0.0) -> xr.Dataset:
    """Load the packaged library as a Dataset of schema ``materials``.

    Parameters
    ----------
    polarized_bases
        True: ``polarized_base`` has the library's values. False: it is 0.
    variation
        Factor of the library's ``colour_variation``, ``gloss_variation`` and ``vehicle_variation``. [1]

    Returns
    -------
    ``reflectance(material, wavelength)`` and ``transmittance(material, wavelength)`` (0 except for leaves)
    over 0.4–2.5 µm, ``refractive_index`` and ``extinction_index`` at 0.65 µm and the same over wavelength as
    ``refractive_index_spectrum`` and ``extinction_index_spectrum``, GGX ``roughness``, ``specular_weight``
    (fraction of a facet with a Fresnel interface), ``polarized_base`` (scale of the polarization of a base,
    `render.shading.interface`), ``mottle`` (relative standard deviation of the slow change of
    reflectance over the ground), ``gap_fraction`` (share of holes in a leaf card), ``paint_share`` (fraction
    of vehicles with that paint, 0 for other materials) and ``preview_rgb`` (sRGB, gamma-encoded, for
    pictures). Treat it as read-only.
    """
    designs = {name: MaterialDesign(**entry) for name, entry in read_data("materials.toml").items()}
    return _dataset(designs, None, polarized_bases, variation)


def load_user_materials(
    path: Path, polarized_bases: bool = False, variation: float = 0.0
) -> tuple[xr.Dataset, dict[str, str]]:
    """Load the packaged library, followed by a user's own materials.

    Parameters
    ----------
    path
        TOML file: one table per material, in the form of ``data/materials.toml`` (``file`` names a CSV in the
        folder of the TOML, with columns ``wavelength_um`` and ``reflectance``), under ``[mesh]`` the
        material for each of a mesh's own, and under ``[paint_shares]`` the share of vehicles with each paint,
        in place of the library's.
    polarized_bases, variation
        See `load_materials`; for a user's materials too.

    Returns
    -------
    Dataset as `load_materials` gives it, and the table ``[mesh]``.

    Raises
    ------
    ValueError
        If the file or a spectrum cannot be read, or a value is out of its range.
    """
    table = read_toml(path, "materials_file")
    mesh, shares = table.pop("mesh", {}), table.pop("paint_shares", None)
    if not (isinstance(mesh, dict) and all(isinstance(v, str) for v in mesh.values())):
        raise ValueError(f"`materials_file` must give names under [mesh]; got {mesh!r}.")
    library = load_materials(polarized_bases, variation)
    designs: dict[str, MaterialDesign] = {}
    for name, entry in table.items():
        if name in library["material"].values or name == "paint":
            raise ValueError(f"`materials_file` must give new names; got {name!r}, which the library has.")
        if not isinstance(entry, dict):
            raise ValueError(f"`materials_file` must hold one table a material; got {name} = {entry!r}.")
        try:
            designs[name] = validate_design(MaterialDesign, entry)
        except ValueError as error:
            reason = str(error).splitlines()[0]
            raise ValueError(f"`{name}` must be a material: {reason}") from error
    known = {*library["material"].values, *designs}
    for name, design in designs.items():
        if design.toward is not None and design.toward not in known:
            raise ValueError(f"`{name}` must have a material as its `toward`; got {design.toward!r}.")
    if designs:
        own = _dataset(designs, path.parent, polarized_bases, variation)
        library = xr.concat([library, own], dim="material", combine_attrs="override")
    if shares is not None:
        # a new dataset: the library is cached, and shared by all cases of this process
        library = library.assign(paint_share=library["paint_share"].copy(data=_paint_shares(library, shares)))
    return schema.check(library, "materials"), mesh


def _paint_shares(library: xr.Dataset, shares: object) -> Float[Array, "material"]:
    """Share of each material among the paints of vehicles; those that a table leaves out have none."""
    names, example = library["material"].values.tolist(), "such as paint_white = 0.2"
    if not (isinstance(shares, dict) and shares):
        raise ValueError(f"`paint_shares` must be a table of paints and shares, {example}; got {shares!r}.")
    for name, share in shares.items():
        if name not in names:
            raise ValueError(f"`paint_shares` must name materials, {example}; got {name!r}.")
        if isinstance(share, bool) or not isinstance(share, int | float) or not 0 <= share <= 1:
            raise ValueError(f"`paint_shares.{name}` must be a share from 0 to 1; got {share!r}.")
    if sum(shares.values()) <= 0:
        raise ValueError(f"`paint_shares` must have a share above 0, {example}; got none.")
    return np.array([float(shares.get(name, 0.0)) for name in names])


def _dataset(
    designs: Mapping[str, MaterialDesign], folder: Path | None, polarized_bases: bool, variation: float
) -> xr.Dataset:
    """Dataset of schema ``materials``; ``file`` entries are in a folder."""
    wavelength = spectral.wavelength_grid()
    kinds = designs.values()
    reflectance, transmittance, constants, preview = [], [], [], []
    # display colours under an equal-energy light, to which the eye adapts; IEC 61966-2-1 primaries and gamma
    matching = spectral.cie_xyz(wavelength)
    white = SRGB_FROM_XYZ @ (matching.sum(axis=1) / matching[1].sum())
    for name, design in designs.items():
        base = _base(name, design, folder, wavelength)
        reflectance.append(base)
        transmittance.append(_transmittance(name, design, base, folder, wavelength))
        constants.append(_optical_constants(design, folder, wavelength))
        linear = np.clip((SRGB_FROM_XYZ @ (matching @ base / matching[1].sum())) / white, 0, 1)
        preview.append(np.array(design.preview_rgb) if design.preview_rgb else encode_srgb(linear))
    constants = np.stack(constants)
    at_reference = constants[:, :, int(np.argmin(np.abs(wavelength - REFERENCE_WAVELENGTH_UM)))]

    def column(values: Iterable[float]) -> tuple:
        return "material", np.array(list(values)), {"units": "1"}

    scalars = {n: n for n in ("roughness", "specular_weight", "mottle", "gap_fraction")}
    scalars["paint_share"] = "share"
    library = xr.Dataset(
        {
            "reflectance": (("material", "wavelength"), np.stack(reflectance), {"units": "1"}),
            "transmittance": (("material", "wavelength"), np.stack(transmittance), {"units": "1"}),
            "refractive_index": column(at_reference[:, 0]),
            "extinction_index": column(at_reference[:, 1]),
            "refractive_index_spectrum": (("material", "wavelength"), constants[:, 0], {"units": "1"}),
            "extinction_index_spectrum": (("material", "wavelength"), constants[:, 1], {"units": "1"}),
            **{name: column(getattr(d, key) for d in kinds) for name, key in scalars.items()},
            "distribution": column(DISTRIBUTIONS.index(d.distribution) for d in kinds),
            "groove_slope": ("material", np.radians([d.groove_slope_deg for d in kinds]), {"units": "rad"}),
            "polarized_base": column(polarized_bases * d.polarized_base for d in kinds),
            "toward": ("material", np.array([d.toward or "" for d in kinds], dtype=object)),
            **{n: column(variation * getattr(d, n) for d in kinds) for n in VARIATIONS},
            "preview_rgb": (("material", "rgb"), np.stack(preview), {"units": "1"}),
        },
        coords={"material": list(designs), "wavelength": ("wavelength", wavelength, {"units": "um"})},
        attrs={"index_wavelength_um": REFERENCE_WAVELENGTH_UM},
    )
    return schema.check(library, "materials")


def material_index(materials: xr.Dataset) -> dict[str, int]:
    """Index of each material by name."""
    return {str(name): i for i, name in enumerate(materials["material"].values)}


def choose_paints(materials: xr.Dataset, keys: Int[Array, "key"], seed: int) -> Int[Array, "key"]:
    """Material index of a paint for each integer key, in the library's proportions.

    The paint depends on the key and the seed only.
    """
    share = materials["paint_share"].values
    paints = np.flatnonzero(share > 0)
    edges = np.cumsum(share[paints]) / share[paints].sum()
    # uniform numbers in [0, 1) from integers by the finaliser of SplitMix64 (Steele et al. 2014)
    start = (int(seed) * 0x9E3779B97F4A7C15) % 2**64
    with np.errstate(over="ignore"):
        z = (np.asarray(keys).astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        z = z ^ np.uint64(start)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    uniform = (z >> np.uint64(11)).astype(float) / 2.0**53
    chosen = np.minimum(np.searchsorted(edges, uniform, side="right"), paints.size - 1)
    return paints[chosen].astype(np.int16)


def _transmittance(
    name: str, design: MaterialDesign, reflectance: Array, folder: Path | None, wavelength: Array
) -> Array:
    """Transmittance of a thin sheet of a material; 0 unless it is a leaf."""
    if design.transmittance_column is not None:
        values = _read_user(str(design.file), design.transmittance_column, wavelength, folder)
    elif design.leaf_absorptance is not None and design.refractive_index is not None:
        values = leaf_transmittance(reflectance, design.leaf_absorptance, design.refractive_index)
    else:
        values = np.zeros(wavelength.size)
    wrong = (values < 0) | (values + reflectance > 1 + 1e-9)  # a billionth: rounding
    if wrong.any():
        k = int(np.argmax(wrong))
        raise ValueError(
            f"`{name}` must have a transmittance of at least 0 and at most 1 less its reflectance; "
            f"got {values[k]:.4g} at {wavelength[k]:.3g} µm."
        )
    return values


def _optical_constants(
    design: MaterialDesign, folder: Path | None, wavelength: Array
) -> Float[Array, "2 wavelength"]:
    """Refractive and extinction index."""
    if design.refractive_index is not None:
        pair = design.refractive_index, design.extinction_index
        return np.repeat(np.array(pair)[:, None], wavelength.size, axis=1)
    if (name := design.optical_constants_file) is not None:
        return np.stack([_read_user(name, column, wavelength, folder) for column in "nk"])
    name = str(design.optical_constants)
    return np.stack([_read_packaged(name, column, wavelength, "optical_constants") for column in "nk"])


def _read_user(name: str, column: str, wavelength: Array, folder: Path | None) -> Array:
    place = folder or Path()
    if not resolve_path(place / name).is_relative_to(resolve_path(place)) or not is_file(place / name):
        raise ValueError(f"`{name}` must be a file in the materials file's folder or below; got none there.")
    return _read_column(place / name, column, wavelength)


def _read_packaged(name: str, column: str, wavelength: Array, key: str) -> Array:
    path = data_file("spectra", f"{name}.csv")
    if not (name.isidentifier() and len(name) <= 100 and path.is_file()):  # no path to another folder
        raise ValueError(f"`{key}` must be one of the packaged spectra; got {name!r}.")
    return _read_column(path, column, wavelength)


def _read_column(path: Path, column: str, wavelength: Array) -> Array:
    spectra = read_spectra(path, path.name, {column: _LIMITS.get(column, (0.0, 1.0))}, fill=True)
    return spectral.resample(wavelength, spectra["wavelength_um"], spectra[column], path.name)


def _base(name: str, design: MaterialDesign, folder: Path | None, wavelength: Array) -> Array:
    """Reflectance of a base; it must reflect more light than it polarizes."""
    if design.constant is not None:
        base = np.full(wavelength.size, design.constant)
    elif design.file is not None:
        base = _read_user(design.file, design.column, wavelength, folder)
    else:
        base = np.zeros(wavelength.size)
        for part, weight in (design.mix or {str(design.spectrum): 1.0}).items():
            base += weight * _read_packaged(part, design.column, wavelength, "spectrum")
    darkest = float(base.min())
    highest = MAX_POLARIZED_SHARE * darkest / MAX_POLARIZED_REFLECTANCE
    if design.polarized_base > highest:
        raise ValueError(
            f"`{name}.polarized_base` must be at most {highest:.3g} for a base that reflects {darkest:.3g} "
            f"where it is darkest; got {design.polarized_base:g}."
        )
    return base


_CONE_RAD = math.radians(40)  # light meets the first layer within this cone (PROSPECT-5)
_NODES = 64  # of the average over directions
_HALVINGS = 40  # to 1e-12 of the range
_CUTS, _PARTS = 7, 64  # of the range of layers, to as much
_MAX_LAYERS = 30.0


def leaf_transmittance(
    reflectance: Float[Array, "wavelength"], absorptance: float, refractive_index: float
) -> Float[Array, "wavelength"]:
    """Hemispherical transmittance of a leaf by its reflectance. [1]

    Parameters
    ----------
    reflectance
        Reflectance of the leaf, 0 to 1. [1]
    absorptance
        Absorptance at the maximum of the reflectance, in the near infrared: about 0.05 for a single leaf. It
        determines the number of layers. [1]
    refractive_index
        Refractive index of the leaf's wax and cell walls, over 1. [1]

    Raises
    ------
    ValueError
        If reflectance and absorptance leave no light to transmit.
    """
    highest = float(np.max(reflectance))
    if not 0 < absorptance < 1 - highest:
        raise ValueError(
            f"`leaf_absorptance` must lie above 0 and leave light to pass: below {1 - highest:.3g}; "
            f"got {absorptance:g}."
        )
    low, high = 1.0, _MAX_LAYERS
    for _ in range(_CUTS):  # more layers reflect more, so that more must be absorbed
        layers = np.linspace(low, high, _PARTS + 1)
        through = _inverse(np.full(_PARTS - 1, highest), layers[1:-1], refractive_index)
        below = np.count_nonzero(1 - highest - through <= absorptance)
        low, high = layers[below : below + 2].tolist()
    return _inverse(np.asarray(reflectance, float), low, refractive_index)


def plate_stack(
    inner: ArrayLike, layers: ArrayLike, refractive_index: float
) -> tuple[Float[Array, "*any"], Float[Array, "*any"]]:
    """Reflectance and transmittance of a stack of absorbing plates.

    Parameters
    ----------
    inner
        Transmittance of one plate's inside, 0 to 1. [1]
    layers
        Number of plates, at least 1, not necessarily an integer. [1]
    refractive_index
        Refractive index of the plates, over 1. [1]
    """
    first, inside = _entering(refractive_index, _CONE_RAD), _entering(refractive_index, math.pi / 2)
    inner = np.clip(np.asarray(inner, float), 1e-9, 1 - 1e-9)  # the ends are limits of the formulae
    top_r, top_t = _plate(inner, first, inside, refractive_index)
    r, t = _plate(inner, inside, inside, refractive_index)
    # Stokes' solution for layers − 1 equal plates
    root = np.sqrt(np.maximum((t**2 - r**2 - 1) ** 2 - 4 * r**2, 0))
    a, b = (1 + r**2 - t**2 + root) / (2 * r), (1 - r**2 + t**2 + root) / (2 * t)
    power = b ** (np.asarray(layers) - 1)
    whole = a * power - 1 / (a * power)
    below_r, below_t = (power - 1 / power) / whole, (a - 1 / a) / whole
    between = 1 - r * below_r
    return top_r + top_t * t * below_r / between, top_t * below_t / between


def _plate(inner: Array, entering: float, inside: float, n: float) -> tuple[Array, Array]:
    """Reflectance and transmittance of one plate, which diffuses the light."""
    back = n**2 - inside  # n² times the reflectance from within
    between = n**4 - (inner * back) ** 2
    transmitted = entering * inside * inner * n**2 / between
    return 1 - entering + entering * inside * inner**2 * back / between, transmitted


@lru_cache(maxsize=64)
def _entering(n: float, cone_rad: float) -> float:
    """Fresnel transmittance for unpolarized light averaged over a cone (Stern, Appl. Opt. 3, 111 (1964))."""
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    # sin²: even steps of it are even in projected solid angle
    s2 = 0.5 * (node + 1) * math.sin(cone_rad) ** 2
    c, ct = np.sqrt(1 - s2), np.sqrt(1 - s2 / n**2)
    rs, rp = (c - n * ct) / (c + n * ct), (n * c - ct) / (n * c + ct)
    return float(np.sum(weight * (1 - 0.5 * (rs**2 + rp**2))) / 2)


def _inverse(reflectance: Array, layers: ArrayLike, n: float) -> Array:
    """Transmittance of a stack of a reflectance; 0 where even a black inside reflects more."""
    low, high = np.zeros(reflectance.shape), np.ones(reflectance.shape)
    for _ in range(_HALVINGS):
        inner = 0.5 * (low + high)
        more = plate_stack(inner, layers, n)[0] > reflectance
        low, high = np.where(more, low, inner), np.where(more, inner, high)
    return np.where(low > 0, plate_stack(low, layers, n)[1], 0.0)
