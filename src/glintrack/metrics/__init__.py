"""Scores of tracks and pictures against the truth."""

from glintrack.metrics.custody import (
    custody,
    custody_scores,
    idf1_moving,
    median_time_to_loss,
    same_track_after,
)
from glintrack.metrics.definitions import (
    MATCH_DISTANCE_M,
    MOVING_SPEED_M_S,
    VISIBLE_FRACTION,
    is_in_window,
    is_moving,
    is_visible,
    window_km2,
)
from glintrack.metrics.multi_object import Similarity, gospa, multi_object_scores, ospa, point_similarity
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
from glintrack.metrics.rows import score_epochs, score_rows, score_tables
from glintrack.metrics.spectra import band_misregistration, spectral_angle, spectral_rmse
from glintrack.metrics.summary import HEADLINE, summarize
from glintrack.metrics.tracks import (
    EpochScore,
    completeness,
    identity_switches,
    match,
    near_pairs,
    purity,
    running_purity,
    score_epoch,
    track_purity,
    vehicle_purity,
)

__all__ = [
    "HEADLINE",
    "MATCH_DISTANCE_M",
    "MOVING_SPEED_M_S",
    "QUALITY_UNITS",
    "VISIBLE_FRACTION",
    "EpochScore",
    "Similarity",
    "aop_error",
    "band_misregistration",
    "completeness",
    "custody",
    "custody_scores",
    "dolp_error",
    "frame_quality",
    "gospa",
    "identity_switches",
    "idf1_moving",
    "is_in_window",
    "is_moving",
    "is_visible",
    "match",
    "median_time_to_loss",
    "mtf",
    "multi_object_scores",
    "near_pairs",
    "ospa",
    "point_similarity",
    "psnr",
    "purity",
    "registration_error",
    "registration_error_px",
    "rmse",
    "running_purity",
    "same_track_after",
    "score_epoch",
    "score_epochs",
    "score_rows",
    "score_tables",
    "snr",
    "spectral_angle",
    "spectral_rmse",
    "ssim",
    "summarize",
    "track_purity",
    "vehicle_purity",
    "window_km2",
]
