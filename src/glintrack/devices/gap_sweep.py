"""A spectrum from a sweep of the etalon's gap: Tikhonov's regularised inverse with smoothness.

A pixel behind the etalon reads, at gap g, m_g = Σ_λ W_gλ L_λ. The responses overlap and hold several orders,
so L is found as the spectrum that explains the readings and bends least:
min ‖(W L − m)/noise‖² + α ‖L″‖². How much it may bend, α, follows from a stated rule.
"""

from typing import Literal

import numpy as np
import xarray as xr
from jaxtyping import Float
from numpy.typing import ArrayLike

from glintrack.core.arrays import Array
from glintrack.core.spectral import check_wavelengths, quadrature_weights

Rule = Literal["discrepancy", "gcv"]
_TRIALS = 161  # values of α, a constant factor apart
_LEVEL = 1e-3  # how little level and slope weigh beside curvature: they are all but free


def sweep_weights(
    responses: xr.Dataset, throughput: ArrayLike = 1.0, photons: bool = True
) -> Float[Array, "gap wavelength"]:
    """Weights whose product with a radiance spectrum is the pixel's reading at each gap.

    Parameters
    ----------
    responses
        From `etalon.responses`.
    throughput
        Optics, quantum efficiency and the like over wavelength. [1]
    photons
        Count photons (∝ λ), as a detector does; else energy.

    Returns
    -------
    Transmittance × throughput × wavelength [µm] × step [µm]; multiply by a sensor's constant for electrons.
    """
    wavelength = responses["wavelength"].values
    weights = responses["transmittance"].values * np.asarray(throughput) * quadrature_weights(wavelength)
    return weights * wavelength if photons else weights


def reconstruct(
    readings: ArrayLike,
    weights: Float[Array, "gap wavelength"],
    wavelength_um: ArrayLike,
    noise: ArrayLike | None = None,
    rule: Rule | None = None,
) -> xr.Dataset:
    """Spectra from gap sweeps.

    Parameters
    ----------
    readings
        (gap,) or (spectrum, gap): what the pixel read at each gap, in the unit of ``weights`` times radiance.
    weights
        From `sweep_weights`. Rows may be dropped together with their readings.
    wavelength_um
        Rising; four at least. [µm]
    noise
        RMS noise of each reading, one number, (gap,) or (spectrum, gap), in the unit of the readings. Without
        it the readings count alike.
    rule
        ``"discrepancy"`` (Morozov; needs the noise): the most smoothing whose misfit is no larger than the
        noise, χ² = number of readings. ``"gcv"``: generalized cross-validation, which predicts each reading
        best from the others. By default discrepancy where the noise is known, else cross-validation.

    Returns
    -------
    ``radiance`` and, with ``noise``, its standard deviation ``radiance_sigma`` over (spectrum, wavelength);
    ``regularization`` (α), ``misfit`` (χ²/readings; without noise, relative to the mean square reading) and
    ``degrees_of_freedom`` (how many numbers the readings decided) over spectrum. Smoothing biases sharp
    features; ``radiance_sigma`` holds the noise alone. Spectra are not forced to be positive.

    Raises
    ------
    ValueError
        For shapes that do not fit, values that are not finite, noise that is not positive.

    References
    ----------
    Hansen, Discrete Inverse Problems, SIAM 2010, chapters 4, 5 and 8 (standard form).
    """
    wavelength = check_wavelengths(wavelength_um)
    values, weights, sigma = _checked(readings, weights, wavelength, noise)
    rule = rule or ("gcv" if noise is None else "discrepancy")
    if rule not in ("discrepancy", "gcv"):
        raise ValueError(f"`rule` must be 'discrepancy' or 'gcv', got {rule!r}")
    if rule == "discrepancy" and noise is None:
        raise ValueError("`noise` must be given for the discrepancy rule, got none (or use rule='gcv')")
    smooth = np.linalg.inv(_curvature(wavelength))
    common = len(sigma) == 1
    groups = [slice(None)] if common else [slice(k, k + 1) for k in range(len(values))]
    parts = [_solve(values[g], weights, sigma[0] if common else sigma[g][0], smooth, rule) for g in groups]
    radiance, deviation, alpha, misfit, freedom = (np.concatenate(p) for p in zip(*parts, strict=True))
    if noise is None:
        misfit = misfit / np.maximum(np.mean(values**2, axis=1), np.finfo(float).tiny)
    units = {"units": "1"}
    data = {
        "radiance": (("spectrum", "wavelength"), radiance, {"units": "of readings over weights"}),
        "regularization": ("spectrum", alpha, units),
        "misfit": ("spectrum", misfit, units),
        "degrees_of_freedom": ("spectrum", freedom, units),
    }
    if noise is not None:
        data["radiance_sigma"] = (("spectrum", "wavelength"), deviation, {"units": "of radiance"})
    coords = {"wavelength": ("wavelength", wavelength, {"units": "um"})}
    return xr.Dataset(data, coords=coords, attrs={"rule": rule})


def averaging_kernel(
    weights: Float[Array, "gap wavelength"],
    wavelength_um: ArrayLike,
    regularization: float,
    noise: ArrayLike = 1.0,
) -> Float[Array, "found true"]:
    """How each found value averages the true spectrum: found = kernel @ true; the identity would be perfect.

    The width of its rows is the spectral resolution of the sweep at that α.
    """
    wavelength = check_wavelengths(wavelength_um)
    sigma = np.broadcast_to(np.asarray(noise, float), len(weights))
    smooth = np.linalg.inv(_curvature(wavelength))
    u, s, vt = np.linalg.svd(weights / sigma[:, None] @ smooth, full_matrices=False)
    return smooth @ (vt.T * (s / (s**2 + regularization))) @ u.T @ (weights / sigma[:, None])


def _solve(
    values: Array, weights: Array, sigma: Array, smooth: Array, rule: Rule
) -> tuple[Array, Array, Array, Array, Array]:
    """Spectra that share one noise, in standard form: L = smooth @ z, and z is kept small."""
    u, s, vt = np.linalg.svd(weights / sigma[:, None] @ smooth, full_matrices=False)
    scaled = values / sigma
    seen = scaled @ u
    never = np.maximum(np.sum(scaled**2, axis=1) - np.sum(seen**2, axis=1), 0)  # no spectrum explains this
    count = values.shape[1]
    alphas = np.geomspace(s[0] ** 2 * 1e-14, s[0] ** 2 * 1e2, _TRIALS)
    kept = s**2 / (s**2 + alphas[:, None])  # of each singular direction, for each α
    misfit = seen**2 @ ((1 - kept) ** 2).T + never[:, None]  # rises with α
    if rule == "discrepancy":
        alpha = np.array([np.exp(np.interp(count, row, np.log(alphas))) for row in misfit])
    else:
        alpha = alphas[np.argmin(misfit / np.maximum(count - kept.sum(axis=1), 1e-9) ** 2, axis=1)]
    kept = s**2 / (s**2 + alpha[:, None])
    back = smooth @ vt.T
    radiance = (seen * kept / s) @ back.T
    deviation = np.sqrt((kept / s) ** 2 @ (back**2).T)
    left = (np.sum((seen * (1 - kept)) ** 2, axis=1) + never) / count
    return radiance, deviation, alpha, left, kept.sum(axis=1)


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


def _checked(
    readings: ArrayLike, weights: Array, wavelength: Array, noise: ArrayLike | None
) -> tuple[Array, Array, Array]:
    """Readings as (spectrum, gap); noise as (1, gap) or (spectrum, gap)."""
    values, weights = np.atleast_2d(np.asarray(readings, float)), np.asarray(weights, float)
    if weights.ndim != 2 or weights.shape[1] != wavelength.size or wavelength.size < 4:
        raise ValueError(
            f"`weights` must be (gap, wavelength) with the {wavelength.size} wavelengths given (4 or more), "
            f"got shape {weights.shape}"
        )
    if values.ndim != 2 or values.shape[1] != len(weights):
        raise ValueError(
            f"`readings` must hold one value for each of {len(weights)} gaps, got shape {values.shape}"
        )
    if not (np.isfinite(values).all() and np.isfinite(weights).all()):
        raise ValueError("`readings` and weights must be finite, got NaN or infinity (drop those gaps)")
    sigma = np.atleast_2d(np.asarray(1.0 if noise is None else noise, float))
    if sigma.shape[-1] not in (1, values.shape[1]) or len(sigma) not in (1, len(values)):
        raise ValueError(
            f"`noise` must be one number, one a gap or one a reading {values.shape}, got shape {sigma.shape}"
        )
    if not (sigma > 0).all():
        raise ValueError(f"`noise` must be positive, got {sigma.min():g}")
    return values, weights, np.broadcast_to(sigma, (len(sigma), values.shape[1]))
