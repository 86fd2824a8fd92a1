"""One epoch of the tracker: which detection is whose, and what is believed of each target after it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.arrays import Array
from glintrack.track import motion as kinematics
from glintrack.track.association import associate
from glintrack.track.identity import feature_kernels as kernels
from glintrack.track.identity import features, polarization
from glintrack.track.initiation import Targets, followed


@dataclass(frozen=True)
class Choice:
    """How detections were associated: each track's one, and each gated pair with its probability."""

    assigned: Int[Array, "target"]
    tracks: Int[Array, "pair"]
    partners: Int[Array, "pair"]
    weights: Float[Array, "pair"]


@dataclass(frozen=True)
class Prices:
    """What each gated pair and each miss costs, as in `associate.assign`. [nat]

    ``likeness`` is what features take off a pair's cost. They say whose a detection is, not that there is a
    vehicle: what stands about and flickers looks like itself too. Scores therefore leave it out.
    """

    tracks: Int[Array, "pair"]
    partners: Int[Array, "pair"]
    cost: Float[Array, "pair"]
    miss_cost: Float[Array, "target"]
    likeness: Float[Array, "pair"]


@dataclass(frozen=True)
class Told:
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
    index: Int[Array, "told"]
    ground: Float[Array, "told"]
    axes: tuple[Array, Array] | None = None


def told_of(state, spectral: Float[Array, "detection feature"], polarized) -> Told:
    """What is told of detections, seen with what the tracker knows of vehicles and of the ground."""
    design, population = state.design, state.population
    index = np.flatnonzero(np.isfinite(spectral).all(axis=1))
    ground = features.ground_ratio(population, state.ground, spectral[index], design.identity.cap)
    speaks = len(index) > 0 and features.speaks(population)
    axes = features.axes(population, design.identity.sigma) if speaks else None
    return Told(spectral, polarized, index, ground, axes)


def priced(state, motion, targets, seen, found, density, told) -> Prices:
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
    told
        Of the detections.
    """
    design = state.design
    pairs, partners = associate.gate(
        targets.mean, targets.covariance, found.position, found.covariance, design.association.gate
    )
    cost = np.log(density[partners]) + associate.surprise(
        targets.modes, motion.detection, pairs, partners, found.position, found.covariance
    )
    if found.log_likelihood_ratio is not None:
        cost = cost - found.log_likelihood_ratio[partners]
    likeness = np.zeros(len(pairs))
    if len(told.index):
        alike, of_pair = _likeness(state, targets, pairs, partners, told)
        likeness[of_pair] = alike
    if design.identity.polarization:
        likeness = likeness + features.log_likelihood_ratio(
            state.polarized, targets.polarization[pairs], targets.looks[pairs], told.polarized[partners],
            design.identity.sigma, design.identity.cap,
        )  # fmt: skip
    if state.roads is not None and len(found):
        road = (design.roads.half_width_m, design.roads.sigma_m, design.roads.cap)
        cost = cost + state.roads.off_road_cost(found.position, *road)[partners]
    miss_cost = -np.log1p(-(targets.mode_probability @ motion.detection) * seen)
    return Prices(pairs, partners, cost - likeness, miss_cost, likeness)


def _likeness(state, targets, pairs, partners, told) -> tuple[Float[Array, "some"], Int[Array, "some"]]:
    """Log-likelihood ratio of each pair that a spectrum says anything of, and which pairs those are. [nat]"""
    design = state.design
    of_pair, place = kernels.pairs_told(pairs, partners, told.index, len(told.spectral))
    track = pairs[of_pair]
    sam = design.identity.measure == "sam"
    ratio = features.angle_likelihood_ratio if sam else features.log_likelihood_ratio
    alike = ratio(
        state.population, targets.feature[track], targets.spectra[track], told.spectral[told.index[place]],
        design.identity.sigma, design.identity.cap, told.axes,
    )  # fmt: skip
    return features.with_mistakes(alike, told.ground[place], design.identity.outlier_share)[0], of_pair


def choose(state, targets, prices: Prices, count: int) -> tuple[Choice, Targets]:
    """Which detection is whose, each track's one or all by their probabilities.

    Parameters
    ----------
    state
        `TrackerState` before the epoch.
    targets, prices, count
        Predicted, with the prices of their pairs and the number of detections.

    Returns
    -------
    The association, and the targets with new score.
    """
    design, pairs, partners = state.design, prices.tracks, prices.partners
    assigned = associate.assign(pairs, partners, prices.cost, prices.miss_cost, count)
    earned = -prices.miss_cost
    chosen = assigned[pairs] == partners
    earned[pairs[chosen]] = -prices.cost[chosen] - prices.likeness[chosen]
    if design.association.method == "gnn":
        pairs, partners, weights = pairs[chosen], partners[chosen], np.ones(int(chosen.sum()))
    else:
        weights = associate.marginals(pairs, partners, prices.cost, prices.miss_cost, count)
    score = np.maximum(targets.score + earned, 0.0)
    new = replace(targets, score=score)
    return Choice(assigned, pairs, partners, weights), new


def advanced(state, motion, targets, seen, found, density, told, interval_s):
    """Targets after an epoch, the detection of each, and the populations of both kinds of features.

    Parameters
    ----------
    state, motion, targets, seen, found, density, told
        As of `priced`.
    interval_s
        Since the epoch before. [s]
    """
    prices = priced(state, motion, targets, seen, found, density, told)
    choice, targets = choose(state, targets, prices, len(found))
    targets, population = updated(state, targets, motion, seen, found, told, choice, interval_s)
    looks = state.polarized
    if state.design.identity.polarization:
        targets, looks = polarized(targets, looks, told.polarized, choice.assigned)
    return targets, choice.assigned, (population, looks)


def updated(state, targets, motion, seen, found, told, choice, interval_s):
    """Targets after their detections, and the population after their spectra.

    Parameters
    ----------
    state
        As in `choose`.
    targets, choice
        From there.
    motion, seen, found, told
        As there.
    interval_s
        Time since the frame before. [s]
    """
    first = np.searchsorted(choice.tracks, np.arange(len(targets) + 1))
    targets = targets.moved(
        kinematics.update(
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
    feature, spectra, population = remembered(state, targets, told, choice.assigned)
    memory = (feature, spectra)
    return followed(state.design, targets, motion, choice.assigned, memory, interval_s), population


def remembered(state, targets, told, assigned):
    """Mean feature and number of spectra of each target, and the population, after an epoch.

    A spectrum counts by the probability that it is the target's own and not the ground's; parameters as in
    `updated`.
    """
    design, population = state.design, state.population
    if len(told.index) == 0:
        return targets.feature, targets.spectra, population
    feature, spectra = targets.feature.copy(), targets.spectra.copy()
    hit, place = kernels.pairs_told(targets.id, assigned, told.index, len(told.spectral))
    new, ground = told.spectral[told.index[place]], told.ground[place]
    limits = (design.identity.sigma, design.identity.cap, told.axes)
    ratio = features.log_likelihood_ratio(population, feature[hit], spectra[hit], new, *limits)
    share = features.with_mistakes(ratio, ground, design.identity.outlier_share)[1]
    own = (ratio >= ground) | (
        design.identity.outlier_share == 0
    )  # else a spectrum of the ground would widen what vehicles look like
    population = features.learn(population, new[own], feature[hit[own]], spectra[hit[own]])
    spectra[hit] += share
    feature[hit] += (new - feature[hit]) * (share / spectra[hit])[:, None]
    return feature, spectra, population


def without_ground(state, told: Told) -> Float[Array, "detection feature"]:
    """The spectral features, NaN where they more probably show the ground than any vehicle."""
    if state.design.identity.outlier_share == 0 or not (told.ground > 0).any():
        return told.spectral
    out = told.spectral.copy()
    out[told.index[told.ground > 0]] = np.nan
    return out


def learnt_ground(state, missed: Float[Array, "spectrum feature"]) -> features.Population:
    """The ground's spectra after some more, less those of vehicles that nobody knew of."""
    if len(missed) == 0:
        return state.ground
    ground = features.ground_ratio(state.population, state.ground, missed, state.design.identity.cap)
    missed = missed[ground >= 0]
    return features.learn(state.ground, missed, np.zeros_like(missed), np.zeros(len(missed)))


def polarized(targets, population, told, assigned) -> tuple[Targets, features.Population]:
    """Targets and population after the polarization of their detections.

    Parameters
    ----------
    targets, population
        Before.
    told
        Polarization of each detection, NaN for none. [1]
    assigned
        Detection of each target, −1 for none.
    """
    hit = np.nonzero(assigned >= 0)[0]
    new = np.full((len(targets), 2), np.nan)
    new[hit] = told[assigned[hit]]
    known = np.isfinite(new).all(axis=1)
    if known.any():
        population = features.learn(population, new[known], targets.polarization[known], targets.looks[known])
    mean, looks = polarization.remember(targets.polarization, targets.looks, new)
    return replace(targets, polarization=mean, looks=looks), population
