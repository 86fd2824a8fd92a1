"""Change detection on rectified frames: registration, neighbourhood, local noise scale, blobs.

A pixel has changed where it leaves what is known of it, within the registration tolerance around it, by more
than a number of local noise scales. The background is updated *after* the tracker has said which change is a
vehicle: what is tracked is not absorbed, what nobody tracks (parallax of buildings, aliasing of edges) soon
is, and raises the noise scale where it comes again. The detectors ``background``, ``three-frame`` and
``mog2`` are made of these parts and differ in the strength of change alone.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import scipy.special
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows
from glintrack.track.detect import background_model as model
from glintrack.track.detect import blobs, registration
from glintrack.track.detect import change_kernels as kernels
from glintrack.track.detect.background_model import Background
from glintrack.track.detect.change_kernels import CHANGED, DISPLACED, HOLE
from glintrack.track.detect.design import DetectDesign
from glintrack.track.detect.detections import Detections, order, take
from glintrack.track.detect.frame import Frame, Grid, grid_of, plane

MOST_SHIFT_M = 3.0  # a pose error beyond this is not one frame's jitter
_LEAST_CHANGED = 16384  # pixels; fewer are not worth a thread
OFFSET_SHARE = 0.1  # the anchor to ground coordinates: the mean shift of about ten frames


@dataclass(frozen=True)
class Layer:
    """One plane of a frame, registered to its background.

    Parameters
    ----------
    image
        NaN where there is no data. [unit of the plane]
    floor
        Least noise scale. [unit of the plane]
    """

    image: Float[Array, "y x"]
    floor: np.float32


@dataclass(frozen=True)
class Registered:
    """A frame moved onto its background.

    Parameters
    ----------
    layers
        By name of the plane.
    grid
        Of the frame.
    offset
        See `Background`. [pixel]
    moved
        Rows and columns by which the frame's own places lie beyond those of its background. [pixel]
    """

    layers: Mapping[str, Layer]
    grid: Grid
    offset: tuple[float, float]
    moved: tuple[float, float]


@dataclass(frozen=True)
class Change:
    """Changed pixels of one frame, grouped into blobs; the `Detections.detail` of the change detectors.

    Parameters
    ----------
    rows, columns, blob
        Of each changed pixel; holes have blob −1, displaced pixels −2.
    detection_blob
        Blob number of each detection.
    layers, offset
        As in `Registered`.
    """

    rows: Int[Array, "pixel"]
    columns: Int[Array, "pixel"]
    blob: Int[Array, "pixel"]
    detection_blob: Int[Array, "detection"]
    layers: Mapping[str, Layer]
    offset: tuple[float, float]


def empty_backgrounds(frame: Frame) -> dict[str, Background]:
    """Backgrounds that have seen nothing, of each plane of the frame."""
    grid = frame.grid or grid_of(frame, None)
    return {name: model.empty_background(grid.shape) for name in frame.planes}


def register(design: DetectDesign, known: Mapping[str, Background], frame: Frame) -> Registered:
    """The frame's planes moved onto their backgrounds; the first is the one that the frame is registered by.

    Parameters
    ----------
    design
        Noise floor; boost and threshold of DoLP.
    known
        Background of each plane, from the frames before.
    frame
        NaN where there is no data.
    """
    grid = frame.grid or grid_of(frame, None)
    frames = {name: _values(design, frame, name) for name in frame.planes}
    first = next(iter(frames))
    floor = model.noise_floor(design, known[first].mean, frames[first], first)
    shift = registration.shift_between(
        frames[first], known[first].mean, 3 * float(floor), MOST_SHIFT_M / grid.gsd_m
    )
    before = known[first].offset
    offset = tuple(o + OFFSET_SHARE * (s - o) for s, o in zip(shift, before, strict=True))
    moved = (shift[0] - offset[0], shift[1] - offset[1])
    layers = {}
    for name, image in frames.items():
        placed = registration.shift_image(image, *moved)
        if placed is not frames[first]:
            floor = model.noise_floor(design, known[name].mean, placed, name)
        layers[name] = Layer(placed, floor)
    return Registered(layers, grid, (offset[0], offset[1]), moved)


def _values(design: DetectDesign, frame: Frame, name: str) -> Float[Array, "y x"]:
    values = plane(frame, name)
    if name == "dolp":  # NaN stays NaN
        values = np.minimum(values * np.float32(design.dolp_boost), np.float32(1.0))
        values = np.maximum(values, np.float32(design.dolp_threshold))
    return values


def excess(
    design: DetectDesign,
    reference: Array | tuple[Array, Array],
    known: Background,
    layer: Layer,
    gsd_m: float,
) -> Float[Array, "y x"]:
    """Squared excess of a plane over a reference in local noise scales, capped; −1 without data. [1]

    Parameters
    ----------
    design
        Threshold and tolerance.
    reference
        What is expected of each pixel, or the least and greatest that are. [unit of the plane]
    known
        Background, for its noise scale.
    layer
        The plane, registered.
    gsd_m
        Grid spacing. [m]
    """
    low, high = reference if isinstance(reference, tuple) else (reference, reference)
    low, high, weight = envelope(low, high, design.registration_tolerance_m / gsd_m)
    strength, cap = np.empty_like(layer.image), np.float32(4 * design.threshold**2)
    over_rows(
        kernels.excess2, len(strength), layer.image, low, high, weight, known.scale, layer.floor, cap,
        strength, least=model.rows_worth(strength),
    )  # fmt: skip
    return strength


def blobs_of(
    design: DetectDesign,
    known: Mapping[str, Background],
    placed: Registered,
    strengths: Mapping[str, Float[Array, "y x"]],
    expected_m: Float[Array, "track 2"],
) -> Detections:
    """Blobs of changed pixels that may be vehicles, with what `update` needs of them.

    Parameters
    ----------
    design
        Threshold and size limits.
    known, placed
        Backgrounds, and the frame registered to them.
    strengths
        Squared change of each plane in noise scales, −1 where there is no data; several are fused. [1]
    expected_m
        East and north where confirmed targets are expected: they cut merged blobs. [m]
    """
    gsd_m, corner_m = placed.grid.gsd_m, placed.grid.corner_m
    level = math.sqrt(fused_level2(design.threshold, len(strengths)))
    strength = fused(list(strengths.values()))
    changed = _changed(strength, level**2, gsd_m)
    rows, columns = np.divmod(np.flatnonzero(changed), changed.shape[1])
    explained = _explained(design, known, placed.layers, strengths, changed, rows, columns, gsd_m)
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
    found = blobs.detections_of(moment[fits], gsd_m, corner_m, design.sigma_m, level)
    sequence = order(found)
    change = Change(
        np.r_[rows, others[0]],
        np.r_[columns, others[1]],
        np.r_[blob, -explained.astype(np.int64)],
        np.nonzero(fits)[0][sequence],
        placed.layers,
        placed.offset,
    )
    displacement_m = (gsd_m * placed.moved[1], -gsd_m * placed.moved[0])
    return replace(take(found, sequence), displacement_m=displacement_m, detail=change)


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
        least=model.rows_worth(strength),
    )
    kernels.fill_holes(changed, strength, holes)
    return changed.view(bool)


def fused(strength: list[Array]) -> Float[Array, "y x"]:
    """Sum of squared excesses; a plane without data adds nothing, and −1 is where none has any."""
    if len(strength) == 1:
        return strength[0]
    total = sum(np.maximum(s, 0) for s in strength)
    return np.where(np.max(strength, axis=0) < 0, np.float32(-1.0), total).astype(np.float32)


def fused_level2(threshold: float, planes: int) -> float:
    """Squared threshold of a sum of one or two squares that Gaussian noise passes as often as one. [1]

    For one, P(z² > t²) = erfc(t/√2); for two, P(z₁² + z₂² > s) = exp(−s/2).
    """
    if planes == 1:
        return threshold**2
    return -2.0 * float(math.log(2.0) + scipy.special.log_ndtr(-threshold))


def _explained(design, known, layers, strengths, changed, rows, columns, gsd_m) -> Int[Array, "pixel"]:
    """What the surroundings say of each changed pixel, in the product in which it has changed most."""
    reach, near = max(3, round(6 / gsd_m)), round(design.parallax_m / gsd_m)
    out = np.full(len(rows), CHANGED, np.uint8)
    most = np.full(len(rows), -np.inf, np.float32)
    for name, layer in layers.items():
        mine = np.flatnonzero(strengths[name][rows, columns] > most)
        most[mine] = strengths[name][rows[mine], columns[mine]]
        said = np.empty(len(mine), np.uint8)
        frame = kernels.ChangedFrame(layer.image, known[name].mean, known[name].scale, layer.floor, changed)
        over_rows(
            kernels.explained, len(mine), frame, rows[mine], columns[mine], reach, near,
            design.parallax_share, said, least=_LEAST_CHANGED,
        )  # fmt: skip
        out[mine] = said
    return out


def update(
    design: DetectDesign,
    known: Mapping[str, Background],
    found: Detections,
    explained: Bool[Array, "detection"],
    interval_s: float,
) -> dict[str, Background]:
    """The backgrounds after one more frame.

    Parameters
    ----------
    design
        Time constants.
    known
        Before the frame.
    found
        From `blobs_of` on the frame.
    explained
        Which detections a confirmed track explains.
    interval_s
        Time since the frame before, 0 for the first. [s]
    """
    change: Change = found.detail
    interval_s = interval_s or design.untracked_s
    kind_of_blob = np.full(int(change.blob.max(initial=-1)) + 3, model.UNTRACKED, np.uint8)
    kind_of_blob[change.detection_blob[explained]] = model.TRACKED
    kind_of_blob[-HOLE], kind_of_blob[-DISPLACED] = model.HOLE, model.DISPLACED
    changed = (change.rows, change.columns, kind_of_blob[change.blob])
    return {
        name: model.updated(design, known[name], layer.image, changed, layer.floor, change.offset, interval_s)
        for name, layer in change.layers.items()
    }


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
        over_rows(kernels.envelope, len(low), low, high, weight, *wider, least=model.rows_worth(low))
        low, high = wider
    return low, high, weight
