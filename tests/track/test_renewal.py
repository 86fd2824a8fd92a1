"""A track found again far from where it was expected gets a new number."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack import track
from glintrack.track.renewal import FAR_M, renewed

from .test_belief import AREA, EXISTENCE, INTERVAL_S, followed

SPEED_M_S = 8.0


def ids_told(aside_m, missed, method):
    """Ids reported of one target that drives east, out of sight for some frames, then found so far aside."""
    design = track.TrackDesign().replace(
        {
            "query.policy": "none",
            **EXISTENCE,
            "reporting.max_false_share": 0.5,
            "motion.acceleration_psd_m2_s3": 4.0,
            "association.gate_probability": 0.999999,
            "association.method": method,
        }
    )
    state, out = track.start(design), []
    for k in range(16 + missed):
        seen = k < 8 or k >= 8 + missed
        place = [SPEED_M_S * INTERVAL_S * k, aside_m if k >= 8 else 0.0]
        found = track.Detections(
            np.array([place])[: int(seen)], 0.25 * np.eye(2)[None][: int(seen)], np.ones(int(seen)),
            np.ones(int(seen)), log_likelihood_ratio=np.full(int(seen), 3.5),
        )  # fmt: skip
        state = track.step_detections(state, found, INTERVAL_S * k, AREA)
        out.append(track.report(state)["track"].values.tolist())
    return out


@pytest.mark.parametrize("method", ["gnn", "mht"])
def test_found_again_near_it_is_itself_and_far_off_another(method):
    near, far = ids_told(0.9 * FAR_M, 2, method), ids_told(1.1 * FAR_M, 2, method)
    assert near[7] == near[-1]
    assert len(near[-1]) == len(far[-1]) == 1
    assert far[7] == near[7]
    assert far[-1] != far[7]
    assert far[10] == far[-1], "at the frame in which it is found again"


def test_only_what_was_out_of_sight_gets_a_new_number():
    before = followed([0.0, 100.0, 200.0])
    before = replace(before, misses=np.array([1, 0, 1]))
    far = [0.0, SPEED_M_S * INTERVAL_S + FAR_M + 3]
    moved = before.mean + np.array([0.0, 0.0, 0.0, 0.0])
    moved[:, :2] += far
    after = replace(before, mean=moved, mode_mean=moved[:, None], misses=np.array([0, 0, 2]))
    assert renewed(before, after, INTERVAL_S, 7).tolist() == [7, 1, 2]
    tentative = replace(after, confirmed=np.array([False, True, True]))
    assert renewed(before, tentative, INTERVAL_S, 7).tolist() == [0, 1, 2]
