"""The ground map anew from a flight's first frames: of each place what most of them agree on.

What the first frame shows is learnt whole, its vehicles too, and what differs from it afterwards hardly at
all: under dense traffic, where other vehicles follow before a place is believed to be free, the map holds
vehicles for half a minute. So the first frames are kept, each is predicted from every other alone, and the
map is made anew from them, each reading by the share of the others that confirm it over the greatest such
share at its place.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import cast

import numpy as np
from jaxtyping import Float, Int

from glintrack.camera import Camera, Pose
from glintrack.core.arrays import Array
from glintrack.core.records import Mosaic
from glintrack.track.detect.frame import Frame
from glintrack.track.detect.mosaic_model import (
    COARSE,
    SCALE_START,
    SOFT,
    ElementPrediction,
    Ground,
    predict,
    update_ground,
)

FRAMES, SPACING_S = 4, 0.45  # kept, and time between them at least: a car has then left its place
_TINY = 1e-6  # of a share: where nothing is confirmed all is learnt alike


def kept(frames: Sequence[Frame], frame: Frame) -> tuple[Frame, ...]:
    """The first frames with one more, if it is late enough; of it what the map needs."""
    if frames and frame.time_s - frames[-1].time_s < SPACING_S:
        return tuple(frames)
    return *frames, replace(frame, image=None, surface=None)


def agreed(ground: Ground, frames: Sequence[Frame]) -> Ground:
    """The map of what the first frames agree on.

    Parameters
    ----------
    ground
        What was learnt until then: its area and kinds of elements hold on.
    frames
        The first, two at least, in the order of time.
    """
    votes: list[list[tuple[Float[Array, "row column"], ...]]] = [[] for _ in frames]
    cells = []
    for j, other in enumerate(frames):
        alone = _emptied(ground)
        seen = _predicted(alone, other)
        cells.append(_cells(ground, seen))
        alone = _learnt(alone, other, seen, 0.0)
        for i, frame in enumerate(frames):
            if i != j:
                votes[i].append(_predicted(alone, frame).z2)
    shares = [[_share(np.stack(of_kind)) for of_kind in zip(*of_frame, strict=True)] for of_frame in votes]
    best = [np.zeros(ground.differed_s.shape, np.float32) for _ in ground.places]
    for share, cell in zip(shares, cells, strict=True):
        for k, most in enumerate(best):
            np.maximum.at(most.reshape(-1), cell[k], share[k])
    out, before_s = _emptied(ground), frames[0].time_s
    for frame, share, cell in zip(frames, shares, cells, strict=True):
        weight = tuple(
            np.square(one / np.maximum(most.reshape(-1)[at], _TINY))
            for one, most, at in zip(share, best, cell, strict=True)
        )
        out = _learnt(out, frame, _predicted(out, frame), frame.time_s - before_s, weight)
        before_s = frame.time_s
    return out


def _share(z2: Float[Array, "other row column"]) -> Float[Array, "row column"]:
    """Share of the other frames that confirm each reading, by its squared deviations from them."""
    known = np.isfinite(z2)
    agrees = np.where(known, 1 / (1 + np.where(known, z2, 0) / SOFT) ** 2, 0)
    share = agrees.sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    return np.where(known.any(axis=0), share, 1).astype(np.float32)


def _cells(ground: Ground, seen: ElementPrediction) -> list[Int[Array, "row column"]]:
    """The coarse cell that each element of each kind sees, row by row, held to the map."""
    rows, columns = ground.differed_s.shape
    out = []
    for i, j in ground.places:
        own = slice(i, None, ground.side), slice(j, None, ground.side)
        y, x = (np.floor((np.nan_to_num(at[own]) + 0.5) / COARSE) for at in (seen.y, seen.x))
        row, column = np.clip(y, 0, rows - 1).astype(np.int32), np.clip(x, 0, columns - 1).astype(np.int32)
        out.append(row * np.int32(columns) + column)
    return out


def _emptied(ground: Ground) -> Ground:
    """The same area, nothing learnt."""
    return replace(
        ground,
        maps=tuple(np.zeros_like(one) for one in ground.maps),
        scales=tuple(np.full_like(one, SCALE_START) for one in ground.scales),
        differed_s=np.zeros_like(ground.differed_s),
        since_s=None,
        first_s=None,
        shift_m=(0.0, 0.0),
    )


def _predicted(ground: Ground, frame: Frame) -> ElementPrediction:
    mosaic, camera, pose = cast(Mosaic, frame.mosaic), cast(Camera, frame.camera), cast(Pose, frame.pose)
    return predict(ground, mosaic, camera, pose, frame.terrain, frame.time_s)


def _learnt(ground: Ground, frame: Frame, seen: ElementPrediction, interval_s: float, weight=None) -> Ground:
    """The ground with a frame in it."""
    masked, camera = np.zeros(ground.differed_s.shape, np.bool_), cast(Camera, frame.camera)
    return update_ground(ground, seen, camera, masked, frame.time_s, interval_s, weight)
