"""Whether a score meets a requirement: yes, no, or undecided, and how many more flights would decide.

A flight's score m has Student's interval m ± t s: s is its standard error by the jackknife over equal parts
of its time, t of one degree of freedom less than there are parts. A study brings the intervals of its report.
What lies on one side of the limit with all of its interval is decided. Parts of one flight share their city:
the interval says what more of the same traffic would bring, not what another city would.
"""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import stdtrit

from glintrack.core.designs import suggest_name
from glintrack.core.schema import MIN_SCORED_S
from glintrack.metrics.summary import summarize
from glintrack.metrics.tracks import EpochScore

PARTS = 6  # of a flight: ten seconds of a minute, in which a vehicle crosses a few streets
LEAST_FRAMES = 2 * PARTS
CONFIDENCE = 0.95
MOST_FLIGHTS = 1000
SHARES = ("completeness", "completeness_all", "completeness_visible", "custody", "purity", "idf1_moving",
          "same_track_after_10s")  # fmt: skip
_TEXT = re.compile(r"\s*(?:(?P<channel>\w+)\.)?(?P<score>\w+)\s*(?P<sign><=|>=|<|>)\s*(?P<limit>\S+)\s*")


@dataclass(frozen=True)
class Requirement:
    """A limit that a score must keep.

    Parameters
    ----------
    score
        As `metrics.summarize` names it.
    at_least
        Whether the score must reach the limit, or not pass it.
    limit
        In the score's unit.
    channel
        Whose; the one that holds most vehicles by default.
    """

    score: str
    at_least: bool
    limit: float
    channel: str | None = None

    def check_channel(self, channels: Sequence[str]) -> None:
        """Refuse a channel that is none of these."""
        if self.channel not in (None, *channels):
            known = ", ".join(channels)
            raise ValueError(
                f"`--require` must name a channel of the flights ({known}), got {self.channel!r}"
            )

    def __str__(self) -> str:
        """As it is read."""
        of = f"{self.channel}." if self.channel else ""
        return f"{of}{self.score} {'>=' if self.at_least else '<='} {self.limit:g}"


@dataclass(frozen=True)
class Judged:
    """What flights say of a requirement.

    Parameters
    ----------
    value, low, high
        Of the score, with its interval of 95 %.
    answer
        ``yes``, ``no`` or ``undecided``.
    more_flights
        How many more like these would decide, if the value stays; None if decided, or if none of a thousand.
    """

    value: float
    low: float
    high: float
    answer: str
    more_flights: int | None = None


def read_requirement(text: str) -> Requirement:
    """A requirement as ``custody>=0.8`` or ``pan.false_per_km2<=40``.

    Raises
    ------
    ValueError
        If it is not so written, names no score, or its limit is not a finite number.
    """
    parts = _TEXT.fullmatch(text)
    if parts is None:
        raise ValueError(
            f"`--require` must be SCORE>=NUMBER or SCORE<=NUMBER, as 'custody>=0.8', got {text[:80]!r} (in "
            "quotes, or the shell takes what follows > for a file)"
        )
    known = summarize([])
    if parts["score"] not in known:
        raise ValueError(
            f"`--require` must name a score, got {parts['score'][:80]!r} "
            f"({suggest_name(parts['score'], known)})"
        )
    try:
        limit = float(parts["limit"])
    except ValueError:
        limit = math.nan
    if not math.isfinite(limit):
        raise ValueError(f"`--require` must give a finite limit, got {parts['limit'][:80]!r}")
    if parts["score"] in SHARES and not 0 <= limit <= 1:
        raise ValueError(f"`--require` must give a share from 0 to 1 for {parts['score']}, got {limit:g}")
    channel = parts["channel"] and parts["channel"].lower()  # tables say DoLP
    return Requirement(parts["score"], parts["sign"].startswith(">"), limit, channel)


def judge_flight(requirement: Requirement, epochs: Sequence[EpochScore]) -> Judged:
    """By the scores of one flight, epoch by epoch; undecided if it is `short`."""
    if short(len(epochs), epochs[-1].time_s - epochs[0].time_s if epochs else 0.0):
        value = summarize(epochs)[requirement.score]
        return Judged(value, math.nan, math.nan, "undecided")
    parts = np.array_split(np.arange(len(epochs)), PARTS)

    def score(kept: Sequence[int]) -> float:
        chosen = [epochs[k] for number in kept for k in parts[number]]
        return summarize(chosen)[requirement.score]

    return judge(requirement, *jackknife(score, len(parts)))


def short(frames: int, duration_s: float) -> bool:
    """Whether a flight says nothing: parts of single frames, or too soon for a track to be told. [1, s]"""
    return frames < LEAST_FRAMES or duration_s < MIN_SCORED_S


def jackknife(score: Callable[[Sequence[int]], float], parts: int) -> tuple[float, float, float]:
    """A score of all parts with Student's interval, its standard error by leaving each out in turn."""
    every = range(parts)
    left_out = np.array([score([k for k in every if k != part]) for part in every])
    left_out = left_out[np.isfinite(left_out)]
    value, n = score(list(every)), len(left_out)
    if n < 2:
        return value, math.nan, math.nan
    error = math.sqrt((n - 1) / n * ((left_out - left_out.mean()) ** 2).sum())
    reach = float(stdtrit(n - 1, 0.5 + CONFIDENCE / 2)) * error
    return value, value - reach, value + reach


def judge(requirement: Requirement, value: float, low: float, high: float, flights: int = 1) -> Judged:
    """A requirement by a score and its interval over so many flights; intervals shrink as 1/√flights."""
    if not (math.isfinite(low) and math.isfinite(high)):
        return Judged(value, math.nan, math.nan, "undecided")
    limit, at_least = requirement.limit, requirement.at_least
    if low >= limit if at_least else high <= limit:
        return Judged(value, low, high, "yes")
    if high < limit if at_least else low > limit:
        return Judged(value, low, high, "no")
    over, reach = abs(value - limit), value - low if value > limit else high - value
    more = flights * ((reach / over) ** 2 - 1) if over > 0 else math.inf
    return Judged(value, low, high, "undecided", max(math.ceil(more), 1) if more <= MOST_FLIGHTS else None)


def in_a_sentence(requirement: Requirement, found: Judged) -> str:
    """The answer first, then the figures behind it."""
    answer = {"yes": "Yes", "no": "No"}.get(found.answer, "Undecided")
    if not math.isfinite(found.low):
        least = f"{LEAST_FRAMES} frames and {MIN_SCORED_S:g} s at least"
        return f"{answer}: {requirement} is required, and the flight is too short to say ({least})."
    interval = f"({found.low:.3g} to {found.high:.3g})"
    said = f"{answer}: {requirement} is required, found is {found.value:.3g} {interval}"
    if found.answer != "undecided":
        return f"{said}."
    if found.more_flights is None:
        return f"{said}; {MOST_FLIGHTS} more flights would not decide."
    more = "one more flight" if found.more_flights == 1 else f"some {found.more_flights} more flights"
    return f"{said}; {more} like it would decide."
