"""Electrons to counts and back: shot, dark and read noise, full well, gain, quantizer, calibration.

Each row has its own stream of random numbers (SplitMix64, Steele, Lea and Flood, OOPSLA 2014), so that the
frame does not depend on how its rows were spread over threads.
"""

import math

import numba as nb
import numpy as np
from jaxtyping import Float

from glintrack.arrays import Array
from glintrack.parallel import over_rows
from glintrack.sensor.sensor import Sensor

PEDESTAL_COUNTS = 64  # of the converter below zero, so that dark noise is not cut off
FULL_FOR_CERTAIN = 10.0  # full wells: glints need no larger Poisson deviates than that
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_NORMAL_ABOVE = 1e7  # electrons: the Poisson law is then normal to 1e-4 of its width


def read_out(
    planes: Float[Array, "plane row column"], sensor: Sensor, rng: np.random.Generator
) -> Float[Array, "row column"]:
    """Light on the elements to what each reads, calibrated.

    Parameters
    ----------
    planes
        Light on the elements, ``sensor.planes`` of it. [W m⁻² sr⁻¹ µm⁻¹]
    sensor
        From `build_sensor`.
    rng
        Seeds the frame.

    Returns
    -------
    The band-mean radiance of unpolarized light that gives each element's count. [W m⁻² sr⁻¹ µm⁻¹]
    """
    design, pattern = sensor.design, sensor.pattern
    out = np.empty(planes.shape[1:], np.float32)
    over_rows(
        _read_out,
        len(out),
        photo_electrons(planes, sensor),
        sensor.electrons_per_reading,
        pattern.gain,
        pattern.known_gain,
        pattern.offset_e,
        pattern.known_offset_e,
        float(design.full_well_e),
        float(design.read_noise_e),
        float(design.electrons_per_count),
        float(2**design.bits - 1),
        np.uint64(rng.integers(0, 2**63)),
        out,
    )
    return out


def photo_electrons(planes: Float[Array, "plane row column"], sensor: Sensor) -> Float[Array, "row column"]:
    """Electrons that light makes in elements of mean gain: each one's analyser row times the light. [e]"""
    side, turn = sensor.side, sensor.pattern.polarizer_turn
    out = np.zeros(planes.shape[1:])
    for i in range(side):
        for j in range(side):
            own = (slice(i, None, side), slice(j, None, side))
            for k, (_, component) in enumerate(sensor.planes):
                gain = sensor.element_gains[i, j, k]
                if component and turn is not None:  # Q and U of a channel lie side by side
                    q, u = sensor.element_gains[i, j, k + 1 - component : k + 3 - component]
                    c, s = turn[(0, *own)], turn[(1, *own)]
                    gain = c * q - s * u if component == 1 else s * q + c * u
                elif not gain:
                    continue
                out[own] += gain * planes[(k, *own)].astype(float)
    return out


def poisson(mean: Float[Array, "n"], rng: np.random.Generator) -> Float[Array, "n"]:
    """Poisson deviates by the frame's own generator, for its tests. [electrons]"""
    mean = np.ascontiguousarray(mean, dtype=float)
    out = np.empty(len(mean))
    _poisson_row(mean, np.uint64(rng.integers(0, 2**63)), out)
    return out


@nb.njit(cache=True)
def _mix(z):
    """SplitMix64's output function: a hash of 64 bits."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@nb.njit(cache=True)
def _next(state):
    """One step of SplitMix64: (new state, uniform in (0, 1))."""
    state = state + _GOLDEN
    return state, (float(_mix(state) >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@nb.njit(cache=True)
def _normal_pair(state):
    """Two standard normal deviates (Box and Muller)."""
    state, u = _next(state)
    state, v = _next(state)
    radius = math.sqrt(-2.0 * math.log(u))
    return state, radius * math.cos(2 * math.pi * v), radius * math.sin(2 * math.pi * v)


@nb.njit(cache=True)
def _poisson(state, mean):
    """A Poisson deviate: by multiplication below 10, by transformed rejection above.

    Hörmann, "The transformed rejection method for generating Poisson random variables", Insurance:
    Mathematics and Economics 12, 39 (1993), algorithm PTRS.
    """
    if mean <= 0:
        return state, 0.0
    if mean < 10:
        limit, product, k = math.exp(-mean), 1.0, -1
        while product > limit:
            state, u = _next(state)
            product *= u
            k += 1
        return state, float(k)
    if mean > _NORMAL_ABOVE:
        state, g, _ = _normal_pair(state)
        return state, math.floor(mean + math.sqrt(mean) * g + 0.5)
    b = 0.931 + 2.53 * math.sqrt(mean)
    a = -0.059 + 0.02483 * b
    v_r = 0.9277 - 3.6224 / (b - 2)
    while True:
        state, u = _next(state)
        state, v = _next(state)
        u -= 0.5
        us = 0.5 - abs(u)
        k = math.floor((2 * a / us + b) * u + mean + 0.43)
        if us >= 0.07 and v <= v_r:
            return state, k
        if k < 0 or (us < 0.013 and v > us):
            continue
        inverse_alpha = 1.1239 + 1.1328 / (b - 3.4)
        left = math.log(v * inverse_alpha / (a / (us * us) + b))
        if left <= k * math.log(mean) - mean - math.lgamma(k + 1):
            return state, k


@nb.njit(cache=True)
def _poisson_row(mean, seed, out):
    state = seed
    for i in range(len(mean)):
        state, out[i] = _poisson(state, mean[i])


@nb.njit(nogil=True, cache=True)
def _read_out(
    start,
    stop,
    light,
    per_reading,
    gain,
    known_gain,
    offset,
    known_offset,
    full_well,
    read_noise,
    per_count,
    top_count,
    seed,
    out,
):
    columns = out.shape[1]
    side = per_reading.shape[0]
    for i in range(start, stop):
        state = _mix(seed + _mix(np.uint64(i + 1)))  # anywhere on the generator's cycle: rows do not overlap
        spare, has_spare = 0.0, False
        for j in range(columns):
            a, b = i % side, j % side
            expected = light[i, j] * gain[i, j] + max(offset[i, j], 0.0)
            state, electrons = _poisson(state, min(expected, FULL_FOR_CERTAIN * full_well))
            electrons = min(electrons + min(offset[i, j], 0.0), full_well)
            if read_noise > 0:
                if has_spare:
                    electrons += read_noise * spare
                    has_spare = False
                else:
                    state, g, spare = _normal_pair(state)
                    has_spare = True
                    electrons += read_noise * g
            count = math.floor(electrons / per_count + 0.5)
            count = min(max(count, -PEDESTAL_COUNTS), top_count)
            out[i, j] = (count * per_count - known_offset[i, j]) / (per_reading[a, b] * known_gain[i, j])
