"""Verdict of a flight: how well the design tracks vehicles, at which stage most are lost, and reservations.

The verdict is that of the channel with the highest completeness. The stage of the loss budget with the
largest step down is named. What a detector that uses several frames gains after `predicted_background` is not
a loss there.
"""

import contextlib
import math
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
import xarray as xr

from glintrack.atmosphere import sun_direction
from glintrack.case.advice import describe_unfitted
from glintrack.case.check import assess_case
from glintrack.case.design import Case
from glintrack.case.quantities import ground_view
from glintrack.core.schema import CHANNEL_WORDS, MIN_SCORED_S
from glintrack.metrics.requirement import MIN_FRAMES, is_too_short
from glintrack.results.collect import scored_times
from glintrack.results.losses import LOSSES, largest_loss

_MIN_IN_VIEW = 0.75  # share of the movers in the frame, below which the small field is a reservation
_MAX_DIFFERENCE = 0.015  # between the tracker's stage and completeness, without a reservation
_AREAS = {"window": "in the window", "footprint": "in the frame", "polygon": "in the scored polygon"}
_MIN_MOVERS = 15  # in the scored area at a time, below which shares change by a tenth with one of them
_MAX_WAIT = 0.15  # share of the frames before the first track, without a reservation
_MAX_FALSE_RATIO = 3.0  # of the share of false tracks to its limit, without a reservation


def select_channel(scores: Mapping[str, Mapping[str, float]]) -> str | None:
    """Channel with the highest completeness, the first of equals; None if no score is finite.

    Parameters
    ----------
    scores
        Scores of each channel, from `Result.scores`.
    """
    shares = {name: _number(of, "completeness") for name, of in scores.items()}
    finite = {name: value for name, value in shares.items() if math.isfinite(value)}
    return max(finite, key=lambda name: finite[name]) if finite else None


def verdict(tree: xr.DataTree, scores: Mapping[str, Mapping[str, float]]) -> str:
    """Completeness, false tracks, custody and largest loss of a flight as text; empty without scores.

    Parameters
    ----------
    tree
        A result; its group ``/bound`` has the loss budgets, if they were measured.
    scores
        Scores of each channel.
    """
    name = select_channel(scores)
    if name is None:
        false = {CHANNEL_WORDS.get(k, k): _number(of, "false_per_km2") for k, of in scores.items()}
        rates = ", ".join(f"{_count(n)} in {words}" for words, n in false.items() if math.isfinite(n))
        said = f"No vehicle moves {scored_area(tree)}. False tracks per km²: {rates}." if rates else ""
        return (describe_undecided(tree, next(iter(scores))) + said).strip() if scores else ""
    of = scores[name]
    visible, custody, false = (_number(of, k) for k in ("completeness_visible", "custody", "false_per_km2"))
    lag_s = float(_attributes(tree, name).get("report_lag_s", 0.0))
    text = f"{describe_subject(name)} {per_hundred(of['completeness'])} of 100 moving vehicles"
    text += f" {scored_area(tree)}"
    if "completeness_window" in _attributes(tree, name):
        text += f" ({per_hundred(tree[name].attrs['completeness_window'])} of 100 in the whole window)"
    text += f", {per_hundred(visible)} of 100 visible ones" if math.isfinite(visible) else ""
    text += f", with {_count(false)} false tracks per km²" if math.isfinite(false) else ""
    mean_of = describe_frames(int(_attributes(tree, name).get("frames", 0))) or "all frames"
    lag = f", fixed lag {lag_s:g} s" if lag_s else ""
    parts = [f"{describe_undecided(tree, name)}{text} (mean of {mean_of}{lag})"]
    if math.isfinite(custody):
        parts.append(f"One track stays on a vehicle for {per_hundred(custody)} % of its visible time")
    return ". ".join([*parts, *_describe_losses(stage_shares(tree).get(name, {}))]) + "."


def describe_undecided(tree: xr.DataTree, name: str) -> str:
    """Sentence before the scores of a run that is too short to judge a design; else empty."""
    scored_s = scored_times(tree, name)
    length_s = float(np.ptp(scored_s)) if len(scored_s) else 0.0
    left = f"{len(scored_s)} frame{'' if len(scored_s) == 1 else 's'} in {length_s:.3g} s"
    if "learning_frames" not in _attributes(tree, name) or not is_too_short(len(scored_s), length_s):
        return ""
    needed = f"a verdict needs {MIN_FRAMES} frames and {MIN_SCORED_S:g} s"
    return f"Undecided: the run is too short. After learning the background {left} are left; {needed}. "


def scored_area(tree: xr.DataTree) -> str:
    """Words for the scored area, such as "in the window"."""
    return _AREAS.get(str(tree.attrs.get("area")), _AREAS["window"])


def describe_other_channels(scores: Mapping[str, Mapping[str, float]]) -> str:
    """Completeness and false tracks of the channels that the verdict is not of; empty without any.

    Parameters
    ----------
    scores
        Scores of each channel.
    """
    parts = []
    for name in [name for name in scores if name != select_channel(scores)]:
        visible, false = (_number(scores[name], k) for k in ("completeness_visible", "false_per_km2"))
        if math.isfinite(visible) and math.isfinite(false):
            parts.append(
                f"{describe_subject(name)} {per_hundred(visible)} of 100 visible vehicles, with "
                f"{_count(false)} false tracks per km²."
            )
    return " ".join(["On the same frames:", *parts]) if parts else ""


def reservations(
    tree: xr.DataTree, scores: Mapping[str, Mapping[str, float]], case: Case | None
) -> list[str]:
    """Reservations about the verdict, such as a field smaller than the window or a short flight.

    Parameters
    ----------
    tree, scores
        As for `verdict`.
    case
        The design; None where it cannot be read.
    """
    name = select_channel(scores)
    if name is None:
        return []
    budget = stage_shares(tree).get(name, {})
    return [
        *_few_movers(tree, name, case),
        *_about_scores(tree, name, scores[name], budget),
        *_small_field(tree, budget, case),
        *_about_design(tree, name, budget, scores[name], case),
        *_late_tracks(tree, name),
    ]


def _budgets(tree: xr.DataTree) -> Mapping[str, xr.DataTree]:
    """Loss budgets of a result by group of elements; empty if none was measured."""
    return tree["bound"].children if "bound" in tree.children else {}


def budget_frames(tree: xr.DataTree) -> str:
    """Describe the frames of the loss budget and of the flight, such as "9 of the 60 frames"."""
    count = max((len(np.atleast_1d(of.attrs.get("frames", []))) for of in _budgets(tree).values()), default=0)
    if "frames_done" in tree.attrs:
        return f"{count or 'the measured'} of the {tree.attrs['frames_done']} frames"
    return describe_frames(count) or "the measured frames"


def stage_shares(tree: xr.DataTree) -> dict[str, dict[str, float]]:
    """Share of the moving vehicles at each stage that a result measured, by group of elements."""
    found = {}
    for group, node in _budgets(tree).items():
        one = node.to_dataset()
        if {"stage", "of_moving"} <= set(map(str, one.variables)):
            values = zip(one["stage"].values, one["of_moving"].values.astype(float), strict=True)
            found[str(group)] = {str(stage): float(share) for stage, share in values if math.isfinite(share)}
    return {group: one for group, one in found.items() if one}


_BOUND_WORDS = {"sensor": "lower bound from sensor noise", "detector": "single detections"}


def format_accuracy(attributes: Mapping[Any, Any]) -> str:
    """Line with the median bounds of positions and the tracker's error.

    Parameters
    ----------
    attributes
        Attributes of a loss budget: medians over the visible movers and frames.
    """
    medians = {name: _number(attributes, f"position_bound_{name}_median_m") for name in _BOUND_WORDS}
    parts = [f"{_BOUND_WORDS[name]} {value:.2g} m" for name, value in medians.items() if math.isfinite(value)]
    median = _number(attributes, "position_error_tracker_median_m")
    if math.isfinite(median):
        parts.append(f"tracks reported at once {median:.2g} m")
    return "median position error of visible moving vehicles: " + (", ".join(parts) or "not measured")


def accuracy_lines(tree: xr.DataTree) -> dict[str, str]:
    """`format_accuracy` of each group of elements for which a result measured it."""
    measured = {g: n.attrs for g, n in _budgets(tree).items() if "position_bound_sensor_median_m" in n.attrs}
    return {str(group): format_accuracy(attrs) for group, attrs in measured.items()}


def view_facts(case: Case) -> dict[str, str]:
    """Flight, sun, altitude, off-nadir angle and ground sample distance of a case, by name."""
    flight, (across, along) = case.flight, ground_view(case)[0]
    elevation, azimuth = sun_angles_deg(case)
    turn_deg = flight.azimuth_from_sun_deg
    from_sun = f"{abs(turn_deg):g}° {'left' if turn_deg < 0 else 'right'} of the sun"
    return {
        "flight": f"{describe_frames(flight.frames)} at {flight.rate_hz:g} Hz",
        "sun": f"{elevation:.0f}° high, azimuth {azimuth:.0f}°",
        "altitude": f"{flight.altitude_m:.0f} m",
        "off nadir": f"{flight.off_nadir_deg:g}°, looking {from_sun}",
        "an element sees": f"{across:.2g} m × {along:.2g} m of ground",
    }


def sun_angles_deg(case: Case) -> tuple[float, float]:
    """Elevation of the sun, and its azimuth clockwise from north. [°]"""
    zenith, azimuth = (math.degrees(angle) for angle in sun_direction(case.atmosphere))
    return 90 - zenith, azimuth


def _describe_losses(budget: Mapping[str, float]) -> Iterator[str]:
    known, loss = budget.get("known_background"), largest_loss(budget)
    if known is not None:
        yield f"If the background were known, {per_hundred(known)} of 100 moving vehicles could be found"
    if loss is not None:
        yield (
            f"The largest lasting loss is {LOSSES[loss.stage]}: from {per_hundred(loss.before)} to "
            f"{per_hundred(loss.after)} of 100 moving vehicles"
        )


def _about_scores(
    tree: xr.DataTree, name: str, of: Mapping[str, float], budget: Mapping[str, float]
) -> Iterator[str]:
    """Scores without the lag, and of the frames of the loss budget."""
    live, share = _attributes(tree, name), budget.get("tracker")
    visible, false = (_number(live, f"{k}_at_once") for k in ("completeness_visible", "false_per_km2"))
    if math.isfinite(visible + false):
        yield (
            f"Tracks are reported {live['report_lag_s']:g} s late (`track.reporting.lag_s`), so that later "
            f"frames count. Reported at once, {per_hundred(visible)} of 100 visible vehicles are tracked, "
            f"with {_count(false)} false tracks per km²."
        )
    if share is not None and abs(share - float(of["completeness"])) > _MAX_DIFFERENCE:
        yield (
            f"The loss budget uses {budget_frames(tree)}, with {per_hundred(share)} of 100 moving vehicles "
            "tracked. The scores use all frames after the background is learnt."
        )


def _small_field(tree: xr.DataTree, budget: Mapping[str, float], case: Case | None) -> Iterator[str]:
    if case is None or tree.attrs.get("area") == "footprint":
        return
    (across, along), seen = ground_view(case)[1], budget.get("in_view")
    if seen is not None:
        outside = f". {per_hundred(1 - seen)} of 100 moving vehicles are outside"
    elif case.scene.uses_mesh_window:
        return
    else:  # without a loss budget, from the areas
        seen, outside = min(across * along / math.prod(case.scene.size_m), 1.0), ", less than the window"
    if seen < _MIN_IN_VIEW:
        yield (
            f"The array sees about {across:.0f} m × {along:.0f} m of ground{outside}. The scores are of all "
            f'vehicles {scored_area(tree)}; `scene.area = "footprint"` scores those in the frame. To compare '
            "pitches or focal lengths over one field, change `sensor.rows` and `sensor.columns` with them "
            "(in a study: `constraints.constant_field = true`)."
        )


def _about_design(
    tree: xr.DataTree, name: str, budget: Mapping[str, float], scores: Mapping[str, float], case: Case | None
) -> Iterator[str]:
    """Warn of a flight too short for a loss budget, of the sensor, and of too many false tracks."""
    if case is None:
        return
    if not budget and 0 < case.bound.every and case.flight.frames <= case.bound.every:
        yield (
            f"The loss budget was not measured: it needs more than {case.bound.every} frames "
            f"(`bound.every`); the case has {case.flight.frames}."
        )
    with contextlib.suppress(OSError, ValueError):  # a file that the case names is not here
        judged = assess_case(case, ("view", "sensor", "tracker"))
        yield from (f"Design: {one.reason}." for one in judged if one.answer == "bad")
        yield from (f"{text[0].upper()}{text[1:]}." for text in describe_unfitted(judged))
    valid, false = (_number(scores, key) for key in ("tracked_per_km2", "false_per_km2"))
    limit, share = case.track.reporting.max_false_share, false / (valid + false) if false > 0 else math.nan
    found = f"/{name}/detections"
    used = case.track.effective(found not in tree.groups or "log_likelihood_ratio" in tree[found])
    if used.reporting.uses_existence and share > _MAX_FALSE_RATIO * limit:
        yield (
            f"{per_hundred(share)} of 100 reported tracks are false, more than the limit of "
            f"{per_hundred(limit)} (`track.reporting.max_false_share`). The limit is met only on flights "
            "like those to which the existence model was fitted."
        )


def _late_tracks(tree: xr.DataTree, name: str) -> Iterator[str]:
    count = len(scored_times(tree, name))
    found = np.asarray(tree[name]["completeness"].values, float)[-count:] > 0 if count else np.empty(0)
    empty = int(np.argmax(found)) if found.any() else 0  # without any, the verdict is 0 of 100
    if empty > _MAX_WAIT * len(found):
        yield (
            f"The first vehicle was tracked after {empty} of the {len(found)} scored frames. Vehicles in "
            "view before that count as missed, so a longer flight may give a higher completeness."
        )


def _few_movers(tree: xr.DataTree, name: str, case: Case | None) -> Iterator[str]:
    movers = _number(_attributes(tree, name), "vehicles_per_frame")
    if movers < _MIN_MOVERS:
        by_file = case is not None and (case.scene.traffic_file is not None or case.scene.city == "mesh")
        more = "" if by_file else " A smaller `scene.traffic_insertion_period_s` gives more traffic."
        if tree.attrs.get("area") == "footprint":
            more += " Another stare point (`flight.stare_east_m`, `flight.stare_north_m`) may show more."
        they = "vehicle moves" if round(movers) == 1 else "vehicles move"
        yield f"Only {movers:.0f} {they} {scored_area(tree)} at a time: shares are not precise.{more}"


def describe_subject(channel: str) -> str:
    """Subject and verb of a sentence about a channel."""
    words = {"pan": "Pan tracks", "dolp": "DoLP tracks", "all": "All elements together track"}
    return words.get(channel, f"{channel} tracks")


def _attributes(tree: xr.DataTree, name: str) -> Mapping[Any, Any]:
    """Scores and other attributes of a channel."""
    return tree[name].attrs if name in tree.children else {}


def _number(values: Mapping[Any, Any], key: str) -> float:
    """Value of a key; NaN without one."""
    return float(values.get(key, math.nan))


def describe_frames(count: int) -> str:
    """Count of frames in words; empty for none."""
    return f"{count} frame{'s' if count > 1 else ''}" if count else ""


def _count(value: float) -> str:
    return f"{value:.0f}" if value >= 9.5 else f"{value:.1f}"


def per_hundred(share: float) -> str:
    """Share as a whole number of 100."""
    return f"{100 * share:.0f}"
