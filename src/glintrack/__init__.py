"""glintrack: will this imaging sensor keep track of the vehicles?

``simulate(Case.from_toml("case.toml"))`` flies one design over a city and scores its tracker;
``load_result("result-case")`` gives the arrays of what ``glintrack run`` wrote, and
``read_result("result-case")`` all of it, which shows itself in a notebook.
"""

from glintrack.config import Case
from glintrack.results.read import load_result, read_result
from glintrack.simulate import simulate

__all__ = ["Case", "load_result", "read_result", "simulate"]
