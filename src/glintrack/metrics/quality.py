"""Quality of one frame against its noiseless truth: image, sharpness, registration, polarization, spectra."""

import math
from collections.abc import Mapping

import numpy as np
import xarray as xr
from jaxtyping import Float
from scipy.ndimage import gaussian_filter, minimum_filter

from glintrack.camera import Camera, Pose, ground_points, project
from glintrack.core.arrays import Array
from glintrack.core.installation import read_data
from glintrack.core.schema import check
from glintrack.stokes import aop, dolp

_SSIM_SIGMA_PX = 1.5  # as in the original paper, with K = 0.01 and 0.03
_SSIM_REACH = 3.5
_SSIM_K = (0.01, 0.03)
# scores of `frame_quality` and their units
QUALITY_UNITS: Mapping[str, str] = read_data("schemas.toml")["quality"]


def frame_quality(
    image: xr.Dataset,
    truth: xr.Dataset,
    camera: Camera,
    true_pose: Pose,
    reported_pose: Pose,
    spectra: xr.Dataset | None = None,
    true_spectra: Array | None = None,
) -> dict[str, float]:
    """Compute the scores of `QUALITY_UNITS` for one rectified frame.

    Parameters
    ----------
    image
        Schema ``image``: the tracker's input.
    truth
        Schema ``image`` on the same grid: the light without noise, blur and mosaic, rectified with the true
        pose.
    camera, true_pose, reported_pose
        Camera and poses, for the registration error on level ground at 0 m.
    spectra, true_spectra
        Schema ``spectra``, and the spectra of a noiseless spectrometer, row by row. [radiance]

    Returns
    -------
    Scores; NaN for one without data.
    """
    check(image, "image")
    check(truth, "image")
    pan, true_pan = image["pan"].values, truth["pan"].values
    floor = float(image.attrs.get("dolp_floor", 0.0))
    stokes, true_stokes = image["stokes_radiance"].values, truth["stokes_radiance"].values
    frequency, transfer = mtf(pan, true_pan)
    angle, spectral = float("nan"), float("nan")
    if spectra is not None and true_spectra is not None and len(true_spectra):
        measured = spectra["radiance"].values
        angles = spectral_angle(measured, true_spectra)
        angle = float(np.nanmean(angles)) if np.isfinite(angles).any() else angle
        spectral = rmse(measured, true_spectra)
    return {
        "rmse": rmse(pan, true_pan),
        "psnr": psnr(pan, true_pan),
        "ssim": ssim(pan, true_pan),
        "snr": snr(pan, true_pan),
        "mtf_quarter": float(np.interp(0.25, frequency, transfer)),  # half way to the grid's limit
        "dolp_rmse": rmse(dolp(stokes, floor), dolp(true_stokes, floor)),
        "aop_rmse": aop_error(stokes, true_stokes, floor=floor),
        "registration_error": registration_error(camera, true_pose, reported_pose),
        "registration_error_px": registration_error_px(camera, true_pose, reported_pose),
        "spectral_angle": angle,
        "spectral_rmse": spectral,
    }


def rmse(image: Float[Array, "*pixel"], truth: Float[Array, "*pixel"]) -> float:
    """Root mean square difference over shared data; NaN without any. [unit of the image]"""
    difference = np.asarray(image, float) - np.asarray(truth, float)
    difference = difference[np.isfinite(difference)]
    return float(np.sqrt(np.mean(difference**2))) if difference.size else float("nan")


def psnr(image: Float[Array, "*pixel"], truth: Float[Array, "*pixel"], peak: float | None = None) -> float:
    """Peak signal-to-noise ratio, 20 log₁₀(peak/RMSE); infinite for equal images. [dB]

    Parameters
    ----------
    image, truth
        NaN where there is no data.
    peak
        Range of the values; by default that of the truth where both have data. [unit of the image]
    """
    if peak is None:
        shared = np.asarray(truth, float)[np.isfinite(image) & np.isfinite(truth)]
        peak = float(np.ptp(shared)) if shared.size else float("nan")
    error = rmse(image, truth)
    return float("inf") if error == 0 else 20 * math.log10(peak / error) if peak > 0 else float("nan")


def ssim(image: Float[Array, "y x"], truth: Float[Array, "y x"], peak: float | None = None) -> float:
    """Structural similarity, mean over shared data; 1 for equal images. [1]

    Parameters
    ----------
    image, truth
        NaN without data; pixels with such data in their window of 11 × 11 are left out.
    peak
        Range of the values; by default that of the truth. [unit of the image]

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
    # the border has no data
    inside = np.asarray(minimum_filter(both, 2 * reach + 1, mode="constant", cval=False), bool)
    return float(index[inside].mean()) if inside.any() else float("nan")


def snr(image: Float[Array, "*pixel"], truth: Float[Array, "*pixel"]) -> float:
    """Signal-to-noise ratio, 20 log₁₀ of the truth's mean over the standard deviation of the noise. [dB]

    The noise is the difference less its mean: a bias is no noise.
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

    The share of the image's spectrum that correlates with the truth's, Re⟨F·G*⟩/⟨|G|²⟩: uncorrelated noise
    averages out.

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


def registration_error(camera: Camera, true_pose: Pose, reported_pose: Pose) -> float:
    """RMS position error on level ground at 0 m from the reported pose. [m]"""
    pixels = _pixel_lattice(camera)
    true, reported = (ground_points(camera, pose, pixels) for pose in (true_pose, reported_pose))
    return rmse(np.linalg.norm(reported - true, axis=-1), np.zeros(pixels.shape[:2]))


def registration_error_px(camera: Camera, true_pose: Pose, reported_pose: Pose) -> float:
    """RMS distance in the frame of ground points from their positions by the reported pose. [element]"""
    pixels = _pixel_lattice(camera)
    reported = project(camera, reported_pose, ground_points(camera, true_pose, pixels))
    return rmse(np.linalg.norm(reported - pixels, axis=-1), np.zeros(pixels.shape[:2]))


def _pixel_lattice(camera: Camera, side: int = 9) -> Float[Array, "side side 2"]:
    """Pixels spread evenly over the frame."""
    rows, columns = np.linspace(0, camera.rows - 1, side), np.linspace(0, camera.columns - 1, side)
    return np.stack(np.meshgrid(rows, columns, indexing="ij"), axis=-1)


def aop_error(
    stokes: Float[Array, "*pixel s"],
    truth: Float[Array, "*pixel s"],
    min_dolp: float = 0.05,
    floor: float = 0.0,
) -> float:
    """RMS error of the angle of polarization, modulo π. [rad]

    Parameters
    ----------
    stokes, truth
        Stokes vectors in one reference axis. [radiance]
    min_dolp
        Pixels whose true DoLP is less are left out: their angle is undefined. [1]
    floor
        Pixels whose S0 is at or below this in either are left out. [radiance]
    """
    valid = (dolp(truth, floor) >= min_dolp) & np.isfinite(dolp(stokes, floor))
    error = np.remainder(aop(stokes) - aop(truth) + np.pi / 2, np.pi) - np.pi / 2
    return rmse(np.where(valid, error, np.nan), np.zeros(valid.shape))


def spectral_angle(
    measured: Float[Array, "*spectrum wavelength"], truth: Float[Array, "*spectrum wavelength"]
) -> Float[Array, "*spectrum"]:
    """Angle between spectra as vectors, independent of brightness (SAM). [rad]

    NaN for a spectrum with a gap or without radiance.

    References
    ----------
    Kruse et al., Remote Sensing of Environment 44, 145 (1993).
    """
    a, b = np.asarray(measured, float), np.asarray(truth, float)
    with np.errstate(divide="ignore", invalid="ignore"):
        a = a / np.linalg.norm(a, axis=-1, keepdims=True)
        b = b / np.linalg.norm(b, axis=-1, keepdims=True)
    # half the chord: no loss of digits at small angles, as the arc cosine has
    return 2 * np.arctan2(np.linalg.norm(a - b, axis=-1), np.linalg.norm(a + b, axis=-1))
