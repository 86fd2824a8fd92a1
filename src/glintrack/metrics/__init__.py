"""How well vehicles were tracked, and how good the pictures were, against the truth."""

from .tracks import (
    MATCH_DISTANCE_M,
    MOVING_SPEED_M_S,
    VISIBLE_FRACTION,
    EpochScore,
    completeness,
    identity_switches,
    match,
    purity,
    score_epoch,
    summarize,
    track_purity,
    vehicle_purity,
)

__all__ = [
    "MATCH_DISTANCE_M",
    "MOVING_SPEED_M_S",
    "VISIBLE_FRACTION",
    "EpochScore",
    "completeness",
    "identity_switches",
    "match",
    "purity",
    "score_epoch",
    "summarize",
    "track_purity",
    "vehicle_purity",
]
