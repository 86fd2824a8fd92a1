"""Rules of the tracker in use, keys that its detector ignores, and cases outside the fitted range."""

import pytest

from glintrack.case.check import assess_case
from glintrack.case.design import Case
from glintrack.case.fitted_range import describe_binning, describe_initiation
from glintrack.case.packaged import find_case, list_cases
from glintrack.track.calibration import read_calibration


@pytest.mark.parametrize("name", list_cases())
def test_packaged_cases_are_within_the_fitted_range(name):
    assert {one.answer for one in assess_case(Case.from_toml(find_case(name)), ["tracker"])} == {"good"}


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"flight.rate_hz": 5.0, "sensor.max_frame_rate_hz": 5.0},
            "frame rate is 5.00 Hz, and detector and tracker were fitted at 2.00 Hz: lower `flight.rate_hz`",
        ),
        ({"sensor.pitch_um": 8.5}, "detector's sample distance is 0.375 m, and"),
        ({"flight.off_nadir_deg": 0.0}, "fitted at 50.0°: raise `flight.off_nadir_deg`"),
        ({"track.detect.max_speed_m_s": 40.0}, "speed limit is 40.0 m/s, and"),
        ({"track.reporting.lag_s": 3.0}, "lag of reports is 3.00 s, and"),
        ({"track.detect.detector": "median-motion"}, "0 % of the models were fitted for the detector in use"),
    ],
)
def test_what_lies_outside_the_fitted_range_is_doubtful(changes, words):
    found = [one for one in assess_case(Case().replace(changes)) if one.rank]
    assert {one.answer for one in found} == {"doubtful"} and any(words in one.reason for one in found)


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


def test_each_channel_has_its_own_fitted_range():
    reporting, detector = read_calibration("existence"), read_calibration("mosaic")
    assert reporting.valid_range("pan")["rate_hz"] == [2.0]
    assert reporting.valid_range("all")["rate_hz"] == [1.5, 10.0]
    assert detector.valid_range("all")["off_nadir_deg"] == [8.0, 50.0]
    assert detector.valid_range("all")["detector"] == detector.valid["detector"]


def test_the_line_of_confirmation_states_the_keys_in_use():
    own = {"track.reporting.method": "confirmation", "track.initiation.confirm_hits": 4}
    line = describe_initiation(Case())
    assert (
        "by detections in 2 of 5 frames, over 1 m or more, at 0.5 m/s or more (rules 'existence', `track"
        in line
    )
    assert "in 4 of 5 frames, over 1 s or more, over 8 m or more, at 2.5" in describe_initiation(
        Case().replace(own)
    )


def test_keys_of_another_detector_are_refused():
    """In a case `auto` is `mosaic`, which reads no rectified frames."""
    with pytest.raises(ValueError, match=r"`track.detect.dolp_boost` must be left out with detect.detector"):
        Case().replace({"track.detect.dolp_boost": 5.0})
    own = {"track.detect.detector": "median-motion", "track.detect.dolp_threshold": 0.3}
    assert Case().replace(own).track.detect.dolp_threshold == 0.3
