"""How well vehicles were tracked, and how good the pictures were, against the truth."""

from glintrack.metrics.multi_object import Likeness, gospa, likeness, multi_object_scores, ospa
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
from glintrack.metrics.quality import QUALITY_UNITS, frame_quality
from glintrack.metrics.rows import score_epochs, score_rows
from glintrack.metrics.spectra import band_misregistration, spectral_angle, spectral_rmse
from glintrack.metrics.tracks import (
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
    "Likeness",
    "aop_error",
    "band_misregistration",
    "completeness",
    "dolp_error",
    "frame_quality",
    "gospa",
    "identity_switches",
    "likeness",
    "match",
    "mtf",
    "multi_object_scores",
    "ospa",
    "psnr",
    "purity",
    "registration_error",
    "registration_error_px",
    "rmse",
    "running_purity",
    "score_epoch",
    "score_epochs",
    "score_rows",
    "snr",
    "spectral_angle",
    "spectral_rmse",
    "ssim",
    "summarize",
    "track_purity",
    "vehicle_purity",
]
