"""The ladder from the sensor's limit to the tracker's score: what is lost where."""

from glintrack.bounds.ladder import FOUND, RUNG_WORDS, RUNGS, TRACKED, by, ladder
from glintrack.bounds.recorder import LadderRecorder

__all__ = ["FOUND", "RUNGS", "RUNG_WORDS", "TRACKED", "LadderRecorder", "by", "ladder"]
