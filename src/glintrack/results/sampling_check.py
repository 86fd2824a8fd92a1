"""The renderer's own sampling error in a flight: some squares of a few frames against many more rays.

In each square the light is that of `REFERENCE` × `REFERENCE` rays an element instead; how much that changes
what the inner elements expect, in σ of their noise, is the error.
"""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float

from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.results.epoch import Epoch
from glintrack.sensor import dark_noise_e, photo_electrons

REFERENCE = 12  # rays along each side of an element
SIDE, MARGIN = 32, 6  # elements of a square; its edge, over which the lens mixes in what was not traced again
SQUARES = 6  # of a frame


@dataclass
class SamplingCheck:
    """Watches a run: measures the first frame, the middle one and the last.

    Parameters
    ----------
    case
        The design being flown.
    """

    case: Case
    _errors: list[Array] = field(default_factory=list)

    def measure(self, epoch: Epoch) -> None:
        """Called after every turn of a loop."""
        last = self.case.flight.frames - 1
        if epoch.channel == self.case.channels[0] and epoch.index in {0, last // 2, last}:
            self._errors.append(frame_error(epoch))

    def found(self) -> dict[str, float]:
        """Median and 90 % quantile of the error, in σ of the noise; nothing if no element was measured."""
        every = np.concatenate([np.empty(0), *self._errors])
        if not len(every):
            return {}
        return {
            "sampling_error_median_sigma": float(np.median(every)),
            "sampling_error_90_sigma": float(np.quantile(every, 0.9)),
        }


def frame_error(epoch: Epoch) -> Float[Array, "element"]:
    """|error| of what the inner elements of some squares of a frame expect. [σ]"""
    true_frame, observer = epoch.true_frame, epoch.observer
    hits, sensor = true_frame.hits, true_frame.sensor
    squares = _squares(hits.rows, hits.columns, epoch.index)
    frame = np.arange(hits.rows * hits.columns).reshape(hits.rows, hits.columns)
    elements = np.unique(np.concatenate([frame[square].ravel() for square in squares]))
    many = observer.replace(sampling=None, oversampling=REFERENCE)
    anew = many.trace(observer.city.at(epoch.time_s), true_frame.true_pose, elements=elements)
    planes = true_frame.planes_with(observer, anew)
    flown, best = (photo_electrons(p, sensor) for p in (true_frame.planes, planes))
    error = np.abs(flown - best) / np.sqrt(np.maximum(best, 0) + dark_noise_e(sensor) ** 2)
    inner = [
        (slice(r.start + MARGIN, r.stop - MARGIN), slice(c.start + MARGIN, c.stop - MARGIN))
        for r, c in squares
    ]
    return np.concatenate([error[square].ravel() for square in inner])


def _squares(rows: int, columns: int, frame: int) -> list[tuple[slice, slice]]:
    """Squares at places drawn for each frame; the whole frame where it is no larger."""
    rng = np.random.default_rng((frame, 18))
    out = []
    for _ in range(SQUARES):
        size = min(SIDE, rows), min(SIDE, columns)
        top, left = rng.integers(rows - size[0] + 1), rng.integers(columns - size[1] + 1)
        out.append((slice(int(top), int(top) + size[0]), slice(int(left), int(left) + size[1])))
    return out
