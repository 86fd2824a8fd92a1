"""Tunable Fabry–Pérot etalon over a pixel (§3.1, Figure 4a): transmittance at each gap, spectra from a sweep.

Two thin metal films face each other over an air gap. The lower one is on the window before the array, the
upper one hangs on springs. Order 1 passes a band above twice the gap, since metals reflect with a phase.
From a gap of about 350 nm order 2 is in the visible, too: an order filter blocks it, or the whole response
is inverted (`reconstruct`).

A pixel behind the etalon reads, at gap g, m_g = Σ_λ W_gλ L_λ. The responses overlap and hold several orders,
so L is estimated as the smoothest spectrum that agrees with the readings:
min ‖(W L − m)/noise‖² + α ‖L″‖² (Tikhonov). The noise determines α.
"""

from typing import Literal, Self

import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike
from pydantic import Field, model_validator
from scipy.optimize import fminbound
from scipy.signal import peak_widths

from glintrack.core.arrays import Array
from glintrack.core.designs import Design
from glintrack.core.schema import check
from glintrack.core.spectral import (
    MAX_WAVELENGTH_UM,
    MIN_WAVELENGTH_UM,
    check_wavelengths,
    quadrature_weights,
    wavelength_grid,
)
from glintrack.devices.micromirror.equilibrium import holding_voltage
from glintrack.devices.optical_constants import MetalDesign, permittivity
from glintrack.devices.thin_film import stack_response

_RINGS, _SPOKES = 4, 8  # rays of a converging cone: 1e-5 in transmittance at F/2
_TRIALS = 161  # values of α, a constant factor apart
_LEVEL = 1e-3  # weight of level and slope relative to curvature: they are nearly free
_FINE_STEP_UM = 1e-4  # for the width of a peak


class OrderFilterDesign(Design):
    """A long-pass filter that is put in for the larger gaps; the ``[order_filter]`` table of an etalon."""

    cut_on_um: float = Field(default=0.58, ge=0.3, le=2.5, description="Where it passes half")
    edge_nm: float = Field(default=10.0, gt=0, le=500, description="Width of the edge, 10 % to 90 %")
    from_gap_nm: float = Field(default=290.0, ge=0, le=1e5, description="Smallest gap at which it is in")
    passed: float = Field(default=0.95, gt=0, le=1, description="Transmittance well above the edge")
    blocked: float = Field(default=0.001, ge=0, le=1, description="Transmittance well below the edge")

    def transmittance(self, wavelength_um: Float[Array, "wavelength"]) -> Float[Array, "wavelength"]:
        """Transmittance of the filter when it is in: a logistic edge. [1]"""
        slope = 2 * np.log(9) / (self.edge_nm * 1e-3)
        step = 1 / (1 + np.exp(-np.clip(slope * (wavelength_um - self.cut_on_um), -500, 500)))
        return self.blocked + (self.passed - self.blocked) * step


class GapActuatorDesign(Design):
    """Electrodes and springs of the upper film; the ``[actuator]`` table of an etalon."""

    rest_gap_nm: float = Field(default=460.0, gt=0, le=1e5, description="Optical gap without voltage")
    electrode_gap_um: float = Field(default=1.5, gt=0, le=100)
    """Of the electrodes, apart from the optical gap."""
    electrode_area_um2: float = Field(default=100.0, gt=0, le=1e6)
    spring_n_per_m: float = Field(default=1.0, gt=0, le=1e4)


class EtalonDesign(Design):
    """One etalon: what ``glintrack device etalon`` reads."""

    name: str = Field(default="etalon", min_length=1, max_length=80)
    metal: MetalDesign = MetalDesign(model="lorentz-drude", name="silver")
    metal_thickness_nm: float = Field(default=30.0, ge=0, le=1000, description="Of each of the two films")
    window_index: float = Field(default=1.45, ge=1, le=4, description="Of the window behind")
    gap_start_nm: float = Field(default=150.0, ge=0, le=1e5, description="First gap of a sweep")
    gap_stop_nm: float = Field(default=450.0, gt=0, le=1e5, description="Last gap of a sweep")
    gap_count: int = Field(default=100, ge=2, le=10_000, description="How many gaps a sweep has")
    wavelength_start_um: float = Field(default=0.4, ge=MIN_WAVELENGTH_UM, le=MAX_WAVELENGTH_UM)
    wavelength_stop_um: float = Field(default=1.0, ge=MIN_WAVELENGTH_UM, le=MAX_WAVELENGTH_UM)
    wavelength_step_um: float = Field(default=0.01, gt=0, le=0.5)
    incidence_deg: float = Field(default=0.0, ge=0, lt=90, description="Of the chief ray, in air")
    polarization: Literal["s", "p", "unpolarized"] = "unpolarized"
    f_number: float | None = Field(default=None, ge=0.6, le=1000)
    """Of the cone of light on the pixel [default: parallel light]."""
    order_filter: OrderFilterDesign | None = None
    actuator: GapActuatorDesign = GapActuatorDesign()

    @model_validator(mode="after")
    def _fits_together(self) -> Self:
        if not self.gap_start_nm < self.gap_stop_nm:
            raise ValueError(
                f"`gap_stop_nm` must exceed gap_start_nm = {self.gap_start_nm:g}; got {self.gap_stop_nm:g}."
            )
        if self.f_number is not None and self.polarization != "unpolarized":
            raise ValueError(
                f"`polarization` must be 'unpolarized' with an f_number; got {self.polarization!r}. "
                "A cone holds every plane of incidence."
            )
        wavelength_grid(self.wavelength_start_um, self.wavelength_stop_um, self.wavelength_step_um)
        return self

    @property
    def gaps_um(self) -> Float[Array, "gap"]:
        """Gaps of a sweep. [µm]"""
        return np.linspace(self.gap_start_nm, self.gap_stop_nm, self.gap_count) * 1e-3

    @property
    def wavelengths_um(self) -> Float[Array, "wavelength"]:
        """Wavelength grid. [µm]"""
        return wavelength_grid(self.wavelength_start_um, self.wavelength_stop_um, self.wavelength_step_um)


def responses(
    design: EtalonDesign, gaps_um: ArrayLike | None = None, wavelength_um: ArrayLike | None = None
) -> xr.Dataset:
    """Transmittance into the window for every gap and wavelength: the response of the pixel below.

    Parameters
    ----------
    gaps_um, wavelength_um
        Gaps of the sweep, and rising wavelengths; the design's by default. [µm]

    Returns
    -------
    Schema ``etalon``: ``transmittance`` over (gap, wavelength), order filter included, and ``filter_in``, 1
    at the gaps where it is in.

    Raises
    ------
    ValueError
        For a negative gap, or a wavelength outside 0.4 to 2.5 µm or outside the metal's data.
    """
    gaps = np.atleast_1d(np.asarray(design.gaps_um if gaps_um is None else gaps_um, float))
    wavelength = check_wavelengths(design.wavelengths_um if wavelength_um is None else wavelength_um)
    if gaps.size == 0 or not np.all(gaps >= 0):
        came = "none" if gaps.size == 0 else f"{gaps.min():g}"
        raise ValueError(f"`gaps_um` must be 0 or more; got {came}.")
    through = _transmittance(design, gaps[:, None], wavelength)
    filter_in = np.zeros(gaps.size, bool)
    if design.order_filter is not None:
        filter_in = gaps * 1e3 >= design.order_filter.from_gap_nm
        through[filter_in] *= design.order_filter.transmittance(wavelength)
    dataset = xr.Dataset(
        {
            "transmittance": (("gap", "wavelength"), through, {"units": "1"}),
            "filter_in": ("gap", filter_in.astype(np.int8), {"units": "1"}),
        },
        coords={
            "gap": ("gap", gaps, {"units": "um"}),
            "wavelength": ("wavelength", wavelength, {"units": "um"}),
        },
        attrs={"device": "etalon", "design": design.model_dump_json()},
    )
    return check(dataset, "etalon")


def find_peaks(design: EtalonDesign, wavelength_um: ArrayLike, order: int = 1) -> xr.Dataset:
    """Gap of highest transmittance at each wavelength in one order, with the peak's height and width.

    Parameters
    ----------
    wavelength_um
        Wavelengths of the peaks. [µm]
    order
        Interference order, 1 or more.

    Returns
    -------
    ``gap`` [µm], ``peak_transmittance`` [1] and ``fwhm`` [µm] over ``wavelength``, without the order filter;
    ``fwhm`` is NaN where the peak runs out of 0.4 to 2.5 µm before it has fallen to half.
    """
    wavelength = check_wavelengths(wavelength_um)
    if order < 1:
        raise ValueError(f"`order` must be 1 or more; got {order}.")
    gap, peak, width = np.empty((3, wavelength.size))
    for i, w in enumerate(wavelength):
        low, high = max(0.03 * w, (order / 2 - 0.25) * w), (order / 2 + 0.02) * w
        trial = np.linspace(low, high, 200)
        best = int(np.argmax(_transmittance(design, trial, np.array([w]))))
        around = trial[max(best - 1, 0)], trial[min(best + 1, trial.size - 1)]
        found = fminbound(
            lambda g, w=w: -_transmittance(design, np.array(g), np.array(w)).item(), *around, xtol=1e-8
        )
        gap[i] = float(found)  # pyright: ignore[reportArgumentType] - one number without full_output
        peak[i], width[i] = _peak_and_width(design, gap[i], w)
    return xr.Dataset(
        {
            "gap": ("wavelength", gap, {"units": "um"}),
            "peak_transmittance": ("wavelength", peak, {"units": "1"}),
            "fwhm": ("wavelength", width, {"units": "um"}),
        },
        coords={"wavelength": ("wavelength", wavelength, {"units": "um"})},
        attrs={"order": order},
    )


def drive_voltage(design: EtalonDesign, gaps_um: ArrayLike) -> Float[Array, "gap"]:
    """Voltage for each gap of the etalon. [V]

    Raises
    ------
    ValueError
        For a gap above the one at rest, or one that needs more than a third of the electrode gap as travel.
    """
    a = design.actuator
    travel = np.round(a.rest_gap_nm * 1e-9 - np.atleast_1d(np.asarray(gaps_um, float)) * 1e-6, 18)
    return holding_voltage(travel, a.spring_n_per_m, a.electrode_area_um2 * 1e-12, a.electrode_gap_um * 1e-6)


def _transmittance(design: EtalonDesign, gap_um: Array, wavelength_um: Array) -> Array:
    """Transmittance of films, gap and window, averaged over polarizations and over the cone."""
    metal = np.sqrt(permittivity(design.metal, wavelength_um))
    film = design.metal_thickness_nm * 1e-3
    indices = [1.0, metal, 1.0, metal, design.window_index]
    total = np.zeros(np.broadcast_shapes(gap_um.shape, wavelength_um.shape))
    polarizations = ("s", "p") if design.polarization == "unpolarized" else (design.polarization,)
    for angle, weight in zip(*_rays(design), strict=True):
        for polarization in polarizations:
            found = stack_response(indices, [film, gap_um, film], wavelength_um, angle, polarization)
            total += weight / len(polarizations) * found.transmittance
    return total


def _rays(design: EtalonDesign) -> tuple[Array, Array]:
    """Angles of incidence and weights of a cone of uniform radiance about the chief ray."""
    chief = np.radians(design.incidence_deg)
    if design.f_number is None:
        return np.array([chief]), np.ones(1)
    node, weight = np.polynomial.legendre.leggauss(_RINGS)
    sine = np.sqrt(0.5 * (1 + node)) / (2 * design.f_number)  # even steps of sin² are even irradiance
    if chief == 0:
        return np.arcsin(sine), weight / 2
    azimuth = 2 * np.pi * (np.arange(_SPOKES) + 0.5) / _SPOKES
    away = np.arcsin(sine)[:, None]
    cosine = np.cos(chief) * np.cos(away) - np.sin(chief) * np.sin(away) * np.cos(azimuth)
    if not np.all(cosine > 0):
        raise ValueError(
            f"`incidence_deg` must leave the whole cone above the horizon; got {design.incidence_deg:g}° "
            f"at F/{design.f_number:g}."
        )
    return np.arccos(cosine).ravel(), np.repeat(weight / 2 / _SPOKES, _SPOKES)


def _peak_and_width(design: EtalonDesign, gap_um: float, wavelength_um: float) -> tuple[float, float]:
    """Highest transmittance near a wavelength and its full width at half of that. [1, µm]"""
    first, last = max(0.7 * wavelength_um, MIN_WAVELENGTH_UM), min(1.5 * wavelength_um, MAX_WAVELENGTH_UM)
    fine = np.arange(first, last, _FINE_STEP_UM)
    curve = _transmittance(design, np.array(gap_um), fine)
    near = np.flatnonzero(np.abs(fine - wavelength_um) <= 0.01 * wavelength_um)
    top = int(near[np.argmax(curve[near])])
    whole = curve[[top]], np.array([0]), np.array([fine.size - 1])  # half of the peak, not of its prominence
    (width,), _, (left,), (right,) = peak_widths(curve, [top], prominence_data=whole)
    is_inside = 0 < left and right < fine.size - 1
    return float(curve[top]), float(width * _FINE_STEP_UM) if is_inside else float("nan")


def tabulate(design: EtalonDesign) -> xr.Dataset:
    """Transmittance, drive voltages and peaks of an etalon, over gap and wavelength.

    Raises
    ------
    ValueError
        For gaps that the actuator cannot reach, or wavelengths outside the metal's data.
    """
    table = responses(design)
    volts = drive_voltage(design, table["gap"].values)
    names = {"wavelength": "peak_wavelength", "gap": "peak_gap"}
    found = find_peaks(design, design.wavelengths_um).rename(names)
    return table.assign(voltage=("gap", volts, {"units": "V"})).merge(found, combine_attrs="override")


def sweep_weights(responses: xr.Dataset, throughput: ArrayLike = 1.0) -> Float[Array, "gap wavelength"]:
    """Weights from a radiance spectrum to the photons of the pixel at each gap.

    Parameters
    ----------
    responses
        From `responses`.
    throughput
        Optics, quantum efficiency and the like over wavelength. [1]

    Returns
    -------
    Transmittance × throughput × wavelength [µm] × step [µm]; multiply by a sensor's constant for electrons.
    """
    wavelength = responses["wavelength"].values
    weights = responses["transmittance"].values * np.asarray(throughput) * quadrature_weights(wavelength)
    return weights * wavelength


def reconstruct(
    readings: ArrayLike, weights: Float[Array, "gap wavelength"], wavelength_um: ArrayLike, noise: ArrayLike
) -> xr.Dataset:
    """Spectra from gap sweeps.

    The smoothing is the largest with a misfit within the noise, χ² = number of readings (Morozov's
    discrepancy principle).

    Parameters
    ----------
    readings
        (gap,) or (spectrum, gap): what the pixel read at each gap, in the unit of ``weights`` times radiance.
    weights
        From `sweep_weights`. Rows may be dropped together with their readings.
    wavelength_um
        Rising; four at least. [µm]
    noise
        RMS noise of each reading, one number, (gap,) or (spectrum, gap), in the unit of the readings.

    Returns
    -------
    ``radiance`` and its standard deviation ``radiance_sigma`` over (spectrum, wavelength); ``misfit``
    (χ²/readings) and ``degrees_of_freedom`` (how many numbers the readings decided) over spectrum. Smoothing
    biases sharp features; ``radiance_sigma`` is the noise alone. Spectra are not forced to be positive.

    Raises
    ------
    ValueError
        For shapes that do not fit, values that are not finite, noise that is not positive.

    References
    ----------
    Hansen, Discrete Inverse Problems, SIAM 2010, chapters 4, 5 and 8 (standard form).
    """
    wavelength = check_wavelengths(wavelength_um)
    values, weights = np.atleast_2d(np.asarray(readings, float)), np.asarray(weights, float)
    if weights.ndim != 2 or weights.shape[1] != wavelength.size or wavelength.size < 4:
        raise ValueError(
            f"`weights` must be (gap, wavelength) with the {wavelength.size} wavelengths given (4 or more); "
            f"got shape {weights.shape}."
        )
    if values.ndim != 2 or values.shape[1] != len(weights):
        raise ValueError(
            f"`readings` must hold one value for each of {len(weights)} gaps; got shape {values.shape}."
        )
    if not (np.isfinite(values).all() and np.isfinite(weights).all()):
        raise ValueError("`readings` and weights must be finite; got NaN or infinity. Drop those gaps.")
    sigma = np.atleast_2d(np.asarray(noise, float))
    if sigma.shape[-1] not in (1, values.shape[1]) or len(sigma) not in (1, len(values)):
        raise ValueError(
            f"`noise` must be one number, one a gap or one a reading {values.shape}; got shape {sigma.shape}."
        )
    if not (sigma > 0).all():
        raise ValueError(f"`noise` must be positive; got {sigma.min():g}.")
    sigma = np.broadcast_to(sigma, (len(sigma), values.shape[1]))
    smooth = np.linalg.inv(_curvature(wavelength))
    groups = [values] if len(sigma) == 1 else values[:, None]
    parts = [_solve(own, weights, row, smooth, wavelength) for own, row in zip(groups, sigma, strict=True)]
    return xr.concat(parts, "spectrum")


def _solve(values: Array, weights: Array, sigma: Array, smooth: Array, wavelength: Array) -> xr.Dataset:
    """Spectra that share one noise, in standard form: L = smooth @ z with small z."""
    u, s, vt = np.linalg.svd(weights / sigma[:, None] @ smooth, full_matrices=False)
    scaled = values / sigma
    seen = scaled @ u
    never = np.maximum(np.sum(scaled**2, axis=1) - np.sum(seen**2, axis=1), 0)  # no spectrum explains this
    count = values.shape[1]
    alphas = np.geomspace(s[0] ** 2 * 1e-14, s[0] ** 2 * 1e2, _TRIALS)
    share = s**2 / (s**2 + alphas[:, None])  # of each singular direction, for each α
    misfit = seen**2 @ ((1 - share) ** 2).T + never[:, None]  # rises with α
    alpha = np.array([np.exp(np.interp(count, row, np.log(alphas))) for row in misfit])
    share = s**2 / (s**2 + alpha[:, None])
    back = smooth @ vt.T
    spectra, one = ("spectrum", "wavelength"), {"units": "1"}
    deviation = np.sqrt((share / s) ** 2 @ (back**2).T)
    left = (np.sum((seen * (1 - share)) ** 2, axis=1) + never) / count
    return xr.Dataset(
        {
            "radiance": (spectra, (seen * share / s) @ back.T, {"units": "of readings over weights"}),
            "radiance_sigma": (spectra, deviation, {"units": "of radiance"}),
            "misfit": ("spectrum", left, one),
            "degrees_of_freedom": ("spectrum", share.sum(axis=1), one),
        },
        coords={"wavelength": ("wavelength", wavelength, {"units": "um"})},
    )


def _curvature(wavelength: Array) -> Array:
    """Second derivative over the grid, made square and invertible by faint rows for level and slope."""
    n = wavelength.size
    x = (wavelength - wavelength[0]) / (wavelength[-1] - wavelength[0])
    operator = np.zeros((n, n))
    operator[0], operator[1] = _LEVEL / n, _LEVEL * (x - x.mean()) / n
    step = 1 / (n - 1)
    for i in range(1, n - 1):
        before, after = x[i] - x[i - 1], x[i + 1] - x[i]
        row = np.array([1 / before, -1 / before - 1 / after, 1 / after]) * 2 / (before + after)
        operator[i + 1, i - 1 : i + 2] = row * step**2  # 1, −2, 1 on an even grid
    return operator
