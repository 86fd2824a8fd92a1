"""Lens prescriptions through optiland (extra ``optics``), alone and in the frame.

Sequential rays through the surfaces of a relay or a spectrometer give spots, wavefront, distortion and
vignetting, as in the paper's lens-design program (§3.2, Fig. 11). `with_lens` writes them into a sensor's
design. Rays that are reflected twice are in `ghosts`; scatter is not traced, see docs/theory/limitations.md.
"""

import math
import warnings
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
import xarray as xr
from jaxtyping import Float
from numba import NumbaIRAssumptionWarning
from numpy.typing import ArrayLike
from pydantic import Field, model_validator

from glintrack.core.arrays import Array
from glintrack.core.designs import Design, validate_design
from glintrack.core.distortion import Distortion
from glintrack.core.installation import data_file, read_data, require_extra
from glintrack.io.toml import read_toml
from glintrack.io.untrusted import is_file, plain
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.lens_kernels import FIELD_NODES

_F_NUMBER_ERROR = 0.05  # between the design's and the prescription's, on the image's side
_TILT = 3  # Noll's indices to here are piston and tilts: distortion has them
_MIN_NM = 0.05  # of a coefficient; 1/10000 of a wave changes no picture
RINGS = 6  # of the hexapolar pattern of rays

_Field = Annotated[float, Field(ge=-1e6, le=1e6)]
_Wavelength = Annotated[float, Field(gt=0, le=30)]


class LensSurface(Design):
    """One surface of a prescription, in the order of the light."""

    radius_mm: float | None = Field(default=None, ge=-1e7, le=1e7)
    """Of curvature; flat if left out."""
    thickness_mm: float = Field(ge=-1e6, le=1e6, description="To the next surface; negative after a mirror")
    material: str = "air"
    """Behind it: air, mirror, or a glass by its catalogue name."""
    conic: float = Field(default=0.0, ge=-1e3, le=1e3)
    stop: bool = False
    reflectance: float | None = Field(default=None, ge=0, lt=1)
    """Of its coating, where it is glass; bare if left out."""
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
            raise ValueError(f"`lens.surfaces` must have one stop; got {stops}.")
        return self


def lens_names() -> list[str]:
    """Names of the packaged prescriptions."""
    return sorted(path.stem for path in data_file("lenses").glob("*.toml"))


def read_lens(name: str) -> LensDesign:
    """Read a packaged prescription by name, or a user's TOML file.

    Raises
    ------
    ValueError
        If it cannot be read or is no prescription.
    """
    if name not in lens_names():
        if not is_file(Path(name)):
            known = ", ".join(lens_names())
            raise ValueError(f"`lens` must be one of {known} or a readable TOML file; got {name}.")
        if name.lower().endswith(".zmx"):
            convert = f"python docs/howto/my_zemax_lens.py {name} lens.toml"
            raise ValueError(f"`lens` must be a TOML file; got the Zemax file {name}. Convert it: {convert}")
        return validate_design(LensDesign, read_toml(name, "lens"))
    return validate_design(LensDesign, read_data("lenses", f"{name}.toml"))


def build_optic(lens: LensDesign) -> Any:
    """Build the optiland ``Optic`` of a prescription.

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
                f"`surfaces.{index - 1}.material` must be air, mirror or a glass of the catalogues; got "
                f"{surface.material!r}. {plain(hint)}"
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
    optic: Any, lens: LensDesign, place_mm: ArrayLike, wavelength_um: float, rings: int = RINGS
) -> Float[Array, "surface ray 3"]:
    """(x, y, z) of the rays of one place on the object at every surface; NaN where blocked. [mm]"""
    hx, hy = np.array(place_mm) / _reach(lens)
    optic.trace(Hx=hx, Hy=hy, wavelength=wavelength_um, num_rays=rings, distribution="hexapolar")
    return np.stack([np.asarray(getattr(optic.surfaces, axis)) for axis in "xyz"], axis=-1)


def launch_rays(optic: Any, lens: LensDesign, field: int, wavelength_um: float, rays: int) -> Any:
    """Optiland's rays of one field before the first surface, evenly over the pupil's area."""
    k = np.arange(rays)
    radius, azimuth = np.sqrt((k + 0.5) / rays), k * np.pi * (3 - np.sqrt(5))  # Vogel's sunflower
    hx, hy = np.tile(np.array(lens.fields_mm[field]) / _reach(lens), (rays, 1)).T
    px, py = radius * np.cos(azimuth), radius * np.sin(azimuth)
    return optic.ray_tracer.ray_generator.generate_rays(hx, hy, px, py, wavelength_um)


def image_of(
    lens: LensDesign, objects_mm: Float[Array, "place 2"], wavelength_um: float
) -> tuple[Float[Array, "place 2"], Float[Array, "place"], Float[Array, "place"]]:
    """Centroids (x, y) of the images of places [mm], RMS spots [µm], and shares of rays that arrive [1]."""
    optic, passed = build_optic(lens), np.zeros(len(objects_mm))
    centres, spots = np.full((len(objects_mm), 2), np.nan), np.full(len(objects_mm), np.nan)
    for k, place in enumerate(objects_mm):
        image = ray_paths(optic, lens, place, wavelength_um)[-1, :, :2]
        arrived = np.isfinite(image).all(axis=1)
        passed[k] = arrived.mean()
        if arrived.any():
            centres[k] = image[arrived].mean(axis=0)
            spots[k] = 1e3 * np.sqrt(((image[arrived] - centres[k]) ** 2).sum(axis=1).mean())
    return centres, spots, passed


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
    """Distance of the outermost field from the axis, optiland's unit of fields. [mm]"""
    return max(np.hypot(x, y) for x, y in lens.fields_mm) or 1.0


def lens_quality(lens: LensDesign) -> xr.Dataset:
    """Spots, image positions, distortion and vignetting of a prescription.

    Returns
    -------
    Over field and wavelength: ``spot_rms`` about the spot's centroid [µm], ``image_x`` and ``image_y`` of
    that centroid [mm], ``distortion``, its distance from the best magnification of the object [mm], and
    ``passed``, the share of rays that arrive [1].
    """
    fields = np.array(lens.fields_mm)
    found = [image_of(lens, fields, wavelength) for wavelength in lens.wavelengths_um]
    centre, spread, passed = (np.stack(parts, axis=1) for parts in zip(*found, strict=True))
    # distance of each image from magnification × object + shift, fitted for each wavelength
    residual = np.full(spread.shape, np.nan)
    for j in range(spread.shape[1]):
        known = np.isfinite(centre[:, j]).all(axis=1)
        if known.sum() >= 2:
            objects = fields[known] - fields[known].mean(axis=0)
            images = centre[known, j] - centre[known, j].mean(axis=0)
            magnification = (objects * images).sum() / (objects**2).sum()
            residual[known, j] = np.hypot(*(images - magnification * objects).T)
    dims = ("field", "wavelength")
    return xr.Dataset(
        {
            "spot_rms": (dims, spread, {"units": "um"}),
            "image_x": (dims, centre[..., 0], {"units": "mm"}),
            "image_y": (dims, centre[..., 1], {"units": "mm"}),
            "distortion": (dims, residual, {"units": "mm"}),
            "passed": (dims, passed, {"units": "1"}),
        },
        coords={"wavelength": ("wavelength", np.array(lens.wavelengths_um), {"units": "um"})},
    )


def with_lens(design: SensorDesign) -> SensorDesign:
    """Set aberrations, distortion and vignetting of a design from its prescription.

    Parameters
    ----------
    design
        Returned unchanged without ``optics.lens``.

    Returns
    -------
    The design with ``field_zernikes_rms_nm``, ``distortion`` and ``vignetting`` of ``optics`` set and
    ``lens`` empty.

    Raises
    ------
    ValueError
        If the extra ``optics`` is missing, or the prescription is invalid, does not reach the array's
        corners or has another F-number.

    Notes
    -----
    The middle of the prescription's fields images to the middle of the array; the image's x is to the right
    and its y up. Rays are those of the middle of the band, for all wavelengths. The design's focal length
    and principal point represent the best-fitting scale down the image and shift; the distortion adds another
    scale across and Brown's polynomials.
    """
    optics = design.optics
    if not optics.lens:
        return design
    lens = read_lens(optics.lens)
    wavelength_um = sum(design.band_um) / 2
    objects, magnification = _objects(design, lens, wavelength_um)
    found = abs(magnification) * lens.f_number
    if abs(found / design.f_number - 1) > _F_NUMBER_ERROR:
        raise ValueError(
            f"`sensor.f_number` must be the lens's, {found:.2f} on the image's side of {lens.name}; "
            f"got {design.f_number:g}."
        )
    places, _, passed = image_of(lens, objects.reshape(-1, 2), wavelength_um)
    if not np.isfinite(places).all():
        raise ValueError(f"`sensor.optics.lens` must image the whole array; got a dark part by {lens.name}.")
    errors_nm = 1e3 * path_errors_um(lens, objects.reshape(-1, 2), wavelength_um)
    # prescriptions count the path's error the other way round
    nodes = [
        {k: round(-float(v), 3) for k, v in enumerate(node, 1) if k > _TILT and abs(v) >= _MIN_NM}
        for node in errors_nm
    ]
    zernikes = tuple(tuple(nodes[k : k + FIELD_NODES]) for k in range(0, len(nodes), FIELD_NODES))
    # light lost relative to the middle, by the best fit in the square of the distance
    rows, columns = (np.linspace(-n, n, FIELD_NODES) for n in (design.rows, design.columns))
    height2 = (rows[:, None] ** 2 + columns**2) / math.hypot(design.rows, design.columns) ** 2
    passed = passed.reshape(objects.shape[:2])
    lost = 1 - passed / float(passed[FIELD_NODES // 2, FIELD_NODES // 2])
    update = {
        "lens": "",
        "field_zernikes_rms_nm": zernikes,
        "distortion": _distortion(objects.reshape(-1, 2) * magnification, places, design.focal_length_mm),
        "vignetting": float(np.clip((lost * height2).sum() / (height2**2).sum(), 0, 0.99)),
    }
    return design.model_copy(update={"optics": optics.model_copy(update=update)})


def _objects(
    design: SensorDesign, lens: LensDesign, wavelength_um: float
) -> tuple[Float[Array, "row column 2"], float]:
    """Places on the object, from the top left, of nodes over the array; and the magnification. [mm]"""
    fields = np.array(lens.fields_mm)
    low, high = fields.min(axis=0), fields.max(axis=0)
    low[0], high[0] = min(low[0], -high[0]), max(high[0], -low[0])  # a prescription is even in x
    middle, step = (low + high) / 2, 1e-3 * max(np.ptp(fields), 1.0)
    around = middle + np.array([[-step, 0], [step, 0], [0, -step], [0, step]])
    near, *_ = image_of(lens, around, wavelength_um)
    magnification = float((near[1, 0] - near[0, 0] + near[3, 1] - near[2, 1]) / (4 * step))
    half = np.array([design.columns, design.rows]) / 2 * design.pitch_um * 1e-3
    reach = half / abs(magnification)
    allowed = (high - low) / 2 * 1.01
    if (reach > allowed).any():
        width, height = 2 * allowed * abs(magnification)
        raise ValueError(
            f"`sensor.optics.lens` must reach the array's corners; got {lens.name} for {width:.1f} × "
            f"{height:.1f} mm and an array of {2 * half[0]:.1f} × {2 * half[1]:.1f} mm."
        )
    nodes = np.linspace(-1, 1, FIELD_NODES)
    right, up = np.meshgrid(nodes * half[0], -nodes * half[1])
    return middle + np.stack([right, up], axis=-1) / magnification, magnification


def _distortion(ideal_mm: Array, image_mm: Array, focal_mm: float) -> Distortion:
    """Coefficients of the best fit to the images, together with a shift and a scale."""
    x, y = ((ideal_mm - ideal_mm.mean(axis=0)) / focal_mm).T
    moved = (image_mm - image_mm.mean(axis=0)) / focal_mm - np.stack([x, y], axis=-1)
    y, moved_y = -y, -moved[:, 1]  # down
    r2 = x * x + y * y
    one, none = np.ones_like(x), np.zeros_like(x)
    across = [x * r2, x * r2**2, 2 * x * y, r2 + 2 * x * x, x, y, x, one, none]
    down = [y * r2, y * r2**2, r2 + 2 * y * y, 2 * x * y, none, none, y, none, one]
    columns = np.concatenate([np.stack(across, axis=-1), np.stack(down, axis=-1)])
    scale = np.linalg.norm(columns, axis=0)
    fitted = np.linalg.lstsq(columns / scale, np.concatenate([moved[:, 0], moved_y]), rcond=None)[0] / scale
    k1, k2, p1, p2, b1, b2 = (float(v) for v in fitted[:6])
    return Distortion(k1=k1, k2=k2, p1=p1, p2=p2, b1=b1, b2=b2)
