"""A design on one wavelength grid: channels, responsivities, lens and calibration of its elements."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from glintrack.camera import Camera, Pose, project
from glintrack.core.arrays import Array
from glintrack.core.spectral import channel_weights
from glintrack.devices import EtalonDesign, etalon
from glintrack.sensor.design import SensorDesign
from glintrack.sensor.fixed_pattern import FixedPattern, build_fixed_pattern, departure_at_incidence
from glintrack.sensor.layouts import analyser_matrix, condition_number, invert, pan_element, places
from glintrack.sensor.lens import with_lens
from glintrack.sensor.lens_kernels import LensKernels, lens_kernels
from glintrack.sensor.polarizer import Polarizer, load_polarizer
from glintrack.sensor.response import (
    analyser_response,
    electrons,
    element_response,
    filtered_response,
    photon_gain,
    photon_weights,
    reference_light,
    spectrometer_bands,
    spectrometer_response,
)
from glintrack.stokes import rotate_qu

ETALON_STEPS = 60  # gaps of a sweep, in equal times
_NOTHING = 1e-12  # of the bare response: rounding in an analyser row


@dataclass(frozen=True)
class Sensor:
    """A design on one wavelength grid.

    Parameters
    ----------
    design
        The user's design, with the values of its lens prescription.
    camera
        Its geometry, in elements.
    wavelength_um
        Grid of the radiance. [µm]
    channels
        Spectral weights for the renderer: pan first, then those of the polarizers' analyser rows and of the
        filters, where they have another shape. [1]
    planes
        (channel, Stokes component) of all planes of light that some element responds to.
    element_gains
        Electrons of each element of the superpixel per unit of each plane.
    stokes_gains
        Electrons of each element per unit of band-mean S0, S1 and S2 in light of the reference spectrum, as
        calibrated.
    diattenuation
        Of the polarizers, for the reference spectrum, on average. [1]
    stokes_matrix
        (3, polarizer): from the polarizers' readings to S0, S1, S2; None without polarizers. [1]
    condition
        Condition number of the matrix that it inverts. [1]
    kernels
        Lens kernels of each channel, on a grid of one cell an element.
    pattern
        The elements' own gains and offsets, true and calibrated.
    band_centre_um, band_weights, band_electrons_per_radiance
        The spectrometer's bands: centres, weights on the grid, electrons per unit of radiance. [µm, 1, e]
    sweep_electrons
        If the mirrors are etalons: electrons at each gap of a sweep per unit of radiance in each band.
    exposure_part
        This frame's exposure over the original design's; see `next_exposure_ms`. [1]
    """

    design: SensorDesign
    camera: Camera
    wavelength_um: Float[Array, "wavelength"]
    channels: Float[Array, "channel wavelength"]
    planes: tuple[tuple[int, int], ...]
    element_gains: Float[Array, "side side plane"]
    stokes_gains: Float[Array, "side side 3"]
    diattenuation: float
    stokes_matrix: Float[Array, "3 polarizer"] | None
    condition: float
    kernels: tuple[LensKernels, ...]
    pattern: FixedPattern
    band_centre_um: Float[Array, "band"]
    band_weights: Float[Array, "band wavelength"]
    band_electrons_per_radiance: Float[Array, "band"]
    sweep_electrons: Float[Array, "gap band"] | None = None
    exposure_part: float = 1.0

    def superpixel_of(self, enu: Float[Array, "point 3"], pose: Pose) -> Int[Array, "point 2"]:
        """(row, column) of the superpixel with the *mirror* nearest to each point, −1 off the array."""
        element = project(self.camera, pose, np.asarray(enu, dtype=float).reshape(-1, 3))
        side = self.side
        index = np.round((np.nan_to_num(element, nan=-9.0) - np.array(self.mirror_element)) / side)
        size = np.array([self.design.rows // side, self.design.columns // side])
        inside = np.all((index >= 0) & (index < size), axis=1)
        return np.where(inside[:, None], index, -1).astype(int)

    @property
    def electrons_per_reading(self) -> Float[Array, "side side"]:
        """Electrons of each element per unit of band-mean radiance of unpolarized light."""
        return self.stokes_gains[..., 0]

    @property
    def side(self) -> int:
        """Elements along a superpixel."""
        return len(self.design.superpixel)

    @property
    def pan_weights(self) -> Float[Array, "1 wavelength"]:
        """Photon-weighted response of a bare element; its product with a spectrum is the band mean. [1]"""
        return self.channels[:1]

    @property
    def electrons_per_radiance(self) -> float:
        """Electrons a bare element collects for a band-mean radiance of 1 W m⁻² sr⁻¹ µm⁻¹."""
        return photon_gain(self.design, self.wavelength_um, element_response(self.design, self.wavelength_um))

    @property
    def mirror_element(self) -> tuple[int, int]:
        """(row, column) of the micromirror in the superpixel; without one, of the element of pan."""
        return self.pan_element or (0, 0)

    @property
    def pan_element(self) -> tuple[int, int] | None:
        """(row, column) of the element of pan: the mirror, else an open one; None where pan is S0."""
        return pan_element(self.design.superpixel)


def build_sensor(
    design: SensorDesign, wavelength_um: Float[Array, "wavelength"], polarizer: Polarizer | None = None
) -> Sensor:
    """Camera, channels, responsivities, lens and calibration of a design.

    Parameters
    ----------
    wavelength_um
        Grid of the radiance, covering its bands. [µm]
    polarizer
        Polarizer over its elements; the design's by default.

    Raises
    ------
    ValueError
        If a band reaches beyond the grid, a table or curve does not cover the band, or the polarizers do not
        determine the Stokes vector.
    """
    wavelength_um = np.asarray(wavelength_um, dtype=float)
    if not design.has_mirror:  # and so no spectrometer
        design = design.model_copy(update={"spectrometer_um": design.band_um})
    for name in ("band_um", "spectrometer_um"):
        low, high = getattr(design, name)
        if low < wavelength_um[0] - 1e-9 or high > wavelength_um[-1] + 1e-9:
            raise ValueError(
                f"`sensor.{name}` must lie within the atmosphere's {wavelength_um[0]:g} to "
                f"{wavelength_um[-1]:g} µm; got {low:g} to {high:g}."
            )
    design = with_lens(design)
    polarizer = load_polarizer(design) if polarizer is None else polarizer
    elements = _elements(design, polarizer, wavelength_um)
    measured = elements.pop("analysers")
    matrix, condition = None, 1.0
    if design.has_stokes:
        condition = condition_number(measured)
        matrix = invert(measured)  # an ideal formula on polarizers that cannot be inverted would be no better
        if design.stokes == "fesenkov":
            matrix = invert(analyser_matrix(design.superpixel, 1.0))
    centres, bands = spectrometer_bands(design, wavelength_um)
    width, time_ms = design.spectrometer_bandwidth_um, design.spectrometer_integration_time_ms
    efficiency = np.interp(centres, wavelength_um, spectrometer_response(design, wavelength_um))
    if design.has_mirror and not np.all(efficiency > 0):
        raise ValueError(
            "`sensor.spectrometer_um` must lie where the elements respond; got no response at "
            f"{centres[efficiency <= 0][0]:g} µm. Set it, or quantum_efficiency."
        )
    size, distortion = (design.rows, design.columns), design.optics.distortion
    slant = departure_at_incidence(design, polarizer, wavelength_um, elements["channels"][0])
    return Sensor(
        design=design,
        camera=Camera(design.focal_length_m, design.pitch_m, *size, distortion=distortion),
        wavelength_um=wavelength_um,
        stokes_matrix=matrix,
        condition=condition,
        kernels=lens_kernels(design, wavelength_um, elements["channels"]),
        pattern=build_fixed_pattern(design, slant),
        band_centre_um=centres,
        band_weights=channel_weights(wavelength_um, bands),
        band_electrons_per_radiance=np.array(
            [electrons(design, x * width * e, time_ms) for x, e in zip(centres, efficiency, strict=True)]
        ),
        sweep_electrons=_sweep_electrons(design, centres, efficiency),
        **elements,
    )


def _sweep_electrons(design: SensorDesign, centres_um: Array, efficiency: Array) -> Array | None:
    """Electrons (gap, band) of an etalon's sweep, its integration time shared evenly by the gaps."""
    if design.spectrometer != "etalon":
        return None
    if len(centres_um) < 4:
        raise ValueError(
            f"`sensor.spectrometer` must have four bands at least to sweep an etalon; got {len(centres_um)}."
        )
    mirror = EtalonDesign(gap_count=ETALON_STEPS)
    gaps_um = mirror.gaps_um
    passed = etalon.responses(mirror, gaps_um, centres_um)
    weights_um2 = etalon.sweep_weights(passed, efficiency)
    return weights_um2 * electrons(design, 1.0, design.spectrometer_integration_time_ms / len(gaps_um))


def _elements(design: SensorDesign, polarizer: Polarizer, wavelength_um: Array) -> dict[str, Any]:
    """Channels and planes of light, and the response of each element of the superpixel to them."""
    bare = element_response(design, wavelength_um)
    channels = [photon_weights(wavelength_um, bare)]
    light = reference_light(design, wavelength_um)
    mean = channels[0] @ light
    if not mean > 0:
        raise ValueError("`sensor.reference_spectrum` must have light in the pan band; got none.")
    own = []  # of the analyser row about the pass axis: channel and electrons of each component
    for curve in analyser_response(design, polarizer, wavelength_um) if design.has_stokes else ():
        if np.abs(curve).max() <= _NOTHING * bare.max():
            own.append((0, 0.0))
            continue
        channel, sign = _channel_of(channels, photon_weights(wavelength_um, curve))
        own.append((channel, sign * photon_gain(design, wavelength_um, np.abs(curve))))
    rows = {}  # element -> plane -> electrons
    for i, row in enumerate(design.superpixel):
        for j, what in enumerate(row):
            if not isinstance(what, str):
                rows[i, j] = _rotate_row(own, 2 * math.radians(what))
                continue
            curve = filtered_response(design, what, wavelength_um)
            channel, _ = _channel_of(channels, photon_weights(wavelength_um, curve))
            rows[i, j] = {(channel, 0): photon_gain(design, wavelength_um, curve)}
    seen = {plane for gains in rows.values() for plane, gain in gains.items() if gain}
    # Q and U of a channel always both: they mix in an element with an axis error
    planes = tuple(sorted({(c, k) for c, part in seen for k in ((0,) if part == 0 else (1, 2))}))
    side = len(design.superpixel)
    gains = np.array([[[rows[i, j].get(p, 0.0) for p in planes] for j in range(side)] for i in range(side)])
    known = np.zeros((side, side, 3))  # electrons of the reference light, were it all I, Q or U
    for k, (channel, component) in enumerate(planes):
        known[..., component] += gains[..., k] * (channels[channel] @ light) / mean
    if not np.all(known[..., 0] > 0):
        raise ValueError("`sensor.band_um` must hold light that the elements respond to; got none.")
    polarizers = places(design.superpixel, "polarizer")
    analysers = np.array([known[place] / known[place][0] for place in polarizers]).reshape(-1, 3)
    return {
        "channels": np.stack(channels),
        "planes": planes,
        "element_gains": gains,
        "stokes_gains": known,
        "diattenuation": float(np.hypot(analysers[:, 1], analysers[:, 2]).mean()) if polarizers else 1.0,
        "analysers": analysers,
    }


def _rotate_row(own: list[tuple[int, float]], angle: float) -> dict[tuple[int, int], float]:
    """Electrons per plane with the pass axis rotated by half an angle; see `stokes.rotation_mueller`."""
    (total, t), (along, q), (slanted, u) = own
    cos2, sin2, found = math.cos(angle), -math.sin(angle), {(total, 0): t}
    rotated = rotate_qu.py_func  # of a few numbers: not worth compiling
    for channel, parts in ((along, rotated(q, 0.0, cos2, sin2)), (slanted, rotated(0.0, u, cos2, sin2))):
        for component, gain in enumerate(parts, start=1):
            found[channel, component] = found.get((channel, component), 0.0) + gain
    return found


def _channel_of(channels: list[Array], weights: Array) -> tuple[int, float]:
    """Index of the channel with these weights up to their sign, and the sign; add it if it is new."""
    for k, known in enumerate(channels):
        for sign in (1.0, -1.0):
            if np.allclose(weights, sign * known, rtol=1e-9, atol=1e-12):
                return k, sign
    channels.append(weights)
    return len(channels) - 1, 1.0


def noise_equivalent_radiance(sensor: Sensor) -> float:
    """RMS of the dark noise (dark current, read, quantizer) of a bare element. [W m⁻² sr⁻¹ µm⁻¹]"""
    return sensor.design.dark_noise_e / sensor.electrons_per_radiance


def summary(sensor: Sensor) -> list[tuple[str, str]]:
    """Names and values of derived quantities: field of view, electrons, noise, polarizers."""
    design = sensor.design
    reading = sensor.electrons_per_radiance
    full, half = design.saturation_e / reading, design.saturation_e / 2
    kernel = sensor.kernels[0]
    node = kernel.strength.shape[0] // 2
    rows = [
        ("lens", f"{design.focal_length_mm:g} mm F/{design.f_number:g}"),
        ("field of view", " × ".join(f"{angle:.2f}°" for angle in design.field_of_view_deg)),
        ("electrons per W m⁻² sr⁻¹ µm⁻¹", f"{reading:.1f}"),
        ("radiance that fills the well", f"{full:.1f} W m⁻² sr⁻¹ µm⁻¹"),
        ("noise in the dark", f"{noise_equivalent_radiance(sensor):.3g} W m⁻² sr⁻¹ µm⁻¹"),
        ("", f"{design.dark_noise_e:.1f} e"),
        ("signal to noise, half full", f"{half / math.sqrt(design.noise_variance_e2(half)):.0f}"),
        ("light on the element it belongs to", f"{kernel.at(node, node).max():.3f}"),
    ]
    if design.has_stokes:
        rows += [
            ("diattenuation over the band", f"{sensor.diattenuation:.4f}"),
            ("DoLP lost by the ideal formula", f"{1 - sensor.diattenuation:.4f} of it"),
            ("condition number of the polarizers", f"{sensor.condition:.3f}"),
        ]
    if design.has_mirror:
        bands = len(sensor.band_centre_um)
        rows.append(("spectrometer", f"{bands} bands, {design.spectrometer}"))
    return rows
