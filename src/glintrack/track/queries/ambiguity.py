"""Which detections of a frame to take spectra of at once, before it is said whose they are.

Where the sensor can turn mirrors and expose again before the scene has moved, a spectrum need not be asked
of a prediction for the next frame: it is taken where change was seen, and settles the association it is
asked for.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.track.association import update
from glintrack.track.design import TrackDesign
from glintrack.track.identity import features
from glintrack.track.identity.feature_kernels import expected
from glintrack.track.initiation import Targets
from glintrack.track.queries import choose
from glintrack.track.queries.kernels import binary_entropy


def information_gain(
    targets: Targets,
    population: features.Population,
    design: TrackDesign,
    costs: update.AssociationCosts,
    share: Float[Array, "pair"],
    count: int,
) -> Float[Array, "detection"]:
    """Entropy that a spectrum of each detection is expected to take away, now and later. [nat]

    Whose a detection is has the probabilities of belief propagation, times that its owner is a vehicle at
    all; what is left is nobody's. A spectrum is drawn from what is known of its owner's, or from anybody's.
    *Now* is the mutual information of both: also what a spectrum says on whether a young target is one thing.
    *Later* it is a reference for its owner, which serves the owner's contention and, since that changes, the
    mean of all: the variance of the mean of n spectra falls by 1/(n + 1) − 1/(n + 2). That spectra may be
    mistaken (`identity.outlier_share`) is left out, and the angle counts as the likelihood does.

    Parameters
    ----------
    targets
        Predicted to the frame.
    population, design
        Of spectral features, and of the tracker.
    costs, share
        Of the gated pairs, without spectra: from `update.association_costs` and `associate.marginals`.
    count
        Number of detections.
    """
    owned = share * choose.existence(targets)[costs.tracks]
    along, ratio = features.along_axes(population, targets.feature, targets.spectra, design.identity.sigma)
    order = np.argsort(costs.partners, kind="stable")
    first = np.searchsorted(costs.partners[order], np.arange(count + 1))
    later = choose.FRAMES_AHEAD * _later(costs.tracks, share, targets.spectra)[order] * owned[order]
    limit = 0.5 * design.identity.cap
    return _information_gain(
        first, costs.tracks[order], owned[order], later, along, targets.spectra, ratio, limit
    )


@nb.njit(cache=True)
def _later(tracks, share, spectra):
    """What one more reference gains for the owner in each pair. [nat]"""
    contention, out = np.zeros(len(spectra)), np.empty(len(tracks))
    for q in range(len(tracks)):
        contention[tracks[q]] += binary_entropy(min(max(share[q], 0.0), 1.0))
    mean = contention.mean()
    for q in range(len(tracks)):
        n = spectra[tracks[q]]
        out[q] = (contention[tracks[q]] + mean) / ((n + 1.0) * (n + 2.0))
    return out


@nb.njit(cache=True)
def _information_gain(first, tracks, owned, later, along, spectra, ratio, limit):
    """Of each detection: what is later, and the mutual information of its owner and its spectrum. [nat]

    The latter by the bound of Kolchinsky and Tracey, Entropy 19, 361 (2017), Eq. (10) with α = ½:
    −Σᵢ wᵢ ln Σₖ wₖ exp(−Bᵢₖ), of B the Bhattacharyya distances; exact where all are alike or all apart, but
    that distances are cut off at half the likelihood ratio's cap.
    """
    out = np.zeros(len(first) - 1)
    for j in range(len(out)):
        low, high = first[j], first[j + 1]
        nobody = 1.0
        for q in range(low, high):
            nobody -= owned[q]
            out[j] += later[q]
        for i in range(low, high + 1):  # the last is anybody: a new vehicle, or none
            weight = owned[i] if i < high else nobody
            if weight <= 0.0:
                continue
            alike = 0.0
            for k in range(low, high + 1):
                other = max(owned[k] if k < high else nobody, 0.0)
                apart = 0.0
                for f in range(len(ratio) if i != k else 0):
                    a, a2 = 0.0, 1.0
                    if i < high:
                        a, a2 = expected(along[tracks[i], f], spectra[tracks[i]], ratio[f])
                    b, b2 = 0.0, 1.0
                    if k < high:
                        b, b2 = expected(along[tracks[k], f], spectra[tracks[k]], ratio[f])
                    total = a2 + b2
                    apart += 0.25 * (a - b) ** 2 / total + 0.5 * math.log(0.5 * total / math.sqrt(a2 * b2))
                alike += other * math.exp(-min(apart, limit))
            out[j] -= weight * math.log(min(alike, 1.0))
    return out


def owner_of(
    costs: update.AssociationCosts, share: Float[Array, "pair"], count: int
) -> Int[Array, "detection"]:
    """The likeliest target of each detection, −1 where none may have it."""
    out = np.full(count, -1)
    order = np.argsort(share, kind="stable")
    out[costs.partners[order]] = costs.tracks[order]  # the likeliest is written last
    return out
