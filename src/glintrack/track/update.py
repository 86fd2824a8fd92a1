"""One epoch of the tracker: association of detections, and the targets after it."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.track import assignment, identity
from glintrack.track.initiation import Targets, followed, trust_after
from glintrack.track.motion import update_modes


@dataclass(frozen=True)
class Choice:
    """How detections were associated: each track's one, and each gated pair with its probability."""

    assigned: Int[Array, "target"]
    tracks: Int[Array, "pair"]
    partners: Int[Array, "pair"]
    weights: Float[Array, "pair"]


@dataclass(frozen=True)
class AssociationCosts:
    """What each gated pair and each miss costs, as in `assignment.assign`. [nat]

    ``feature_ratio`` is what features take off a pair's cost. They say whose a detection is, not that there
    is a vehicle: what stands about and flickers looks like itself too. Scores therefore leave it out.
    """

    tracks: Int[Array, "pair"]
    partners: Int[Array, "pair"]
    cost: Float[Array, "pair"]
    miss_cost: Float[Array, "target"]
    feature_ratio: Float[Array, "pair"]


@dataclass(frozen=True)
class Evidence:
    """What is told of each detection besides its place.

    Parameters
    ----------
    spectral
        Features, NaN where there are none.
    index
        Detections that have a spectrum.
    ground
        How much more each of those spectra speaks for the ground than for a vehicle. [nat]
    axes
        Of the features (`identity.axes`); None while the population says nothing, or if nothing is told.
    """

    spectral: Float[Array, "detection feature"]
    index: Int[Array, "spectrum"]
    ground: Float[Array, "spectrum"]
    axes: tuple[Array, Array] | None = None


def evidence_of(state, spectral: Float[Array, "detection feature"]) -> Evidence:
    """What is told of detections, seen with what the tracker knows of vehicles and of the ground."""
    design, population = state.design, state.population
    index = np.flatnonzero(np.isfinite(spectral).all(axis=1))
    ground = identity.ground_ratio(population, state.ground, spectral[index], design.identity.cap)
    speaks = len(index) > 0 and identity.speaks(population)
    axes = identity.axes(population) if speaks else None
    return Evidence(spectral, index, ground, axes)


def association_costs(
    state, seen, targets: Targets, in_view: Float[Array, "target"], evidence: Evidence
) -> AssociationCosts:
    """Which detections may be whose, and at what cost.

    Parameters
    ----------
    state
        `TrackerState` before the epoch: design, population of features, road map.
    seen
        `FrameDetections` of the epoch.
    targets, in_view
        Predicted targets, and the share of each one's surroundings that had data. [1]
    evidence
        Of the detections.
    """
    design, motion, found, density = state.design, seen.motion, seen.found, seen.density
    pairs, partners = assignment.gate(
        targets.mean, targets.covariance, found.position, found.covariance, design.association.gate
    )
    cost = np.log(density[partners]) + assignment.negative_log_likelihood(
        targets.modes, motion.detection, pairs, partners, found.position, found.covariance
    )
    if found.log_likelihood_ratio is not None:
        cost = cost - found.log_likelihood_ratio[partners]
    if found.velocity is not None and found.velocity_share < 1:
        cost = cost - velocity_ratio(targets, found, pairs, partners)
    feature_ratio = np.zeros(len(pairs))
    if len(evidence.index):
        alike, of_pair = _feature_ratio(state, targets, pairs, partners, evidence)
        feature_ratio[of_pair] = alike
    if state.roads is not None and len(found):
        off_road = state.roads.off_road_cost(found.position, design.roads.sigma_m, design.roads.cap)
        cost = cost + off_road[partners]
    miss_cost = -np.log1p(-(targets.mode_probability @ motion.detection) * in_view)
    return AssociationCosts(pairs, partners, cost - feature_ratio, miss_cost, feature_ratio)


def velocity_ratio(targets, found, pairs, partners) -> Float[Array, "pair"]:
    """How much likelier a detection's motion is of the pair's target than of clutter. [nat]

    With probability `Detections.velocity_share` it is the target's, with the detector's error; else, and of
    clutter, it is any of those tried.
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


def _feature_ratio(
    state, targets, pairs, partners, evidence
) -> tuple[Float[Array, "some"], Int[Array, "some"]]:
    """Log-likelihood ratio of each pair that a spectrum says anything of, and which pairs those are. [nat]"""
    design = state.design
    of_pair, place = _pairs_with_spectra(partners, evidence)
    track = pairs[of_pair]
    alike = identity.log_likelihood_ratio(
        state.population, targets.feature[track], targets.spectra[track],
        evidence.spectral[evidence.index[place]], design.identity.cap, evidence.axes,
    )  # fmt: skip
    return identity.outlier_mixture(alike, evidence.ground[place], design.identity.outlier_share)[0], of_pair


def _pairs_with_spectra(
    detection: Int[Array, "pair"], evidence: Evidence
) -> tuple[Int[Array, "some"], Int[Array, "some"]]:
    """Pairs whose detection, −1 for none, has a spectrum, and the place of that spectrum."""
    place = np.full(len(evidence.spectral) + 1, -1)
    place[evidence.index] = np.arange(len(evidence.index))
    of_pair = place[detection]
    pair = np.flatnonzero(of_pair >= 0)
    return pair, of_pair[pair]


def choose(state, targets, costs: AssociationCosts, count: int) -> tuple[Choice, Targets]:
    """Which detection is whose, each track's one or all by their probabilities.

    Parameters
    ----------
    state
        `TrackerState` before the epoch.
    targets, costs, count
        Predicted, with the costs of their pairs and the number of detections.

    Returns
    -------
    The association, and the targets with new score.
    """
    design, pairs, partners = state.design, costs.tracks, costs.partners
    assigned = assignment.assign(pairs, partners, costs.cost, costs.miss_cost, count)
    earned = -costs.miss_cost
    chosen = assigned[pairs] == partners
    earned[pairs[chosen]] = -costs.cost[chosen] - costs.feature_ratio[chosen]
    if design.association.method == "gnn":
        pairs, partners, weights = pairs[chosen], partners[chosen], np.ones(int(chosen.sum()))
    else:
        weights = assignment.marginals(pairs, partners, costs.cost, costs.miss_cost, count)
    score = np.maximum(targets.score + earned, 0.0)
    new = replace(targets, score=score)
    return Choice(assigned, pairs, partners, weights), new


def advance_targets(
    state, seen, evidence: Evidence
) -> tuple[Targets, Int[Array, "target"], identity.Population]:
    """Targets after an epoch, the detection of each, and the population of features.

    Parameters
    ----------
    state, seen, evidence
        As in `association_costs`.
    """
    costs = association_costs(state, seen, seen.predicted, seen.in_view, evidence)
    choice, targets = choose(state, seen.predicted, costs, len(seen.found))
    targets, population = update_targets(state, seen, targets, seen.in_view, evidence, choice)
    return targets, choice.assigned, population


def update_targets(
    state, seen, targets: Targets, in_view: Float[Array, "target"], evidence: Evidence, choice: Choice
) -> tuple[Targets, identity.Population]:
    """Targets after their detections, and the population after their spectra.

    Parameters
    ----------
    state, seen, in_view, evidence
        As in `association_costs`.
    targets, choice
        From `choose`.
    """
    found = seen.found
    first = np.searchsorted(choice.tracks, np.arange(len(targets) + 1))
    modes = update_modes(
        targets.modes, seen.motion, in_view, first, choice.partners, choice.weights, found.position,
        found.covariance,
    )  # fmt: skip
    targets = targets.moved(modes)
    targets = replace(targets, trust=trust_after(targets.trust, found, choice.assigned, seen.interval_s))
    feature, spectra, population = update_features(state, targets, evidence, choice.assigned)
    memory = (feature, spectra)
    new = followed(state.design, targets, seen.motion, choice.assigned, memory, seen.interval_s)
    return new, population


def update_features(state, targets, evidence, assigned):
    """Mean feature and number of spectra of each target, and the population, after an epoch.

    A spectrum counts by the probability that it is the target's own and not the ground's; parameters as in
    `update_targets`.
    """
    design, population = state.design, state.population
    if len(evidence.index) == 0:
        return targets.feature, targets.spectra, population
    feature, spectra = targets.feature.copy(), targets.spectra.copy()
    hit, place = _pairs_with_spectra(assigned, evidence)
    new, ground = evidence.spectral[evidence.index[place]], evidence.ground[place]
    ratio = identity.log_likelihood_ratio(
        population, feature[hit], spectra[hit], new, design.identity.cap, evidence.axes
    )
    share = identity.outlier_mixture(ratio, ground, design.identity.outlier_share)[1]
    # a spectrum of the ground would widen what vehicles look like
    own = (ratio >= ground) | (design.identity.outlier_share == 0)
    population = identity.update_population(population, new[own], feature[hit[own]], spectra[hit[own]])
    spectra[hit] += share
    feature[hit] += (new - feature[hit]) * (share / spectra[hit])[:, None]
    return feature, spectra, population


def without_ground(state, evidence: Evidence) -> Float[Array, "detection feature"]:
    """The spectral features, NaN where they more probably show the ground than any vehicle."""
    if state.design.identity.outlier_share == 0 or not (evidence.ground > 0).any():
        return evidence.spectral
    out = evidence.spectral.copy()
    out[evidence.index[evidence.ground > 0]] = np.nan
    return out


def update_ground(state, missed: Float[Array, "spectrum feature"]) -> identity.Population:
    """The ground's spectra after some more, less those of vehicles that nobody knew of."""
    if len(missed) == 0:
        return state.ground
    ground = identity.ground_ratio(state.population, state.ground, missed, state.design.identity.cap)
    missed = missed[ground >= 0]
    return identity.update_population(state.ground, missed, np.zeros_like(missed), np.zeros(len(missed)))
