"""Labelled data sets: raws, rectified channels, light without noise, poses, boxes, masks and tracks."""

from glintrack.dataset.annotations import read_rows
from glintrack.dataset.baseline import BASELINES, SCORES, Baseline, score_baselines
from glintrack.dataset.build import build_dataset, read_plan
from glintrack.dataset.multiobject import TrackingSet
from glintrack.dataset.plan import DatasetPlan, plan_dataset, split_by_city, standard_cases
from glintrack.dataset.shards import LabelledFrame, simulate_frames

__all__ = [
    "BASELINES", "SCORES", "Baseline", "DatasetPlan", "LabelledFrame", "TrackingSet", "build_dataset",
    "plan_dataset", "read_plan", "read_rows", "score_baselines", "simulate_frames", "split_by_city",
    "standard_cases",
]  # fmt: skip
