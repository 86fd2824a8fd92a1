"""Designs that tests begin from: one ray an element, ideal polarizers, and confirmation reporting."""

from collections.abc import Mapping
from typing import Any

from glintrack import Case
from glintrack.sensor import SensorDesign
from glintrack.track import TrackDesign

SENSOR: Mapping[str, Any] = {"oversampling": 1, "polarizer": "ideal", "demosaic": "bilinear"}
TRACK: Mapping[str, Mapping[str, Any]] = {
    "motion": {"acceleration_psd_m2_s3": 1.5},
    "association": {"gate_probability": 0.999},
    "initiation": {"rules": "rectified"},
    "reporting": {"method": "confirmation"},
    "query": {"at": "prediction"},
}


def plain_sensor(**keys: Any) -> SensorDesign:
    """The sensor with some keys changed."""
    return SensorDesign(**{**SENSOR, **keys})


def plain_tracker() -> TrackDesign:
    """The tracker."""
    return TrackDesign.model_validate(TRACK)


def plain_case(values: Mapping[str, Any]) -> Case:
    """A case with both, from its other values."""
    track = values.get("track", {})
    if track.get("reporting", {}).get("method") == "existence":
        track = {**track, "initiation": {"rules": "change", **track.get("initiation", {})}}
    both = {
        "channels": ("pan", "dolp"),
        **values,
        "sensor": {**SENSOR, **values.get("sensor", {})},
        "track": {name: {**TRACK.get(name, {}), **track.get(name, {})} for name in {**TRACK, **track}},
    }
    return Case.model_validate(both)
