"""glintrack: will this imaging sensor keep track of the vehicles?

``simulate(Case.from_toml("case.toml"))`` flies one design over a city and scores its tracker;
``load_result("result-case")`` reads what ``glintrack run`` wrote.
"""

from .config import Case
from .report import load_result
from .simulate import simulate

__all__ = ["Case", "load_result", "simulate"]
