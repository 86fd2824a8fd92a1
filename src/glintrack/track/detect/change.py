"""Change detection on rectified frames: clipped exponential background, neighbourhood, local noise scale.

A pixel has changed where it leaves the range that the background spans within the registration tolerance
around it, by more than a number of local noise scales. The background is learnt *after* the tracker has said
which change is a vehicle: what is tracked is not absorbed, what nobody tracks (parallax of buildings,
aliasing of edges) soon is, and raises the noise scale where it comes again.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int

from glintrack.arrays import Array
from glintrack.parallel import over_rows
from glintrack.track.design import TrackDesign
from glintrack.track.detect import background as backgrounds
from glintrack.track.detect import blobs, mog2, registration
from glintrack.track.detect import change_kernels as kernels
from glintrack.track.detect.background import Background
from glintrack.track.detect.change_kernels import CHANGED, DISPLACED, HOLE

MOST_SHIFT_M = 3.0  # a pose error beyond this is not one frame's jitter
_LEAST_CHANGED = 16384  # pixels; fewer are not worth a thread
OFFSET_SHARE = 0.1  # the anchor to ground coordinates: the mean shift of about ten frames


@dataclass(frozen=True)
class Layer:
    """One product of a frame, registered to its background.

    Parameters
    ----------
    image
        NaN where there is no data. [unit of the product]
    floor
        Least noise scale. [unit of the product]
    strength
        Squared excess over the background in noise scales, capped; −1 where there is no data. [1]
    mixture
        The mixture after this frame, for the detector ``mog2``.
    """

    image: Float[Array, "y x"]
    floor: np.float32
    strength: Float[Array, "y x"]
    mixture: mog2.Mixture | None


@dataclass(frozen=True)
class Change:
    """Changed pixels of one frame, grouped into blobs.

    Parameters
    ----------
    rows, columns, blob
        Of each changed pixel; holes have blob −1, displaced pixels −2.
    detections
        Blobs that may be vehicles.
    detection_blob
        Blob number of each detection.
    layers
        The products looked at, by name.
    offset
        See `Background`. [pixel]
    moved
        Rows and columns by which the frame's own places lie beyond those of its background. [pixel]
    """

    rows: Int[Array, "pixel"]
    columns: Int[Array, "pixel"]
    blob: Int[Array, "pixel"]
    detections: blobs.Detections
    detection_blob: Int[Array, "detection"]
    layers: Mapping[str, Layer]
    offset: tuple[float, float]
    moved: tuple[float, float]


def detect(
    design: TrackDesign,
    known: Mapping[str, Background],
    frames: Mapping[str, Float[Array, "y x"]],
    gsd_m: float,
    corner_m: tuple[float, float],
    expected_m: Float[Array, "target 2"],
    interval_s: float = 0.0,
) -> Change:
    """Blobs in which a frame differs from the background.

    Parameters
    ----------
    design
        Detector, threshold, tolerance and size limits.
    known
        Background of each product, from the frames before.
    frames
        Products of the frame, NaN where there is no data; several are fused. The first is the one that the
        frame is registered by. [radiance or 1]
    gsd_m
        Grid spacing. [m]
    corner_m
        East and north of the centre of pixel (0, 0). [m]
    expected_m
        East and north where confirmed targets are expected: they cut merged blobs. [m]
    interval_s
        Time since the frame before, for ``mog2``. [s]
    """
    first = next(iter(frames))
    floor = backgrounds.noise_floor(design, known[first].mean, frames[first], first)
    shift = registration.shift_between(
        frames[first], known[first].mean, 3 * float(floor), MOST_SHIFT_M / gsd_m
    )
    before = known[first].offset
    offset = tuple(o + OFFSET_SHARE * (s - o) for s, o in zip(shift, before, strict=True))
    moved = (shift[0] - offset[0], shift[1] - offset[1])
    layers = {}
    for name, image in frames.items():
        placed = registration.displaced(image, *moved)
        if placed is not frames[first]:
            floor = backgrounds.noise_floor(design, known[name].mean, placed, name)
        layers[name] = _layer(design, known[name], placed, floor, gsd_m, interval_s)
    level = math.sqrt(fused_level2(design.threshold, len(layers)))
    strength = fused([layer.strength for layer in layers.values()])
    changed = _changed(strength, level**2, gsd_m)
    rows, columns = np.divmod(np.flatnonzero(changed), changed.shape[1])
    explained = _explained(design, known, layers, changed, rows, columns, gsd_m)
    no_vehicle = explained != CHANGED
    explained, others = explained[no_vehicle], (rows[no_vehicle], columns[no_vehicle])
    changed[others] = False
    rows, columns = rows[~no_vehicle], columns[~no_vehicle]
    blob = blobs.label(rows, columns, changed, max(1, math.floor(design.fragment_gap_m / gsd_m)))
    if len(expected_m) > 1 and len(rows):
        seeds = np.stack([corner_m[1] - expected_m[:, 1], expected_m[:, 0] - corner_m[0]], axis=-1) / gsd_m
        blob = blobs.split(rows, columns, blob, seeds, 2.0 / gsd_m, 6.0 / gsd_m)
    count = int(blob.max()) + 1 if len(blob) else 0
    weight = np.sqrt(np.maximum(strength[rows, columns], level**2 / 4)).astype(float)
    moment = blobs.moments(rows, columns, blob, weight, count)
    fits = blobs.vehicle_sized(moment, gsd_m, (design.area_min_m2, design.area_max_m2), design.length_max_m)
    found = blobs.detections_of(moment[fits], gsd_m, corner_m, design.detection_sigma_m, level)
    sequence = blobs.order(found)
    return Change(
        np.r_[rows, others[0]],
        np.r_[columns, others[1]],
        np.r_[blob, -explained.astype(np.int64)],
        blobs.take(found, sequence),
        np.nonzero(fits)[0][sequence],
        layers,
        (offset[0], offset[1]),
        moved,
    )


def _layer(
    design: TrackDesign, known: Background, image: Array, floor: np.float32, gsd_m: float, interval_s: float
) -> Layer:
    """How far one product lies beyond its background, by the detector that the design names."""
    if design.detector == "mog2":
        model = known.mixture or mog2.start(image)
        model, foreground = mog2.step(model, image, design.threshold, interval_s, design.background_s)
        strength = np.where(foreground, np.float32(2 * design.threshold**2), np.float32(0.0))
        return Layer(image, floor, np.where(np.isfinite(image), strength, np.float32(-1.0)), model)
    low = high = known.mean
    if design.detector == "three-frame":
        low, high = _range_of(known.recent, image)
    low, high, weight = envelope(low, high, design.registration_tolerance_m / gsd_m)
    strength, cap = np.empty_like(image), np.float32(4 * design.threshold**2)
    over_rows(
        kernels.excess2, len(image), image, low, high, weight, known.scale, floor, cap, strength,
        least=backgrounds.rows_worth(image),
    )  # fmt: skip
    return Layer(image, floor, strength, None)


def _changed(strength: Float[Array, "y x"], level2: float, gsd_m: float) -> Array:
    """Pixels that have changed by more than the level, in the mean of a small part of a vehicle."""
    changed, holes = np.empty(strength.shape, np.uint8), np.empty(len(strength), np.bool_)
    side = kernels.side_weight(gsd_m)
    over_rows(
        kernels.changed,
        len(strength),
        strength,
        side,
        np.float32(level2),
        changed,
        holes,
        least=backgrounds.rows_worth(strength),
    )
    kernels.fill_holes(changed, strength, holes)
    return changed.view(bool)


def _range_of(recent: tuple[Array, ...], image: Array) -> tuple[Array, Array]:
    """Least and greatest of the two frames before: what differs from both moves, and is here now."""
    if len(recent) < 2:
        nothing = np.full(image.shape, np.nan, np.float32)
        return nothing, nothing
    return np.minimum(*recent), np.maximum(*recent)


def fused(strength: list[Array]) -> Float[Array, "y x"]:
    """Sum of squared excesses; a product without data adds nothing, and −1 is where none has any."""
    if len(strength) == 1:
        return strength[0]
    total = sum(np.maximum(s, 0) for s in strength)
    return np.where(np.max(strength, axis=0) < 0, np.float32(-1.0), total).astype(np.float32)


def fused_level2(threshold: float, products: int) -> float:
    """Squared threshold of a sum of one or two squares that Gaussian noise passes as often as one. [1]

    For one, P(z² > t²) = erfc(t/√2); for two, P(z₁² + z₂² > s) = exp(−s/2).
    """
    if products == 1:
        return threshold**2
    return -2.0 * float(math.log(2.0) + scipy.special.log_ndtr(-threshold))


def _explained(design, known, layers, changed, rows, columns, gsd_m) -> Int[Array, "pixel"]:
    """What the surroundings say of each changed pixel, in the product in which it has changed most."""
    reach, near = max(3, round(6 / gsd_m)), round(design.parallax_m / gsd_m)
    out = np.full(len(rows), CHANGED, np.uint8)
    most = np.full(len(rows), -np.inf, np.float32)
    for name, layer in layers.items():
        mine = np.flatnonzero(layer.strength[rows, columns] > most)
        most[mine] = layer.strength[rows[mine], columns[mine]]
        said = np.empty(len(mine), np.uint8)
        over_rows(
            kernels.explained, len(mine), layer.image, known[name].mean, known[name].scale, layer.floor,
            changed, rows[mine], columns[mine], reach, near, design.parallax_share, said,
            least=_LEAST_CHANGED,
        )  # fmt: skip
        out[mine] = said
    return out


def learn(
    design: TrackDesign,
    known: Mapping[str, Background],
    change: Change,
    tracked: Bool[Array, "detection"],
    interval_s: float,
) -> dict[str, Background]:
    """The backgrounds after one more frame.

    Parameters
    ----------
    design
        Time constants.
    known
        Before the frame.
    change
        From `detect` on the frame.
    tracked
        Which detections a confirmed track explains.
    interval_s
        Time since the frame before. [s]
    """
    kind_of_blob = np.full(int(change.blob.max(initial=-1)) + 3, backgrounds.UNTRACKED, np.uint8)
    kind_of_blob[change.detection_blob[tracked]] = backgrounds.TRACKED
    kind_of_blob[-HOLE], kind_of_blob[-DISPLACED] = backgrounds.HOLE, backgrounds.DISPLACED
    changed = (change.rows, change.columns, kind_of_blob[change.blob])
    out = {}
    for name, layer in change.layers.items():
        after = backgrounds.learnt(
            design, known[name], layer.image, changed, layer.floor, change.offset, interval_s
        )
        recent = (*known[name].recent[-1:], layer.image) if design.detector == "three-frame" else ()
        out[name] = replace(after, recent=recent, mixture=layer.mixture)
    return out


def envelope(
    low: Float[Array, "y x"], high: Float[Array, "y x"], tolerance_px: float
) -> tuple[Float[Array, "y x"], Float[Array, "y x"], np.float32]:
    """Least and greatest background that a displacement up to ``tolerance_px`` can bring to each pixel.

    Between whole pixels the background counts as linear. NaN where no background is known. It is worked out
    but for the last pass over 3 × 3 pixels, whose weight is returned too: `kernels.excess2` makes that one.
    """
    passes = max(1, math.ceil(tolerance_px))
    weight = np.float32(tolerance_px / passes)
    for _ in range(passes - 1):
        wider = np.empty_like(low), np.empty_like(high)
        over_rows(kernels.envelope, len(low), low, high, weight, *wider, least=backgrounds.rows_worth(low))
        low, high = wider
    return low, high, weight
