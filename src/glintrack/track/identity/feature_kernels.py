"""Kernels of spectral features: a few spectra a frame, for which NumPy would only cost calls."""

import math

import numba as nb
import numpy as np


@nb.njit(cache=True)
def expected(mean, count, ratio):
    """Mean and variance of a track's next spectrum along one axis, where all have mean 0 and variance 1.

    Bayes: of the vehicle's own mean the prior variance is 1 − ratio, of each spectrum about it the ratio.
    """
    gain = count * (1.0 - ratio) / (count * (1.0 - ratio) + ratio)
    return gain * mean, ratio + (1.0 - ratio) * (1.0 - gain)


@nb.njit(cache=True)
def log_ratios(feature, track_mean, track_count, middle, basis, ratio, cap):
    """How much more each feature speaks for its track than for anybody; 0 where either says nothing.

    Parameters
    ----------
    feature, track_mean, track_count : (pair, feature), (pair, feature), (pair,)
        NaN in a feature is none.
    middle, basis, ratio : (feature,), (feature, axis), (axis,)
        Mean of all features, and the axes (`features.axes`).
    cap : float
        Greatest magnitude. [nat]
    """
    out, size = np.zeros(len(feature)), len(middle)
    for q in range(len(feature)):
        if not track_count[q] > 0:
            continue
        total = 0.0
        for k in range(size):
            y = mean = 0.0
            for i in range(size):
                y += (feature[q, i] - middle[i]) * basis[i, k]
                mean += (track_mean[q, i] - middle[i]) * basis[i, k]
            m, variance = expected(mean, track_count[q], ratio[k])
            total += y * y - (y - m) ** 2 / variance - math.log(variance)
        if total - total == 0.0:
            out[q] = min(max(0.5 * total, -cap), cap)
    return out


@nb.njit(cache=True)
def outlier_mixture(ratio, ground, outlier_share):
    """As `features.outlier_mixture`."""
    out, share = np.empty(len(ratio)), np.empty(len(ratio))
    for q in range(len(ratio)):
        own, beside = (
            (1.0 - outlier_share) * math.exp(ratio[q]),
            0.5 * outlier_share * (math.exp(ground[q]) + 1.0),
        )
        out[q] = math.log((own + beside) / (1.0 - outlier_share + beside))
        share[q] = own / (own + beside)
    return out, share


@nb.njit(cache=True)
def pairs_with_spectra(tracks, detections, index, count):
    """Pairs whose detection, −1 for none, is in an index: which they are, and where it is there."""
    place = np.full(count, -1, np.int64)
    for r in range(len(index)):
        place[index[r]] = r
    pair, spectrum = np.empty(len(tracks), np.int64), np.empty(len(tracks), np.int64)
    n = 0
    for q in range(len(tracks)):
        if detections[q] >= 0 and place[detections[q]] >= 0:
            pair[n], spectrum[n] = q, place[detections[q]]
            n += 1
    return pair[:n], spectrum[:n]


@nb.njit(cache=True)
def divergence2(one, one_count, other, other_count, ratio, cap):
    """Twice the divergence of a track's next spectrum from another's, both given along the axes, capped."""
    total = 0.0
    for k in range(len(ratio)):
        a, a_variance = expected(one[k], one_count, ratio[k])
        b, b_variance = expected(other[k], other_count, ratio[k])
        wider = a_variance / b_variance
        total += (a - b) ** 2 / b_variance + wider - 1.0 - math.log(wider)
    return min(total, 2.0 * cap)


@nb.njit(cache=True)
def divergences2(one, one_count, other, other_count, ratio, cap):
    """`divergence2` of each pair."""
    out = np.empty(len(one))
    for q in range(len(one)):
        out[q] = divergence2(one[q], one_count[q], other[q], other_count[q], ratio, cap)
    return out


@nb.njit(cache=True)
def log_densities(feature, mean, spread):
    """Gaussian log density of each feature, but for the constant that all share."""
    size = len(mean)
    low = np.zeros((size, size))  # Cholesky: spread = low · lowᵀ
    half_log = 0.0
    for i in range(size):
        for j in range(i + 1):
            total = spread[i, j]
            for k in range(j):
                total -= low[i, k] * low[j, k]
            low[i, j] = math.sqrt(total) if i == j else total / low[j, j]
        half_log += math.log(low[i, i])
    out, white = np.empty(len(feature)), np.empty(size)
    for q in range(len(feature)):
        distance2 = 0.0
        for i in range(size):
            total = feature[q, i] - mean[i]
            for k in range(i):
                total -= low[i, k] * white[k]
            white[i] = total / low[i, i]
            distance2 += white[i] ** 2
        out[q] = -0.5 * distance2 - half_log
    return out


@nb.njit(cache=True)
def angle(a, b):
    """Angle between two spectra whose logarithms are given. [rad]"""
    aa = ab = bb = 0.0
    for k in range(len(a)):
        x, y = math.exp(a[k]), math.exp(b[k])
        aa += x * x
        ab += x * y
        bb += y * y
    return math.acos(min(max(ab / math.sqrt(aa * bb), -1.0), 1.0))


@nb.njit(cache=True)
def angles(a, b):
    """`angle` of each pair."""
    out = np.empty(len(a))
    for q in range(len(a)):
        out[q] = angle(a[q], b[q])
    return out


@nb.njit(cache=True)
def joined_moments(count, mean, scatter, feature):
    """Mean and scatter of a set and some more features, and the sum of these' squared angles to that mean."""
    n, size = feature.shape
    middle = np.zeros(size)
    for q in range(n):
        middle += feature[q]
    middle /= n
    delta = middle - mean
    scatter_out = scatter.copy()
    for i in range(size):
        for j in range(i + 1):
            total = 0.0
            for q in range(n):
                total += (feature[q, i] - middle[i]) * (feature[q, j] - middle[j])
            total += delta[i] * delta[j] * count * n / (count + n)
            scatter_out[i, j] = scatter_out[j, i] = scatter[i, j] + total
    mean_out, angle2 = mean + delta * n / (count + n), 0.0
    for q in range(n):
        angle2 += angle(feature[q], mean_out) ** 2
    return mean_out, scatter_out, angle2


@nb.njit(cache=True)
def own_moments(scatter, feature, track_mean, track_count):
    """Scatter of features about their tracks' means with some more, their number, and squared angles."""
    out = scatter.copy()
    known, angle2 = 0, 0.0
    for q in range(len(feature)):
        if track_count[q] > 0:
            known += 1
            weight = track_count[q] / (track_count[q] + 1.0)
            angle2 += weight * angle(feature[q], track_mean[q]) ** 2
            for i in range(len(out)):
                for j in range(i + 1):
                    out[i, j] += (
                        weight * (feature[q, i] - track_mean[q, i]) * (feature[q, j] - track_mean[q, j])
                    )
                    out[j, i] = out[i, j]
    return out, known, angle2
