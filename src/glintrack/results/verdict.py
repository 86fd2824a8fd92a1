"""The answer of a flight in one sentence: how well the design keeps track, what limits it, what it saw.

The loop that holds most vehicles speaks. Where the flight measured the ladder (`glintrack.bounds`), the
largest step down between neighbouring rungs says where most vehicles are lost. What a detector with a memory
wins back below `predicted_background` is not lost there.
"""

import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from glintrack.atmosphere import sun_direction
from glintrack.case.check import assess, ground_view
from glintrack.case.design import Case
from glintrack.core.schema import MIN_SCORED_S

_HOLDS = {"pan": "pan frames hold", "dolp": "DoLP holds", "all": "all elements together hold"}
CHANNEL_WORDS: Mapping[str, str] = {"pan": "pan", "dolp": "DoLP", "all": "all elements"}
_LOSSES = {
    "in_view": "out of the frame",
    "visible": "behind buildings and trees",
    "ideal_observer": "in the sensor's noise",
    "known_background": "between vehicles that stand close together",
    "predicted_background": "where the background is predicted from past frames (edges, parallax, mosaic)",
    "reported_pose": "to the navigator's errors",
    "detector": "in detection",
    "tracker": "in association and confirmation",
}
_MOST_OF_WINDOW = 0.75  # of the movers that the frame holds, below which its field is told
_SAME_SHARE = 0.015  # between the tracker's rung and completeness, from which the difference is told
_FEW_MOVERS = 15  # in the window at a time, below which shares jump by a tenth with one of them
_LONG_WAIT = 0.15  # of the frames before the first track, from which they are told
_SHORT = 8  # frames in which a track may well not be confirmed yet
_FAR_BEYOND = 3.0  # times the share of false tracks that was asked for, from which that is told
_MEMORY = ("predicted_background", "reported_pose", "detector")  # may lie below the rungs after them


def best_channel(scores: Mapping[str, Mapping[str, float]]) -> str | None:
    """The loop that holds most vehicles, the first of equals; None if no score is finite.

    Parameters
    ----------
    scores
        Of each channel, from `Result.scores`.
    """
    held = {name: float(of.get("completeness", math.nan)) for name, of in scores.items()}
    finite = {name: value for name, value in held.items() if math.isfinite(value)}
    return max(finite, key=lambda name: finite[name]) if finite else None


def verdict(tree: xr.DataTree, scores: Mapping[str, Mapping[str, float]]) -> str:
    """Whether the design keeps track of the vehicles, and why not better: a sentence, empty without scores.

    Parameters
    ----------
    tree
        Of a result; its group ``/bound`` holds the ladders, if they were measured.
    scores
        Of each channel.
    """
    name = best_channel(scores)
    if name is None:
        return _nothing_moved(scores)
    of = scores[name]
    subject = _HOLDS.get(name, f"change in {name} holds")
    lag_s = float(_attributes(tree, name).get("report_lag_s", 0.0))
    late = f", told {lag_s:g} s late," if lag_s else ""
    said = (
        f"In the mean of its frames{late} {subject} {_per_hundred(of['completeness'])} of 100 moving vehicles"
    )
    visible, custody, false = (
        float(of.get(k, math.nan)) for k in ("completeness_visible", "custody", "false_per_km2")
    )
    if math.isfinite(visible):
        said += f", {_per_hundred(visible)} of 100 visible ones"
    if math.isfinite(false):
        said += f", with {_count(false)} false tracks per km²"
    parts = [said]
    if math.isfinite(custody):
        share = _per_hundred(custody)
        parts.append(f"one and the same track stays with a vehicle for {share} % of the time it is in sight")
    return "; ".join([*parts, *_limits(ladder_shares(tree).get(name, {}))]) + "."


def _nothing_moved(scores: Mapping[str, Mapping[str, float]]) -> str:
    """What is left to say where no vehicle moved; empty without scores."""
    false = {name: float(of.get("false_per_km2", math.nan)) for name, of in scores.items()}
    told = [
        f"{_count(n)} in {CHANNEL_WORDS.get(name, name)}" for name, n in false.items() if math.isfinite(n)
    ]
    if not told:
        return ""
    return (
        f"No vehicle moves in the window, so that none can be held; false tracks per km²: {', '.join(told)}."
    )


def beside(scores: Mapping[str, Mapping[str, float]]) -> str:
    """What the other loops over the same light hold: a sentence, empty without any.

    Parameters
    ----------
    scores
        Of each channel.
    """
    parts = []
    for name in [name for name in scores if name != best_channel(scores)]:
        of = scores[name]
        visible, false = (float(of.get(k, math.nan)) for k in ("completeness_visible", "false_per_km2"))
        if math.isfinite(visible) and math.isfinite(false):
            subject = _HOLDS.get(name, f"change in {name} holds")
            held = f"{subject} {_per_hundred(visible)} of 100 visible ones"
            parts.append(f"{held} with {_count(false)} false tracks per km²")
    return f"Over the same light {', and '.join(parts)}." if parts else ""


def reservations(
    tree: xr.DataTree, scores: Mapping[str, Mapping[str, float]], case: Case | None
) -> list[str]:
    """What keeps the verdict from being the whole answer: a field smaller than the window, a short flight.

    Parameters
    ----------
    tree, scores
        As for `verdict`.
    case
        The design; None where it cannot be read.
    """
    name = best_channel(scores)
    if name is None:
        return []
    ladder = ladder_shares(tree).get(name, {})
    return [
        *_at_once(tree, name),
        *_other_frames(tree, scores[name], ladder),
        *_small_field(ladder, case),
        *_no_ladder(ladder, case),
        *_odd_design(case),
        *_late_tracks(tree, name),
        *_false_beyond(scores[name], case),
        *_few_movers(tree, name, case),
    ]


def measured_frames(tree: xr.DataTree) -> int:
    """On how many frames the ladder was measured; 0 without one."""
    groups = tree["bound"].children.values() if "bound" in tree.children else ()
    return max((len(np.atleast_1d(node.attrs.get("frames", []))) for node in groups), default=0)


def ladder_shares(tree: xr.DataTree) -> dict[str, dict[str, float]]:
    """Group of elements -> rung -> share of all movers, of the rungs that a result measured."""
    found = {}
    for group, node in tree["bound"].children.items() if "bound" in tree.children else ():
        one = node.to_dataset()
        if {"rung", "ladder"} <= set(map(str, one.variables)):
            values = zip(one["rung"].values, one["ladder"].values.astype(float), strict=True)
            found[str(group)] = {str(rung): float(share) for rung, share in values if math.isfinite(share)}
    return {group: one for group, one in found.items() if one}


def shown_accuracy(figures: Mapping[Any, Any]) -> str:
    """One line: how well positions can be known, in the median, and the tracker's errors beside it.

    Parameters
    ----------
    figures
        Attributes of a ladder: medians over the visible movers and frames.
    """
    names = {"sensor": "the sensor's bound", "detector": "the detector's bound"}
    medians = {name: float(figures.get(f"position_bound_{name}_median_m", math.nan)) for name in names}
    parts = [f"{names[name]} {value:.2g} m" for name, value in medians.items() if math.isfinite(value)]
    rms = float(figures.get("position_error_tracker_rms_m", math.nan))
    if math.isfinite(rms):
        median = float(figures["position_error_tracker_median_m"])
        parts.append(f"the tracker's error on those it holds {median:.2g} m (rms {rms:.2g} m)")
    return "position, median: " + (", ".join(parts) or "not measured")


def accuracy_lines(tree: xr.DataTree) -> dict[str, str]:
    """`shown_accuracy` of each group of elements for which a result measured it."""
    groups = tree["bound"].children if "bound" in tree.children else {}
    measured = {g: n.attrs for g, n in groups.items() if "position_bound_sensor_median_m" in n.attrs}
    return {str(group): shown_accuracy(attrs) for group, attrs in measured.items()}


def view_facts(case: Case) -> dict[str, str]:
    """What was flown, by name: flight, sun, altitude, off-nadir angle and ground sample distance."""
    flight, (across, along) = case.flight, ground_view(case)[0]
    high, azimuth = sun_place_deg(case)
    return {
        "flight": f"{_frames(flight.frames)} at {flight.rate_hz:g} Hz",
        "sun": f"{high:.0f}° high, azimuth {azimuth:.0f}°",
        "altitude": f"{flight.altitude_m:.0f} m",
        "off nadir": f"{flight.off_nadir_deg:g}°, {_signed(flight.azimuth_from_sun_deg)}° from the sun's "
        "azimuth",
        "an element sees": f"{across:.2g} m × {along:.2g} m of ground",
    }


def sun_place_deg(case: Case) -> tuple[float, float]:
    """How high the sun stands, and its azimuth clockwise from north. [°]"""
    zenith, azimuth = (math.degrees(angle) for angle in sun_direction(case.atmosphere))
    return 90 - zenith, azimuth


def _limits(ladder: Mapping[str, float]) -> Iterator[str]:
    memory, visible = ladder.get("known_background"), ladder.get("visible")
    if memory is not None and visible:
        yield (
            f"a perfect memory of the scene through this sensor would find {100 * memory / visible:.0f} "
            "of 100 visible ones"
        )
    steps, ends, before = {}, {}, 1.0
    rungs = list(ladder)
    for rung in _LOSSES:
        if rung in ladder:
            later = rungs[rungs.index(rung) :] if rung in _MEMORY else [rung]
            share = max(ladder[one] for one in later)
            steps[rung], ends[rung] = before - share, (before, share)
            before = share
    worst = max(steps, key=lambda rung: steps[rung], default=None)
    if worst is not None and steps[worst] > 0:
        before, after = (_per_hundred(share) for share in ends[worst])
        back = "" if ends[worst][1] == ladder[worst] else ", with what later rungs win back"
        yield (
            f"the largest part is lost {_LOSSES[worst]}: of 100 movers {before} are left before it and "
            f"{after} after{back}"
        )


def _at_once(tree: xr.DataTree, name: str) -> Iterator[str]:
    of = _attributes(tree, name)
    visible, false = (
        float(of.get(f"{k}_at_once", math.nan)) for k in ("completeness_visible", "false_per_km2")
    )
    if math.isfinite(visible + false):
        yield (
            f"At once, without waiting {of['report_lag_s']:g} s, {_per_hundred(visible)} of 100 visible ones "
            f"would be told, with {_count(false)} false tracks per km² (`track.reporting.lag_s`)."
        )


def _other_frames(tree: xr.DataTree, of: Mapping[str, float], ladder: Mapping[str, float]) -> Iterator[str]:
    held, on = float(of["completeness"]), ladder.get("tracker")
    if on is not None and abs(on - held) > _SAME_SHARE:
        yield (
            f"The ladder is of {_frames(measured_frames(tree))}, on which the tracker holds "
            f"{_per_hundred(on)} of 100 moving vehicles; the scores are of all frames, the first ones too, "
            "in which the ground is still being learnt."
        )


def _small_field(ladder: Mapping[str, float], case: Case | None) -> Iterator[str]:
    if case is None:
        return
    (across, along), seen = ground_view(case)[1], ladder.get("in_view")
    outside = ""
    if seen is None and case.scene.window_is_the_meshs:
        return
    if seen is None:  # without a ladder, from the areas
        seen = min(across * along / math.prod(case.scene.size_m), 1.0)
    else:
        outside = f", and {_per_hundred(1 - seen)} of 100 movers of the window drive outside it"
    if seen < _MOST_OF_WINDOW:
        yield (
            f"The array sees about {across:.0f} m × {along:.0f} m of ground"
            f"{outside or ', less than the window'}; what is held and false per km² is of the whole window. "
            "To compare pitches or focal lengths over one field, "
            "change `sensor.rows` and `sensor.columns` with them (in a study: `constraints.constant_field = "
            "true`)."
        )


def _no_ladder(ladder: Mapping[str, float], case: Case | None) -> Iterator[str]:
    if not ladder and case is not None and 0 < case.bound.every and case.flight.frames <= case.bound.every:
        yield (
            f"Why the others are lost was not measured: that takes more than {case.bound.every} frames "
            f"(`bound.every`), got {case.flight.frames}."
        )


def _odd_design(case: Case | None) -> Iterator[str]:
    """What `case check` warns of in the sensor: full wells, cars smaller than an element."""
    if case is None:
        return
    try:
        said = assess(case).of_sensor
    except (OSError, ValueError):  # a file that the case names is not here
        return
    for warning in said:
        yield f"By the design, {warning}."


def _late_tracks(tree: xr.DataTree, name: str) -> Iterator[str]:
    if name not in tree.children or "completeness" not in tree[name]:
        return
    held = np.asarray(tree[name]["completeness"].values, float)
    empty = int(np.argmax(held > 0)) if (held > 0).any() else len(held)
    if empty == len(held):
        times_s = np.asarray(tree[name]["completeness"]["time"].values, float)
        early = empty <= _SHORT or np.ptp(times_s) < MIN_SCORED_S
        why = ": the ground is learnt over some seconds first, then tracks are begun" if early else ""
        yield f"No track was right in {_frames(empty)}{why}."
    elif empty >= _LONG_WAIT * len(held):
        yield (
            f"{empty} of the {len(held)} frames had passed before the first track was confirmed, and count "
            "as missed: a longer flight holds more."
        )


def _false_beyond(scores: Mapping[str, float], case: Case | None) -> Iterator[str]:
    """Where far more of what was told is false than was asked for."""
    held, false = (float(scores.get(key, math.nan)) for key in ("held_per_km2", "false_per_km2"))
    if case is None or not case.track.reporting.uses_existence:
        return
    if not false > 0 or not math.isfinite(held):
        return
    asked, share = case.track.reporting.max_false_share, false / (held + false)
    if share > _FAR_BEYOND * asked:
        yield (
            f"Of 100 tracks told {_per_hundred(share)} were false, where {_per_hundred(asked)} were asked "
            "for: `track.reporting.max_false_share` is kept on flights like those that its model was "
            "fitted to."
        )


def _few_movers(tree: xr.DataTree, name: str, case: Case | None) -> Iterator[str]:
    movers = float(_attributes(tree, name).get("vehicles_per_epoch", math.nan))
    if movers < _FEW_MOVERS:
        by_file = case is not None and (case.scene.traffic_file is not None or case.scene.city == "mesh")
        more = "" if by_file else ": a smaller `scene.traffic_insertion_period_s` lets more drive"
        they = "vehicle moves" if round(movers) == 1 else "vehicles move"
        yield f"Only {movers:.0f} {they} in the window at a time, of which shares say little{more}."


def _attributes(tree: xr.DataTree, name: str) -> Mapping[Any, Any]:
    """Scores and more of a loop."""
    return tree[name].attrs if name in tree.children else {}


def _frames(count: int) -> str:
    return f"{count} frame{'s' if count > 1 else ''}" if count else "the measured frames"


def _signed(value: float) -> str:
    return f"{value:g}".replace("-", "−")


def _count(value: float) -> str:
    return f"{value:.0f}" if value >= 9.5 else f"{value:.1f}"


def _per_hundred(share: float) -> str:
    return f"{100 * share:.0f}"
