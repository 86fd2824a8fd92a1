"""Tracking of what moves, and the spectra it asks for.

`start`, `step` and `report` are the whole interface of the main path; `step_detections` takes what somebody
else detected. The tracker never sees the truth.
"""

from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Association, Detections, no_detections, of_boxes
from glintrack.track.detect.detector import DETECTORS, Detector, detector_of
from glintrack.track.detect.frame import Frame, Grid
from glintrack.track.files import track_detections, track_frames
from glintrack.track.frame_detections import FrameDetections, detect_frame, given_detections
from glintrack.track.queries import query_detections, query_predictions
from glintrack.track.reporting import (
    LabelledTracks,
    PendingEpoch,
    advance,
    flush,
    report,
    report_at_shares,
    reported_epochs,
)
from glintrack.track.state import TrackerState
from glintrack.track.tracker import detections, start, step, step_detections

__all__ = [
    "DETECTORS",
    "Association",
    "Detections",
    "Detector",
    "Frame",
    "FrameDetections",
    "Grid",
    "LabelledTracks",
    "PendingEpoch",
    "TrackDesign",
    "TrackerState",
    "advance",
    "detect_frame",
    "detections",
    "detector_of",
    "flush",
    "given_detections",
    "no_detections",
    "of_boxes",
    "query_detections",
    "query_predictions",
    "report",
    "report_at_shares",
    "reported_epochs",
    "start",
    "step",
    "step_detections",
    "track_detections",
    "track_frames",
]
