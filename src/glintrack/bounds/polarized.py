"""The ideal observer of DoLP alone: it is told one number a superpixel, √(S1² + S2²)/S0.

Q/I and U/I have normal noise to first order; the density of their length follows by a sum over the angle, and
the cumulants of the likelihood ratio by Monte Carlo over draws of both hypotheses, the same for every s.
"""

from itertools import pairwise
from typing import NamedTuple

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.bounds.likelihood import Cumulants
from glintrack.core.arrays import Array
from glintrack.core.parallel import over_rows

DRAWS = 64  # of each hypothesis and superpixel
MOST = 24  # superpixels of a vehicle that are used, those that say most: a bound from below
_ANGLES = 24  # a step of 2σ/3: the sum of a Gaussian is good to 1e-15
_REACH = 8.0  # standard deviations


class Polarization(NamedTuple):
    """Q/I and U/I of superpixels, and the covariance that noise gives them. [1]"""

    mean: Float[Array, "superpixel 2"]
    covariance: Float[Array, "superpixel 2 2"]


def polarization(
    readings: Float[Array, "superpixel polarizer"],
    variance: Float[Array, "superpixel polarizer"],
    stokes_matrix: Float[Array, "3 polarizer"],
) -> Polarization:
    """Q/I and U/I of the polarizers' readings with noise, to first order."""
    s = readings @ stokes_matrix.T
    total = np.where(np.abs(s[:, :1]) > 1e-12, s[:, :1], 1e-12)
    mean = s[:, 1:] / total
    slope = (stokes_matrix[None, 1:] - mean[..., None] * stokes_matrix[None, :1]) / total[..., None]
    return Polarization(mean, np.einsum("nap,np,nbp->nab", slope, variance, slope))


def dolp_variance(of: Polarization) -> Float[Array, "superpixel"]:
    """Variance of the length of (Q/I, U/I), to first order; that of one component where it is 0. [1]"""
    length = np.linalg.norm(of.mean, axis=1)
    along = np.where(length[:, None] > 1e-9, of.mean / np.maximum(length, 1e-9)[:, None], [[1.0, 0.0]])
    return np.einsum("na,nab,nb->n", along, of.covariance, along)


def dolp_and_variance(
    readings: Float[Array, "superpixel polarizer"],
    variance: Float[Array, "superpixel polarizer"] | None,
    stokes_matrix: Float[Array, "3 polarizer"],
) -> tuple[Float[Array, "superpixel"], Float[Array, "superpixel"]]:
    """DoLP of the polarizers' readings, and `dolp_variance` of their `polarization` without its covariance.

    Without the readings' variance that of DoLP is 0.
    """
    s = readings @ stokes_matrix.T
    total = np.where(np.abs(s[:, 0]) > 1e-12, s[:, 0], 1e-12)
    mean = s[:, 1:] / total[:, None]
    length = np.sqrt(mean[:, 0] ** 2 + mean[:, 1] ** 2)
    if variance is None:
        return length, np.zeros_like(length)
    along = np.where(length[:, None] > 1e-9, mean / np.maximum(length, 1e-9)[:, None], [[1.0, 0.0]])
    slope = along @ stokes_matrix[1:] - (along * mean).sum(axis=1)[:, None] * stokes_matrix[:1]
    return length, (slope**2 * variance).sum(axis=1) / total**2


def dolp_cumulants(
    without: Polarization,
    present: Polarization,
    first: Int[Array, "vehicle+1"],
    rng: np.random.Generator,
) -> list[Cumulants]:
    """K(s) of the likelihood ratio of each vehicle's DoLP; see `likelihood.detection_probability`.

    Parameters
    ----------
    without, present
        From `polarization`, of the same superpixels, one vehicle's after the other's.
    first
        Where each vehicle's begin, and where the last one's end.
    rng
        Draws.
    """
    gap = np.linalg.norm(present.mean, axis=1) - np.linalg.norm(without.mean, axis=1)
    told = gap**2 / (dolp_variance(without) + dolp_variance(present))
    kept = [a + np.argsort(-told[a:b], kind="stable")[:MOST] for a, b in pairwise(first.tolist())]
    if not kept:
        return []
    chosen, ends = np.concatenate(kept), np.cumsum([0, *map(len, kept)])
    both = [Polarization(h.mean[chosen], h.covariance[chosen]) for h in (without, present)]
    deviates = np.concatenate([rng.standard_normal((2, len(one), DRAWS, 2)) for one in kept], axis=1)
    length = np.concatenate([_lengths(*one) for one in zip(both, deviates, strict=True)], axis=1)
    log0, log1 = (_log_density(h, length) for h in both)
    return [_over_draws(log0[a:b], log1[a:b]) for a, b in pairwise(ends.tolist())]


def _over_draws(log0: Float[Array, "superpixel draw"], log1: Float[Array, "superpixel draw"]) -> Cumulants:
    """K(s) from log densities at draws of both hypotheses in equal parts."""
    proposal = np.logaddexp(log0, log1) - np.log(2)

    def cumulants(s: float) -> float:
        exponent = s * log1 + (1 - s) * log0 - proposal
        top = exponent.max(axis=1)
        mean = np.exp(exponent - top[:, None]).mean(axis=1)
        # drawn from a mixture, the mean density is 1 to within noise at s = 0 and 1: taken out linearly in s
        return float((top + np.log(mean)).sum()) - (1 - s) * ends[0] - s * ends[1]

    ends = (0.0, 0.0)
    ends = (cumulants(0.0), cumulants(1.0))
    return cumulants


def _lengths(
    of: Polarization, deviates: Float[Array, "superpixel draw 2"]
) -> Float[Array, "superpixel draw"]:
    """Lengths of normal vectors."""
    root = np.linalg.cholesky(of.covariance + 1e-18 * np.eye(2))
    return np.linalg.norm(of.mean[:, None] + np.einsum("nab,ndb->nda", root, deviates), axis=-1)


def _log_density(of: Polarization, length: Array) -> Float[Array, "superpixel draw"]:
    """Log density of the length of a normal 2-vector: its density on the circle, summed over the angle."""
    inverse = np.linalg.inv(of.covariance + 1e-18 * np.eye(2))
    norm = -np.log(2 * np.pi) + 0.5 * np.log(np.linalg.det(inverse))
    middle = np.arctan2(of.mean[:, 1], of.mean[:, 0])
    widest = np.sqrt(np.linalg.eigvalsh(of.covariance)[:, -1] + 1e-18)
    half = np.minimum(np.pi, _REACH * widest[:, None] / np.maximum(length, 1e-12))
    total = np.empty(length.shape)
    over_rows(_sum_over_angles, len(length), length, of.mean, inverse, middle, half, total)
    return norm[:, None] + np.log(np.maximum(length, 1e-300)) + total


@nb.njit(nogil=True, cache=True)
def _sum_over_angles(start, stop, length, mean, inverse, middle, half, out):
    """Log of the integral of e^(−½ x'Σ⁻¹x) over the angles within ``half`` of the middle."""
    exponent = np.empty(_ANGLES)
    for k in range(start, stop):
        a, b, d = inverse[k, 0, 0], inverse[k, 0, 1], inverse[k, 1, 1]
        for draw in range(length.shape[1]):
            step = 2 * half[k, draw] / _ANGLES
            first, c, s = middle[k] - half[k, draw] + 0.5 * step, np.cos(step), np.sin(step)
            x, y = length[k, draw] * np.cos(first), length[k, draw] * np.sin(first)
            top = -np.inf
            for at in range(_ANGLES):
                u, v = x - mean[k, 0], y - mean[k, 1]
                exponent[at] = -0.5 * (a * u * u + 2 * b * u * v + d * v * v)
                top = max(top, exponent[at])
                x, y = c * x - s * y, s * x + c * y  # turned by a step
            total = 0.0
            for at in range(_ANGLES):
                total += np.exp(exponent[at] - top)
            out[k, draw] = top + np.log(total * step)
