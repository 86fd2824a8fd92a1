"""Largest lasting loss of a loss budget, and the remedy that recorded studies suggest for a design."""

from collections.abc import Mapping
from typing import NamedTuple

from glintrack.case.design import Case
from glintrack.case.quantities import ground_view
from glintrack.core.installation import read_data
from glintrack.io.toml import read_toml
from glintrack.track.calibration import calibration_file

LOSSES: Mapping[str, str] = read_data("page", "scores.toml")["losses"]  # a cause for each stage
_MEMORY = ("predicted_background", "reported_pose", "detector")  # may be lower than the stages after them


class Loss(NamedTuple):
    """Stage of a loss, and the share of the moving vehicles before and after it. [1]"""

    stage: str
    before: float
    after: float


def largest_loss(budget: Mapping[str, float]) -> Loss | None:
    """Largest lasting loss: a share that no later stage recovers; None if nothing is lost.

    Parameters
    ----------
    budget
        Share of the moving vehicles at each stage, from `stage_shares`.
    """
    found, before, stages = [], 1.0, list(budget)
    for stage in LOSSES:
        if stage in budget:
            later = stages[stages.index(stage) :] if stage in _MEMORY else [stage]
            share = max(budget[one] for one in later)
            found.append(Loss(stage, before, share))
            before = share
    worst = max(found, key=lambda loss: loss.before - loss.after, default=None)
    return worst if worst is not None and worst.before > worst.after else None


class Remedy(NamedTuple):
    """Advice and the effect that a study recorded."""

    advice: str
    evidence: str


def find_remedy(stage: str, case: Case | None) -> Remedy | None:
    """Remedy for a loss whose range holds the design; None if no study recorded one.

    Parameters
    ----------
    stage
        Stage of the loss.
    case
        The design; None where it is not known.
    """
    known = {}
    if case is not None:
        flight = case.flight
        known = {"rate_hz": flight.rate_hz, "off_nadir_deg": flight.off_nadir_deg}
        known["gsd_m"] = ground_view(case)[0][0]
    for one in read_toml(calibration_file("sensitivities"), "sensitivities")["remedies"]:
        ranges = one.get("valid", {}).items()
        if stage in one["stages"] and all(k in known and low <= known[k] <= top for k, (low, top) in ranges):
            return Remedy(one["advice"], one["evidence"])
    return None
