"""One epoch of the tracker: which detection is whose, and what is believed of each target after it."""

from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Int

from glintrack.track import associate, features, kinematics, polarization
from glintrack.track.targets import Targets, confirmation, hits_of, trusted

Array = np.ndarray


@dataclass(frozen=True)
class Choice:
    """How detections were associated: each track's one, and each gated pair with its probability."""

    assigned: Int[Array, "target"]
    tracks: Int[Array, "pair"]
    partners: Int[Array, "pair"]
    weights: Float[Array, "pair"]


@dataclass(frozen=True)
class Prices:
    """What each gated pair and each miss costs, as in `associate.assign`. [nat]"""

    tracks: Int[Array, "pair"]
    partners: Int[Array, "pair"]
    cost: Float[Array, "pair"]
    miss_cost: Float[Array, "target"]


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
        Spectral and polarization features of each detection, NaN for none.
    """
    design, (spectral, polarized) = state.design, told
    pairs, partners = associate.gate(
        targets.mean, targets.covariance, found.position, found.covariance, design.gate
    )
    cost = np.log(density[partners]) + associate.surprise(
        targets.modes, motion.detection, pairs, partners, found.position, found.covariance
    )
    sam = design.feature_measure == "sam"
    ratio = features.angle_likelihood_ratio if sam else features.log_likelihood_ratio
    limits = (design.feature_sigma, design.feature_cap)
    alike = ratio(
        state.population, targets.feature[pairs], targets.spectra[pairs], spectral[partners], *limits
    )
    ground = features.ground_ratio(state.population, state.ground, spectral, design.feature_cap)
    cost = cost - features.with_mistakes(alike, ground[partners], design.feature_mistaken)[0]
    if design.feature_polarization:
        cost = cost - features.log_likelihood_ratio(
            state.polarized, targets.polarization[pairs], targets.looks[pairs], polarized[partners], *limits
        )
    if state.roads is not None and len(found):
        road = (design.road_half_width_m, design.road_sigma_m, design.road_cap)
        cost = cost + state.roads.off_road_cost(found.position, *road)[partners]
    miss_cost = -np.log1p(-(targets.mode_probability @ motion.detection) * seen)
    return Prices(pairs, partners, cost, miss_cost)


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
    earned[pairs[chosen]] = -prices.cost[chosen]
    if design.association == "gnn":
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
    targets, population = updated(state, targets, motion, seen, found, told[0], choice, interval_s)
    looks = state.polarized
    if state.design.feature_polarization:
        targets, looks = polarized(targets, looks, told[1], choice.assigned)
    return targets, choice.assigned, (population, looks)


def updated(state, targets, motion, seen, found, spectral, choice, interval_s):
    """Targets after their detections, and the population after their spectra.

    Parameters
    ----------
    state
        As in `choose`.
    targets, choice
        From there.
    motion, seen, found
        As there.
    spectral
        Spectral feature of each detection, NaN for none.
    interval_s
        Time since the frame before. [s]
    """
    design, assigned = state.design, choice.assigned
    hit = assigned >= 0
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
    hits, window = confirmation(design, interval_s)
    history = ((targets.history << 1) | hit) & ((1 << window) - 1)
    age_s = targets.age_s + interval_s

    feature, spectra, population = remembered(state, targets, spectral, assigned)
    mean = targets.mean
    travel = np.hypot(*(mean[:, :2] - targets.born).T)
    speed = np.hypot(mean[:, 2], mean[:, 3])
    confirmed = targets.confirmed | (
        hit
        & (hits_of(history) >= hits)
        & (age_s >= design.confirm_s - 1e-9)
        & (targets.score >= design.confirm_score)
        & (travel >= design.confirm_travel_m)
        & (speed >= design.confirm_speed_m_s)
    )
    updated = replace(
        targets, history=history, confirmed=confirmed,
        feature=feature, spectra=spectra, age_s=age_s,
        unseen_s=np.where(hit, 0.0, targets.unseen_s + interval_s),
        misses=np.where(hit, 0, targets.misses + 1),
        trust=trusted(design, targets, motion, hit, interval_s),
    )  # fmt: skip
    return updated, population


def remembered(state, targets, spectral, assigned):
    """Mean feature and number of spectra of each target, and the population, after an epoch.

    A spectrum counts by the probability that it is the target's own and not the ground's; parameters as in
    `updated`.
    """
    design, population = state.design, state.population
    feature, spectra = targets.feature.copy(), targets.spectra.copy()
    told = np.nonzero(assigned >= 0)[0]
    told = told[np.isfinite(spectral[assigned[told]]).all(axis=1)]
    new = spectral[assigned[told]]
    limits = (design.feature_sigma, design.feature_cap)
    ratio = features.log_likelihood_ratio(population, feature[told], spectra[told], new, *limits)
    ground = features.ground_ratio(population, state.ground, new, design.feature_cap)
    share = features.with_mistakes(ratio, ground, design.feature_mistaken)[1]
    own = (ratio >= ground) | (
        design.feature_mistaken == 0
    )  # else a spectrum of the ground would widen what vehicles look like
    population = features.learn(population, new[own], feature[told[own]], spectra[told[own]])
    spectra[told] += share
    feature[told] += (new - feature[told]) * (share / spectra[told])[:, None]
    return feature, spectra, population


def without_ground(state, spectral: Float[Array, "detection feature"]) -> Float[Array, "detection feature"]:
    """The same features, NaN where they more probably show the ground than any vehicle."""
    if state.design.feature_mistaken == 0:
        return spectral
    ground = features.ground_ratio(state.population, state.ground, spectral, state.design.feature_cap)
    return np.where(ground[:, None] <= 0, spectral, np.nan)


def learnt_ground(state, missed: Float[Array, "spectrum feature"]) -> features.Population:
    """The ground's spectra after some more, less those of vehicles that nobody knew of."""
    ground = features.ground_ratio(state.population, state.ground, missed, state.design.feature_cap)
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
