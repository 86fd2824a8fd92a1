"""Scores that a study's report tells of, in order, and what tables, figures and pages call them."""

import pandas as pd

from glintrack.bounds import RUNG_WORDS

RESPONSES = (
    "held_per_km2",
    "completeness",
    "completeness_visible",
    "custody",
    "purity",
    "identity_switches",
    "false_per_km2",
    "false_per_epoch",
    "rung_known_background",
    "rung_predicted_background",
    "rung_detector",
)  # the headline first
SHORT = {
    "false_per_km2": "false/km²",
    "completeness_visible": "of visible: tracker",
    "rung_known_background": "of all: background known",
    "rung_detector": "of all: detector",
}
RANKED_BY = ("held_per_km2", "completeness_visible", "custody")  # what designs are ranked by
# told beside the headline: its price first
BESIDE = ("false_per_km2", "completeness_visible", "rung_known_background", "rung_detector")
NAMES = {
    "held_per_km2": "vehicles held per km²",
    "custody": "custody",
    "false_per_km2": "false tracks per km²",
    "completeness": "completeness, of all moving vehicles",
    "completeness_visible": "completeness, of visible moving vehicles",
    "purity": "track purity",
    "identity_switches": "identity switches of a flight",
    "false_per_epoch": "false tracks a frame",
    "data_rate_mbit_s": "data rate [Mbit/s]",
    **{f"rung_{rung}": f"ladder, of all moving vehicles: {words}" for rung, words in RUNG_WORDS.items()},
}
CHANNELS = {
    "pan": ("tab:gray", "o"),
    "dolp": ("tab:blue", "s"),
    "all": ("tab:green", "^"),
}
CHANNEL_NAMES = {"pan": "pan", "dolp": "DoLP", "all": "all elements"}


def headline(table: pd.DataFrame) -> str:
    """The first of `RESPONSES` that a table of effects has."""
    return next(name for name in RESPONSES if name in set(table["response"]))
