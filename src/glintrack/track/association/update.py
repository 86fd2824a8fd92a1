"""One epoch of the tracker: which detection is whose, and what is believed of each target after it."""

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.track.association import associate
from glintrack.track.identity import feature_kernels as kernels
from glintrack.track.identity import features, polarization
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
    """What each gated pair and each miss costs, as in `associate.assign`. [nat]

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
    spectral, polarized
        Features, NaN where there are none.
    index
        Detections that have a spectrum.
    ground
        How much more each of those spectra speaks for the ground than for a vehicle. [nat]
    axes
        Of the features (`features.axes`); None while the population says nothing, or if nothing is told.
    """

    spectral: Float[Array, "detection feature"]
    polarized: Float[Array, "detection 2"]
    index: Int[Array, "spectrum"]
    ground: Float[Array, "spectrum"]
    axes: tuple[Array, Array] | None = None


def evidence_of(state, spectral: Float[Array, "detection feature"], polarized) -> Evidence:
    """What is told of detections, seen with what the tracker knows of vehicles and of the ground."""
    design, population = state.design, state.population
    index = np.flatnonzero(np.isfinite(spectral).all(axis=1))
    ground = features.ground_ratio(population, state.ground, spectral[index], design.identity.cap)
    speaks = len(index) > 0 and features.speaks(population)
    axes = features.axes(population, design.identity.sigma) if speaks else None
    return Evidence(spectral, polarized, index, ground, axes)


def association_costs(state, motion, targets, seen, found, density, evidence) -> AssociationCosts:
    """Which detections may be whose, and at what cost.

    Parameters
    ----------
    state
        `TrackerState` before the epoch: design, populations of features, road map.
    motion, targets
        Modes over the interval, and the targets predicted with them.
    seen
        Share of each target's surroundings that had data. [1]
    found
        Detections.
    density
        Of clutter about each detection. [m⁻²]
    evidence
        Of the detections.
    """
    design = state.design
    pairs, partners = associate.gate(
        targets.mean, targets.covariance, found.position, found.covariance, design.association.gate
    )
    cost = np.log(density[partners]) + associate.negative_log_likelihood(
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
    if design.identity.polarization:
        feature_ratio = feature_ratio + features.log_likelihood_ratio(
            state.polarized, targets.polarization[pairs], targets.observations[pairs],
            evidence.polarized[partners],            design.identity.sigma, design.identity.cap,
        )  # fmt: skip
    if state.roads is not None and len(found):
        road = (design.roads.half_width_m, design.roads.sigma_m, design.roads.cap)
        cost = cost + state.roads.off_road_cost(found.position, *road)[partners]
    miss_cost = -np.log1p(-(targets.mode_probability @ motion.detection) * seen)
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
    of_pair, place = kernels.pairs_with_spectra(pairs, partners, evidence.index, len(evidence.spectral))
    track = pairs[of_pair]
    sam = design.identity.measure == "sam"
    ratio = features.angle_likelihood_ratio if sam else features.log_likelihood_ratio
    alike = ratio(
        state.population, targets.feature[track], targets.spectra[track],
        evidence.spectral[evidence.index[place]],
        design.identity.sigma, design.identity.cap, evidence.axes,
    )  # fmt: skip
    return features.outlier_mixture(alike, evidence.ground[place], design.identity.outlier_share)[0], of_pair


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
    assigned = associate.assign(pairs, partners, costs.cost, costs.miss_cost, count)
    earned = -costs.miss_cost
    chosen = assigned[pairs] == partners
    earned[pairs[chosen]] = -costs.cost[chosen] - costs.feature_ratio[chosen]
    if design.association.method == "gnn":
        pairs, partners, weights = pairs[chosen], partners[chosen], np.ones(int(chosen.sum()))
    else:
        weights = associate.marginals(pairs, partners, costs.cost, costs.miss_cost, count)
    score = np.maximum(targets.score + earned, 0.0)
    new = replace(targets, score=score)
    return Choice(assigned, pairs, partners, weights), new


def step(state, motion, targets, seen, found, density, evidence, interval_s):
    """Targets after an epoch, the detection of each, and the populations of both kinds of features.

    Parameters
    ----------
    state, motion, targets, seen, found, density, evidence
        As of `association_costs`.
    interval_s
        Since the epoch before. [s]
    """
    costs = association_costs(state, motion, targets, seen, found, density, evidence)
    choice, targets = choose(state, targets, costs, len(found))
    targets, population = update_targets(state, targets, motion, seen, found, evidence, choice, interval_s)
    polarized = state.polarized
    if state.design.identity.polarization:
        targets, polarized = update_polarization(targets, polarized, evidence.polarized, choice.assigned)
    return targets, choice.assigned, (population, polarized)


def update_targets(state, targets, motion, seen, found, evidence, choice, interval_s):
    """Targets after their detections, and the population after their spectra.

    Parameters
    ----------
    state
        As in `choose`.
    targets, choice
        From there.
    motion, seen, found, evidence
        As there.
    interval_s
        Time since the frame before. [s]
    """
    first = np.searchsorted(choice.tracks, np.arange(len(targets) + 1))
    targets = targets.moved(
        update_modes(
            targets.modes,
            motion,
            seen,
            first,
            choice.partners,
            choice.weights,
            found.position,
            found.covariance,
        )
    )
    targets = replace(targets, trust=trust_after(targets.trust, found, choice.assigned, interval_s))
    feature, spectra, population = update_features(state, targets, evidence, choice.assigned)
    memory = (feature, spectra)
    return followed(state.design, targets, motion, choice.assigned, memory, interval_s), population


def update_features(state, targets, evidence, assigned):
    """Mean feature and number of spectra of each target, and the population, after an epoch.

    A spectrum counts by the probability that it is the target's own and not the ground's; parameters as in
    `updated`.
    """
    design, population = state.design, state.population
    if len(evidence.index) == 0:
        return targets.feature, targets.spectra, population
    feature, spectra = targets.feature.copy(), targets.spectra.copy()
    hit, place = kernels.pairs_with_spectra(targets.id, assigned, evidence.index, len(evidence.spectral))
    new, ground = evidence.spectral[evidence.index[place]], evidence.ground[place]
    limits = (design.identity.sigma, design.identity.cap, evidence.axes)
    ratio = features.log_likelihood_ratio(population, feature[hit], spectra[hit], new, *limits)
    share = features.outlier_mixture(ratio, ground, design.identity.outlier_share)[1]
    own = (ratio >= ground) | (
        design.identity.outlier_share == 0
    )  # else a spectrum of the ground would widen what vehicles look like
    population = features.update_population(population, new[own], feature[hit[own]], spectra[hit[own]])
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


def update_ground(state, missed: Float[Array, "spectrum feature"]) -> features.Population:
    """The ground's spectra after some more, less those of vehicles that nobody knew of."""
    if len(missed) == 0:
        return state.ground
    ground = features.ground_ratio(state.population, state.ground, missed, state.design.identity.cap)
    missed = missed[ground >= 0]
    return features.update_population(state.ground, missed, np.zeros_like(missed), np.zeros(len(missed)))


def update_polarization(targets, population, evidence, assigned) -> tuple[Targets, features.Population]:
    """Targets and population after the polarization of their detections.

    Parameters
    ----------
    targets, population
        Before.
    evidence
        Polarization of each detection, NaN for none. [1]
    assigned
        Detection of each target, −1 for none.
    """
    hit = np.nonzero(assigned >= 0)[0]
    new = np.full((len(targets), 2), np.nan)
    new[hit] = evidence[assigned[hit]]
    known = np.isfinite(new).all(axis=1)
    if known.any():
        population = features.update_population(
            population, new[known], targets.polarization[known], targets.observations[known]
        )
    mean, observations = polarization.remember(targets.polarization, targets.observations, new)
    return replace(targets, polarization=mean, observations=observations), population
