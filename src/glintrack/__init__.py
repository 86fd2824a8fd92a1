"""glintrack: will this imaging sensor keep track of the vehicles?

``run("quickstart")`` flies a case into a result folder, ``simulate(Case.from_toml("case.toml"))`` in memory;
``load_result("result-quickstart")`` gives the arrays of a folder. Every command has its function here. Names
are loaded when they are first used.
"""

import os
from importlib import import_module
from typing import TYPE_CHECKING

from glintrack.core.lazy import lazy_names

if TYPE_CHECKING:
    from glintrack import (
        atmosphere,
        devices,
        flight,
        metrics,
        ortho,
        render,
        scene,
        sensor,
        stokes,
        study,
        track,
    )
    from glintrack.atmosphere import solve_tables as solve_atmosphere
    from glintrack.camera import Camera, Pose
    from glintrack.case.design import Case
    from glintrack.case.packaged import list_cases
    from glintrack.core.about import VERSION as __version__
    from glintrack.core.about import citation
    from glintrack.loop import simulate
    from glintrack.ortho.photograph import rectify
    from glintrack.results.read import load_result, read_result
    from glintrack.results.run import expose, label_frame, render_frame, run, score
    from glintrack.scene import build_scene
    from glintrack.sensor import measure_polarization
    from glintrack.track import track_detections, track_frames

__all__ = [
    "Camera",
    "Case",
    "Pose",
    "__version__",
    "atmosphere",
    "build_scene",
    "citation",
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
    "solve_atmosphere",
    "stokes",
    "study",
    "track",
    "track_detections",
    "track_frames",
]
if not os.access(os.path.dirname(__file__), os.W_OK):  # numba refuses kernels that it could not keep
    import_module("glintrack.core.kernels.place").find_place()
__getattr__, __dir__ = lazy_names(__name__, __file__)
