"""Trade studies: many cases of one base, simulated anywhere, resumed after anything, and what they say."""

from glintrack.study.design import StudyDesign, read_study
from glintrack.study.folder import StudyFolder, collect_table, read_results, write_results
from glintrack.study.hits import HitsCache
from glintrack.study.plan import Plan, Point, build_plan, read_plan
from glintrack.study.report import analyse, write_report
from glintrack.study.run import RunReport, StudyEvent, StudyPace, estimate_cpu_s, forecast, run_study
from glintrack.study.workers import Pool, Task, attempt, dask, processes, serial, simulate_case

__all__ = [
    "HitsCache", "Plan", "Point", "Pool", "RunReport", "StudyDesign", "StudyEvent", "StudyFolder",
    "StudyPace", "Task", "analyse", "attempt", "build_plan", "collect_table", "dask", "estimate_cpu_s",
    "forecast", "processes", "read_plan", "read_results", "read_study", "run_study", "serial",
    "simulate_case", "write_report", "write_results",
]  # fmt: skip
