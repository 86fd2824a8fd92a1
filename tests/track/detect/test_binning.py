"""Binning of fine elements: noise of means, places of binned elements, and the detector's statistic."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.camera import Camera, Pose, ground_points
from glintrack.core.distortion import Distortion
from glintrack.core.records import Mosaic
from glintrack.track.design import DetectDesign
from glintrack.track.detect.binning import bin_camera, bin_frame, bin_mosaic, binning_factor, frame_binning
from glintrack.track.detect.detections import Association
from glintrack.track.detect.mosaic import MosaicDetector
from tests.track.detect import mosaic_flight as flight

LAYOUTS = [(("open",),), flight.LAYOUT, tuple(tuple(range(4 * i, 4 * i + 4)) for i in range(4))]


def mosaic_of(electrons, layout=LAYOUTS[0], sigma_e=30.0):
    side = len(layout)
    return Mosaic(electrons, np.full(electrons.shape, sigma_e), layout, np.ones((side, side, 3)))


@pytest.mark.parametrize(
    ("gsd_m", "factor"), [(0.0206, 17), (0.0797, 5), (0.2, 2), (0.35, 1), (0.375, 1), (0.75, 1), (1.4, 1)]
)
def test_binned_elements_are_as_coarse_as_in_the_calibration(gsd_m, factor):
    assert binning_factor(gsd_m) == factor
    assert factor == 1 or 0.35 <= factor * gsd_m < 0.75


@pytest.mark.parametrize("layout", LAYOUTS[:2])
@pytest.mark.parametrize("factor", [2, 5])
def test_variance_of_a_mean_is_that_of_an_element_over_the_count(layout, factor):
    noise = 30.0 * np.random.default_rng(1).standard_normal((600, 800))
    binned = bin_mosaic(mosaic_of(5000.0 + noise, layout), factor)
    inner = binned.electrons[4:-4, 4:-4]
    five_standard_errors = 5 / np.sqrt(2 * inner.size)
    assert inner.var() == pytest.approx((30.0 / factor) ** 2, rel=five_standard_errors)
    assert binned.sigma_e[4:-4, 4:-4] == pytest.approx(30.0 / factor, rel=1e-5)


def test_unknown_elements_are_left_out_of_means():
    electrons = np.arange(36.0).reshape(6, 6)
    electrons[0, 1] = electrons[3:, 3:] = np.nan
    binned = bin_mosaic(mosaic_of(electrons), 3)
    assert binned.electrons[0, 0] == pytest.approx((np.sum([0, 2, 6, 7, 8, 12, 13, 14])) / 8)
    assert binned.sigma_e[0, 0] == pytest.approx(30.0 / np.sqrt(8))
    assert np.isnan(binned.electrons[1, 1]) and binned.electrons[0, 1] == pytest.approx(10.0)


@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("factor", [2, 3, 5])
def test_each_kind_is_averaged_around_the_centre_of_its_binned_element(layout, factor):
    """A ramp's mean is its value at the centre, within the distance of elements of a kind."""
    side, count = len(layout), 8 * len(layout) * factor + 1  # the last row is left out
    row, column = np.mgrid[:count, :count].astype(float)
    for ramp, axis in ((row, 0), (column, 1)):
        binned = bin_mosaic(mosaic_of(ramp, layout), factor).electrons
        centre = factor * (np.arange(len(binned)) + 0.5) - 0.5
        inner = slice(2 * side, -2 * side)
        error = (binned - (centre[:, None] if axis == 0 else centre))[inner, inner]
        assert np.abs(error).max() <= (0.0 if side == 1 else side / 2) + 1e-3


def test_binned_camera_sees_the_same_ground():
    camera = Camera(0.1, 3.45e-6, 403, 611, 190.0, 320.0, Distortion(k1=-0.1))
    pose = Pose(0.0, 0.0, 2000.0, gimbal_depression_rad=1.0)
    binned = bin_camera(camera, 2, 5)
    assert (binned.rows, binned.columns) == (80, 122)
    pixels = np.stack(np.meshgrid([0.0, 79.0], [0.0, 60.0, 121.0], indexing="ij"), axis=-1)
    micrometre = 1e-6
    np.testing.assert_allclose(
        ground_points(binned, pose, pixels), ground_points(camera, pose, 5 * pixels + 2), atol=micrometre
    )


def strongest(frames):
    """Strength, log-likelihood ratio and place of the likeliest peak of each frame after the sixth."""
    detector = MosaicDetector(DetectDesign())
    state, out = detector.start(frames[0]), []
    for frame in frames:
        found = detector.detect(state, frame)
        detail = found.detail
        if len(detail.ratio):
            best = np.argmax(detail.ratio)
            out.append((detail.peaks.features[best, 1], detail.ratio[best], *detail.place_m[best]))
        state = detector.update(state, frame, found, Association(np.zeros(len(found), bool)))
    return np.array(out[-4:])


def test_vehicle_at_13_cm_has_the_statistic_that_it_has_at_38_cm():
    """The same light on 9 elements as on one; without binning the strength is a third of it."""
    fine, coarse = (flight.frames(9, "pan", fine=n, contrast=0.2) for n in (6, 2))
    assert frame_binning(fine[0]) == 3 and frame_binning(coarse[0]) == 1
    assert bin_frame(coarse[0], 1) is coarse[0]
    a, b = strongest(fine), strongest(coarse)
    assert np.median(a[:, 0]) == pytest.approx(np.median(b[:, 0]), rel=0.3)
    assert np.median(a[:, 1]) == pytest.approx(np.median(b[:, 1]), abs=1.0)
    half_a_cell_m = 0.4
    assert np.hypot(*np.median(a[:, 2:] - b[:, 2:], axis=0)) < half_a_cell_m


def test_array_smaller_than_a_binned_superpixel_is_not_binned_away():
    small = replace(
        flight.CAMERA, pitch_m=1e-8, rows=8, columns=12, principal_row=None, principal_column=None
    )
    frame = replace(flight.frames(1)[0], camera=small)
    assert frame_binning(frame) == 2 and bin_camera(small, 2, 2).rows == 4
