"""A labelled set from seeds: raws, rectified channels, light without noise, poses, boxes, masks, tracks."""

from glintrack.dataset.baseline import BASELINES, SCORES, Baseline, score_baselines
from glintrack.dataset.build import build_dataset
from glintrack.dataset.multiobject import TrackingSet, track_target
from glintrack.dataset.plan import DatasetPlan, plan_dataset, split_by_city, standard_cases
from glintrack.dataset.shards import LabelledFrame, labelled_frames

__all__ = [
    "BASELINES",
    "SCORES",
    "Baseline",
    "DatasetPlan",
    "LabelledFrame",
    "TrackingSet",
    "build_dataset",
    "labelled_frames",
    "plan_dataset",
    "score_baselines",
    "split_by_city",
    "standard_cases",
    "track_target",
]
