"""Which product of a frame the tracker looks at, and the choice between them from epoch to epoch."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float

from glintrack.arrays import Array
from glintrack.track.design import TrackDesign
from glintrack.track.detect import change
from glintrack.track.detect.background import Background
from glintrack.track.detect.blobs import Detections
from glintrack.track.detect.change import Change
from glintrack.track.detect.frame import Grid

STRONG = 1.5  # contrast of a change that noise does not make: half again the threshold
ADVANTAGE = 1.25  # another product must be worth so much more before the tracker turns to it
VEHICLE_M = 4.0  # a blob nearer than this to a measured track is its vehicle


@dataclass(frozen=True)
class Choice:
    """The product in use.

    Parameters
    ----------
    name
        ``pan``, ``dolp`` or ``fused``.
    worth
        Of each product that stands for choice, see `worth`; empty where there is no choice.
    """

    name: str
    worth: Mapping[str, float] = field(default_factory=dict)


def look(
    design: TrackDesign,
    known: Mapping[str, Background],
    frames: Mapping[str, Float[Array, "y x"]],
    grid: Grid,
    expected_m: Float[Array, "target 2"],
    interval_s: float,
) -> dict[str, Change]:
    """Change in every product that may be used; arguments as in `change.detect`."""
    rest = (grid.gsd_m, grid.corner_m, expected_m, interval_s)
    if design.modality != "adaptive":
        return {design.modality: change.detect(design, known, frames, *rest)}
    return {name: change.detect(design, known, {name: frames[name]}, *rest) for name in frames}


def choose(
    design: TrackDesign, before: Choice | None, looks: Mapping[str, Change], interval_s: float
) -> Choice:
    """The product to use at this epoch.

    The worth of each is averaged over `adapt_s`; another is taken when its worth is `ADVANTAGE` times that of
    the one in use. The first frames cannot tell: pan begins.
    """
    if design.modality != "adaptive":
        return Choice(design.modality)
    now = {name: worth(look.detections) for name, look in looks.items()}
    if before is None:
        return Choice("pan", now)
    share = 1 - math.exp(-interval_s / design.adapt_s)
    mean = {name: old + share * (now[name] - old) for name, old in before.worth.items()}
    best = max(mean, key=lambda name: (mean[name], name == before.name))
    return Choice(best if mean[best] > ADVANTAGE * mean[before.name] else before.name, mean)


def worth(found: Detections) -> float:
    """Number of strong changes times their share of all changes of a vehicle's size.

    Strength is in local noise scales, so that it means the same in every product. A product that shows few
    vehicles has few strong changes, one that floods has a small share of them.
    """
    strong = int((found.contrast >= STRONG).sum())
    return strong**2 / max(len(found), 1)


def learn(
    design: TrackDesign,
    known: Mapping[str, Background],
    looks: Mapping[str, Change],
    choice: Choice,
    explained: Bool[Array, "detection"],
    measured_m: Float[Array, "target 2"],
    interval_s: float,
) -> dict[str, Background]:
    """All backgrounds after one more frame.

    Parameters
    ----------
    design, known, looks, choice, interval_s
        As above.
    explained
        Which detections of the product in use a confirmed track explains.
    measured_m
        Where confirmed tracks were just measured: they explain what lies there in the other products. [m]
    """
    out: dict[str, Background] = {}
    for name, seen in looks.items():
        mine = explained if name == choice.name else _near(seen.detections.position, measured_m)
        out |= change.learn(design, known, seen, mine, interval_s)
    return out


def _near(position: Float[Array, "detection 2"], measured: Float[Array, "target 2"]) -> Array:
    if len(position) == 0 or len(measured) == 0:
        return np.zeros(len(position), bool)
    apart = np.hypot(*(position[:, None] - measured[None]).transpose(2, 0, 1))
    return apart.min(axis=1) <= VEHICLE_M
