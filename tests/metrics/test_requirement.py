"""Requirements: Student's interval of known numbers, decided or not, and how many flights would decide."""

import numpy as np
import pytest
from scipy import stats

from glintrack.metrics.requirement import (
    Requirement,
    assess,
    assess_flight,
    describe_assessment,
    jackknife,
    read_requirement,
)
from glintrack.metrics.tracks import Vehicles, match_epoch

VALUES = np.array([0.70, 0.74, 0.78, 0.72, 0.76, 0.74])


STUDENT = stats.t.interval(0.95, 5, VALUES.mean(), stats.sem(VALUES))


def test_jackknife_of_a_mean_has_students_interval():
    """Of a mean the jackknife's standard error is s/√n, exactly."""
    found = jackknife(lambda kept: VALUES[list(kept)].mean(), len(VALUES))
    np.testing.assert_allclose(found, (0.74, *STUDENT), rtol=1e-12)


@pytest.mark.parametrize(("limit", "answer"), [(0.70, "yes"), (0.80, "no"), (0.75, "undecided")])
def test_what_lies_on_one_side_with_all_of_its_interval_is_decided(limit, answer):
    found = assess(Requirement("custody", True, limit), 0.74, *STUDENT)
    assert found.answer == answer
    opposite = assess(Requirement("custody", False, limit), 0.74, *STUDENT)
    assert opposite.answer == {"yes": "no", "no": "yes"}.get(answer, answer)


@pytest.mark.parametrize("flights", [1, 4])
def test_so_many_more_flights_decide(flights):
    """An interval that shrinks as 1/√flights just leaves the limit with those told, and not with one less."""
    required = Requirement("custody", True, 0.735)
    found = assess(required, 0.74, *STUDENT, flights)
    assert found.answer == "undecided"
    for more, answer in ((found.more_flights, "yes"), (found.more_flights - 1, "undecided")):
        shrunk = 0.74 + (np.array(STUDENT) - 0.74) * np.sqrt(flights / (flights + more))
        assert assess(required, 0.74, *shrunk).answer == answer


def test_right_on_the_limit_no_number_decides():
    found = assess(Requirement("custody", True, 0.74), 0.74, *STUDENT)
    assert (found.answer, found.more_flights) == ("undecided", None)
    assert "would not decide" in describe_assessment(Requirement("custody", True, 0.74), found)


def test_one_part_decides_nothing():
    found = assess(Requirement("custody", True, 0.1), *jackknife(lambda kept: 0.7 if kept else np.nan, 1))
    assert found.answer == "undecided"
    assert "too short" in describe_assessment(Requirement("custody", True, 0.1), found)


def test_requirements_are_read_with_channel_and_sign():
    assert read_requirement("custody>=0.8") == Requirement("custody", True, 0.8)
    assert read_requirement(" pan.false_per_km2 <= 40 ") == Requirement("false_per_km2", False, 40, "pan")
    assert str(read_requirement("dolp.purity>.9")) == "dolp.purity >= 0.9"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("custody", "SCORE>=NUMBER"),
        ("custdy>=0.8", r"Did you mean `custody`"),
        ("custody>=nan", "finite"),
        ("a=1", "SCORE"),
    ],
)
def test_what_is_no_requirement_is_refused(text, match):
    with pytest.raises(ValueError, match=match):
        read_requirement(text)


KM2 = (0.0, 0.0, 1000.0, 1000.0)


def test_channel_that_did_not_fly_is_refused():
    with pytest.raises(ValueError, match="pan, dolp"):
        read_requirement("all.custody>=0.8").check_channel(["pan", "dolp"])


@pytest.mark.parametrize(
    ("frames", "rate_hz", "decides"), [(40, 2.0, True), (8, 0.5, False), (40, 20.0, False)]
)
def test_a_flight_of_few_frames_or_seconds_decides_nothing(frames, rate_hz, decides):
    """Two of three vehicles held throughout: no part differs from the others."""
    ids, yes = np.arange(3), np.ones(3, bool)
    place_m = 50.0 * np.stack([ids, ids], axis=1)
    vehicles = Vehicles(ids, place_m, yes, yes, yes)
    epochs = [match_epoch(ids[:2], place_m[:2], vehicles, 5.0, k / rate_hz, KM2) for k in range(frames)]
    found = assess_flight(Requirement("completeness", True, 0.5), epochs)
    assert found.value == pytest.approx(2 / 3)
    assert found.answer == ("yes" if decides else "undecided")


def test_the_interval_of_a_total_is_that_of_the_sum_of_its_parts():
    """Each sixth of the flight begins and ends under track 1, and changes between tracks 1 and 2 within."""
    switches = np.array([4, 6, 8, 4, 6, 2])
    held = np.concatenate([np.pad([2, 1] * (n // 2), (1, 19 - n), constant_values=1) for n in switches])
    ids, yes = np.array([3]), np.ones(1, bool)
    vehicles = Vehicles(ids, np.zeros((1, 2)), yes, yes, yes)
    epochs = [
        match_epoch(np.array([t]), np.zeros((1, 2)), vehicles, 5.0, k / 2, KM2) for k, t in enumerate(held)
    ]
    found = assess_flight(Requirement("identity_switches", False, 100), epochs)
    assert found.value == 30
    reach = stats.t.ppf(0.975, 5) * np.sqrt(6) * switches.std(ddof=1)
    assert (found.low, found.high) == pytest.approx((30 - reach, 30 + reach))
