"""Trade studies: many cases of one base, flown anywhere, resumed after anything, and what they say."""

from glintrack.study.design import StudyDesign, read_study
from glintrack.study.estimate import Pace, result_bytes, rough_s
from glintrack.study.folder import StudyFolder
from glintrack.study.hits import HitsCache
from glintrack.study.plan import Plan, Point, build_plan, read_plan
from glintrack.study.report import analyse, write_report
from glintrack.study.run import Event, Report, hits_at_hand, run_study
from glintrack.study.source import source_key
from glintrack.study.table import collect_table, read_results, write_results
from glintrack.study.task import Task, attempt, fly_case
from glintrack.study.workers import Pool, dask, processes, serial

__all__ = [
    "Event",
    "HitsCache",
    "Pace",
    "Plan",
    "Point",
    "Pool",
    "Report",
    "StudyDesign",
    "StudyFolder",
    "Task",
    "analyse",
    "attempt",
    "build_plan",
    "collect_table",
    "dask",
    "fly_case",
    "hits_at_hand",
    "processes",
    "read_plan",
    "read_results",
    "read_study",
    "result_bytes",
    "rough_s",
    "run_study",
    "serial",
    "source_key",
    "write_report",
    "write_results",
]
