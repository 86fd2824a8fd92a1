"""Where an element gets more rays: the rule against hand-worked spreads, and the error it keeps to."""

from dataclasses import replace

import numpy as np
import pytest

from glintrack import Case
from glintrack.case.build import build_scenario, sampling_of
from glintrack.render import Sampling, trace
from glintrack.render.samples import Samples
from glintrack.render.sampling import FIRST_SIDE, FURTHER_SIDES, RoughLight, error_of, further_sides
from glintrack.sensor import dark_noise_e, light_on_elements
from tests.conftest import box, nadir, plane, small_camera, snapshot

UP = np.array([0.0, 0.0, 1.0])
EVEN = RoughLight(np.array([1e4, 2e4]), np.zeros(2), np.zeros(2))


def samples_of(rows, columns, dark):
    """Level ground in the sun, four rays an element; those of ``dark`` lie half in shade."""
    count = rows * columns
    lit = np.where(np.isin(np.arange(count), dark), 0.5, 1.0).astype(np.float32)
    whole = Samples.empty(np.arange(count), count, 0)
    whole.normal[:] = UP
    return whole._replace(
        count=np.ones(count, np.int64), rays=np.full(count, 4, np.float32), sun_visible=lit,
        material=np.zeros(count, np.int16),
    )  # fmt: skip


def test_a_shadow_border_gets_the_smallest_grid_that_is_fine_enough():
    """Half of an element at 10⁴ e, half in the dark: spread 5000 e, σ √(mean + dark²)."""
    sampling = Sampling(5.0, 1.0, 20.0)
    sides = further_sides(samples_of(5, 5, [12]), (5, 5), UP, EVEN, sampling).reshape(5, 5)
    spread = 5000.0 / np.sqrt((1e4 * (0.5 + 4 * 0.5) / 3) + 20.0**2)  # the four beside count half each
    expected = next(s for s in (0, *FURTHER_SIDES) if error_of(np.array([spread]), 4 + s * s)[0] <= 5.0)
    assert expected > 0 and sides[2, 2] == expected
    beside = sides[[1, 3, 2, 2], [2, 2, 1, 3]]
    assert (beside <= expected).all() and (sides[[0, 0, 4, 4], [0, 4, 0, 4]] == 0).all()
    finer = further_sides(samples_of(5, 5, [12]), (5, 5), UP, EVEN, replace(sampling, error=2.0))
    assert finer.reshape(5, 5)[2, 2] > expected


def test_even_ground_gets_no_more_rays():
    sides = further_sides(samples_of(6, 7, []), (6, 7), UP, EVEN, Sampling(0.1, 1.0, 20.0))
    assert (sides == 0).all()


def test_the_pattern_depends_on_the_pose_alone_and_can_be_followed_again(three_cars):
    """Rays follow ``like`` where the vehicles are gone: the same places in every element."""
    scene = build_scenario(small_case())
    pose, now = scene.flight.pose(0.0), scene.city.at(0.0)
    hits = scene.observer.trace(now, pose)
    assert {FIRST_SIDE**2} < set(hits.rays.tolist())
    again = scene.observer.trace(now.without_traffic(), pose, like=hits)
    np.testing.assert_array_equal(again.rays, hits.rays)
    alone = scene.observer.trace(now.without_traffic(), pose)
    assert (alone.rays < hits.rays).any() and (alone.rays <= hits.rays).all()


def test_the_error_is_what_is_asked_for(three_cars):
    """RMS against 15 × 15 rays over the elements about the cars, with half the error and twice the rays."""
    found = {}
    for error in (10.0, 2.0):
        scene = build_scenario(small_case(sampling_error=error))
        pose, now, sensor = scene.flight.pose(0.0), scene.city.at(0.0), scene.sensor
        hits = scene.observer.trace(now, pose)
        edges = hits.rays > FIRST_SIDE**2
        best = replace(scene.observer, sampling=None, oversampling=15)
        planes = [
            light_on_elements(scene.observer.radiance(h)(sensor.channels).values, sensor)[0]
            for h in (hits, best.trace(now, pose))
        ]
        mean = planes[1] * sensor.electrons_per_radiance
        off = (
            (planes[0] - planes[1])
            * sensor.electrons_per_radiance
            / np.sqrt(mean + dark_noise_e(sensor) ** 2)
        )
        found[error] = np.sqrt(np.mean(off.ravel()[edges] ** 2)), hits.rays.sum()
        assert found[error][0] < error
    assert found[2.0][0] < 0.6 * found[10.0][0] and found[2.0][1] > found[10.0][1]


@pytest.mark.parametrize("error", [0.0, -1.0, 10.5, float("nan")])
def test_a_bad_error_is_refused_in_one_sentence(error):
    with pytest.raises(ValueError, match="sampling_error"):
        Case.model_validate({"name": "x", "sensor": {"sampling_error": error}})


def test_a_fixed_number_of_rays_needs_no_error():
    assert sampling_of(Case.model_validate({"name": "x", "sensor": {"oversampling": 3}})) is None
    hits = trace(
        snapshot(plane(), [box(4, 4, 10)], [np.eye(3, 4)], [0]), small_camera(9, 9), nadir(), UP, np.ones(2),
        oversampling=3,
    )  # fmt: skip
    assert set(hits.rays.tolist()) == {9}


def small_case(**sensor):
    return Case.model_validate(
        {
            "name": "three cars",
            "flight": {"off_nadir_deg": 30.0, "altitude_m": 2600.0, "frames": 2},
            "sensor": {"rows": 160, "columns": 200, "oversampling": 0, **sensor},
        }
    )
