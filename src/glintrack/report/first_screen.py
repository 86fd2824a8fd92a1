"""The first screen of a run's page: the verdict, a small ladder, what was flown, north and scale.

The ladder is that of the channel that speaks in the verdict. Where the flight measured none, its bars are the
scores: held of all movers, of the visible ones, and custody.
"""

import math
from dataclasses import dataclass

from glintrack.bounds import RUNG_WORDS
from glintrack.results.notebook import SCORE_LABELS
from glintrack.results.read import Result
from glintrack.results.verdict import (
    CHANNEL_WORDS,
    best_channel,
    ladder_shares,
    measured_frames,
    sun_place_deg,
    view_facts,
)

_SCORE_BARS = ("completeness", "completeness_visible", "custody")
_ROUND_M = (1, 2, 5)
_BAR_SHARE = 0.3  # of the window's width that the scale bar takes at most
_ARROW = 7.0  # length of the sun's arrow, of a plan 100 wide


@dataclass(frozen=True)
class Bar:
    """One rung: its words, its share of 100 vehicles, and whether it ends the ladder."""

    label: str
    per_hundred: float
    last: bool = False


def ladder_bars(result: Result) -> tuple[str, list[Bar]]:
    """Caption and bars of the channel that speaks; nothing without scores."""
    name = best_channel(result.scores)
    if name is None or result.tree is None:
        return "", []
    rungs = ladder_shares(result.tree).get(name, {})
    if len(rungs) > 1:
        bars = [Bar(RUNG_WORDS.get(r, r.replace("_", " ")), 100 * share) for r, share in rungs.items()]
        count = measured_frames(result.tree)
        of = f" of the {result.tree.attrs['frames_done']}" if "frames_done" in result.tree.attrs else ""
        on = f"on {count or 'the measured'}{of} frames"
        caption = f"Of 100 moving vehicles, {CHANNEL_WORDS.get(name, name)}, {on}"
    else:
        of = result.scores[name]
        told = {key: of[key] for key in _SCORE_BARS if math.isfinite(of.get(key, math.nan))}
        bars = [Bar(SCORE_LABELS[key], 100 * value) for key, value in told.items()]
        caption = f"Of 100 vehicles, {CHANNEL_WORDS.get(name, name)}"
    return caption, [*bars[:-1], *(Bar(b.label, b.per_hundred, last=True) for b in bars[-1:])]


def facts(result: Result) -> dict[str, str]:
    """Case and what was flown, by name; the case alone where its design cannot be read."""
    return {"case": result.name} | (view_facts(result.case) if result.case is not None else {})


def sun_azimuth_deg(result: Result) -> float | None:
    """Where one looks to see the sun, clockwise from north; None where the design cannot be read. [°]"""
    return None if result.case is None else sun_place_deg(result.case)[1]


def round_length_m(most_m: float) -> float:
    """The longest of 1, 2, 5, 10, 20 … that a scale bar may have. [m]"""
    power = 10.0 ** math.floor(math.log10(most_m))
    return max(step * power for step in _ROUND_M if step * power <= most_m * (1 + 1e-9))


def plan(extent_m: tuple[float, float, float, float], azimuth_deg: float | None, picture: str = "") -> dict:
    """The window seen from above, 100 units wide: its height, the scale bar, and where the sun stands.

    Parameters
    ----------
    extent_m
        West, south, east, north. [m]
    azimuth_deg
        Of the sun. [°]
    picture
        Address of a picture of the window, if there is one.
    """
    wide, high = extent_m[2] - extent_m[0], extent_m[3] - extent_m[1]
    bar_m = round_length_m(_BAR_SHARE * wide)
    sun = None
    if azimuth_deg is not None:  # the arrow points to where the sun stands
        towards = math.radians(azimuth_deg)
        sun = {"x": f"{_ARROW * math.sin(towards):.2f}", "y": f"{-_ARROW * math.cos(towards):.2f}",
               "degrees": f"{azimuth_deg:.0f}"}  # fmt: skip
    return {
        "picture": picture,
        "said": f"The window, {wide:.0f} m × {high:.0f} m, north up",
        "high": f"{100 * high / wide:.2f}",
        "bar_label": f"{bar_m:g} m",
        "bar": f"{100 * bar_m / wide:.2f}",
        "sun": sun,
    }
