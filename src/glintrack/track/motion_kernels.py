"""Kernels of `motion`: predict, update and combine the modes of many targets (equations there)."""

import math
from typing import NamedTuple

import numba as nb
import numpy as np

from glintrack.core.arrays import Array


class Belief(NamedTuple):
    """`Modes` as kernels take them."""

    mean: Array
    covariance: Array
    probability: Array


class Step(NamedTuple):
    """One interval: `Motion`, the time in which each target's speed decays, and the widest variance."""

    reach: Array
    turn: Array
    noise: Array
    transition: Array
    stopped: int
    stopping2: float
    damping: Array
    dt: float
    widest2: float


class Scan(NamedTuple):
    """One scan: its detections, and which targets they may be of (see `update`)."""

    detection: Array
    seen: Array
    first: Array
    partners: Array
    weights: Array
    measured: Array
    noise: Array


@nb.njit(nogil=True, cache=True)
def predict_rows(start, stop, before, step, after):
    """Predict targets ``start`` to ``stop`` into ``after``."""
    mean, covariance, probability = before.mean, before.covariance, before.probability
    mean_out, covariance_out, probability_out = after.mean, after.covariance, after.probability
    reach, turn, noise, transition = step.reach, step.turn, step.noise, step.transition
    stopped, stopping2, damping, dt = step.stopped, step.stopping2, step.damping, step.dt
    modes = mean.shape[1]
    x, p, share = np.empty(4), np.empty((4, 4)), np.empty(modes)
    a, b = np.empty((2, 2)), np.empty((2, 2))
    change = transition.copy()
    for k in range(start, stop):
        if stopped >= 0:
            _stopping(k, mean, covariance, transition, stopped, stopping2, change)
        slowed, shortened = 1.0, 1.0  # speed left after dt, and way made relative to that at full speed
        if np.isfinite(damping[k]) and dt > 0:
            slowed = math.exp(-dt / damping[k])
            shortened = damping[k] * (1.0 - slowed) / dt
        for j in range(modes):
            if modes == 1:
                probability_out[k, j] = probability[k, j]
                for r in range(4):
                    x[r] = mean[k, j, r]
                    for c in range(4):
                        p[r, c] = covariance[k, j, r, c]
            else:
                _mix(k, j, mean, covariance, probability, change, share, x, p, probability_out)
            for r in range(2):
                for c in range(2):
                    a[r, c], b[r, c] = shortened * reach[j, r, c], slowed * turn[j, r, c]
            _move(x, p, a, b, noise[j], mean_out[k, j], covariance_out[k, j])
            wide = 0.5 * (covariance_out[k, j, 0, 0] + covariance_out[k, j, 1, 1])
            if wide > step.widest2:  # all of it alike: the gain of the next measurement stays what it was
                for r in range(4):
                    for c in range(4):
                        covariance_out[k, j, r, c] *= step.widest2 / wide


@nb.njit(cache=True, error_model="numpy")
def _stopping(k, mean, covariance, transition, stopped, stopping2, change):
    """Transitions of target k: what drives fast does not stand at the next look, and stays in its mode.

    The factor is the likelihood that a velocity of that mode, braked within the interval, is 0, relative to
    that of a mean of 0.
    """
    for i in range(len(transition)):
        if i == stopped:
            continue
        spread = stopping2 + 0.5 * (covariance[k, i, 2, 2] + covariance[k, i, 3, 3])
        slow = math.exp(-0.5 * (mean[k, i, 2] ** 2 + mean[k, i, 3] ** 2) / spread)
        change[i, stopped] = slow * transition[i, stopped]
        change[i, i] = transition[i, i] + (1.0 - slow) * transition[i, stopped]


@nb.njit(cache=True, error_model="numpy")
def _mix(k, j, mean, covariance, probability, transition, share, x, p, probability_out):
    """Mean and covariance of target k on entering mode j, into x and p; and the probability of mode j.

    ``share`` is scratch.
    """
    modes = mean.shape[1]
    total = 0.0
    for i in range(modes):
        total += transition[i, j] * probability[k, i]
    probability_out[k, j] = total
    for r in range(4):
        x[r] = 0.0
    for i in range(modes):
        share[i] = transition[i, j] * probability[k, i] / total if total > 0 else 1.0 / modes
        for r in range(4):
            x[r] += share[i] * mean[k, i, r]
    for r in range(4):
        p0 = p1 = p2 = p3 = 0.0  # both halves: a row at once
        for i in range(modes):
            apart = mean[k, i, r] - x[r]
            p0 += share[i] * (covariance[k, i, r, 0] + apart * (mean[k, i, 0] - x[0]))
            p1 += share[i] * (covariance[k, i, r, 1] + apart * (mean[k, i, 1] - x[1]))
            p2 += share[i] * (covariance[k, i, r, 2] + apart * (mean[k, i, 2] - x[2]))
            p3 += share[i] * (covariance[k, i, r, 3] + apart * (mean[k, i, 3] - x[3]))
        p[r, 0], p[r, 1], p[r, 2], p[r, 3] = p0, p1, p2, p3


@nb.njit(cache=True)
def _move(x, p, a, b, noise, x_out, p_out):
    """F x and F P Fᵀ + Q with F = [[1, a], [0, b]]."""
    for r in range(2):
        x_out[r] = x[r] + a[r, 0] * x[2] + a[r, 1] * x[3]
        x_out[r + 2] = b[r, 0] * x[2] + b[r, 1] * x[3]
    fp = p_out  # F P first, row by row; then each row times Fᵀ in place
    for c in range(4):
        for r in range(2):
            fp[r, c] = p[r, c] + a[r, 0] * p[2, c] + a[r, 1] * p[3, c]
            fp[r + 2, c] = b[r, 0] * p[2, c] + b[r, 1] * p[3, c]
    for r in range(4):
        east, north, v, w = fp[r, 0], fp[r, 1], fp[r, 2], fp[r, 3]
        p_out[r, 0] = noise[r, 0] + east + a[0, 0] * v + a[0, 1] * w
        p_out[r, 1] = noise[r, 1] + north + a[1, 0] * v + a[1, 1] * w
        p_out[r, 2] = noise[r, 2] + b[0, 0] * v + b[0, 1] * w
        p_out[r, 3] = noise[r, 3] + b[1, 0] * v + b[1, 1] * w
    for r in range(4):
        for c in range(r):
            p_out[r, c] = p_out[c, r]


@nb.njit(nogil=True, cache=True)
def update_rows(start, stop, before, scan, after):
    """Update targets ``start`` to ``stop`` into ``after``."""
    mean, covariance, probability = before.mean, before.covariance, before.probability
    mean_out, covariance_out, probability_out = after.mean, after.covariance, after.probability
    first, partners, weights = scan.first, scan.partners, scan.weights
    measured, noise = scan.measured, scan.noise
    modes, most = mean.shape[1], 1
    for k in range(start, stop):
        most = max(most, first[k + 1] - first[k])
    events = np.empty((modes, most + 1))
    means, spreads, gain = np.empty((1, most, 4)), np.empty((1, most, 4, 4)), np.empty((4, 2))
    for k in range(start, stop):
        low, high = first[k], first[k + 1]
        hit = 0.0
        for q in range(low, high):
            hit += weights[q]
        missed = max(1.0 - hit, 0.0)
        total = _event_probabilities(k, before, scan, missed, events)
        for j in range(modes):
            own = 0.0
            for q in range(high - low + 1):
                own += events[j, q]
            probability_out[k, j] = own / total if total > 0 else probability[k, j]
            if low == high or own <= 0.0:
                for r in range(4):
                    mean_out[k, j, r] = mean[k, j, r]
                    for c in range(4):
                        covariance_out[k, j, r, c] = covariance[k, j, r, c]
            elif high - low == 1 and missed == 0.0:
                _kalman(
                    mean,
                    covariance,
                    k,
                    j,
                    measured,
                    noise,
                    partners[low],
                    gain,
                    mean_out,
                    covariance_out,
                    k,
                    j,
                )
            else:
                for q in range(low, high):
                    _kalman(
                        mean, covariance, k, j, measured, noise, partners[q], gain, means, spreads, 0, q - low
                    )
                _collapse(
                    k, j, events, own, high - low, mean, covariance, means, spreads, mean_out, covariance_out
                )


@nb.njit(cache=True, error_model="numpy")
def _event_probabilities(k, before, scan, missed, events):
    """Joint probability of each mode and event of target k, the miss last, into ``events``; and their sum."""
    mean, covariance, probability = before.mean, before.covariance, before.probability
    detection, seen, weights = scan.detection, scan.seen, scan.weights
    low, high, modes = scan.first[k], scan.first[k + 1], mean.shape[1]
    blind = total = 0.0  # prior probability of a miss, over all modes
    for j in range(modes):
        blind += probability[k, j] * (1.0 - detection[j] * seen[k])
    for q in range(low, high):
        if modes == 1:
            events[0, q - low] = weights[q]
            continue
        likelihood = 0.0
        for j in range(modes):
            density = normal_density(scan.measured, scan.noise, scan.partners[q], mean, covariance, k, j)
            events[j, q - low] = probability[k, j] * detection[j] * density
            likelihood += events[j, q - low]
        for j in range(modes):
            share = events[j, q - low] / likelihood if likelihood > 0 else probability[k, j]
            events[j, q - low] = weights[q] * share
    for j in range(modes):
        prior = probability[k, j] * (1.0 - detection[j] * seen[k])
        events[j, high - low] = missed * (prior / blind if blind > 0 else probability[k, j])
        for q in range(high - low + 1):
            total += events[j, q]
    return total


@nb.njit(cache=True, error_model="numpy")
def _kalman(mean, covariance, k, j, measured, noise, d, gain, mean_out, covariance_out, k_out, j_out):
    """Mode j of target k after detection d, by Joseph's form, which stays positive where rounding bites.

    P' = (1 − K H) P (1 − K H)ᵀ + K R Kᵀ, where H takes the position; ``gain`` is scratch.
    """
    n00, n01, n11 = noise[d, 0, 0], noise[d, 0, 1], noise[d, 1, 1]
    p00, p01, p11 = covariance[k, j, 0, 0], covariance[k, j, 0, 1], covariance[k, j, 1, 1]
    s00, s01, s11 = p00 + n00, p01 + n01, p11 + n11
    determinant = s00 * s11 - s01 * s01
    y0, y1 = measured[d, 0] - mean[k, j, 0], measured[d, 1] - mean[k, j, 1]
    for r in range(4):
        a, b = covariance[k, j, r, 0], covariance[k, j, r, 1]
        gain[r, 0], gain[r, 1] = (a * s11 - b * s01) / determinant, (b * s00 - a * s01) / determinant
        mean_out[k_out, j_out, r] = mean[k, j, r] + gain[r, 0] * y0 + gain[r, 1] * y1
    for r in range(4):
        a, b = gain[r, 0], gain[r, 1]
        for c in range(4):  # (1 − K H) P
            covariance_out[k_out, j_out, r, c] = (
                covariance[k, j, r, c] - a * covariance[k, j, 0, c] - b * covariance[k, j, 1, c]
            )
        east = a * n00 + b * n01 - covariance_out[k_out, j_out, r, 0]
        north = a * n01 + b * n11 - covariance_out[k_out, j_out, r, 1]
        for c in range(4):
            covariance_out[k_out, j_out, r, c] += east * gain[c, 0] + north * gain[c, 1]
    for r in range(4):
        for c in range(r):
            covariance_out[k_out, j_out, r, c] = covariance_out[k_out, j_out, c, r]


@nb.njit(cache=True)
def _collapse(k, j, events, own, count, mean, covariance, means, spreads, mean_out, covariance_out):
    """Mean and covariance of mode j of target k over its events: after each detection, and after a miss."""
    miss = events[j, count] / own
    for r in range(4):
        total = miss * mean[k, j, r]
        for q in range(count):
            total += events[j, q] / own * means[0, q, r]
        mean_out[k, j, r] = total
    for r in range(4):
        for c in range(4):
            dr, dc = mean[k, j, r] - mean_out[k, j, r], mean[k, j, c] - mean_out[k, j, c]
            total = miss * (covariance[k, j, r, c] + dr * dc)
            for q in range(count):
                dr, dc = means[0, q, r] - mean_out[k, j, r], means[0, q, c] - mean_out[k, j, c]
                total += events[j, q] / own * (spreads[0, q, r, c] + dr * dc)
            covariance_out[k, j, r, c] = total


@nb.njit(cache=True, error_model="numpy")
def normal_density(measured, noise, d, mean, covariance, k, j):
    """Density of measured position d under mode j of predicted target k. [m⁻²]"""
    s00 = covariance[k, j, 0, 0] + noise[d, 0, 0]
    s01 = covariance[k, j, 0, 1] + noise[d, 0, 1]
    s11 = covariance[k, j, 1, 1] + noise[d, 1, 1]
    determinant = s00 * s11 - s01 * s01
    dx, dy = measured[d, 0] - mean[k, j, 0], measured[d, 1] - mean[k, j, 1]
    distance2 = (dx * dx * s11 - 2.0 * dx * dy * s01 + dy * dy * s00) / determinant
    return math.exp(-0.5 * distance2) / (2.0 * math.pi * math.sqrt(determinant))


@nb.njit(nogil=True, cache=True)
def combine_rows(start, stop, mean, covariance, probability, mean_out, covariance_out):
    """Mean and covariance over the modes of targets ``start`` to ``stop``."""
    for k in range(start, stop):
        for r in range(4):
            mean_out[k, r] = 0.0
            for j in range(mean.shape[1]):
                mean_out[k, r] += probability[k, j] * mean[k, j, r]
        for r in range(4):
            for c in range(4):
                covariance_out[k, r, c] = 0.0
        for j in range(mean.shape[1]):
            for r in range(4):
                apart = mean[k, j, r] - mean_out[k, r]
                for c in range(4):  # both halves: a row at once
                    dc = mean[k, j, c] - mean_out[k, c]
                    covariance_out[k, r, c] += probability[k, j] * (covariance[k, j, r, c] + apart * dc)
