"""The ladder from the sensor's limit to the tracker's score: what is lost where."""

from glintrack.bound.ladder import FOUND, RUNGS, TRACKED, by, ladder
from glintrack.bound.recorder import LadderRecorder

__all__ = ["FOUND", "RUNGS", "TRACKED", "LadderRecorder", "by", "ladder"]
