"""Scores of tracks and images against the truth."""

from glintrack.core.schema import MOVING_SPEED_M_S
from glintrack.metrics.multi_object import gospa, multi_object_scores, ospa, point_similarity
from glintrack.metrics.quality import (
    QUALITY_UNITS,
    aop_error,
    frame_quality,
    mtf,
    psnr,
    registration_error,
    registration_error_px,
    rmse,
    snr,
    spectral_angle,
    ssim,
)
from glintrack.metrics.rows import score_epochs, score_rows, score_tables
from glintrack.metrics.summary import (
    HEADLINE,
    completeness,
    custody,
    identity_switches,
    idf1_moving,
    median_time_to_loss,
    purity,
    running_purity,
    same_track_after,
    same_track_after_stop,
    summarize,
    vehicle_purity,
)
from glintrack.metrics.tracks import (
    MATCH_DISTANCE_M,
    VISIBLE_FRACTION,
    Area,
    EpochScore,
    area_km2,
    contains,
    is_in_area,
    is_moving,
    is_visible,
    match,
    near_pairs,
    score_epoch,
)

__all__ = [
    "HEADLINE", "MATCH_DISTANCE_M", "MOVING_SPEED_M_S", "QUALITY_UNITS", "VISIBLE_FRACTION", "Area",
    "EpochScore", "aop_error", "area_km2", "completeness", "contains", "custody", "frame_quality", "gospa",
    "identity_switches", "idf1_moving", "is_in_area", "is_moving", "is_visible", "match",
    "median_time_to_loss", "mtf", "multi_object_scores", "near_pairs", "ospa", "point_similarity", "psnr",
    "purity", "registration_error", "registration_error_px", "rmse", "running_purity", "same_track_after",
    "same_track_after_stop", "score_epoch", "score_epochs", "score_rows", "score_tables", "snr",
    "spectral_angle", "ssim", "summarize", "vehicle_purity",
]  # fmt: skip
