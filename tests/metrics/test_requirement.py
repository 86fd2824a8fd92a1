"""Requirements: Student's interval of known numbers, decided or not, and how many flights would decide."""

import numpy as np
import pytest
from scipy import stats

from glintrack.metrics.requirement import (
    Requirement,
    in_a_sentence,
    jackknife,
    judge,
    judge_values,
    read_requirement,
)

VALUES = np.array([0.70, 0.74, 0.78, 0.72, 0.76, 0.74])


def test_jackknife_of_a_mean_is_its_standard_error():
    """Of a mean the jackknife is s/√n, exactly."""
    value, error, parts = jackknife(lambda kept: VALUES[list(kept)].mean(), len(VALUES))
    assert (value, parts) == (pytest.approx(0.74), 6)
    assert error == pytest.approx(stats.sem(VALUES), rel=1e-12)


@pytest.mark.parametrize(("limit", "answer"), [(0.70, "yes"), (0.80, "no"), (0.75, "undecided")])
def test_what_lies_on_one_side_with_all_of_its_interval_is_decided(limit, answer):
    found = judge_values(Requirement("custody", True, limit), VALUES, 1)
    low, high = stats.t.interval(0.95, 5, VALUES.mean(), stats.sem(VALUES))
    assert (found.low, found.high) == (pytest.approx(low), pytest.approx(high))
    assert found.answer == answer
    opposite = judge_values(Requirement("custody", False, limit), VALUES, 1)
    assert opposite.answer == {"yes": "no", "no": "yes"}.get(answer, answer)


def test_so_many_more_flights_decide():
    """With the flights told, of the same parts, the interval just leaves the limit; with one less not."""
    required = Requirement("custody", True, 0.735)
    found = judge_values(required, VALUES, 1)
    assert found.answer == "undecided"
    for more, answer in ((found.more_flights, "yes"), (found.more_flights - 1, "undecided")):
        error = stats.sem(VALUES) / np.sqrt(1 + more)
        assert judge(required, VALUES.mean(), error, 6 * (1 + more), 1 + more).answer == answer


def test_right_on_the_limit_no_number_decides():
    found = judge_values(Requirement("custody", True, float(VALUES.mean())), VALUES, 1)
    assert (found.answer, found.more_flights) == ("undecided", None)
    assert "would not decide" in in_a_sentence(Requirement("custody", True, 0.74), found)


def test_one_part_decides_nothing():
    found = judge_values(Requirement("custody", True, 0.1), VALUES[:1], 1)
    assert found.answer == "undecided"
    assert "too short" in in_a_sentence(Requirement("custody", True, 0.1), found)


def test_requirements_are_read_with_channel_and_sign():
    assert read_requirement("custody>=0.8") == Requirement("custody", True, 0.8)
    assert read_requirement(" pan.false_per_km2 <= 40 ") == Requirement("false_per_km2", False, 40, "pan")
    assert str(read_requirement("dolp.purity>.9")) == "dolp.purity >= 0.9"


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("custody", "SCORE>=NUMBER"),
        ("custdy>=0.8", r"\(did you mean `custody`"),
        ("custody>=nan", "finite"),
        ("a=1", "SCORE"),
    ],
)
def test_what_is_no_requirement_is_refused(text, match):
    with pytest.raises(ValueError, match=match):
        read_requirement(text)


def test_channel_that_did_not_fly_is_refused():
    with pytest.raises(ValueError, match="pan, dolp"):
        read_requirement("all.custody>=0.8").check_channel(["pan", "dolp"])
