"""Tracking of what moves in rectified frames, and the spectra it asks for.

`start`, `step` and `report` are the whole interface of the main path; `step_detections` takes what somebody
else detected. The tracker never sees the truth.
"""

from glintrack.track.design import TrackDesign
from glintrack.track.detect.blobs import Detections
from glintrack.track.detect.frame import Grid
from glintrack.track.detect.frame_detections import Look, look, look_at_detections
from glintrack.track.queries.ask import ask, doubts
from glintrack.track.state import TrackerState
from glintrack.track.tracker import detections, report, start, step, step_detections, tracks

__all__ = [
    "Detections",
    "Grid",
    "Look",
    "TrackDesign",
    "TrackerState",
    "ask",
    "detections",
    "doubts",
    "look",
    "look_at_detections",
    "report",
    "start",
    "step",
    "step_detections",
    "tracks",
]
