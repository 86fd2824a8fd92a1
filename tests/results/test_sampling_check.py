"""A flight's own sampling error against that of whole frames."""

import numpy as np
import pytest

from glintrack import Case, simulate
from glintrack.results.sampling_check import SamplingCheck


def case(rays):
    return Case.model_validate(
        {
            "name": "three cars",
            "channels": ["pan"],
            "flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 3, "rate_hz": 2.0},
            "sensor": {"rows": 60, "columns": 80, "pitch_um": 50.0, "oversampling": rays},
            "bound": {"every": 0},
        }
    )


def test_more_rays_leave_less_error(three_cars):
    found = {}
    for rays in (1, 3, 5):
        check = SamplingCheck(case(rays))
        simulate(case(rays), check.measure)
        found[rays] = check.found()
        assert set(found[rays]) == {"sampling_error_median_sigma", "sampling_error_90_sigma"}
    rms = {rays: np.sqrt(np.mean(np.square(list(told.values())))) for rays, told in found.items()}
    assert rms[1] > rms[3] >= rms[5] >= 0


def test_the_rays_of_the_reference_leave_none(three_cars, monkeypatch):
    monkeypatch.setattr("glintrack.results.sampling_check.REFERENCE", 2)
    check = SamplingCheck(case(2))
    simulate(case(2), check.measure)
    assert check.found()["sampling_error_90_sigma"] == pytest.approx(0.0, abs=1e-4)


def test_nothing_is_told_of_a_flight_without_frames():
    assert SamplingCheck(case(1)).found() == {}


def test_an_array_without_an_inner_element_tells_nothing(three_cars):
    tiny = case(1).replace({"sensor.rows": 4, "sensor.columns": 4})
    check = SamplingCheck(tiny)
    simulate(tiny, check.measure)
    assert check.found() == {}
