"""Kernels of change detection against the same thing written in plain NumPy."""

import numpy as np
import pytest
from scipy import ndimage

from glintrack.track.detect import background_model, blobs, change, change_kernels, registration

SHAPE = (37, 53)
ROUNDING = 2e-5  # single precision over a frame of some thousand pixels


def speckled(seed: int) -> np.ndarray:
    """Smooth texture with a corner and single pixels missing."""
    rng = np.random.default_rng(seed)
    out = ndimage.gaussian_filter(rng.normal(size=SHAPE), 1.5) * 5 + 10
    out[rng.random(SHAPE) < 0.02] = np.nan
    out[:9, :13] = np.nan
    return out.astype(np.float32)


def test_shift_ignores_what_is_missing():
    """The least-squares step over known pixels alone, in double precision."""
    image, mean, clip = speckled(0), speckled(1), 0.7
    gy, gx = np.full(SHAPE, np.nan), np.full(SHAPE, np.nan)
    gy[1:-1], gx[:, 1:-1] = 0.5 * (mean[2:] - mean[:-2]), 0.5 * (mean[:, 2:] - mean[:, :-2])
    difference = image.astype(float) - mean
    used = np.isfinite(difference + gy + gx)
    used[::2] = False
    weight = np.minimum(1, clip / np.abs(difference[used])) ** 2
    slopes = np.stack([gy[used], gx[used]])
    normal = (weight * slopes) @ slopes.T
    wanted = -np.linalg.solve(normal, (weight * slopes) @ difference[used])
    got = registration.shift_between(image, mean, clip, 1e9)
    np.testing.assert_allclose(got, wanted, rtol=ROUNDING)


def extreme(of, values):
    """Least or greatest down the columns, then along the rows; unknown pixels drop out and stay unknown."""
    padded = np.pad(values, ((1, 1), (0, 0)), mode="edge")
    down = of(of(padded[:-2], padded[1:-1]), padded[2:])
    down[np.isnan(values)] = np.nan
    padded = np.pad(down, ((0, 0), (1, 1)), mode="edge")
    return of(of(padded[:, :-2], padded[:, 1:-1]), padded[:, 2:])


@pytest.mark.parametrize("tolerance_px", [0.4, 1.0, 1.7])
def test_excess_is_that_over_the_neighbourhood(tolerance_px):
    image, mean = speckled(2), speckled(3)
    scale = np.full(SHAPE, 0.5, np.float32)
    low, high, weight = change.envelope(mean, mean, tolerance_px)
    got = np.empty_like(image)
    floor, cap = np.float32(0.4), np.float32(36.0)
    change_kernels.excess2(0, len(image), image, low, high, weight, scale, floor, cap, got)
    passes = int(np.ceil(tolerance_px))
    low, high = mean.astype(float), mean.astype(float)
    for _ in range(passes):
        low = low + tolerance_px / passes * (extreme(np.fmin, low) - low)
        high = high + tolerance_px / passes * (extreme(np.fmax, high) - high)
    known = np.isfinite(image) & np.isfinite(mean)
    excess = np.maximum(np.maximum(image - high, low - image), 0) / 0.5
    wanted = np.where(known, np.minimum(excess**2, cap), -1)
    np.testing.assert_allclose(got, wanted, rtol=1e-4, atol=1e-4)


def test_changed_pixels_exceed_in_the_mean_and_holes_follow_two_neighbours():
    rng = np.random.default_rng(4)
    strength = rng.exponential(4, SHAPE).astype(np.float32)
    strength[rng.random(SHAPE) < 0.1] = -1
    side = np.float32(0.2)
    kernel = np.outer([0.2, 0.6, 0.2], [0.2, 0.6, 0.2])
    smoothed = ndimage.correlate(np.maximum(strength, 0).astype(float), kernel, mode="nearest")
    before = (smoothed > 5) & (strength >= 0)
    beside = ndimage.correlate(before.astype(int), np.ones((3, 3), int), mode="constant")
    wanted = before.copy()
    wanted[1:-1, 1:-1] |= ((strength < 0) & (beside >= 2))[1:-1, 1:-1]
    whole = changed(strength, side, ((0, SHAPE[0]),))
    np.testing.assert_array_equal(whole, wanted)
    np.testing.assert_array_equal(changed(strength, side, ((0, 11), (11, 12), (12, SHAPE[0]))), wanted)


def changed(strength, side, slices):
    out, holes = np.empty(SHAPE, np.uint8), np.empty(len(strength), np.bool_)
    for start, stop in slices:
        change_kernels.changed(start, stop, strength, side, np.float32(5), out, holes)
    change_kernels.fill_holes(out, strength, holes)
    return out.view(bool)


def test_a_settled_row_is_learnt_as_its_pixels_are_one_by_one():
    """The row of vectors and the loop over pixels give the same, down to the last bit."""
    image, mean = speckled(5), speckled(6)
    rng = np.random.default_rng(7)
    scale = rng.uniform(0.1, 2, SHAPE).astype(np.float32)
    frames = np.where(np.isfinite(mean), rng.choice([12, 90, 254, 255], SHAPE), 0).astype(np.uint8)
    rates = background_model.Rates(
        np.float32(0.1),
        np.linspace(1.3, 1.1, 12, dtype=np.float32),
        np.linspace(0.8, 0.95, 12, dtype=np.float32),
        np.float32(0.2),
    )
    moments = background_model.Moments
    out = moments(np.empty_like(mean), np.empty_like(scale), np.empty_like(frames))
    background_model._update_rows(0, len(image), image, moments(mean, scale, frames), rates, out)
    one_more = [np.concatenate([a, a[:, :1]], axis=1) for a in (mean, scale, frames, image)]
    one_more[0][:, -1], one_more[3][:, -1], one_more[2][:, -1] = 1, 1, 5  # a young pixel in every row
    slow = moments(*(np.empty_like(values) for values in one_more[:3]))
    background_model._update_rows(0, len(image), one_more[3], moments(*one_more[:3]), rates, slow)
    for a, b in zip(out, slow, strict=True):
        np.testing.assert_array_equal(a, b[:, :-1])


@pytest.mark.parametrize("reach", [1, 2, 3])
def test_blobs_are_those_of_a_wider_neighbourhood(reach):
    seen = np.random.default_rng(8).random(SHAPE) < 0.06
    rows, columns = np.nonzero(seen)
    blob = blobs.label(rows, columns, seen, reach)
    near = np.maximum(abs(rows[:, None] - rows), abs(columns[:, None] - columns)) <= reach
    alike = near
    for _ in range(8):  # paths of up to 256 steps
        alike = alike @ alike
    np.testing.assert_array_equal(blob[:, None] == blob, alike)
    firsts = np.unique(blob, return_index=True)[1]
    assert (np.diff(firsts) > 0).all()  # numbered as they first appear
