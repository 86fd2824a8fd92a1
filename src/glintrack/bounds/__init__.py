"""Loss budget: share of the vehicles that is left at each stage, from the scene to the tracks."""

from glintrack.bounds.loss_budget import STAGE_LABELS, STAGES, STAGES_NOTE
from glintrack.bounds.recorder import BudgetRecorder

__all__ = ["STAGES", "STAGES_NOTE", "STAGE_LABELS", "BudgetRecorder"]
