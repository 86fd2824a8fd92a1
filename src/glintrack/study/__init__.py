"""Trade studies: many cases of one base, flown anywhere, resumed after anything, and what they say."""

from .design import StudyDesign, read_study
from .estimate import rays, typical_cost
from .executors import Pool, dask, processes, serial
from .fly import Errand, attempt, fly_case
from .folder import StudyFolder
from .hits import HitsCache
from .plan import Plan, Point, build_plan, read_plan
from .report import analyse, write_report
from .runner import Event, Report, hits_at_hand, run_study
from .table import collect_table, read_results, write_results

__all__ = [
    "Errand",
    "Event",
    "HitsCache",
    "Plan",
    "Point",
    "Pool",
    "Report",
    "StudyDesign",
    "StudyFolder",
    "analyse",
    "attempt",
    "build_plan",
    "collect_table",
    "dask",
    "fly_case",
    "hits_at_hand",
    "processes",
    "rays",
    "read_plan",
    "read_results",
    "read_study",
    "run_study",
    "serial",
    "typical_cost",
    "write_report",
    "write_results",
]
