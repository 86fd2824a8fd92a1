"""The lens: wavefront, point spread and modulation transfer, per wavelength and place in the field.

Scalar diffraction at the pupil with Zernike aberrations and defocus, and a Gaussian spot for all other
aberrations; coefficients may vary over the field.
"""

import math
from collections import Counter

import numpy as np
import xarray as xr
from jaxtyping import Complex, Float
from scipy.special import eval_jacobi

from glintrack.core.arrays import Array
from glintrack.sensor.design import SensorDesign

PUPIL_SAMPLES = 128
EDGE_SAMPLES = 5  # of a pupil sample's side, to soften the edge
_FREQUENCIES = 200  # of a curve
_DEFOCUS = 4  # Noll's index


def pupil(
    design: SensorDesign,
    wavelength_um: float,
    field: tuple[float, float] = (0.0, 0.0),
    samples: int = PUPIL_SAMPLES,
    error_um: Float[Array, "s s"] | None = None,
) -> Complex[Array, "s s"]:
    """Complex pupil function: amplitude and wavefront.

    Parameters
    ----------
    wavelength_um
        Wavelength of the light. [µm]
    field
        (right, up) from the optical axis, relative to the distance of the corner. [1]
    samples
        Samples across the pupil's diameter.
    error_um
        Its `wavefront_um`, if that is known already. [µm]

    Raises
    ------
    ValueError
        If no light passes the pupil.
    """
    # the open share of each sample, soft at the edges
    step, obscuration = 2 / (samples - 1), design.optics.obscuration
    fine = ((np.arange(samples * EDGE_SAMPLES) + 0.5) / EDGE_SAMPLES - 0.5) * step - 1
    square = (fine**2)[:, None] + (fine**2)[None]
    inside = (square <= 1) & (square >= obscuration**2)
    amplitude = inside.reshape(samples, EDGE_SAMPLES, samples, EDGE_SAMPLES).mean(axis=(1, 3))
    if not amplitude.sum() > 0:
        raise ValueError(f"`pupil` must pass light; got obscuration {obscuration}.")
    if error_um is None:
        error_um = wavefront_um(design, field, samples)
    return amplitude * np.exp(2j * math.pi * error_um / wavelength_um)


def noll_indices(index: int) -> tuple[int, int]:
    """Radial and azimuthal order (n, m) of a Zernike polynomial by Noll's index; m < 0 is a sine.

    References
    ----------
    Noll, "Zernike polynomials and atmospheric turbulence", J. Opt. Soc. Am. 66, 207 (1976), Table I.
    """
    n = (math.isqrt(8 * index - 7) - 1) // 2
    place = index - n * (n + 1) // 2 - 1  # among those of the same n
    m = 2 * ((place + 1) // 2) if n % 2 == 0 else 2 * (place // 2) + 1
    return n, m if index % 2 == 0 else -m


def zernike(index: int, radius: Float[Array, "..."], azimuth: Float[Array, "..."]) -> Float[Array, "..."]:
    """Zernike polynomial of RMS 1 over the unit disc, by Noll's index. [1]

    Parameters
    ----------
    index
        Noll's index, from 1 (piston).
    radius, azimuth
        Place in the pupil, the radius over that of the pupil. [1, rad]
    """
    n, m = noll_indices(index)
    order = abs(m)
    k = (n - order) // 2
    radial = (-1) ** k * radius**order * eval_jacobi(k, order, 0, 1 - 2 * radius**2)
    if m == 0:
        return math.sqrt(n + 1) * radial
    wave = np.cos(order * azimuth) if m > 0 else np.sin(order * azimuth)
    return math.sqrt(2 * (n + 1)) * radial * wave


def wavefront_um(
    design: SensorDesign, field: tuple[float, float] = (0.0, 0.0), samples: int = PUPIL_SAMPLES
) -> Float[Array, "s s"]:
    """Optical path error over the pupil's square; meaningful only inside the pupil. [µm]

    Notes
    -----
    The coefficients are RMS over an unobscured pupil; over the field they are bilinear between the nodes of
    ``field_zernikes_rms_nm``.
    """
    optics = design.optics
    across_pupil = np.linspace(-1, 1, samples)
    x, y = np.meshgrid(across_pupil, across_pupil)
    r, t = np.hypot(x, y), np.arctan2(y, x)
    # array behind focus by δ: path error −δ/(8N²) at the pupil's edge, since the rays have crossed; RMS 1/√12
    added = Counter({_DEFOCUS: -1e3 * optics.defocus_um / (8 * design.f_number**2) / math.sqrt(12)})
    for node, share in _nodes_at(design, field):
        added.update({index: share * value for index, value in node.items()})
    terms = Counter(optics.zernike_rms_nm)
    terms.update(added)
    error = np.zeros_like(r)
    for index, value in terms.items():
        if value:
            error += 1e-3 * value * zernike(index, r, t)
    return error


def _nodes_at(design: SensorDesign, field: tuple[float, float]) -> list[tuple[dict[int, float], float]]:
    """Nodes of ``field_zernikes_rms_nm`` around a place, and their weights. [nm, 1]"""
    nodes = design.optics.field_zernikes_rms_nm
    if not nodes:
        return []
    diagonal = math.hypot(design.rows, design.columns)
    parts = []
    for place, count in (
        (-field[1] * diagonal / design.rows, len(nodes)),
        (field[0] * diagonal / design.columns, len(nodes[0])),
    ):
        at = min(max((place + 1) / 2, 0.0), 1.0) * (count - 1)
        low = min(int(at), count - 2)
        parts.append(((low, 1 - (at - low)), (low + 1, at - low)))
    return [(nodes[i][j], a * b) for i, a in parts[0] for j, b in parts[1] if a * b > 0]


def diffraction_pattern(
    design: SensorDesign, passing: Complex[Array, "p p"], wavelength_um: float, step_um: float, samples: int
) -> Float[Array, "s s"]:
    """Point spread function of a pupil on the detector array, without the Gaussian spot; its integral is 1.

    Parameters
    ----------
    design, passing
        The sensor, and its `pupil`.
    wavelength_um
        Wavelength of the light. [µm]
    step_um, samples
        Grid of the result, square, centred; rows run down the image. [µm]

    Returns
    -------
    Irradiance of a point's image per power in it. [µm⁻²]
    """
    # pupil sample × image sample over λN, with the pupil's diameter as the unit of length in the pupil
    place = (np.arange(len(passing)) - len(passing) // 2) / (len(passing) - 1)
    image = (np.arange(samples) - samples // 2) * step_um / (wavelength_um * design.f_number)
    transform = np.exp(-2j * math.pi * np.outer(image, place))
    amplitude = transform @ passing @ transform.T
    # the peak of an unaberrated image is the pupil's area over (λ f)²
    open_area = math.pi / 4 * (1 - design.optics.obscuration**2)
    peak = open_area / (wavelength_um * design.f_number) ** 2
    spread = peak * np.abs(amplitude / np.abs(passing).sum()) ** 2
    return spread[::-1]  # y rises with the row of the pupil, and falls with that of the image


def modulation_transfer(
    design: SensorDesign,
    wavelength_um: float,
    frequency_per_mm: Float[Array, "frequency"],
    direction: str = "x",
    field: tuple[float, float] = (0.0, 0.0),
    element: bool = True,
) -> Float[Array, "frequency"]:
    """Modulation transfer of lens, spot and scatter, and of the element's aperture. [1]

    Parameters
    ----------
    design, wavelength_um, field
        As `pupil`.
    frequency_per_mm
        Spatial frequency on the detector array. [mm⁻¹]
    direction
        ``"x"`` (along a row) or ``"y"``.
    element
        Multiply by the |sinc| of the element's active width.

    References
    ----------
    Goodman, *Introduction to Fourier Optics*, §6.3: the autocorrelation of the pupil.
    """
    frequency = np.abs(np.asarray(frequency_per_mm, dtype=float))
    samples = 2 * PUPIL_SAMPLES
    passing = pupil(design, wavelength_um, field, samples)
    padded = np.zeros((2 * samples, 2 * samples), complex)
    padded[:samples, :samples] = passing
    overlap = np.abs(np.fft.fft2(np.abs(np.fft.fft2(padded)) ** 2))
    line = overlap[0, :samples] if direction == "x" else overlap[:samples, 0]
    # a shift by the whole diameter is the cut-off 1/(λN)
    shift = np.arange(samples) / (samples - 1)
    cutoff_per_mm = 1e3 / (wavelength_um * design.f_number)
    transfer = np.interp(frequency / cutoff_per_mm, shift, line / line[0], right=0.0)
    transfer *= np.exp(-2 * (math.pi * design.spot_sigma_um * 1e-3 * frequency) ** 2)
    transfer *= np.where(frequency > 0, 1 - design.optics.scatter_fraction, 1.0)
    if element:
        width_mm = design.pitch_um * 1e-3 * math.sqrt(design.fill_factor)
        transfer *= np.abs(np.sinc(width_mm * frequency))
    return transfer


def transfer_curves(design: SensorDesign) -> xr.Dataset:
    """Modulation transfer in the middle and in the corner, at the middle of the band. [1]"""
    wavelength_um = sum(design.band_um) / 2
    frequency = np.linspace(0, 1.2e3 / design.pitch_um, _FREQUENCIES)
    size = math.hypot(design.columns, design.rows)
    field = (design.columns / size, design.rows / size)
    open_pupil = type(design.optics)(obscuration=design.optics.obscuration)
    perfect = design.model_copy(update={"spot_sigma_um": 0.0, "optics": open_pupil})
    curves = {
        "diffraction": modulation_transfer(perfect, wavelength_um, frequency, element=False),
        "lens": modulation_transfer(design, wavelength_um, frequency, element=False),
        "lens and element": modulation_transfer(design, wavelength_um, frequency),
        "in the corner, across": modulation_transfer(design, wavelength_um, frequency, "x", field),
        "in the corner, down": modulation_transfer(design, wavelength_um, frequency, "y", field),
    }
    return xr.Dataset(
        {name: ("frequency", values, {"units": "1"}) for name, values in curves.items()},
        coords={"frequency": ("frequency", frequency, {"units": "mm-1"})},
        attrs={"nyquist_per_mm": 500 / design.pitch_um, "wavelength_um": wavelength_um},
    )


def relative_illumination(
    design: SensorDesign, rows: Float[Array, "row"], columns: Float[Array, "column"]
) -> Float[Array, "row column"]:
    """Light on an element over that on the axis: cos⁴ of the field angle and the design's vignetting. [1]

    Parameters
    ----------
    rows, columns
        Places on the array. [element]
    """
    y = (rows - (design.rows - 1) / 2)[:, None] * design.pitch_um * 1e-3
    x = (columns - (design.columns - 1) / 2)[None] * design.pitch_um * 1e-3
    square = x * x + y * y
    corner = ((design.rows - 1) ** 2 + (design.columns - 1) ** 2) / 4 * (design.pitch_um * 1e-3) ** 2
    light = 1 - design.optics.vignetting * square / max(corner, 1e-12)
    if design.optics.relative_illumination == "cos4":
        light = light / (1 + square / design.focal_length_mm**2) ** 2
    return light
