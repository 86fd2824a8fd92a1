"""Quality of a picture against the noiseless truth: errors, structure, signal to noise, sharpness, place."""

import math

import numpy as np
from jaxtyping import Float
from scipy.ndimage import gaussian_filter

from glintrack.camera import Camera, Pose, ground_points, project
from glintrack.core.arrays import Array

_SSIM_SIGMA_PX = 1.5  # as the authors of the index use it, with K = 0.01 and 0.03
_SSIM_REACH = 3.5
_SSIM_K = (0.01, 0.03)


def rmse(image: Float[Array, "*pixel"], truth: Float[Array, "*pixel"]) -> float:
    """Root mean square difference over what both have; NaN if they share nothing. [unit of the image]"""
    difference = np.asarray(image, float) - np.asarray(truth, float)
    difference = difference[np.isfinite(difference)]
    return float(np.sqrt(np.mean(difference**2))) if difference.size else float("nan")


def psnr(image: Float[Array, "*pixel"], truth: Float[Array, "*pixel"], peak: float | None = None) -> float:
    """Peak signal-to-noise ratio, 20 log₁₀(peak/RMSE); infinite for equal pictures. [dB]

    Parameters
    ----------
    image, truth
        NaN where there is no data.
    peak
        Range of the values; that of the truth where both have data if left out. [unit of the image]
    """
    if peak is None:
        shared = np.asarray(truth, float)[np.isfinite(image) & np.isfinite(truth)]
        peak = float(np.ptp(shared)) if shared.size else float("nan")
    error = rmse(image, truth)
    return float("inf") if error == 0 else 20 * math.log10(peak / error) if peak > 0 else float("nan")


def ssim(image: Float[Array, "y x"], truth: Float[Array, "y x"], peak: float | None = None) -> float:
    """Structural similarity, mean over what both have around; 1 for equal pictures. [1]

    Parameters
    ----------
    image, truth
        NaN where there is no data; pixels whose window of 11 × 11 holds some are left out.
    peak
        Range of the values; that of the truth if left out. [unit of the image]

    References
    ----------
    Wang, Bovik, Sheikh and Simoncelli, IEEE Trans. Image Processing 13, 600 (2004), with a Gaussian window.
    """
    image, truth = np.asarray(image, float), np.asarray(truth, float)
    both = np.isfinite(image) & np.isfinite(truth)
    if not both.any():
        return float("nan")
    peak = float(np.ptp(truth[both])) if peak is None else peak
    x, y = (np.where(both, picture, truth[both].mean()) for picture in (image, truth))

    def mean(values: Array) -> Array:
        return gaussian_filter(values, _SSIM_SIGMA_PX, mode="reflect", truncate=_SSIM_REACH)

    mx, my = mean(x), mean(y)
    vx, vy, cov = mean(x * x) - mx * mx, mean(y * y) - my * my, mean(x * y) - mx * my
    c1, c2 = ((k * peak) ** 2 for k in _SSIM_K)
    index = (2 * mx * my + c1) * (2 * cov + c2) / ((mx**2 + my**2 + c1) * (vx + vy + c2))
    reach = int(_SSIM_REACH * _SSIM_SIGMA_PX + 0.5)
    whole = np.pad(both, reach)  # the border counts as no data
    lines = np.lib.stride_tricks.sliding_window_view(whole, 2 * reach + 1, axis=0).all(axis=-1)
    inside = np.lib.stride_tricks.sliding_window_view(lines, 2 * reach + 1, axis=1).all(axis=-1)
    return float(index[inside].mean()) if inside.any() else float("nan")


def snr(image: Float[Array, "*pixel"], truth: Float[Array, "*pixel"]) -> float:
    """Signal-to-noise ratio, 20 log₁₀ of the truth's mean over the RMS of the rest. [dB]

    The rest is what is left of the difference less its mean: a bias is no noise.
    """
    shared = np.isfinite(image) & np.isfinite(truth)
    if not shared.any():
        return float("nan")
    truth = np.asarray(truth, float)[shared]
    noise = float(np.std(np.asarray(image, float)[shared] - truth))
    return float("inf") if noise == 0 else 20 * math.log10(max(float(truth.mean()), 1e-300) / noise)


def mtf(
    image: Float[Array, "y x"], truth: Float[Array, "y x"], bins: int = 16
) -> tuple[Float[Array, "frequency"], Float[Array, "frequency"]]:
    """Modulation transfer from the truth to the image, averaged over directions.

    The share of the image's spectrum that goes with the truth's, Re⟨F·G*⟩/⟨|G|²⟩: noise that knows nothing of
    the truth averages out.

    Parameters
    ----------
    image, truth
        NaN where there is no data: filled with the truth in both.
    bins
        Equal steps of frequency up to ½.

    Returns
    -------
    frequency
        Middles of the bins. [cycle/pixel]
    transfer
        1 where nothing is lost; NaN where the truth has no content. [1]
    """
    image, truth = np.asarray(image, float), np.asarray(truth, float)
    known = np.isfinite(truth)
    if not known.any():
        return (np.arange(bins) + 0.5) / (2 * bins), np.full(bins, np.nan)
    truth = np.where(known, truth, truth[known].mean())
    image = np.where(np.isfinite(image), image, truth)
    window = np.hanning(truth.shape[0] + 2)[1:-1, None] * np.hanning(truth.shape[1] + 2)[None, 1:-1]
    f, g = (np.fft.fft2((picture - truth.mean()) * window) for picture in (image, truth))
    radius = np.hypot(np.fft.fftfreq(truth.shape[0])[:, None], np.fft.fftfreq(truth.shape[1])[None])
    ring = np.minimum((radius * 2 * bins).astype(int), bins)
    cross = np.bincount(ring.ravel(), np.real(f * g.conj()).ravel(), bins + 1)[:bins]
    power = np.bincount(ring.ravel(), (np.abs(g) ** 2).ravel(), bins + 1)[:bins]
    content = power > 1e-12 * power.max(initial=0.0)
    transfer = np.where(content, cross / np.where(content, power, 1.0), np.nan)
    return (np.arange(bins) + 0.5) / (2 * bins), transfer


def registration_error(
    camera: Camera, true_pose: Pose, reported_pose: Pose, ground_m: float = 0.0, side: int = 9
) -> float:
    """RMS misplacement on level ground of what the reported pose puts there. [m]

    Parameters
    ----------
    camera, true_pose, reported_pose
        The camera, where it is, and where the navigator says it is.
    ground_m
        Height of the ground. [m]
    side
        Points along each side of the frame.
    """
    rows, columns = np.linspace(0, camera.rows - 1, side), np.linspace(0, camera.columns - 1, side)
    pixels = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    true = ground_points(camera, true_pose, pixels, ground_m)
    claimed = ground_points(camera, reported_pose, pixels, ground_m)
    return rmse(np.linalg.norm(claimed - true, axis=-1), np.zeros(pixels.shape[:2]))


def registration_error_px(
    camera: Camera, true_pose: Pose, reported_pose: Pose, ground_m: float = 0.0
) -> float:
    """RMS over the frame of where a ground point is and where the reported pose looks for it. [element]"""
    rows, columns = np.linspace(0, camera.rows - 1, 9), np.linspace(0, camera.columns - 1, 9)
    pixels = np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)
    ground = ground_points(camera, true_pose, pixels, ground_m)
    sought = project(camera, reported_pose, ground)
    return rmse(np.linalg.norm(sought - pixels, axis=-1), np.zeros(pixels.shape[:2]))
