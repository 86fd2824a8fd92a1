from . import atmosphere, devices, flight, metrics, ortho, render, scene, sensor, stokes, study, track
from .camera import Camera, Pose
from .case.check import assess_case
from .case.design import Case
from .case.packaged import list_cases
from .core.installation import citation
from .loop import simulate
from .ortho.photograph import rectify
from .results.read import load_result, read_result
from .results.run import compile_kernels, expose, label_frame, render_frame, run, score
from .scene import build_scene
from .sensor import measure_polarization
from .track import track_detections, track_frames

__version__: str
__all__ = [
    "Camera",
    "Case",
    "Pose",
    "__version__",
    "assess_case",
    "atmosphere",
    "build_scene",
    "citation",
    "compile_kernels",
    "devices",
    "expose",
    "flight",
    "label_frame",
    "list_cases",
    "load_result",
    "measure_polarization",
    "metrics",
    "ortho",
    "read_result",
    "rectify",
    "render",
    "render_frame",
    "run",
    "scene",
    "score",
    "sensor",
    "simulate",
    "stokes",
    "study",
    "track",
    "track_detections",
    "track_frames",
]
