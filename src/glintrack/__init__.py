"""glintrack: will this imaging sensor keep track of the vehicles?

``simulate(Case.from_toml("case.toml"))`` flies one design over a city and scores its tracker.
"""

from .config import Case
from .simulate import simulate

__all__ = ["Case", "simulate"]
