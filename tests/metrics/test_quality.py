"""Picture quality against closed forms and, where it is installed, scikit-image."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter

from glintrack import metrics
from glintrack.camera import Camera, Pose, look_at

RNG = np.random.default_rng(4)
TRUTH = 50 + 10 * gaussian_filter(RNG.normal(size=(200, 240)), 1.2)


def test_rmse_psnr_and_snr_of_known_noise():
    image = TRUTH + 2.0 + RNG.normal(0, 0.5, TRUTH.shape)
    image[:5] = np.nan
    tenth_of_a_percent_by_size = 0.02
    assert metrics.rmse(image, TRUTH) == pytest.approx(math.hypot(2, 0.5), rel=tenth_of_a_percent_by_size)
    assert metrics.snr(image, TRUTH) == pytest.approx(20 * math.log10(TRUTH.mean() / 0.5), abs=0.1)
    peak_snr = 20 * math.log10(100 / math.hypot(2, 0.5))
    assert metrics.psnr(image, TRUTH, peak=100) == pytest.approx(peak_snr, abs=0.1)
    assert math.isinf(metrics.psnr(TRUTH, TRUTH)) and math.isinf(metrics.snr(TRUTH, TRUTH))
    assert math.isnan(metrics.rmse(np.full(3, np.nan), np.ones(3)))


def test_ssim_is_one_for_equals_and_closed_for_constants():
    assert metrics.ssim(TRUTH, TRUTH) == pytest.approx(1)
    a, b, peak = np.full((40, 40), 3.0), np.full((40, 40), 5.0), 10.0
    c1 = (0.01 * peak) ** 2
    assert metrics.ssim(a, b, peak) == pytest.approx((2 * 3 * 5 + c1) / (9 + 25 + c1))
    holed = TRUTH.copy()
    holed[50:60, 50:60] = np.nan
    assert metrics.ssim(holed, TRUTH) == pytest.approx(1)
    assert math.isnan(metrics.ssim(np.full((40, 40), np.nan), b))


def test_ssim_and_psnr_agree_with_scikit_image():
    skimage = pytest.importorskip("skimage.metrics", reason="scikit-image is not installed")
    image = gaussian_filter(TRUTH, 0.7) + RNG.normal(0, 0.8, TRUTH.shape)
    peak = float(np.ptp(TRUTH))
    theirs = skimage.structural_similarity(
        TRUTH, image, data_range=peak, gaussian_weights=True, sigma=1.5, use_sample_covariance=False
    )
    assert metrics.ssim(image, TRUTH) == pytest.approx(theirs, abs=1e-9)
    assert metrics.psnr(image, TRUTH) == pytest.approx(
        skimage.peak_signal_noise_ratio(TRUTH, image, data_range=peak), abs=1e-9
    )


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_mtf_of_a_gaussian_blur_is_its_transform(noise):
    """exp(−2π²σ²f²), noise or not."""
    ground = RNG.normal(size=(256, 256))
    frequency, found = metrics.mtf(
        gaussian_filter(ground, 1.1, mode="wrap") + RNG.normal(0, noise, ground.shape), ground, bins=12
    )
    expected = np.exp(-2 * np.pi**2 * 1.1**2 * frequency**2)
    np.testing.assert_allclose(
        found[1:], expected[1:], atol=0.03
    )  # speckle of some hundred frequencies a ring
    assert np.isnan(metrics.mtf(ground, np.full(ground.shape, np.nan))[1]).all()


def test_registration_error_of_a_shifted_navigator_is_its_shift():
    camera = Camera(0.068, 17e-6, 560, 880)
    true = look_at(Pose(-2298, 0, 1928), (0, 0, 0))
    reported = replace(true, east_m=true.east_m + 3, north_m=4.0)
    assert metrics.registration_error(camera, true, reported) == pytest.approx(5)
    nadir = Pose(0, 0, 3000)
    turned = replace(nadir, roll_rad=1e-4)
    # at nadir an element is 17e-6/0.068 = 2.5e-4 rad
    assert metrics.registration_error_px(camera, nadir, turned) == pytest.approx(0.4, rel=0.01)
    assert metrics.registration_error_px(camera, nadir, nadir) == pytest.approx(0, abs=1e-9)
