"""Search for the cheapest design that meets requirements, with real simulations or any other function."""

from glintrack.optimize.report import OptimizationResult, build_result, read_result, write_result
from glintrack.optimize.run import StudyRunner, run_search
from glintrack.optimize.search import Observations, Outcome, Problem, find_cheapest
from glintrack.optimize.spec import Optimization, OptimizationDesign, read_optimization

__all__ = [
    "Observations",
    "Optimization",
    "OptimizationDesign",
    "OptimizationResult",
    "Outcome",
    "Problem",
    "StudyRunner",
    "build_result",
    "find_cheapest",
    "read_optimization",
    "read_result",
    "run_search",
    "write_result",
]
