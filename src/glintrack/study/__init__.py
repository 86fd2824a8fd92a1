"""Trade studies: many cases of one base, flown anywhere, resumed after anything, and what they say."""

from .design import StudyDesign, read_study
from .estimate import Pace, in_words, rays, result_bytes
from .executors import Pool, dask, processes, serial
from .fly import Errand, attempt, fly_case
from .folder import StudyFolder
from .hits import HitsCache
from .plan import Plan, Point, build_plan, read_plan
from .report import analyse, write_report
from .runner import Event, Report, hits_at_hand, run_study
from .source import source_key
from .table import collect_table, read_results, write_results

__all__ = [
    "Errand",
    "Event",
    "HitsCache",
    "Pace",
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
    "in_words",
    "processes",
    "rays",
    "read_plan",
    "read_results",
    "read_study",
    "result_bytes",
    "run_study",
    "serial",
    "source_key",
    "write_report",
    "write_results",
]
