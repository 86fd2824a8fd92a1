"""What the detector `mosaic` tells the tracker of a peak, against drawn peaks whose law is known."""

import math

import numpy as np
import pytest

from glintrack.track.detect import mosaic_calibration as calibration

GAP = 3.0  # between the means of vehicles and clutter, in their common standard deviation


@pytest.mark.parametrize("channel", ["pan", "dolp", "all"])
def test_what_is_told_weighs_against_the_clutter_that_is_told(channel, monkeypatch):
    """Of clutter, the mean of a likelihood ratio is 1: among all peaks, and among those that are told."""
    rng = np.random.default_rng(4)
    vehicle, clutter = (GAP * rng.normal(side * GAP / 2, 1.0, 1_000_000) for side in (1, -1))
    assert np.exp(clutter).mean() == pytest.approx(1.0, abs=0.1)
    shares = [np.mean(ratio > calibration.LEAST_RATIO) for ratio in (vehicle, clutter)]
    monkeypatch.setitem(calibration.TOLD, channel, math.log(shares[0] / shares[1]))
    told = clutter[clutter > calibration.LEAST_RATIO]
    assert np.exp(told).mean() > 5.0
    assert np.exp(calibration.ratio_of_told(channel, told)).mean() == pytest.approx(1.0, abs=0.1)


def test_vehicles_are_told_much_oftener_than_clutter():
    assert calibration.TOLD.keys() == calibration.LAW.keys()
    assert all(math.log(5) < ratio < math.log(200) for ratio in calibration.TOLD.values())
