"""What a run leaves behind: tables, rectified frames and pictures in one folder."""

from .folder import write_result
from .recorder import Recorder

__all__ = ["Recorder", "write_result"]
