"""Whether the points of a study meet a requirement (`metrics.requirement`), by its report's intervals."""

from collections.abc import Mapping
from typing import Any

import numpy as np
import pandas as pd

from glintrack.metrics.requirement import Judged, Requirement, judge
from glintrack.study.analysis import point_scores
from glintrack.study.report import SEED
from glintrack.study.table import flown


def judged_points(
    table: pd.DataFrame, source: Mapping[str, Any], requirement: Requirement
) -> tuple[str, list[tuple[str, Judged]]]:
    """The channel that was looked at, and each point of the design in words with what its flights say.

    Raises
    ------
    ValueError
        If no case is finished, or the study lacks the score or the channel.
    """
    table = flown(table)
    done = table[table["status"] == "finished"]
    if done.empty:
        raise ValueError(f"`result` must hold finished cases, got none of {len(table)} rows finished")
    channels = [str(name) for name in dict.fromkeys(done["channel"])]
    requirement.check_channel(channels)
    held = {name: float(done.loc[done["channel"] == name, "completeness"].mean()) for name in channels}
    channel = requirement.channel or max(held, key=lambda name: held[name])
    found = point_scores(table, list(source["axes"]), requirement.score, channel, np.random.default_rng(SEED))
    flights = len(set(done["replicate"]))
    rows = zip(found["point"], found["score"], found["low"], found["high"], strict=True)
    return channel, [(name, judge(requirement, value, low, high, flights)) for name, value, low, high in rows]
