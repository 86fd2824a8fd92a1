"""Quality of every frame of a small run, and what a navigator's error and its cure do to it."""

import numpy as np

from glintrack import metrics, simulate
from tests.system.test_loop import case

FLIGHT = {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 3, "rate_hz": 2.0}


def quality(**changes):
    tree = simulate(case(flight=FLIGHT, output={"quality": True}, **changes))
    return tree["pan/quality"].to_dataset(inherit=False)


def test_quality_is_stored_with_units_and_falls_with_the_navigators_error(three_cars):
    good = quality()
    assert set(good.data_vars) == set(metrics.QUALITY_UNITS) and good.sizes["time"] == 3
    assert {name: v.attrs["units"] for name, v in good.data_vars.items()} == metrics.QUALITY_UNITS
    np.testing.assert_allclose(good["registration_error"], 0, atol=1e-6)
    assert good.attrs["mean_snr"] > 20
    bad = quality(navigation={"position_rms_m": 3.0})
    assert (bad["registration_error"] > 0.3).all()
    assert bad.attrs["mean_rmse"] > good.attrs["mean_rmse"]


def test_registration_is_an_option_of_the_loop(three_cars):
    """It anchors to the first frame, so that one is as it was, and later ones come closer to it."""
    plain = quality(navigation={"position_rms_m": 3.0})
    cured = quality(navigation={"position_rms_m": 3.0}, ortho={"registration": "phase"})
    assert cured["rmse"].values[0] == plain["rmse"].values[0]
    np.testing.assert_array_equal(cured["registration_error"], plain["registration_error"])
    assert np.isfinite(cured["rmse"]).all()
