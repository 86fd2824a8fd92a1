"""Name what limits a design, and try changes of single keys that help and make nothing worse."""

import math
from collections.abc import Iterable, Iterator, Sequence
from operator import attrgetter
from typing import NamedTuple

from glintrack.case.check import Judgement, assess_case
from glintrack.case.design import Case
from glintrack.case.quantities import CITY_SPEED_M_S
from glintrack.core.units import unit_of

_FACTORS = (1.25, 1.6, 2.0, 2.5, 3.2, 4.0, 5.0, 6.3, 8.0, 10.0)
_MAX_STEPS = 3


class Change(NamedTuple):
    """Change of one key, the case with it, and its judgements."""

    text: str
    case: Case
    judged: list[Judgement]


def conclude(case: Case, judged: Sequence[Judgement], fastest_m_s: float = CITY_SPEED_M_S) -> str:
    """Name what limits a judged design and the keys to change; arguments as of and from `assess_case`."""
    sentences = ["no quantity of the design limits tracking"]
    if limits := _limits(judged):
        limited = f"it is limited by {_join(one.label for one in limits)}"
        sentences = [limited, *_advise(case, judged, fastest_m_s)]
    sentences += describe_unfitted(judged)
    return ". ".join(one[0].upper() + one[1:] for one in sentences)


def describe_unfitted(judged: Iterable[Judgement]) -> list[str]:
    """Sentence on the quantities outside the range that detector and tracker were fitted in, if any are."""
    doubtful = [one for one in judged if one.rank and one.group == "tracker"]
    if not doubtful:
        return []
    parts = _join(f"{one.label} {one.text}" for one in doubtful)
    return [
        f"{parts} {'are' if len(doubtful) > 1 else 'is'} outside the range in which detector and tracker "
        "were fitted, so fewer vehicles may be tracked and more tracks may be false "
        f"({', '.join(f'`{key[1:]}`' for one in doubtful for key in one.keys[:1])})"
    ]


def _limits(judged: Iterable[Judgement]) -> list[Judgement]:
    """Quantities that are not good, the bad ones alone if there are any, without the fitted range."""
    found = [one for one in judged if one.rank and one.group != "tracker"]
    return [one for one in found if one.answer == "bad"] or found


def _advise(case: Case, judged: Sequence[Judgement], fastest_m_s: float) -> Iterator[str]:
    """Sentences with the changes that together make the limiting quantities good."""
    texts = []
    for _ in range(_MAX_STEPS):
        changes = _best_changes(case, judged, fastest_m_s)
        if not changes:
            break
        texts.append(" or ".join(change.text for change in changes))
        case, judged = changes[0].case, changes[0].judged
    left = _limits(judged)
    if texts:
        yield f"change {', and '.join(texts)}" + (
            ": then no quantity of the design limits tracking" * (not left)
        )
    if left:
        yield f"no change of one key makes {_join(one.label for one in left)} good and nothing else worse"


def _best_changes(case: Case, judged: Sequence[Judgement], fastest_m_s: float) -> list[Change]:
    """Find the key whose change improves the limiting quantities most, or two that do it equally."""
    keys = dict.fromkeys(key for one in _limits(judged) for key in one.keys)
    found = [(_gain(judged, one), one) for one in (_try_key(case, judged, key, fastest_m_s) for key in keys)]
    most = max((gain for gain, _ in found), default=0)
    return [change for gain, change in found if gain == most > 0][:2]


def _try_key(case: Case, judged: Sequence[Judgement], key: str, fastest_m_s: float) -> Change:
    """Smallest change of a key that helps most; the case itself if none helps or all make something worse."""
    best, before, name = Change("", case, [*judged]), {one.name: one.rank for one in judged}, key[1:]
    value = attrgetter(name)(case)
    for factor in _FACTORS if value else ():
        scale = factor if key[0] == "+" else 1 / factor
        new = float(f"{scale * value:.2g}")
        if isinstance(value, int):
            step = 2 if name in ("sensor.rows", "sensor.columns") else 1  # of superpixels
            new = step * (math.ceil if scale > 1 else math.floor)(scale * value / step)
        changes, text = {name: new}, f"`{name}` from {value:,.3g} to {new:,.3g} {unit_of(name)}".rstrip()
        if name == "flight.rate_hz":  # the flight keeps its duration
            changes["flight.frames"] = math.ceil(case.flight.frames * scale)
            changes["sensor.max_frame_rate_hz"] = max(new, case.sensor.max_frame_rate_hz)
            text += " (with `sensor.max_frame_rate_hz` and `flight.frames`)"
        try:
            changed = case.replace(changes)
        except ValueError:
            break
        change = Change(text, changed, assess_case(changed, fastest_m_s=fastest_m_s))
        if any(one.rank > before.get(one.name, 0) for one in change.judged):
            break
        if _gain(judged, change) > _gain(judged, best):
            best = change
        if not any(key in one.keys for one in change.judged):
            break
    return best


def _gain(judged: Sequence[Judgement], change: Change) -> int:
    """Sum of the ranks by which a change improves the limiting quantities."""
    after = {one.name: one.rank for one in change.judged}
    return sum(one.rank - after.get(one.name, 0) for one in _limits(judged))


def _join(words: Iterable[str]) -> str:
    *first, last = words
    return f"{', '.join(first)} and {last}" if first else last
