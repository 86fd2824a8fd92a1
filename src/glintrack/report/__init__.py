"""The page, server and video that show a result."""

from glintrack.report.page import build_page
from glintrack.report.video import Composite, write_video
from glintrack.report.view import ResultServer, serve_result

__all__ = ["Composite", "ResultServer", "build_page", "serve_result", "write_video"]
