"""Tracking of what moves in rectified frames, and the spectra it asks for.

`start`, `step` and `report` are the whole interface of the main path; the tracker never sees the truth.
"""

from glintrack.track.blobs import Detections
from glintrack.track.design import TrackDesign
from glintrack.track.tracker import TrackerState, detections, report, start, step, tracks

__all__ = ["Detections", "TrackDesign", "TrackerState", "detections", "report", "start", "step", "tracks"]
