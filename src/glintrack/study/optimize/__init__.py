"""Search for the cheapest design that meets requirements, with real simulations or any other function."""

from glintrack.study.optimize.report import OptimizationResult, build_result, read_result, write_result
from glintrack.study.optimize.run import StudyRunner, run_search
from glintrack.study.optimize.search import Observations, Outcome, Problem, find_cheapest
from glintrack.study.optimize.spec import Optimization, OptimizationDesign, read_optimization

__all__ = [
    "Observations", "Optimization", "OptimizationDesign", "OptimizationResult", "Outcome", "Problem",
    "StudyRunner", "build_result", "find_cheapest", "read_optimization", "read_result", "run_search",
    "write_result",
]  # fmt: skip
