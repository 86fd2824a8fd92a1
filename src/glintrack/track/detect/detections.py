"""Detections of one frame, as arrays, and their association."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from glintrack.core.arrays import Array


@dataclass(frozen=True)
class Detections:
    """Detections of one frame, in any order.

    Parameters
    ----------
    position
        East and north. [m]
    covariance
        Covariance of the position. [m²]
    extent
        Diameter of the disc of equal area. [m]
    contrast
        Peak of the detector's statistic over its threshold. [1]
    log_likelihood_ratio
        Log-likelihood ratio of vehicle against clutter. It lowers the cost of every association of the
        detection and raises the score of its track. [nat]
    displacement_m
        East and north shift of positions in this frame against the ground, as the detector registered it:
        spectra of detections are queried at the shifted positions. [m]
    velocity, velocity_sigma_m_s
        East and north speed, if the detector estimates motions, and the standard deviation of each. New
        tracks start with it if all velocities are right. [m s⁻¹]
    velocity_share, velocity_most_m_s
        Share of the velocities that are right [1]; the others are uniform up to this speed [m s⁻¹]. With a
        share below 1 a velocity is evidence in the association only.
    correlation_s
        Time over which the errors of a vehicle's positions are correlated. At shorter intervals the tracker
        enlarges the covariances in proportion, since such detections carry no independent position. [s]
    earlier_s, earlier
        Times of the earlier frames in which the detector found the detections too [s], and positions: east
        and north, NaN where it did not find one. [m]
    detail
        Data of the detector for `Detector.update`; the tracker does not use it.
    """

    position: Float[Array, "detection 2"]
    covariance: Float[Array, "detection 2 2"]
    extent: Float[Array, "detection"]
    contrast: Float[Array, "detection"]
    log_likelihood_ratio: Float[Array, "detection"] | None = None
    displacement_m: tuple[float, float] = (0.0, 0.0)
    velocity: Float[Array, "detection 2"] | None = None
    velocity_sigma_m_s: float = 0.0
    velocity_share: float = 1.0
    velocity_most_m_s: float = 0.0
    correlation_s: float = 0.0
    earlier_s: tuple[float, ...] = ()
    earlier: Float[Array, "detection earlier 2"] | None = None
    detail: Any = None

    def __len__(self) -> int:
        """Count of detections."""
        return len(self.position)


@dataclass(frozen=True)
class Association:
    """Association of a frame's detections, so that a detector can leave tracks out of its background.

    Parameters
    ----------
    explained
        Mask of the detections that a confirmed track explains, in the detector's order.
    """

    explained: Bool[Array, "detection"]


def no_detections() -> Detections:
    """Return an empty set of detections."""
    return Detections(np.empty((0, 2)), np.empty((0, 2, 2)), np.empty(0), np.empty(0))


def of_boxes(
    box: Float[Array, "detection 4"], sigma_m: float, contrast: Float[Array, "detection"] | None = None
) -> Detections:
    """Convert boxes to detections at their centres.

    Parameters
    ----------
    box
        West, south, east and north edge. [m]
    sigma_m
        Standard deviation of the centre, in east and in north. [m]
    contrast
        See `Detections`; 1 by default.
    """
    box = np.asarray(box, float).reshape(-1, 4)
    n = len(box)
    area = np.maximum(box[:, 2] - box[:, 0], 0) * np.maximum(box[:, 3] - box[:, 1], 0)
    return Detections(
        position=0.5 * (box[:, :2] + box[:, 2:]),
        covariance=np.repeat(sigma_m**2 * np.eye(2)[None], n, axis=0),
        extent=np.sqrt(4 / np.pi * area),
        contrast=np.ones(n) if contrast is None else np.asarray(contrast, float),
    )


def check(found: Detections) -> Detections:
    """Check that detections can be associated, and return them.

    Raises
    ------
    ValueError
        If arrays do not fit each other or a position, covariance or likelihood ratio is not finite.
    """
    n = len(found.position)
    shapes = {"position": (n, 2), "covariance": (n, 2, 2), "extent": (n,), "contrast": (n,)}
    optional = {"log_likelihood_ratio": (n,), "velocity": (n, 2)}
    optional["earlier"] = (n, len(found.earlier_s), 2)
    shapes |= {name: shape for name, shape in optional.items() if getattr(found, name) is not None}
    for name, shape in shapes.items():
        if np.shape(getattr(found, name)) != shape:
            raise ValueError(
                f"`detections.{name}` must have shape {shape} for {n} positions; "
                f"got {np.shape(getattr(found, name))}."
            )
    finite = (found.position, found.covariance, found.log_likelihood_ratio, found.velocity)
    if not all(np.isfinite(values).all() for values in finite if values is not None):
        raise ValueError(
            "`detections` must have finite positions, covariances, likelihood ratios and velocities; "
            "got some that are not."
        )
    return found


def order(detections: Detections) -> Int[Array, "detection"]:
    """Sort by east, then north, so that the result does not depend on the detections' order; indices."""
    return np.lexsort(detections.position.T[::-1])


def take(detections: Detections, index: np.ndarray) -> Detections:
    """Select the detections at an index or mask."""
    names = (
        "position", "covariance", "extent", "contrast", "log_likelihood_ratio", "velocity", "earlier"
    )  # fmt: skip
    values = {name: getattr(detections, name) for name in names}
    return replace(detections, **{name: one[index] for name, one in values.items() if one is not None})
