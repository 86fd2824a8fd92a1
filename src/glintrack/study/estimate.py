"""What a study will cost, from what its finished cases took."""

from ..config import Case
from .folder import StudyFolder
from .plan import Plan

# of the quickstart with both modalities on one core; benchmarks/study.py measures it
ROUGH_SECONDS_A_RAY = 2e-6


def rays(case: Case) -> int:
    """Rays of a whole flight, to which most of its cost is proportional."""
    sensor = case.sensor
    return sensor.rows * sensor.columns * sensor.oversampling**2 * case.flight.frames


def typical_cost(plan: Plan, folder: StudyFolder) -> tuple[float, bool]:
    """Seconds of one worker per ray, and whether that was measured in this study or is a rough figure."""
    seconds = work = 0.0
    for key, case in plan.cases.items():
        told = folder.finished(key)
        if told:
            seconds += float(told["seconds"])
            work += rays(case)
    return (seconds / work, True) if work else (ROUGH_SECONDS_A_RAY, False)
