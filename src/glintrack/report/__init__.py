"""What a run leaves behind in one folder, and the page, server and video that show it."""

from .folder import write_result
from .page import build_page
from .read_result import Result, load_result, read_result
from .recorder import Recorder
from .video import Composite, write_video
from .view import ResultServer, serve_result

__all__ = [
    "Composite",
    "Recorder",
    "Result",
    "ResultServer",
    "build_page",
    "load_result",
    "read_result",
    "serve_result",
    "write_result",
    "write_video",
]
