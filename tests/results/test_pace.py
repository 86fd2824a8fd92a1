"""The time left against what two recorded flights took, from a tenth of their frames on."""

import pytest

from glintrack.results.recorder import FlightPace

# Clock at the end of each frame and of the whole run: `glintrack run quickstart --frames 22`, `run
# braunschweig --frames 16` on two cores, kernels compiled: processor time; wall time on a busy machine. [s]
QUICKSTART_CPU = [
    24.0, 29.4, 33.9, 39.0, 44.0, 55.4, 60.3, 64.3, 69.0, 73.7, 83.9, 89.1, 93.7, 98.4, 102.8, 113.8, 118.5,
    123.1, 127.4, 132.3, 141.8, 147.2, 162.6,
]  # fmt: skip
QUICKSTART_WALL = [
    190.4, 206.2, 214.5, 220.8, 226.9, 243.5, 250.5, 256.5, 263.0, 270.0, 285.8, 294.1, 300.0, 306.8, 312.6,
    328.9, 335.2, 340.8, 346.0, 352.3, 371.1, 382.0, 427.3,
]  # fmt: skip
BRAUNSCHWEIG_CPU = [
    20.2, 24.9, 29.7, 34.2, 38.9, 49.4, 54.1, 59.4, 64.1, 68.7, 77.8, 83.0, 87.9, 92.4, 96.6, 105.0, 120.1,
]  # fmt: skip


@pytest.mark.parametrize(
    ("clock", "most"),
    [(QUICKSTART_CPU, 1.6), (QUICKSTART_WALL, 1.8), (BRAUNSCHWEIG_CPU, 1.6)],
    ids=["quickstart, processor", "quickstart, wall", "braunschweig, processor"],
)
def test_the_time_left_is_honest_from_a_tenth_on(clock, most):
    *ends, whole = clock
    pace = FlightPace(len(ends))
    ratios = []
    for frame, at_s in enumerate(ends):
        pace.add(frame, at_s)
        left = pace.left_s()
        if frame + 1 >= 0.1 * len(ends) and left is not None:
            ratios.append(left / (whole - at_s))
    assert len(ratios) >= 0.9 * len(ends) and max(ratios) < most and min(ratios) > 1 / most, ratios


def test_before_two_frames_nothing_is_known():
    pace = FlightPace(10)
    pace.add(0, 40.0)
    assert pace.left_s() is None
    pace.add(1, 42.0)
    assert pace.left_s() == pytest.approx(2.0 * (8 + 2.5 + 0.5))  # what the first frame took has no part
