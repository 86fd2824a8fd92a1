"""All that is measured of one frame against its noiseless truth, by name."""

import numpy as np
import xarray as xr

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.schema import RADIANCE, check
from glintrack.metrics.pictures import (
    mtf,
    psnr,
    registration_error,
    registration_error_px,
    rmse,
    snr,
    ssim,
)
from glintrack.metrics.polarization import aop_error, dolp_error
from glintrack.metrics.spectra import spectral_angle, spectral_rmse

# what `frame_quality` measures, and in what
QUALITY_UNITS = {
    "rmse": RADIANCE,
    "psnr": "dB",
    "ssim": "1",
    "snr": "dB",
    "mtf_quarter": "1",
    "dolp_rmse": "1",
    "aop_rmse": "rad",
    "registration_error": "m",
    "registration_error_px": "element",
    "spectral_angle": "rad",
    "spectral_rmse": RADIANCE,
}


def frame_quality(
    image: xr.Dataset,
    truth: xr.Dataset,
    camera: Camera,
    true_pose: Pose,
    reported_pose: Pose,
    spectra: xr.Dataset | None = None,
    true_spectra: Array | None = None,
) -> dict[str, float]:
    """Every figure of `QUALITY_UNITS` for one rectified frame.

    Parameters
    ----------
    image
        Schema ``image``, as the tracker sees it.
    truth
        Schema ``image`` on the same grid: the light without noise, blur and mosaic, placed by the true pose.
    camera, true_pose, reported_pose
        For the error of registration on level ground at nought.
    spectra, true_spectra
        Schema ``spectra``, and what a noiseless spectrometer would have measured, row by row. [radiance]

    Returns
    -------
    NaN where there is nothing to measure.
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
        spectral = spectral_rmse(measured, true_spectra)
    return {
        "rmse": rmse(pan, true_pan),
        "psnr": psnr(pan, true_pan),
        "ssim": ssim(pan, true_pan),
        "snr": snr(pan, true_pan),
        "mtf_quarter": float(np.interp(0.25, frequency, transfer)),  # half way to the grid's limit
        "dolp_rmse": dolp_error(stokes, true_stokes, floor),
        "aop_rmse": aop_error(stokes, true_stokes, floor=floor),
        "registration_error": registration_error(camera, true_pose, reported_pose),
        "registration_error_px": registration_error_px(camera, true_pose, reported_pose),
        "spectral_angle": angle,
        "spectral_rmse": spectral,
    }
