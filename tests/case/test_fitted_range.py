"""Rules of the tracker in use, keys that its detector ignores, and cases outside the fitted range."""

import pytest

from glintrack.case.check import assess_case
from glintrack.case.design import Case
from glintrack.case.fitted_range import describe_binning, describe_initiation, tracker_notes
from glintrack.case.packaged import find_case, list_cases


@pytest.mark.parametrize("name", list_cases())
def test_packaged_cases_are_within_the_fitted_range(name):
    assert tracker_notes(Case.from_toml(find_case(name))) == []


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"flight.rate_hz": 5.0, "sensor.max_frame_rate_hz": 5.0}, "frame rate 5 Hz (fitted at 2 Hz)"),
        ({"sensor.pitch_um": 8.5}, "ground sample distance 0.375 m (fitted at 0.75 m)"),
        ({"flight.off_nadir_deg": 0.0}, "off-nadir angle 0° (fitted at 50°)"),
        ({"track.detect.max_speed_m_s": 40.0}, "`track.detect.max_speed_m_s` 40 m/s (fitted at 22 m/s)"),
        ({"track.reporting.lag_s": 3.0}, "`track.reporting.lag_s` 3 s (fitted at 1.5 s)"),
        ({"track.detect.detector": "median-motion"}, "detector median-motion (fitted for mosaic)"),
    ],
)
def test_what_lies_outside_the_fitted_range_is_named(changes, words):
    assert words in tracker_notes(Case().replace(changes))[0]


@pytest.mark.parametrize(
    ("pitch_um", "line"),
    [
        (3.45, "detector: means of 3 × 3 elements of a kind, with a ground sample distance of 0.457 m"),
        (1.0, "detector: means of 8 × 8 elements of a kind, with a ground sample distance of 0.353 m"),
        (8.5, None),
        (17.0, None),
    ],
)
def test_elements_finer_than_the_fitted_range_are_averaged(pitch_um, line):
    """An element of 17 µm sees 0.75 m."""
    case = Case().replace({"sensor.pitch_um": pitch_um})
    assert describe_binning(case) == ([line] if line else [])
    assert describe_binning(case.replace({"track.detect.detector": "median-motion"})) == []
    view = {one.name: one.answer for one in assess_case(case, ["view"])}
    assert view["gsd_across_m"] == view["gsd_along_m"] == "good"


def test_the_line_of_confirmation_states_the_keys_in_use():
    assert "2 of 5 frames, 0 s, 1 m, 0.5 m/s (rules 'existence')" in describe_initiation(Case())
    own = {"track.reporting.method": "confirmation", "track.initiation.confirm_hits": 4}
    assert "4 of 5 frames, 1 s, 8 m, 2.5 m/s (rules 'change')" in describe_initiation(Case().replace(own))


def test_keys_of_another_detector_are_refused():
    """In a case `auto` is `mosaic`, which reads no rectified frames."""
    with pytest.raises(ValueError, match=r"`track.detect.dolp_boost` must be left out with detect.detector"):
        Case().replace({"track.detect.dolp_boost": 5.0})
    own = {"track.detect.detector": "median-motion", "track.detect.dolp_threshold": 0.3}
    assert Case().replace(own).track.detect.dolp_threshold == 0.3
