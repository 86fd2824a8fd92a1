"""One epoch of the tracker: association of detections, and the targets after it."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.track import assignment, identity
from glintrack.track.initiation import Targets, update_status
from glintrack.track.motion import position_density, update_modes


@dataclass(frozen=True)
class Choice:
    """Association of detections: each track's own one, and each gated pair with its probability."""

    assigned: Int[Array, "target"]
    tracks: Int[Array, "pair"]
    partners: Int[Array, "pair"]
    weights: Float[Array, "pair"]


@dataclass(frozen=True)
class AssociationCosts:
    """Cost of each gated pair and of each miss, as in `assignment.assign`. [nat]

    ``feature_ratio`` is the part of a pair's cost that features lower. They are evidence of identity, not of
    existence: a fixed object that flickers looks like itself too. Scores therefore leave it out.
    """

    tracks: Int[Array, "pair"]
    partners: Int[Array, "pair"]
    cost: Float[Array, "pair"]
    miss_cost: Float[Array, "target"]
    feature_ratio: Float[Array, "pair"]


@dataclass(frozen=True)
class Evidence:
    """Spectral evidence of each detection.

    Parameters
    ----------
    spectral
        Features, NaN for none.
    index
        Detections that have a spectrum.
    ground
        Log-likelihood ratio of ground against vehicle of each of those spectra. [nat]
    """

    spectral: Float[Array, "detection feature"]
    index: Int[Array, "spectrum"]
    ground: Float[Array, "spectrum"]

    def pairs(self, detection: Int[Array, "pair"]) -> tuple[Int[Array, "some"], Int[Array, "some"]]:
        """Pairs whose detection (−1 for none) has a spectrum, and the row of that spectrum."""
        place = np.full(len(self.spectral) + 1, -1)
        place[self.index] = np.arange(len(self.index))
        pair = np.flatnonzero(place[detection] >= 0)
        return pair, place[detection][pair]


def spectral_evidence(state, spectral: Float[Array, "detection feature"]) -> Evidence:
    """Compare the spectra of detections with those of vehicles and of the ground."""
    index = np.flatnonzero(np.isfinite(spectral).all(axis=1))
    return Evidence(spectral, index, identity.ground_ratio(state.population, state.ground, spectral[index]))


def association_costs(
    state, seen, targets: Targets, in_view: Float[Array, "target"], evidence: Evidence
) -> AssociationCosts:
    """Gate the pairs of targets and detections, and compute their costs.

    Parameters
    ----------
    state
        `TrackerState` before the epoch: design, population of features, road map.
    seen
        `FrameDetections` of the epoch.
    targets, in_view
        Predicted targets, and the share of each one's surroundings that had data. [1]
    evidence
        Spectral evidence of the detections.
    """
    design, motion, found, density = state.design, seen.motion, seen.found, seen.density
    pairs, partners = assignment.gate(
        targets.mean, targets.covariance, found.position, found.covariance, design.association.gate
    )
    normal = position_density(targets.modes, pairs, partners, found.position, found.covariance)
    detected = ((targets.mode_probability * motion.detection)[pairs] * normal).sum(axis=1)
    cost = np.log(density[partners]) - np.log(np.maximum(detected, assignment.MIN_DENSITY_M2))
    if found.log_likelihood_ratio is not None:
        cost = cost - found.log_likelihood_ratio[partners]
    if found.velocity is not None and found.velocity_share < 1:
        cost = cost - velocity_ratio(targets, found, pairs, partners)
    feature_ratio = np.zeros(len(pairs))
    if len(evidence.index):
        of_pair, place = evidence.pairs(partners)
        new, track = evidence.spectral[evidence.index[place]], pairs[of_pair]
        alike = identity.log_likelihood_ratio(
            state.population, targets.feature[track], targets.spectra[track], new
        )
        outlier_share = design.identity.outlier_share
        feature_ratio[of_pair] = identity.outlier_mixture(alike, evidence.ground[place], outlier_share)[0]
    if state.roads is not None and len(found):
        cost = cost + state.roads.off_road_cost(found.position)[partners]
    miss_cost = -np.log1p(-(targets.mode_probability @ motion.detection) * in_view)
    return AssociationCosts(pairs, partners, cost - feature_ratio, miss_cost, feature_ratio)


def velocity_ratio(targets, found, pairs, partners) -> Float[Array, "pair"]:
    """Log-likelihood ratio of a detection's velocity, of the pair's target against clutter. [nat]

    With probability `Detections.velocity_share` it is the target's, with the detector's error. Otherwise, and
    for clutter, it is uniform over the velocities that the detector tries.
    """
    variance = found.velocity_sigma_m_s**2
    a = targets.covariance[pairs, 2, 2] + variance
    b, c = targets.covariance[pairs, 2, 3], targets.covariance[pairs, 3, 3] + variance
    east, north = (found.velocity[partners] - targets.mean[pairs, 2:]).T
    determinant = a * c - b * b
    distance2 = (c * east**2 - 2 * b * east * north + a * north**2) / determinant
    density = np.exp(-0.5 * distance2) / (2 * np.pi * np.sqrt(determinant))
    share, area = found.velocity_share, math.pi * found.velocity_most_m_s**2
    return np.log1p(share * (density * area - 1))


def advance_targets(
    state, seen, evidence: Evidence
) -> tuple[Targets, Int[Array, "target"], identity.Population]:
    """Associate the detections of an epoch and update the targets.

    Parameters
    ----------
    state, seen, evidence
        See `association_costs`.

    Returns
    -------
    The targets, the detection of each (−1 for none), and the population of features.
    """
    costs = association_costs(state, seen, seen.predicted, seen.in_view, evidence)
    pairs, partners, count = costs.tracks, costs.partners, len(seen.found)
    assigned = assignment.assign(pairs, partners, costs.cost, costs.miss_cost, count)
    earned = -costs.miss_cost
    chosen = assigned[pairs] == partners
    earned[pairs[chosen]] = -costs.cost[chosen] - costs.feature_ratio[chosen]
    if state.design.association.method == "gnn":
        pairs, partners, weights = pairs[chosen], partners[chosen], np.ones(int(chosen.sum()))
    else:
        weights = assignment.marginals(pairs, partners, costs.cost, costs.miss_cost, count)
    targets = replace(seen.predicted, score=np.maximum(seen.predicted.score + earned, 0.0))
    choice = Choice(assigned, pairs, partners, weights)
    targets, population = update_targets(state, seen, targets, seen.in_view, evidence, choice)
    return targets, assigned, population


def update_targets(
    state, seen, targets: Targets, in_view: Float[Array, "target"], evidence: Evidence, choice: Choice
) -> tuple[Targets, identity.Population]:
    """Update targets with their detections, and the population of features with their spectra.

    Parameters
    ----------
    state, seen, in_view, evidence
        See `association_costs`.
    targets, choice
        Predicted targets with their new scores, and the association.
    """
    first = np.searchsorted(choice.tracks, np.arange(len(targets) + 1))
    modes = update_modes(
        targets.modes, seen.motion, in_view, first, choice.partners, choice.weights, seen.found.position,
        seen.found.covariance,
    )  # fmt: skip
    targets = targets.with_modes(modes)
    feature, spectra, population = update_features(state, targets, evidence, choice.assigned)
    return update_status(state.design, targets, seen, choice.assigned, feature, spectra), population


def update_features(state, targets, evidence, assigned):
    """Update the mean feature and number of spectra of each target, and the population.

    A spectrum counts by the probability that it is the target's own and not the ground's; parameters as in
    `update_targets`.
    """
    outlier_share, population = state.design.identity.outlier_share, state.population
    if len(evidence.index) == 0:
        return targets.feature, targets.spectra, population
    feature, spectra = targets.feature.copy(), targets.spectra.copy()
    hit, place = evidence.pairs(assigned)
    new, ground = evidence.spectral[evidence.index[place]], evidence.ground[place]
    ratio = identity.log_likelihood_ratio(population, feature[hit], spectra[hit], new)
    share = identity.outlier_mixture(ratio, ground, outlier_share)[1]
    # a spectrum of the ground would widen the distribution of vehicles
    own = (ratio >= ground) | (outlier_share == 0)
    population = identity.update_population(population, new[own], feature[hit[own]], spectra[hit[own]])
    spectra[hit] += share
    feature[hit] += (new - feature[hit]) * (share / spectra[hit])[:, None]
    return feature, spectra, population
