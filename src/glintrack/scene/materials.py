"""The material library: base reflectance spectra and the figures of a Fresnel interface, as one Dataset.

The library is data: ``data/materials.toml`` names for each material its spectrum among ``data/spectra`` and
its surface. A cell that a source left blank at an end of its range holds the nearest measured value; blanks
inside the range (the atmosphere's water bands in field spectra) are bridged by straight lines.
"""

import csv
import tomllib
from functools import lru_cache
from importlib import resources
from importlib.resources.abc import Traversable

import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from pydantic import BaseModel, ConfigDict, Field, model_validator

from glintrack import schema, spectral

Array = np.ndarray
REFERENCE_WAVELENGTH_UM = 0.65  # where refractive and extinction index hold


class MaterialDesign(BaseModel):
    """One table of the library; see the head of ``data/materials.toml`` for the three forms of the base."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    spectrum: str | None = None
    mix: dict[str, float] | None = None
    constant: float | None = Field(default=None, ge=0, le=1)
    column: str = "reflectance"
    refractive_index: float = Field(gt=0)
    extinction_index: float = Field(default=0.0, ge=0)
    roughness: float = Field(ge=0, le=1)
    specular_weight: float = Field(ge=0, le=1)
    mottle: float = Field(default=0.0, ge=0, le=1)
    share: float = Field(default=0.0, ge=0, le=1)
    preview_rgb: tuple[float, float, float] | None = None

    @model_validator(mode="after")
    def _one_base(self) -> "MaterialDesign":
        given = [n for n in ("spectrum", "mix", "constant") if getattr(self, n) is not None]
        if len(given) != 1:
            raise ValueError(f"a material must have exactly one of spectrum, mix, constant, got {given}")
        return self


def read_spectrum(
    path: Traversable, column: str = "reflectance"
) -> tuple[Float[Array, "wavelength"], Float[Array, "wavelength"]]:
    """Wavelengths [µm] and one column [1] of a spectrum file with ``#`` header lines; blanks filled.

    Parameters
    ----------
    path
        CSV file whose first column is ``wavelength_um``.
    column
        Which column.

    Returns
    -------
    Wavelengths and values; blank ends hold the nearest measured value, blanks between are bridged linearly.
    """
    lines = [line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#")]
    rows = list(csv.DictReader(lines))
    if not rows or column not in rows[0] or "wavelength_um" not in rows[0]:
        came = sorted(rows[0]) if rows else "no rows"
        raise ValueError(f"`{path.name}` must have columns wavelength_um and {column}, got {came}")
    wavelength = np.array([float(row["wavelength_um"]) for row in rows])
    values = np.array([float(row[column]) if row[column].strip() else np.nan for row in rows])
    known = np.isfinite(values)
    if not known.any():
        raise ValueError(f"`{path.name}` must hold measured values in column {column}, got none")
    return wavelength, np.interp(wavelength, wavelength[known], values[known])


@lru_cache(maxsize=1)
def load_materials() -> xr.Dataset:
    """The packaged library as a Dataset of schema ``materials``.

    Returns
    -------
    ``reflectance(material, wavelength)`` over 0.4–2.5 µm, indices at 0.65 µm, GGX ``roughness``,
    ``specular_weight`` (fraction of a facet with a Fresnel interface), ``mottle`` (relative standard
    deviation of the slow change of reflectance over the ground), ``paint_share`` (fraction of vehicles with
    that paint, 0 for what is no paint) and ``preview_rgb`` (sRGB, gamma-encoded, for pictures). Treat it as
    read-only.
    """
    data = resources.files("glintrack") / "data"
    table = tomllib.loads((data / "materials.toml").read_text(encoding="utf-8"))
    designs = {name: MaterialDesign(**entry) for name, entry in table.items()}
    wavelength = spectral.wavelength_grid()
    reflectance = np.stack([_base(design, data / "spectra", wavelength) for design in designs.values()])
    preview = np.stack(
        [
            np.array(design.preview_rgb) if design.preview_rgb else _srgb(wavelength, base)
            for design, base in zip(designs.values(), reflectance, strict=True)
        ]
    )

    def scalar(name: str) -> tuple:
        return "material", np.array([getattr(d, name) for d in designs.values()]), {"units": "1"}

    library = xr.Dataset(
        {
            "reflectance": (("material", "wavelength"), reflectance, {"units": "1"}),
            "refractive_index": scalar("refractive_index"),
            "extinction_index": scalar("extinction_index"),
            "roughness": scalar("roughness"),
            "specular_weight": scalar("specular_weight"),
            "mottle": scalar("mottle"),
            "paint_share": scalar("share"),
            "preview_rgb": (("material", "rgb"), preview, {"units": "1"}),
        },
        coords={
            "material": list(designs),
            "wavelength": ("wavelength", wavelength, {"units": "um"}),
        },
        attrs={"index_wavelength_um": REFERENCE_WAVELENGTH_UM},
    )
    return schema.check(library, "materials")


def material_index(materials: xr.Dataset) -> dict[str, int]:
    """Index of each material by name."""
    return {str(name): i for i, name in enumerate(materials["material"].values)}


def choose_paints(materials: xr.Dataset, keys: Int[Array, "key"], seed: int) -> Int[Array, "key"]:
    """Material index of a paint for each key, in the library's proportions; a key always gets the same.

    Parameters
    ----------
    materials
        Library with ``paint_share``.
    keys
        Vehicle ids or any integers.
    seed
        Changes the whole assignment.
    """
    share = materials["paint_share"].values
    paints = np.flatnonzero(share > 0)
    edges = np.cumsum(share[paints]) / share[paints].sum()
    chosen = np.minimum(np.searchsorted(edges, _hash_unit(keys, seed), side="right"), paints.size - 1)
    return paints[chosen].astype(np.int16)


def _hash_unit(keys: Int[Array, "key"], seed: int) -> Float[Array, "key"]:
    """Uniform numbers in [0, 1) from integers: the finaliser of SplitMix64 (Steele et al. 2014)."""
    start = (int(seed) * 0x9E3779B97F4A7C15) % 2**64
    with np.errstate(over="ignore"):
        z = (np.asarray(keys).astype(np.uint64) + np.uint64(1)) * np.uint64(0x9E3779B97F4A7C15)
        z = z ^ np.uint64(start)
        z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
        z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
        z = z ^ (z >> np.uint64(31))
    return (z >> np.uint64(11)).astype(float) / 2.0**53


def _base(design: MaterialDesign, folder: Traversable, wavelength: Float[Array, "wavelength"]) -> Array:
    if design.constant is not None:
        return np.full(wavelength.size, design.constant)
    parts = design.mix or {str(design.spectrum): 1.0}
    total = np.zeros(wavelength.size)
    for name, weight in parts.items():
        table_um, values = read_spectrum(folder / f"{name}.csv", design.column)
        total += weight * spectral.resample(wavelength, table_um, values, name)
    return total


def _srgb(wavelength: Float[Array, "wavelength"], reflectance: Float[Array, "wavelength"]) -> Array:
    """Display colour of a reflectance under an equal-energy light, IEC 61966-2-1 primaries and gamma."""
    matching = spectral.cie_xyz(wavelength)
    xyz = matching @ reflectance / matching[1].sum()
    to_rgb = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
    # equal-energy white is brought to (1, 1, 1): the eye adapts to its light
    linear = np.clip((to_rgb @ xyz) / (to_rgb @ (matching.sum(axis=1) / matching[1].sum())), 0, 1)
    return np.where(linear <= 0.0031308, 12.92 * linear, 1.055 * linear ** (1 / 2.4) - 0.055)
