"""Detection and tracking of vehicles, and queries for spectra.

`start`, `step` and `report` are the interface of the main path; `step_detections` takes the detections of
another program. The tracker never sees the truth.
"""

from glintrack.track.design import TrackDesign
from glintrack.track.detect.detections import Association, Detections, no_detections, of_boxes
from glintrack.track.detect.detector import DETECTORS, Detector, detector_of
from glintrack.track.detect.frame import Frame, Grid
from glintrack.track.files import track_detections, track_frames
from glintrack.track.frame_detections import FrameDetections, TrackerState, detect_frame, prepare_detections
from glintrack.track.queries import query_detections, query_predictions
from glintrack.track.reporting import PendingEpoch, advance, flush, report, report_epochs
from glintrack.track.tracker import start, step, step_detections

__all__ = [
    "DETECTORS", "Association", "Detections", "Detector", "Frame", "FrameDetections", "Grid", "PendingEpoch",
    "TrackDesign", "TrackerState", "advance", "detect_frame", "detector_of", "flush",
    "no_detections", "of_boxes", "prepare_detections", "query_detections", "query_predictions", "report",
    "report_epochs", "start", "step", "step_detections", "track_detections", "track_frames",
]  # fmt: skip
