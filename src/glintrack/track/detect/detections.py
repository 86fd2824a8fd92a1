"""Detections of one frame, as arrays, and what the tracker says of them."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array
from glintrack.core.records import Detection


@dataclass(frozen=True)
class Detections:
    """Detections of one frame, in any order; `records` gives them one by one.

    Parameters
    ----------
    position
        East and north. [m]
    covariance
        Of the position. [m²]
    extent
        Diameter of the disc of equal area. [m]
    contrast
        Peak of the detector's statistic over its threshold. [1]
    log_likelihood_ratio
        How much more likely what was seen there is of a vehicle than of clutter; it lowers the cost of every
        association of the detection and raises the score of the track that gets it. [nat]
    box
        West, south, east and north edge. [m]
    displacement_m
        East and north by which places in this frame lie beyond those on the ground, as the detector
        registered it: a spectrum of a detection is asked there. [m]
    velocity, velocity_sigma_m_s
        East and north speed of what was detected, if the detector follows motions, and the standard deviation
        of each: where a new track starts from, if all are right. [m s⁻¹]
    velocity_share, velocity_most_m_s
        How many of the velocities are right [1]; else each is any up to this speed, and new tracks do not
        start from it, but it says whose a detection is. [m s⁻¹]
    earlier_s, earlier
        Times of the earlier frames in which the detector saw detections too [s], and where: east and north,
        NaN where it did not see that one. [m]
    detail
        Whatever the detector needs of this frame in `Detector.update`; nobody else looks at it.
    """

    position: Float[Array, "detection 2"]
    covariance: Float[Array, "detection 2 2"]
    extent: Float[Array, "detection"]
    contrast: Float[Array, "detection"]
    log_likelihood_ratio: Float[Array, "detection"] | None = None
    box: Float[Array, "detection 4"] | None = None
    displacement_m: tuple[float, float] = (0.0, 0.0)
    velocity: Float[Array, "detection 2"] | None = None
    velocity_sigma_m_s: float = 0.0
    velocity_share: float = 1.0
    velocity_most_m_s: float = 0.0
    earlier_s: tuple[float, ...] = ()
    earlier: Float[Array, "detection earlier 2"] | None = None
    detail: Any = None

    def __len__(self) -> int:
        """Count of detections."""
        return len(self.position)

    def records(self) -> tuple[Detection, ...]:
        """The same detections as small records."""
        return tuple(
            Detection(
                east_m=p[0].item(),
                north_m=p[1].item(),
                east_var_m2=c[0, 0].item(),
                north_var_m2=c[1, 1].item(),
                east_north_cov_m2=c[0, 1].item(),
                extent_m=e.item(),
                contrast=k.item(),
            )
            for p, c, e, k in zip(self.position, self.covariance, self.extent, self.contrast, strict=True)
        )


@dataclass(frozen=True)
class Association:
    """What the tracker says of a frame's detections: a detector should not learn tracks as background.

    Parameters
    ----------
    explained
        Which detections a confirmed track explains, in the order in which the detector gave them.
    measured_m
        Where confirmed tracks were measured in this frame. [m]
    """

    explained: Bool[Array, "detection"]
    measured_m: Float[Array, "track 2"]


def no_detections() -> Detections:
    """No detections at all."""
    return Detections(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0), np.empty(0))


def of_boxes(
    box: Float[Array, "detection 4"], sigma_m: float, contrast: Float[Array, "detection"] | None = None
) -> Detections:
    """Detections from boxes: each stands in the middle of its box.

    Parameters
    ----------
    box
        West, south, east and north edge. [m]
    sigma_m
        Standard deviation of the middle, in east and in north. [m]
    contrast
        As in `Detections`; 1 by default.
    """
    box = np.asarray(box, float).reshape(-1, 4)
    n = len(box)
    area = np.maximum(box[:, 2] - box[:, 0], 0) * np.maximum(box[:, 3] - box[:, 1], 0)
    return Detections(
        position=0.5 * (box[:, :2] + box[:, 2:]),
        covariance=np.repeat(sigma_m**2 * np.eye(2)[None], n, axis=0),
        extent=np.sqrt(4 / np.pi * area),
        contrast=np.ones(n) if contrast is None else np.asarray(contrast, float),
        box=box,
    )


def check(found: Detections) -> Detections:
    """The same detections, if they can be associated.

    Raises
    ------
    ValueError
        If arrays do not fit each other or a position, covariance or likelihood ratio is not finite.
    """
    n = len(found.position)
    shapes = {"position": (n, 2), "covariance": (n, 2, 2), "extent": (n,), "contrast": (n,)}
    optional = {"log_likelihood_ratio": (n,), "box": (n, 4), "velocity": (n, 2)}
    optional["earlier"] = (n, len(found.earlier_s), 2)
    shapes |= {name: shape for name, shape in optional.items() if getattr(found, name) is not None}
    for name, shape in shapes.items():
        if np.shape(getattr(found, name)) != shape:
            raise ValueError(
                f"`detections.{name}` must have shape {shape} for {n} positions, "
                f"got {np.shape(getattr(found, name))}"
            )
    told = (found.position, found.covariance, found.log_likelihood_ratio, found.velocity)
    if not all(np.isfinite(values).all() for values in told if values is not None):
        raise ValueError(
            "`detections` must have finite positions, covariances, likelihood ratios and velocities, "
            "got some that are not"
        )
    return found


def order(detections: Detections) -> Int[Array, "detection"]:
    """Indices that sort detections by east, then north: the result must not depend on their order."""
    east = detections.position[:, 0]
    index = np.argsort(east)
    if (np.diff(east[index]) > 0).all():  # no two alike, and north is not asked
        return index
    return np.lexsort((detections.position[:, 1], east))


def take(detections: Detections, index: np.ndarray) -> Detections:
    """The detections at an index or mask."""
    names = ("log_likelihood_ratio", "box", "velocity", "earlier")
    optional = {name: getattr(detections, name) for name in names}
    return replace(
        detections,
        position=detections.position[index],
        covariance=detections.covariance[index],
        extent=detections.extent[index],
        contrast=detections.contrast[index],
        **{name: values[index] for name, values in optional.items() if values is not None},
    )
