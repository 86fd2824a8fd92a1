"""Sharpness and noise of frames without a target or truth: edge response and temporal noise.

Both need nothing but frames, so that a real camera and its simulation can be compared.
"""

import numpy as np
from jaxtyping import Float
from scipy import ndimage

from glintrack.core.arrays import Array

MAX_EDGES = 400  # the steepest of a frame
HALF_PX, STEP_PX = 6.0, 0.25  # of a profile across an edge
ALONG_PX = 2  # to both sides: a profile is the mean over a short piece of the edge
PLATEAU_PX = 2.0  # at both ends of a profile
MAX_PLATEAU_ERROR = 0.15  # of the step: an edge beside other structure is not used
FLAT_SHARE = 0.3  # of the pixels, those with the least gradient, on which noise is measured
HIGH_PASS_PX = 5
_GAUSSIAN = 1.4826  # standard deviation over median absolute deviation


def edge_rises(image: Float[Array, "y x"]) -> tuple[Float[Array, "edge 2"], Float[Array, "edge"]]:
    """Find the steepest isolated edges of a frame, and the distance in which each rises from 10 % to 90 %.

    Parameters
    ----------
    image
        Without missing data. [any unit]

    Returns
    -------
    place
        Row and column of each edge. [pixel]
    rise
        From 10 % to 90 % of the step. 0.8 for a sharp edge under square pixels. [pixel]
    """
    image = np.asarray(image, float)
    smooth = ndimage.gaussian_filter(image, 1.0)
    slope = np.stack([np.gradient(smooth, axis=axis) for axis in (0, 1)], axis=-1)
    size = np.hypot(slope[..., 0], slope[..., 1])
    margin = int(HALF_PX + ALONG_PX) + 2
    is_peak = np.pad((size == ndimage.maximum_filter(size, 9))[margin:-margin, margin:-margin], margin)
    place = np.argwhere(is_peak & (size > 0))
    place = place[np.argsort(-size[tuple(place.T)], kind="stable")[:MAX_EDGES]]
    across = slope[tuple(place.T)] / size[tuple(place.T)][:, None]
    along = across[:, ::-1] * (-1, 1)
    s = np.arange(-HALF_PX, HALF_PX + STEP_PX / 2, STEP_PX)
    t = np.arange(-ALONG_PX, ALONG_PX + 1)
    at = place[:, None, None] + s[:, None] * across[:, None, None] + t[:, None, None] * along[:, None, None]
    profiles = ndimage.map_coordinates(image, np.moveaxis(at, -1, 0), order=3).mean(axis=1)
    rise = np.array([_rise(s, profile) for profile in profiles])
    known = np.isfinite(rise)
    return place[known].astype(float), rise[known]


def _rise(s: Float[Array, "sample"], profile: Float[Array, "sample"]) -> float:
    """Distance from 10 % to 90 % about the middle of a rising profile; NaN without flat ends. [pixel]"""
    ends = round(PLATEAU_PX / STEP_PX)
    low, high = np.median(profile[:ends]), np.median(profile[-ends:])
    if not high > low:
        return float("nan")
    share = (profile - low) / (high - low)
    error = max(np.abs(share[:ends]).max(), np.abs(share[-ends:] - 1).max())
    half = np.flatnonzero((share[:-1] < 0.5) & (share[1:] >= 0.5))
    if error > MAX_PLATEAU_ERROR or len(half) != 1:
        return float("nan")
    first = np.flatnonzero(share[: half[0] + 1] <= 0.1)
    last = half[0] + 1 + np.flatnonzero(share[half[0] + 1 :] >= 0.9)
    if not (len(first) and len(last)):
        return float("nan")
    a, b = first[-1], last[0]
    start, end = (np.interp(at, share[k : k + 2], s[k : k + 2]) for at, k in ((0.1, a), (0.9, b - 1)))
    return float(end - start)


def temporal_noise(first: Float[Array, "y x"], second: Float[Array, "y x"]) -> Float[Array, "y x"]:
    """Noise of one frame at each flat pixel, from the difference of two; NaN elsewhere. [unit of the frames]

    The standard deviation of a region is 1.48 times the median of its absolute values.

    Parameters
    ----------
    first, second
        Frames on one grid; NaN where there is no data. [any unit]
    """
    change = second - first
    known = np.isfinite(change)
    if not known.any():
        return np.full(change.shape, np.nan)
    change = np.where(known, change, 0.0)
    change = change - ndimage.uniform_filter(change, HIGH_PASS_PX)
    slope = ndimage.gaussian_gradient_magnitude(np.where(known, first, np.median(first[known])), 1.0)
    inner = np.asarray(ndimage.binary_erosion(known, np.ones((HIGH_PASS_PX, HIGH_PASS_PX))), bool)
    flat = inner & (slope <= np.quantile(slope[inner | ~inner.any()], FLAT_SHARE))
    gain = np.sqrt(2 * (1 - 1 / HIGH_PASS_PX**2))  # of the difference after the high pass
    return np.where(flat, change / gain, np.nan)


def robust_sigma(values: Float[Array, "n"]) -> float:
    """Estimate the standard deviation by the median of absolute values; NaN without values."""
    return float(_GAUSSIAN * np.median(np.abs(values))) if len(values) else float("nan")
