"""How well vehicles were tracked, and how good the pictures were, against the truth."""

from .multi_object import Likeness, gospa, likeness, multi_object_scores, ospa
from .pictures import mtf, psnr, registration_error, registration_error_px, rmse, snr, ssim
from .polarization import aop_error, dolp_error
from .quality import QUALITY_UNITS, frame_quality
from .rows import score_rows
from .spectra import band_misregistration, spectral_angle, spectral_rmse
from .tracks import (
    MATCH_DISTANCE_M,
    MOVING_SPEED_M_S,
    VISIBLE_FRACTION,
    EpochScore,
    completeness,
    identity_switches,
    match,
    purity,
    running_purity,
    score_epoch,
    summarize,
    track_purity,
    vehicle_purity,
)

__all__ = [
    "MATCH_DISTANCE_M",
    "MOVING_SPEED_M_S",
    "QUALITY_UNITS",
    "VISIBLE_FRACTION",
    "EpochScore",
    "aop_error",
    "band_misregistration",
    "completeness",
    "dolp_error",
    "frame_quality",
    "Likeness",
    "completeness",
    "gospa",
    "identity_switches",
    "likeness",
    "match",
    "mtf",
    "psnr",
    "multi_object_scores",
    "ospa",
    "purity",
    "registration_error",
    "registration_error_px",
    "rmse",
    "running_purity",
    "score_epoch",
    "snr",
    "spectral_angle",
    "spectral_rmse",
    "ssim",
    "score_rows",
    "summarize",
    "track_purity",
    "vehicle_purity",
]
