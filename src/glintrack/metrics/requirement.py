"""Test a score against a requirement: yes, no, or undecided, and the number of flights that would decide.

A flight's score m has Student's interval m ± t s. The standard error s is from the jackknife over equal parts
of its time, with one degree of freedom less than there are parts. A study has the intervals of its report. A
requirement is decided if the whole interval is on one side of the limit. Parts of one flight share their
city: the interval holds for more of the same traffic, not for another city.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from glintrack.core.designs import suggest_name
from glintrack.core.schema import MIN_SCORED_S
from glintrack.core.units import number_hint
from glintrack.metrics.summary import summarize
from glintrack.metrics.tracks import EpochScore

PARTS = 6  # of a flight: 10 s of a minute, in which a vehicle crosses a few streets
MIN_FRAMES = 2 * PARTS
CONFIDENCE = 0.95
MAX_FLIGHTS = 1000
SHARES = ("completeness", "completeness_with_stopped", "completeness_visible", "custody", "purity",
          "idf1_moving", "same_track_after_10s", "same_track_after_stop")  # fmt: skip
_TOTALS = ("identity_switches",)  # that grow with the flight
_TEXT = re.compile(r"\s*(?:(?P<channel>\w+)\.)?(?P<score>\w+)\s*(?P<sign><=|>=|<|>)\s*(?P<limit>\S+)\s*")


@dataclass(frozen=True)
class Requirement:
    """Limit of a score.

    Parameters
    ----------
    score
        Name in `metrics.summarize`.
    at_least
        True for a minimum, False for a maximum.
    limit
        Limit in the score's unit.
    channel
        Tracking channel; by default the one with the highest completeness.
    """

    score: str
    at_least: bool
    limit: float
    channel: str | None = None

    def check_channel(self, channels: Sequence[str]) -> None:
        """Raise a ValueError if the channel is none of these."""
        if self.channel not in (None, *channels):
            known = ", ".join(channels)
            raise ValueError(f"`--require` must name a channel of the case ({known}); got {self.channel!r}.")

    def __str__(self) -> str:
        """Return the text of the requirement."""
        of = f"{self.channel}." if self.channel else ""
        return f"{of}{self.score} {'>=' if self.at_least else '<='} {self.limit:g}"


@dataclass(frozen=True)
class Assessment:
    """Result of testing a requirement.

    Parameters
    ----------
    value, low, high
        Score and its interval of 95 %.
    answer
        ``yes``, ``no`` or ``undecided``.
    more_flights
        Number of further similar flights that would decide, if the value stays; None if decided, or above
        `MAX_FLIGHTS`.
    """

    value: float
    low: float
    high: float
    answer: str
    more_flights: int | None = None


def read_requirement(text: str, option: str = "--require") -> Requirement:
    """Read a requirement such as ``custody>=0.8`` or ``pan.false_per_km2<=40``.

    Parameters
    ----------
    text
        Text of the user.
    option
        Name of the option or key, for messages.

    Raises
    ------
    ValueError
        If the text has another form, names no score, or its limit is not a finite number.
    """
    parts = _TEXT.fullmatch(text)
    if parts is None:
        raise ValueError(
            f"`{option}` must be SCORE>=NUMBER or SCORE<=NUMBER, as 'custody>=0.8'; got {text[:80]!r}. "
            "Put it in quotes."
        )
    known = summarize([])
    if parts["score"] not in known:
        raise ValueError(
            f"`{option}` must name a score; got {parts['score'][:80]!r}. "
            f"{suggest_name(parts['score'], known)}"
        )
    try:
        limit = float(parts["limit"])
    except ValueError:
        limit = math.nan
    if not math.isfinite(limit):
        got = parts["limit"][:80]
        raise ValueError(f"`{option}` must give a finite limit; got {got!r}.{number_hint(got)}")
    if parts["score"] in SHARES and not 0 <= limit <= 1:
        raise ValueError(f"`{option}` must give a share from 0 to 1 for {parts['score']}; got {limit:g}.")
    channel = parts["channel"] and parts["channel"].lower()  # tables say DoLP
    return Requirement(parts["score"], parts["sign"].startswith(">"), limit, channel)


def assess_flight(requirement: Requirement, epochs: Sequence[EpochScore]) -> Assessment:
    """Test a requirement with the scores of one flight; undecided if it `is_too_short`."""
    if is_too_short(len(epochs), epochs[-1].time_s - epochs[0].time_s if epochs else 0.0):
        value = summarize(epochs)[requirement.score]
        return Assessment(value, math.nan, math.nan, "undecided")
    parts = np.array_split(np.arange(len(epochs)), PARTS)

    def score(selected: Sequence[int]) -> float:
        chosen = [epochs[k] for number in selected for k in parts[number]]
        scale = PARTS / len(selected) if requirement.score in _TOTALS else 1.0
        return scale * summarize(chosen)[requirement.score]

    return assess(requirement, *jackknife(score, len(parts)))


def is_too_short(frames: int, duration_s: float) -> bool:
    """Return True if a flight is too short for a test of requirements. [1, s]"""
    return frames < MIN_FRAMES or duration_s < MIN_SCORED_S


def jackknife(score: Callable[[Sequence[int]], float], parts: int) -> tuple[float, float, float]:
    """Compute a score of all parts and Student's interval, with the standard error from leaving each out."""
    every = range(parts)
    left_out = np.array([score([k for k in every if k != part]) for part in every])
    left_out = left_out[np.isfinite(left_out)]
    value, n = score(list(every)), len(left_out)
    if n < 2:
        return value, math.nan, math.nan
    error = math.sqrt((n - 1) / n * ((left_out - left_out.mean()) ** 2).sum())
    reach = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2)) * error
    return value, value - reach, value + reach


def assess(requirement: Requirement, value: float, low: float, high: float, flights: int = 1) -> Assessment:
    """Test a requirement with a score and its interval over flights; intervals shrink as 1/√flights."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return Assessment(value, math.nan, math.nan, "undecided")
    limit, at_least = requirement.limit, requirement.at_least
    if low >= limit if at_least else high <= limit:
        return Assessment(value, low, high, "yes")
    if high < limit if at_least else low > limit:
        return Assessment(value, low, high, "no")
    over, reach = abs(value - limit), value - low if value > limit else high - value
    more = flights * ((reach / over) ** 2 - 1) if over > 0 else math.inf
    return Assessment(value, low, high, "undecided", max(math.ceil(more), 1) if more <= MAX_FLIGHTS else None)


def describe_assessment(requirement: Requirement, found: Assessment) -> str:
    """Describe an assessment in a sentence, with the answer first."""
    answer = {"yes": "Yes", "no": "No"}.get(found.answer, "Undecided")
    if not math.isfinite(found.low):
        least = f"at least {MIN_FRAMES} frames and {MIN_SCORED_S:g} s after learning"
        return f"{answer}: {requirement} is required; the flight is too short for an answer ({least})."
    interval = f"({found.low:.3g} to {found.high:.3g})"
    text = f"{answer}: {requirement} is required; the score is {found.value:.3g} {interval}"
    if found.answer != "undecided":
        return f"{text}."
    if found.more_flights is None:
        return f"{text}; {MAX_FLIGHTS} more flights would not decide."
    more = "one more flight" if found.more_flights == 1 else f"about {found.more_flights} more flights"
    return f"{text}; {more} would decide."
