"""Keys of initiation: each replaces one value of its preset, and changes when tracks are confirmed or end."""

from dataclasses import asdict, replace

import numpy as np
import pytest

from glintrack import track
from glintrack.track.files import DETECTIONS_DESIGN

AREA = track.Grid((40, 40), (-150.0, 150.0), 7.5)
# one vehicle, one mode of motion, and rules that confirm at the second detection
LENIENT = {
    "motion.model": "constant-velocity",
    "association.method": "gnn",
    "initiation.confirm_score": -1000.0,
    "initiation.confirm_hits": 2,
    "initiation.confirm_window": 2,
    "initiation.confirm_min_age_s": 0.0,
    "initiation.confirm_travel_m": 0.0,
    "initiation.confirm_speed_m_s": 0.0,
    "initiation.coast_ramp_s": 0.5,
}


def states(changes, speed_m_s=4.0, seen=20, frames=20, interval_s=0.5, ratio=None):
    """The tracker after each frame; one vehicle drives east and is detected in the first frames."""
    state = track.start(DETECTIONS_DESIGN.replace(LENIENT | changes))
    for k in range(frames):
        found = track.Detections(
            np.array([[speed_m_s * interval_s * k, 0.0]]), 0.1 * np.eye(2)[None], np.ones(1), np.ones(1)
        )
        if ratio is not None:
            found = replace(found, log_likelihood_ratio=np.array([ratio]))
        found = found if k < seen else track.no_detections()
        state = track.step_detections(state, found, interval_s * k, AREA)
        yield state


def first_confirmed(changes, **options):
    """Frame in which the vehicle is confirmed; None for never."""
    confirmed = [bool(state.targets.confirmed.any()) for state in states(changes, **options)]
    return confirmed.index(True) if any(confirmed) else None


@pytest.mark.parametrize(
    ("key", "value", "frame"),
    [
        ("initiation.confirm_window", 4, 1),
        ("initiation.confirm_min_age_s", 3.0, 6),  # 6 × 0.5 s
        ("initiation.confirm_travel_m", 9.0, 5),  # 5 × 2 m, filtered
        ("initiation.confirm_speed_m_s", 6.0, None),  # it drives 4 m/s
    ],
)
def test_each_key_of_confirmation_delays_it(key, value, frame):
    assert first_confirmed({}) == 1
    assert first_confirmed({key: value}) == frame


def test_hits_count_within_the_window():
    assert first_confirmed({"initiation.confirm_hits": 4, "initiation.confirm_window": 5}) == 3


def test_a_likely_detection_confirms_at_once():
    assert first_confirmed({"initiation.confirm_ratio": 3.0}, ratio=4.0) == 0
    assert first_confirmed({"initiation.confirm_ratio": 5.0}, ratio=4.0) == 1


@pytest.mark.parametrize(
    ("key", "value", "speed_m_s"),
    [("initiation.stopped_coast_s", 3.0, 0.0), ("initiation.coast_s", 3.0, 8.0)],
)
def test_a_track_coasts_for_its_time(key, value, speed_m_s):
    """Measured up to 4.5 s, it is there 3 s later and not after that."""
    alive = [len(state.targets) for state in states({key: value}, speed_m_s, seen=10)]
    assert alive[:16] == [1] * 16 and alive[17:] == [0, 0, 0]


def test_an_unconfirmed_track_coasts_for_its_own_time():
    """Measured once at 0 s, it is there after 1.5 s and not after 2 s."""
    alive = [len(state.targets) for state in states({"initiation.tentative_coast_s": 1.5}, seen=1)]
    assert alive[:5] == [1, 1, 1, 1, 0]


def test_a_short_track_coasts_for_a_share_of_its_time():
    changes = {"initiation.coast_ramp_s": 4.0, "initiation.stopped_coast_s": 8.0}
    alive = [len(state.targets) for state in states(changes, 0.0, seen=5)]  # measured for 2 s: half of 8 s
    assert 11 <= sum(alive) <= 13


def test_a_new_track_has_the_speed_spread_of_the_design():
    state = next(states({"initiation.speed_sigma_m_s": 20.0}))
    np.testing.assert_allclose(state.targets.covariance[0, 2:, 2:], 400.0 * np.eye(2))


def test_keys_replace_single_values_of_the_preset():
    design = track.TrackDesign().replace({"reporting.method": "confirmation"})
    preset = design.initiation.in_use
    one = design.replace({"initiation.confirm_travel_m": 2.0}).initiation.in_use
    assert asdict(one) == {**asdict(preset), "confirm_travel_m": 2.0}
    assert design.replace({"initiation.rules": "frames"}).initiation.in_use.confirm_window == 4


def test_more_hits_than_frames_are_refused():
    design = track.TrackDesign().replace({"reporting.method": "confirmation"})
    with pytest.raises(ValueError, match=r"`initiation.confirm_hits` must be at most confirm_window, 5"):
        design.replace({"initiation.confirm_hits": 6})
