"""Tracking of what moves in rectified frames, and the spectra it asks for.

`start`, `step` and `report` are the whole interface of the main path; `step_detections` takes what somebody
else detected. The tracker never sees the truth.
"""

from glintrack.track.blobs import Detections
from glintrack.track.design import TrackDesign
from glintrack.track.frame import Grid
from glintrack.track.tracker import (
    TrackerState,
    ask,
    detections,
    report,
    start,
    step,
    step_detections,
    tracks,
)

__all__ = [
    "Detections",
    "Grid",
    "TrackDesign",
    "TrackerState",
    "ask",
    "detections",
    "report",
    "start",
    "step",
    "step_detections",
    "tracks",
]
