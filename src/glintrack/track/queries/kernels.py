"""Kernels of the queries: entropy over pairs of rivals, and points where nobody is."""

import math

import numba as nb
import numpy as np

from glintrack.track.identity.feature_kernels import divergence2


@nb.njit(cache=True)
def upper_tail(x):
    """Probability that a standard normal number exceeds x. [1]"""
    return 0.5 * math.erfc(x / math.sqrt(2.0))


@nb.njit(cache=True)
def risk(apart2, alike2, rival_detected):
    """As `choose.association_risk`."""
    exchanged = upper_tail(math.sqrt(apart2 + alike2 / 4.0))
    taken = upper_tail(math.sqrt(apart2 / 2.0 + alike2 / 4.0))
    return rival_detected * exchanged + (1.0 - rival_detected) * taken


@nb.njit(cache=True)
def risks(apart2, alike2, rival_detected):
    """`risk` of each pair."""
    out = np.empty(len(apart2))
    for q in range(len(out)):
        out[q] = risk(apart2[q], alike2[q], rival_detected[q])
    return out


@nb.njit(cache=True)
def binary_entropy(probability):
    """Of a choice between two. [nat]"""
    rest = 1.0 - probability
    first = -probability * math.log(probability) if probability > 0.0 else 0.0
    return first - rest * math.log(rest) if rest > 0.0 else first


@nb.njit(cache=True)
def contention(one, other, place, spread, believed, detected, along, count, ratio, cap):
    """Entropy of each target's association over its rivals: without spectra, and what a spectrum takes of it.

    Parameters
    ----------
    one, other : (pair,)
        Target and rival.
    place, spread : (target, 2), (target, 2, 2)
        Of the positions. [m, m²]
    believed, detected : (target,)
        Probability that it exists, and that it is detected. [1]
    along, count : (target, feature), (target,)
        Mean feature along the axes, and of how many spectra.
    ratio : (feature,)
        Spread within a track over that of all; of length 0 while spectra say nothing.
    cap : float
        As in `divergence2`.
    """
    blind, gain = np.zeros(len(place)), np.zeros(len(place))
    for q in range(len(one)):
        i, j = one[q], other[q]
        if i == j:
            continue
        s00 = spread[i, 0, 0] + spread[j, 0, 0]
        s01 = spread[i, 0, 1] + spread[j, 0, 1]
        s11 = spread[i, 1, 1] + spread[j, 1, 1]
        dx, dy = place[i, 0] - place[j, 0], place[i, 1] - place[j, 1]
        apart2 = (dx * dx * s11 - 2.0 * dx * dy * s01 + dy * dy * s00) / (s00 * s11 - s01 * s01)
        without = binary_entropy(believed[j] * risk(apart2, 0.0, detected[j]))
        blind[i] += without
        if len(ratio):
            alike2 = divergence2(along[i], count[i], along[j], count[j], ratio, cap)
            gain[i] += without - binary_entropy(believed[j] * risk(apart2, alike2, detected[j]))
    return blind, gain


@nb.njit(cache=True)
def information_gain(blind, gain, spread, believed, detected, count, density, radius, observations):
    """As `choose.information_gain`, from the `contention` of each target."""
    n = len(blind)
    out, area = np.empty(n), np.empty(n)
    mean = 0.0
    for i in range(n):
        area[i] = math.sqrt(spread[i, 0, 0] * spread[i, 1, 1] - spread[i, 0, 1] * spread[i, 1, 0])
        stray = -math.expm1(-2.0 * math.pi * area[i] * density)  # a false blob where a missed target was
        out[i] = blind[i] + binary_entropy((1.0 - detected[i]) * stray)
        mean += out[i] / n
    for i in range(n):
        later = observations * (out[i] + mean) / ((count[i] + 1.0) * (count[i] + 2.0))
        met = -math.expm1(-0.5 * radius * radius / area[i])  # the spectrum is of the vehicle
        out[i] = believed[i] * detected[i] * met * (gain[i] + later)
    return out


@nb.njit(cache=True)
def before_and_behind(position, velocity, reach, least):
    """Each position, and the points before and behind it along the velocity if it is fast enough."""
    out = np.empty((len(position), 3, 2))
    for k in range(len(position)):
        speed = math.hypot(velocity[k, 0], velocity[k, 1])
        way = reach / speed if speed >= least else 0.0
        for c in range(2):
            out[k, 0, c] = position[k, c]
            out[k, 1, c] = position[k, c] + way * velocity[k, c]
            out[k, 2, c] = position[k, c] - way * velocity[k, c]
    return out


@nb.njit(cache=True)
def clear_ahead(mean, who, ahead, clear, most):
    """Points ahead of the first targets whose points no target comes near, so many at most."""
    out = np.empty((min(most, len(who)), 2))
    found = 0
    for k in who:
        if found == len(out):
            break
        speed = math.hypot(mean[k, 2], mean[k, 3])
        east, north = mean[k, 0] + ahead * mean[k, 2] / speed, mean[k, 1] + ahead * mean[k, 3] / speed
        near = False
        for j in range(len(mean)):
            if abs(mean[j, 0] - east) < clear:
                near = math.hypot(mean[j, 0] - east, mean[j, 1] - north) < clear
                if near:
                    break
        if not near:
            out[found, 0], out[found, 1] = east, north
            found += 1
    return out[:found]
