"""Ghosts of a lens prescription: light that is reflected twice on its way to the image.

Every pair of surfaces that may reflect is unfolded into a prescription of its own. The rays of the lens are
traced through it: forward to the later surface, back to the earlier one, forward to the image. The later
surface may be the detector array, the earlier one the object. This is the two-reflection part of the paper's
stray-light program (§3.2); scatter, edges and mounts need non-sequential tracing.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.sensor.lens import LensDesign, LensSurface, build_optic, launch_rays

# of bare silicon at 0.6 µm: ((3.9 − 1)/(3.9 + 1))²; Green, Sol. Energy Mater. Sol. Cells 92, 1305 (2008)
SILICON = 0.35
_MAX_INDEX = 5.0  # above that of any glass


@dataclass(frozen=True)
class Ghost:
    """One path of two reflections.

    Parameters
    ----------
    later, earlier
        Reflecting surfaces in the order of the light: 0 is the object, 1 the prescription's first, one
        more than its last the image.
    share
        Light in the ghost over light in the image. [1]
    spot_rms_um
        RMS radius about its centroid; an even disc has √2 times that as radius. [µm]
    shift_um
        Shift of its centroid from the image, right and up. [µm]
    """

    later: int
    earlier: int
    share: float
    spot_rms_um: float
    shift_um: tuple[float, float]

    def on_element(self, pitch_um: float) -> float:
        """Light on an element in the ghost of a point, over the point's own light on an element. [1]"""
        return self.share * min(1.0, pitch_um**2 / max(2 * np.pi * self.spot_rms_um**2, 1e-12))


def ghosts(
    lens: LensDesign,
    field: int = 0,
    wavelength_um: float | None = None,
    image_reflectance: float = SILICON,
    object_reflectance: float = 0.0,
    rays: int = 200,
) -> list[Ghost]:
    """Ghosts of one field of a prescription, the most light first.

    Parameters
    ----------
    lens
        The prescription. Glass reflects by Fresnel's formula at normal incidence or by its ``reflectance``.
    field
        Index among its ``fields_mm``.
    wavelength_um
        The middle one of the prescription by default. [µm]
    image_reflectance, object_reflectance
        Reflectance of the detector array, and of the object plane. [1]
    rays
        Number of rays of each path, evenly over the pupil.

    Returns
    -------
    All pairs with light on the image. Paths back over a grating are left out: it diffracts them elsewhere.

    Raises
    ------
    ValueError
        If the extra ``optics`` is not installed.
    """
    if wavelength_um is None:
        wavelength_um = lens.wavelengths_um[len(lens.wavelengths_um) // 2]
    optic = build_optic(lens)
    index = np.abs(np.ravel(optic.surfaces.n(wavelength_um)).astype(float))
    reflectance = [object_reflectance]
    for k, surface in enumerate(lens.surfaces, start=1):  # none of mirrors, which lose no light
        bare = float(((index[k] - index[k - 1]) / (index[k] + index[k - 1])) ** 2)
        coated = bare if surface.reflectance is None else surface.reflectance
        reflectance.append(0.0 if surface.material == "mirror" else coated)
    reflectance.append(image_reflectance)
    signal = _image_points(optic, launch_rays(optic, lens, field, wavelength_um, rays))
    found = []
    for later in range(1, len(lens.surfaces) + 2):
        for earlier in range(later):
            light = float(reflectance[later] * reflectance[earlier])
            between = lens.surfaces[earlier : later - 1]
            if light == 0 or any(surface.grating_period_um is not None for surface in between):
                continue
            light *= float(np.prod([1 - reflectance[k] for k in range(earlier + 1, later)])) ** 2
            light_rays = launch_rays(optic, lens, field, wavelength_um, rays)
            spot = _image_points(build_optic(unfold(lens, later, earlier)), light_rays)
            if not len(spot) or not len(signal):
                continue
            shift = 1e3 * (spot.mean(axis=0) - signal.mean(axis=0))
            spread = 1e3 * float(np.sqrt(((spot - spot.mean(axis=0)) ** 2).sum(axis=1).mean()))
            share = light * len(spot) / len(signal)
            found.append(Ghost(later, earlier, share, spread, (float(shift[0]), float(shift[1]))))
    return sorted(found, key=lambda ghost: -ghost.share)


def unfold(lens: LensDesign, later: int, earlier: int) -> LensDesign:
    """Unfold the prescription of a ghost: to ``later``, back to ``earlier``, and to the image."""
    count = len(lens.surfaces)
    media = ["air"]  # behind the object and each surface; the same before a mirror and behind it
    for surface in lens.surfaces:
        media.append(media[-1] if surface.material == "mirror" else surface.material)
    first_mm = lens.object_distance_mm
    places = np.cumsum([-first_mm, first_mm, *(surface.thickness_mm for surface in lens.surfaces)])
    path = [*range(1, later), later, *range(later - 1, earlier, -1), earlier, *range(earlier + 1, count + 1)]
    turns = (later - 1, 2 * later - earlier - 1)
    surfaces = []
    for step, (k, after) in enumerate(zip(path, [*path[1:], count + 1], strict=True)):
        own = lens.surfaces[k - 1] if 1 <= k <= count else LensSurface(thickness_mm=0.0)
        if step in turns or own.material == "mirror":
            material = "mirror"
        else:
            material = media[k - 1 if turns[0] < step < turns[1] else k]
        change = {"thickness_mm": float(places[after] - places[k]), "material": material, "stop": step == 0}
        surfaces.append(own.model_copy(update=change))
    return lens.model_copy(update={"surfaces": tuple(surfaces)})


def with_window(
    lens: LensDesign,
    thickness_mm: float,
    gap_mm: float,
    material: str = "N-BK7",
    reflectance: float | None = None,
) -> LensDesign:
    """Put a plane window before the image, which moves back by the focus shift of the glass.

    Parameters
    ----------
    thickness_mm, gap_mm
        Thickness of the window, and its distance from the image. [mm]
    material
        A glass by its catalogue name.
    reflectance
        Reflectance of each face; that of bare glass by default. [1]

    Raises
    ------
    ValueError
        If there is no room for it before the image.
    """
    last = lens.surfaces[-1]
    before_mm = abs(last.thickness_mm)
    unfit = (
        f"`window` must fit into the {before_mm:g} mm before the image; "
        f"got {thickness_mm:g} mm and a gap of {gap_mm:g} mm."
    )
    if not (0 < thickness_mm <= _MAX_INDEX * before_mm and 0 <= gap_mm <= before_mm):
        raise ValueError(unfit)
    way = float(np.copysign(1.0, last.thickness_mm))
    plate = LensSurface(thickness_mm=way * thickness_mm, material=material, reflectance=reflectance)
    behind = LensSurface(thickness_mm=way * gap_mm, reflectance=reflectance)
    middle = lens.wavelengths_um[len(lens.wavelengths_um) // 2]
    probe = lens.model_copy(update={"surfaces": (*lens.surfaces, plate, behind)})
    index = float(np.ravel(build_optic(probe).surfaces.n(middle))[len(lens.surfaces) + 1])
    room_mm = before_mm - gap_mm - thickness_mm / index
    if not room_mm > 0:
        raise ValueError(unfit)
    before = last.model_copy(update={"thickness_mm": way * room_mm})
    return lens.model_copy(update={"surfaces": (*lens.surfaces[:-1], before, plate, behind)})


def _image_points(optic: Any, rays: Any) -> Float[Array, "ray 2"]:
    """Points where rays meet the image. [mm]"""
    optic.surfaces.trace(rays)
    places = np.stack([np.asarray(getattr(optic.surfaces, axis))[-1] for axis in "xy"], axis=-1)
    return places[np.isfinite(places).all(axis=1)]
