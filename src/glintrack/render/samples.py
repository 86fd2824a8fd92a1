"""From rays to samples: what an element's rays have in common is kept once, with the part of them it is.

Rays of an element that met the same plane (material, instance, normal and offset) are one sample; smooth
surfaces keep one for each ray, whose mirrored ray goes its own way.
"""

from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.render.rays.resolve import Surfaces

_SAME_PLANE_M = 0.1  # planes farther apart are two: a kerb is higher, and light beside it another


class Samples(NamedTuple):
    """What the rays of some elements met; see `Hits` for the fields not named here.

    Parameters
    ----------
    element, count
        Which elements, and how many samples each has, one element's after the other's.
    rays
        How many rays a sample stands for.
    instance
        Which of the snapshot's instances was met; −1 for the static mesh and for none.
    mirror
        Where a smooth sample's ray stands in the last two fields; −1 for rough ones.
    smooth_direction, smooth_lifted
        Of smooth samples: the ray's own direction, and where its mirrored ray starts. [1, m]
    """

    element: Int[Array, "chosen"]
    count: Int[Array, "chosen"]
    rays: Float[Array, "sample"]
    point: Float[Array, "sample 3"]
    normal: Float[Array, "sample 3"]
    range_m: Float[Array, "sample"]
    material: Int[Array, "sample"]
    vehicle_id: Int[Array, "sample"]
    instance: Int[Array, "sample"]
    sun_visible: Float[Array, "sample"]
    mirror: Int[Array, "sample"]
    smooth_direction: Float[Array, "smooth 3"]
    smooth_lifted: Float[Array, "smooth 3"]

    @classmethod
    def empty(cls, elements: Int[Array, "chosen"], samples: int, smooth: int) -> "Samples":
        """Arrays for so many, not yet filled."""
        return cls(
            np.asarray(elements, np.int64),
            np.zeros(len(elements), np.int64),
            np.empty(samples, np.float32),
            np.empty((samples, 3), np.float32),
            np.empty((samples, 3), np.float32),
            np.empty(samples, np.float32),
            np.empty(samples, np.int16),
            np.empty(samples, np.int32),
            np.empty(samples, np.int32),
            np.empty(samples, np.float32),
            np.empty(samples, np.int32),
            np.empty((smooth, 3), np.float32),
            np.empty((smooth, 3), np.float32),
        )

    def cut(self, samples: int, smooth: int) -> "Samples":
        """The first of them, in memory of their own."""
        own = [values[:samples].copy() for values in self[2:-2]]
        return Samples(*self[:2], *own, *(values[:smooth].copy() for values in self[-2:]))


def merge_rays(
    elements: Int[Array, "chosen"],
    n: int,
    direction: Float[Array, "ray 3"],
    seen: Surfaces,
    light: Float[Array, "ray"],
    is_smooth: Bool[Array, "material"],
) -> Samples:
    """Samples of elements from n rays of each, one element's after the other's.

    Parameters
    ----------
    elements, n
        Which elements, and how many rays each has.
    direction, seen, light
        Of the rays: where they go, what they met, and the part of the sun's light that arrives there.
    is_smooth
        Materials whose mirrored ray is followed.
    """
    out = Samples.empty(elements, len(direction), len(direction))
    used = np.zeros(2, np.int64)
    _merge(n, direction, seen, light, is_smooth, out, used)
    return out.cut(*used.tolist())


def in_order(lots: list[Samples], count: int) -> Samples:
    """Samples of the elements of a whole frame, in their order, from lots that share no element."""
    counts = np.zeros(count, np.int64)
    for lot in lots:
        counts[lot.element] = lot.count
    first, smooth = _starts(counts), _starts([len(lot.smooth_lifted) for lot in lots])
    out = Samples.empty(np.arange(count), int(first[-1]), int(smooth[-1]))._replace(count=counts)

    def copy(begin: int, end: int) -> None:
        for k in range(begin, end):
            _copy(lots[k], first, smooth[k], out)

    over_rows(copy, len(lots))
    return out


def join_samples(parts: list[Samples], count: int) -> Samples:
    """Samples of the elements of a whole frame: of each what all parts have of it, each part `in_order`."""
    if len(parts) == 1:
        return parts[0]
    ends, smooth = _starts([len(part.rays) for part in parts]), _starts([len(p.smooth_lifted) for p in parts])
    moved = [
        part._replace(mirror=np.where(part.mirror >= 0, part.mirror + start, -1).astype(np.int32))
        for part, start in zip(parts, smooth[:-1].tolist(), strict=True)
    ]
    both = Samples(*(np.concatenate(values) for values in zip(*moved, strict=True)))
    firsts = np.stack([end + _starts(part.count) for end, part in zip(ends[:-1], parts, strict=True)])
    counts = np.zeros(count, np.int64)
    over_rows(_count_joined, count, firsts, both, counts, least=1024)
    first = _starts(counts)
    out = Samples.empty(np.arange(count), int(first[-1]), 0)._replace(
        count=counts, smooth_direction=both.smooth_direction, smooth_lifted=both.smooth_lifted
    )
    over_rows(_join, count, firsts, both, first, out, least=1024)
    return out


def _starts(counts: Int[Array, "n"] | list[int]) -> Int[Array, "n+1"]:
    """Where each of some begins that lie one after the other, and where the last ends."""
    return np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _merge(n, direction, seen, light, is_smooth, out, used):
    sample = smooth = 0
    for k in range(len(out.count)):
        begin = sample
        for ray in range(k * n, (k + 1) * n):
            material = seen.material[ray]
            mirrors = material >= 0 and is_smooth[material]
            if not mirrors:
                same = sample - 1
                while same >= begin and not _is_same(out, same, seen, ray):
                    same -= 1
                if same >= begin:
                    _add(out, same, seen.point[ray], seen.range_m[ray], light[ray], np.float32(1.0))
                    continue
            out.rays[sample], out.range_m[sample], out.sun_visible[sample] = (
                1.0,
                seen.range_m[ray],
                light[ray],
            )
            out.material[sample], out.instance[sample] = material, seen.instance[ray]
            out.vehicle_id[sample] = seen.vehicle_id[ray]
            out.mirror[sample] = smooth if mirrors else -1
            for c in range(3):
                out.point[sample, c], out.normal[sample, c] = seen.point[ray, c], seen.normal[ray, c]
                if mirrors:
                    out.smooth_direction[smooth, c] = direction[ray, c]
                    out.smooth_lifted[smooth, c] = seen.lifted[ray, c]
            sample, smooth = sample + 1, smooth + (1 if mirrors else 0)
        out.count[k] = sample - begin
    used[0], used[1] = sample, smooth


@nb.njit(nogil=True, cache=True)
def _copy(lot, first, smooth, out):
    """Write a lot's samples where those of their elements begin; of its smooth ones from ``smooth`` on."""
    sample = 0
    for k in range(len(lot.element)):
        begin = first[lot.element[k]]
        for to in range(begin, begin + lot.count[k]):
            out.rays[to], out.range_m[to] = lot.rays[sample], lot.range_m[sample]
            out.sun_visible[to], out.material[to] = lot.sun_visible[sample], lot.material[sample]
            out.vehicle_id[to], out.instance[to] = lot.vehicle_id[sample], lot.instance[sample]
            mirror = lot.mirror[sample]
            out.mirror[to] = mirror + smooth if mirror >= 0 else -1
            for c in range(3):
                out.point[to, c], out.normal[to, c] = lot.point[sample, c], lot.normal[sample, c]
            sample += 1
    for k in range(len(lot.smooth_lifted)):
        for c in range(3):
            out.smooth_direction[smooth + k, c] = lot.smooth_direction[k, c]
            out.smooth_lifted[smooth + k, c] = lot.smooth_lifted[k, c]


@nb.njit(nogil=True, cache=True)
def _count_joined(start, stop, firsts, samples, counts):
    for element in range(start, stop):
        total = 0
        for part in range(len(firsts)):
            for sample in range(firsts[part, element], firsts[part, element + 1]):
                total += 1 if _twin(firsts, samples, element, part, sample) < 0 else 0
        counts[element] = total


@nb.njit(nogil=True, cache=True, error_model="numpy")
def _join(start, stop, firsts, samples, first, out):
    for element in range(start, stop):
        begin = to = first[element]
        for part in range(len(firsts)):
            for sample in range(firsts[part, element], firsts[part, element + 1]):
                rays, light = samples.rays[sample], samples.sun_visible[sample]
                if _twin(firsts, samples, element, part, sample) >= 0:
                    same = begin
                    while out.mirror[same] >= 0 or not _is_same(out, same, samples, sample):
                        same += 1
                    _add(out, same, samples.point[sample], samples.range_m[sample], light, rays)
                    continue
                out.rays[to], out.range_m[to], out.sun_visible[to] = rays, samples.range_m[sample], light
                out.material[to], out.vehicle_id[to] = samples.material[sample], samples.vehicle_id[sample]
                out.instance[to], out.mirror[to] = samples.instance[sample], samples.mirror[sample]
                for c in range(3):
                    out.point[to, c], out.normal[to, c] = samples.point[sample, c], samples.normal[sample, c]
                to += 1


@nb.njit(cache=True, forceinline=True)
def _twin(firsts, samples, element, part, sample):
    """Sample of an earlier part of the same element that a rough one goes into, −1 for none."""
    if samples.mirror[sample] >= 0:
        return -1
    for before in range(part):
        for other in range(firsts[before, element], firsts[before, element + 1]):
            if samples.mirror[other] < 0 and _is_same(samples, other, samples, sample):
                return other
    return -1


@nb.njit(cache=True, forceinline=True)
def _is_same(these, one, those, other):
    """Whether two met the same plane of the same thing."""
    same = (
        these.material[one] == those.material[other]
        and these.instance[one] == those.instance[other]
        and these.normal[one, 0] == those.normal[other, 0]
        and these.normal[one, 1] == those.normal[other, 1]
        and these.normal[one, 2] == those.normal[other, 2]
    )
    if not same:
        return False
    apart = np.float32(0.0)
    for c in range(3):
        apart += these.normal[one, c] * (those.point[other, c] - these.point[one, c])
    return abs(apart) < _SAME_PLANE_M


@nb.njit(cache=True, forceinline=True, error_model="numpy")
def _add(out, k, point, range_m, light, rays):
    """Take more rays into a sample's means."""
    total = out.rays[k] + rays
    part = rays / total
    out.rays[k] = total
    if np.isfinite(range_m):
        out.range_m[k] += part * (range_m - out.range_m[k])
    out.sun_visible[k] += part * (light - out.sun_visible[k])
    for c in range(3):
        out.point[k, c] += part * (point[c] - out.point[k, c])
