"""Whether the points of a study meet a requirement; see `metrics.requirement`."""

# pandas' overloads give an index of a frame more types than it can have
# pyright: reportAttributeAccessIssue=false, reportArgumentType=false

from collections.abc import Mapping
from typing import Any

import pandas as pd

from glintrack.metrics.requirement import Judged, Requirement, judge_values
from glintrack.study.analysis import units


def judged_points(
    table: pd.DataFrame, source: Mapping[str, Any], requirement: Requirement
) -> tuple[str, list[tuple[str, Judged]]]:
    """The channel that was looked at, and each point of the design in words with what its flights say.

    Raises
    ------
    ValueError
        If no case is finished, or the study lacks the score or the channel.
    """
    done = table[table["status"] == "finished"]
    if done.empty:
        raise ValueError(f"`result` must hold finished cases, got none of {len(table)} rows finished")
    channels = [str(name) for name in dict.fromkeys(done["channel"])]
    requirement.check_channel(channels)
    held = {name: float(done.loc[done["channel"] == name, "completeness"].mean()) for name in channels}
    channel = requirement.channel or max(held, key=lambda name: held[name])
    axes = [axis for axis in source["axes"] if len(set(done[axis])) > 1]
    found = units(table, axes or list(source["axes"])[:1], requirement.score, channel)
    flights = len(set(done["replicate"]))
    named = [", ".join(f"{axis} = {row[axis]}" for axis in axes) for _, row in found.points.iterrows()]
    judged = [judge_values(requirement, values, flights) for values in found.values]
    return channel, list(zip(named, judged, strict=True))
