"""Loss budget: share of the vehicles that is left at each stage, from the scene to the tracks."""

from glintrack.bounds.loss_budget import STAGE_LABELS, STAGES
from glintrack.bounds.recorder import BudgetRecorder

__all__ = ["STAGES", "STAGE_LABELS", "BudgetRecorder"]
