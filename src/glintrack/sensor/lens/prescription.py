"""Lens prescriptions through optiland (extra ``optics``): spots, wavefront, distortion, vignetting, rays.

It stands for the paper's lens-design program (§3.2, Fig. 11): sequential rays through the surfaces of a relay
or a spectrometer. Rays that are reflected twice are in `ghosts`; scatter is not traced, see docs/limits.md.
"""

import tomllib
import warnings
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import xarray as xr
from jaxtyping import Float
from numba.core.errors import NumbaIRAssumptionWarning
from pydantic import Field, model_validator

from glintrack.core.arrays import Array
from glintrack.core.designs import Design, validated
from glintrack.core.extras import require_extra
from glintrack.io.toml import read_toml
from glintrack.io.untrusted import is_file, plain

RINGS = 6  # of the hexapolar pattern of rays

_Field = Annotated[float, Field(ge=-1e6, le=1e6)]
_Wavelength = Annotated[float, Field(gt=0, le=30)]


class LensSurface(Design):
    """One surface of a prescription, in the order light meets them."""

    radius_mm: float | None = Field(
        default=None, ge=-1e7, le=1e7, description="Of curvature; flat if left out"
    )
    thickness_mm: float = Field(ge=-1e6, le=1e6, description="To the next surface; negative after a mirror")
    material: str = Field(
        default="air", description="Behind it: air, mirror, or a glass by its catalogue name"
    )
    conic: float = Field(default=0.0, ge=-1e3, le=1e3)
    stop: bool = False
    reflectance: float | None = Field(
        default=None, ge=0, lt=1, description="Of its coating, where it is glass; bare if left out"
    )
    grating_period_um: float | None = Field(default=None, gt=0, le=1e6, description="Grooves across y")
    grating_order: int = Field(default=-1, ge=-1000, le=1000)


class LensDesign(Design):
    """A prescription with its object, aperture and fields."""

    name: str = Field(min_length=1, max_length=80)
    object_distance_mm: float = Field(gt=0, le=1e9)
    f_number: float = Field(ge=0.5, le=64, description="On the object's side")
    telecentric: bool = False
    fields_mm: tuple[tuple[_Field, _Field], ...] = Field(min_length=1, description="(x, y) on the object")
    wavelengths_um: tuple[_Wavelength, ...] = Field(min_length=1)
    surfaces: tuple[LensSurface, ...] = Field(min_length=1)

    @model_validator(mode="after")
    def _one_stop(self) -> Self:
        stops = sum(surface.stop for surface in self.surfaces)
        if stops != 1:
            raise ValueError(f"`lens.surfaces` must have one stop, got {stops}")
        return self


def lens_names() -> list[str]:
    """Prescriptions that come with the package."""
    folder = resources.files("glintrack") / "data" / "lenses"
    return sorted(p.name.removesuffix(".toml") for p in folder.iterdir() if p.name.endswith(".toml"))


def read_lens(name: str) -> LensDesign:
    """A packaged prescription by name, or a user's TOML file.

    Raises
    ------
    ValueError
        If it cannot be read or is no prescription.
    """
    if name not in lens_names():
        if not is_file(Path(name)):
            known = ", ".join(lens_names())
            raise ValueError(f"`lens` must be one of {known} or a readable TOML file, got {name}")
        return validated(LensDesign, read_toml(name, "lens"))
    packaged = resources.files("glintrack") / "data" / "lenses" / f"{name}.toml"
    return validated(LensDesign, tomllib.loads(packaged.read_text(encoding="utf-8")))


def build_optic(lens: LensDesign) -> Any:
    """The prescription as an optiland ``Optic``.

    Raises
    ------
    MissingExtraError
        If the extra ``optics`` is not installed.
    """
    optic = require_extra("optiland.optic.optic", "optics", "trace a lens").Optic(lens.name)
    # numba's check of itself, of kernels of optiland that come out right
    warnings.filterwarnings("ignore", category=NumbaIRAssumptionWarning)
    optic.surfaces.add(index=0, thickness=lens.object_distance_mm)
    for index, surface in enumerate(lens.surfaces, start=1):
        kind: dict[str, Any] = {}
        if surface.grating_period_um is not None:
            kind = {
                "surface_type": "grating",
                "grating_order": surface.grating_order,
                "grating_period": surface.grating_period_um,
                "groove_orientation_angle": 0.0,
            }
        try:
            optic.surfaces.add(
                index=index,
                radius=np.inf if surface.radius_mm is None else surface.radius_mm,
                conic=surface.conic,
                thickness=surface.thickness_mm,
                material=surface.material,
                is_stop=surface.stop,
                **kind,
            )
        except ValueError as error:  # a glass that is not in its catalogues
            hint = "".join(str(error).partition("Did you mean")[1:]) or str(error)
            raise ValueError(
                f"`surfaces.{index - 1}.material` must be air, mirror or a glass of the catalogues, got "
                f"{surface.material!r} ({plain(hint)})"
            ) from error
    optic.surfaces.add(index=len(lens.surfaces) + 1)
    optic.set_aperture("objectNA", 0.5 / lens.f_number)
    optic.fields.set_type("object_height")
    for x, y in lens.fields_mm:
        optic.fields.add(x=x, y=y)
    optic.fields.telecentric = lens.telecentric
    middle = len(lens.wavelengths_um) // 2
    for k, wavelength in enumerate(lens.wavelengths_um):
        optic.wavelengths.add(wavelength, is_primary=k == middle)
    return optic


def ray_paths(
    optic: Any, lens: LensDesign, field: int, wavelength_um: float, rings: int = RINGS
) -> Float[Array, "surface ray 3"]:
    """(x, y, z) of the rays of one field at every surface, object to image; NaN where blocked. [mm]"""
    hx, hy = np.array(lens.fields_mm[field]) / _reach(lens)
    optic.trace(Hx=hx, Hy=hy, wavelength=wavelength_um, num_rays=rings, distribution="hexapolar")
    group = optic.surfaces
    return np.stack([np.asarray(getattr(group, axis)) for axis in "xyz"], axis=-1)


def launched(optic: Any, lens: LensDesign, field: int, wavelength_um: float, rays: int) -> Any:
    """Rays of one field before the first surface, as optiland has them, evenly over the pupil's area."""
    k = np.arange(rays)
    radius, azimuth = np.sqrt((k + 0.5) / rays), k * np.pi * (3 - np.sqrt(5))  # Vogel's sunflower
    hx, hy = np.tile(np.array(lens.fields_mm[field]) / _reach(lens), (rays, 1)).T
    px, py = radius * np.cos(azimuth), radius * np.sin(azimuth)
    return optic.ray_tracer.ray_generator.generate_rays(hx, hy, px, py, wavelength_um)


def image_of(
    lens: LensDesign, objects_mm: Float[Array, "place 2"], wavelength_um: float
) -> tuple[Float[Array, "place 2"], Float[Array, "place"]]:
    """Centroids (x, y) of the images of places on the object [mm], and the share of rays that arrive [1]."""
    optic, passed = build_optic(lens), np.zeros(len(objects_mm))
    centres = np.full((len(objects_mm), 2), np.nan)
    for k, place in enumerate(objects_mm):
        hx, hy = place / _reach(lens)
        optic.trace(Hx=hx, Hy=hy, wavelength=wavelength_um, num_rays=RINGS, distribution="hexapolar")
        image = np.stack([np.asarray(optic.surfaces.x)[-1], np.asarray(optic.surfaces.y)[-1]], axis=-1)
        arrived = np.isfinite(image).all(axis=1)
        passed[k] = arrived.mean()
        if arrived.any():
            centres[k] = image[arrived].mean(axis=0)
    return centres, passed


def path_errors_um(
    lens: LensDesign, objects_mm: Float[Array, "place 2"], wavelength_um: float, rings: int = 12
) -> Float[Array, "place term"]:
    """Noll's coefficients 1 to 37, as RMS, of the path error of the light of places on the object. [µm]"""
    optic = build_optic(lens)
    from optiland.wavefront import ZernikeOPD

    setting: dict[str, Any] = {"num_rings": rings, "zernike_type": "noll"}
    fields = (np.asarray(objects_mm) / _reach(lens)).tolist()
    found = [ZernikeOPD(optic, tuple(field), wavelength_um, **setting).coeffs for field in fields]
    return wavelength_um * np.array(found, dtype=float)


def _reach(lens: LensDesign) -> float:
    """Distance of the outermost field from the axis, in which optiland counts. [mm]"""
    return max(np.hypot(x, y) for x, y in lens.fields_mm) or 1.0


def lens_quality(lens: LensDesign) -> xr.Dataset:
    """Spots, image positions, distortion and vignetting of a prescription.

    Returns
    -------
    Over field and wavelength: ``spot_rms`` about the spot's centroid [µm], ``image_x`` and ``image_y`` of
    that centroid [mm], ``distortion``, its distance from the best magnification of the object [mm], and
    ``passed``, the share of rays that arrive [1].
    """
    optic = build_optic(lens)
    shape = (len(lens.fields_mm), len(lens.wavelengths_um))
    centre, spread, passed = np.full((*shape, 2), np.nan), np.full(shape, np.nan), np.zeros(shape)
    for i in range(shape[0]):
        for j, wavelength in enumerate(lens.wavelengths_um):
            image = ray_paths(optic, lens, i, wavelength)[-1, :, :2]
            arrived = np.isfinite(image).all(axis=1)
            passed[i, j] = arrived.mean()
            if arrived.any():
                centre[i, j] = image[arrived].mean(axis=0)
                spread[i, j] = 1e3 * np.sqrt(((image[arrived] - centre[i, j]) ** 2).sum(axis=1).mean())
    dims = ("field", "wavelength")
    return xr.Dataset(
        {
            "spot_rms": (dims, spread, {"units": "um"}),
            "image_x": (dims, centre[..., 0], {"units": "mm"}),
            "image_y": (dims, centre[..., 1], {"units": "mm"}),
            "distortion": (dims, _distortion(np.array(lens.fields_mm), centre), {"units": "mm"}),
            "passed": (dims, passed, {"units": "1"}),
        },
        coords={"wavelength": ("wavelength", np.array(lens.wavelengths_um), {"units": "um"})},
    )


def wavefront_rms(lens: LensDesign, field: int, wavelength_um: float, rays: int = 12) -> float:
    """RMS path error of one field about its best sphere and tilt. [waves]"""
    (error_um,) = path_errors_um(lens, np.array(lens.fields_mm[field : field + 1]), wavelength_um, rays)
    return float(np.hypot.reduce(error_um[4:])) / wavelength_um  # Noll's 1 to 4 are piston, tilts and focus


def _distortion(fields_mm: Array, centre: Array) -> Array:
    """Distance of each image from magnification × object + shift, fitted for each wavelength. [mm]"""
    out = np.full(centre.shape[:2], np.nan)
    for j in range(centre.shape[1]):
        found = centre[:, j]
        known = np.isfinite(found).all(axis=1)
        if known.sum() < 2:
            continue
        objects = fields_mm[known] - fields_mm[known].mean(axis=0)
        images = found[known] - found[known].mean(axis=0)
        magnification = (objects * images).sum() / (objects**2).sum()
        out[known, j] = np.hypot(*(images - magnification * objects).T)
    return out
