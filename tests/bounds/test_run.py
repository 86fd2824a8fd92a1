"""The loss budget of three boxes on level asphalt: everything is found, no stage is above the one before."""

import numpy as np
import pytest
import xarray as xr

from glintrack import Case, simulate
from glintrack.bounds import STAGES
from glintrack.bounds.evidence import element_groups
from glintrack.bounds.run import FlightBudget, measure_bounds, oracle_rules
from glintrack.case.packaged import find_case
from glintrack.results.read import read_result
from glintrack.results.run import run
from glintrack.sensor import build_sensor
from tests.plain import plain_case


def case(**changes):
    design = {
        "name": "three cars",
        "channels": ["pan"],
        "flight": {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 13, "rate_hz": 2.0},
        "sensor": {"rows": 240, "columns": 320},
        "bound": {"every": 4, "false_per_frame": 5.0},
    }
    return plain_case({**design, **changes})


def test_three_cars_are_found_on_every_stage_without_a_tracker(three_cars):
    found = measure_bounds(case())
    assert set(found) == {"pan", "dolp", "all"}
    for group in ("pan", "all"):
        shares = found[group]["of_visible"].sel(stage=list(STAGES[2:7])).values
        np.testing.assert_allclose(shares, 1.0)
    assert found["pan"].attrs["frames"] == [4, 8, 12]
    assert found["all"].attrs["d_prime_50"] > found["pan"].attrs["d_prime_50"] > 10
    assert np.isnan(found["pan"]["of_moving"].sel(stage="tracker"))
    assert "unpolarized" in found["all"] and "unpolarized" not in found["pan"]
    assert found["pan"]["of_moving"].dropna("stage")["stage"].values.tolist() == list(STAGES[:7])


def test_fine_elements_find_the_cars_too(three_cars):
    """Elements of 0.26 m are binned by two, also those of the polarizers."""
    flight = {"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 5, "rate_hz": 2.0}
    sensor = {"rows": 600, "columns": 800, "pitch_um": 6.0, "oversampling": 1}
    for one in measure_bounds(case(flight=flight, sensor=sensor)).values():
        assert (one["of_visible"].sel(stage=["known_background", "reported_pose"]) == 1).all()


@pytest.mark.parametrize(
    "sensor", [{"integration_time_ms": 50.0}, {"read_noise_e": 3e4}, {"read_noise_e": 3e5}], ids=str
)
def test_in_wells_that_are_full_and_in_much_noise_all_elements_know_the_most(three_cars, sensor):
    """Full wells tell DoLP nothing either; in noise approximations may not put observers in another order."""
    found = measure_bounds(case(sensor={"rows": 240, "columns": 320} | sensor))
    pan, dolp, every = (found[g]["of_visible"].sel(stage="ideal_observer").item() for g in found)
    assert every >= max(pan, dolp)
    if "integration_time_ms" in sensor:
        assert max(pan, dolp, every) < 0.05


def test_a_known_background_is_full_where_the_frame_is(three_cars):
    """Else every full element is a change, among which no vehicle is found."""
    bright = {"rows": 240, "columns": 320, "integration_time_ms": 1.5}
    found = measure_bounds(case(sensor=bright))["all"]["false_detections"]
    plain = measure_bounds(case())["all"]["false_detections"]
    assert found.sel(stage="known_background") <= plain.sel(stage="known_background") + 1


def test_a_poor_pose_costs_the_stage_of_the_pose_alone(three_cars):
    poor = {"position_rms_m": 150.0, "roll_pitch_rms_deg": 3.0}
    found = measure_bounds(case(navigation=poor))["all"]["of_visible"]
    assert found.sel(stage="predicted_background") == 1.0 > found.sel(stage="reported_pose")


def test_the_stages_fall_and_an_oracle_holds_what_the_tracker_holds(three_cars):
    design = case()
    steps = FlightBudget(design)
    one = steps.budgets(simulate(design, steps.measure))["pan"]
    shares = one["of_moving"].values
    assert np.isfinite(shares).all()
    down_to_detector = shares[2 : STAGES.index("detector") + 1]
    assert (np.diff(down_to_detector) <= 1e-9).all()
    assert one["of_moving"].sel(stage="oracle_association") >= one["of_moving"].sel(stage="tracker")
    assert (one["length_m"] > 4.0).all() and one.sizes["row"] == 9
    assert (one["found_known_background"] == 1.0).all()


@pytest.mark.parametrize("name", ["quickstart", "braunschweig"])
def test_the_oracle_uses_the_rules_of_the_tracker_in_use(name):
    """The packaged cases report by existence, so that the design's own keys do not confirm."""
    design = Case.from_toml(find_case(name)).track
    times = 0.5 * np.arange(9)
    rules = oracle_rules(design, times, True)
    in_use = design.effective(True).initiation.in_use
    assert rules.hits == in_use.confirm_hits != design.initiation.in_use.confirm_hits
    assert rules.lag_s == design.reporting.lag_s > 0
    fallback = oracle_rules(design, times, False)
    assert fallback.hits == design.initiation.in_use.confirm_hits
    assert fallback.lag_s == 0 and fallback.single_score == np.inf


def test_an_oracle_holds_no_less_than_the_tracker_on_a_packaged_case():
    small = {"flight.frames": 9, "bound.every": 4, "sensor.rows": 200, "sensor.columns": 300}
    few_rays = {"sensor.oversampling": 1, "output.film_frames": 0, "track.query.policy": "none"}
    design = Case.from_toml(find_case("quickstart")).replace(small | few_rays | {"channels": ["pan"]})
    steps = FlightBudget(design)
    found = steps.budgets(simulate(design, steps.measure))["pan"]
    assert found["of_moving"].sel(stage="oracle_association") >= found["of_moving"].sel(stage="tracker") > 0
    held, oracle = found["found_tracker"].values > 0, found["found_oracle_association"].values > 0
    assert (held & ~oracle).sum() <= 0.05 * held.sum()


def test_a_run_leaves_the_loss_budget_in_its_result(three_cars, tmp_path):
    result = run(case(flight={"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 5}), tmp_path / "out")
    assert result.tree is not None and result.channels == ["pan"]
    read = read_result(result.path)  # what a run gives is what it wrote
    assert read.tree is not None and read.notes == result.notes
    assert read.scores["pan"] == pytest.approx(result.scores["pan"], abs=0, nan_ok=True)
    xr.testing.assert_equal(result.tree, read.tree)
    kept = result.tree["bound/pan"]
    assert kept["of_moving"].sel(stage="visible") == 1.0
    assert np.isfinite(kept["found_detector"].values).all()


def test_a_flight_without_a_loss_budget_says_nothing(three_cars):
    steps = FlightBudget(case(bound={"every": 0}))
    tree = simulate(case(bound={"every": 0}, flight={"frames": 3, "off_nadir_deg": 0.0}), steps.measure)
    assert steps.budgets(tree) == {}


def test_bad_input_is_one_sentence(three_cars, monkeypatch):
    with pytest.raises(
        ValueError, match=r"`flight.frames` must be more than bound.every, 4, for a loss budget; got 3"
    ):
        measure_bounds(case(flight={"frames": 3, "off_nadir_deg": 0.0}))
    with pytest.raises(ValueError, match="false_per_frame"):
        case(bound={"false_per_frame": 0.0})
    monkeypatch.setattr("tests.conftest.ASPHALT_SPEED_M_S", 0.0)
    with pytest.raises(
        ValueError, match="`case` must have moving vehicles in the scored area for a loss budget; got none"
    ):
        measure_bounds(case(flight={"frames": 5, "off_nadir_deg": 0.0}))


@pytest.mark.parametrize(
    ("layout", "groups"),
    [
        ("pan", ("pan",)),
        ("mirror", ("pan",)),
        ("mirror-0-60-120", ("pan", "dolp", "all")),
        ("0-45-90-135", ("dolp", "all")),
        ([["open", "open"], ["open", "open"]], ("pan", "all")),  # pan is one element of four
        ("rgb", ("pan",)),  # pan is all elements
    ],
)
def test_a_loss_budget_has_no_group_twice(layout, groups):
    wavelength_um = np.linspace(0.4, 1.0, 13)
    assert element_groups(build_sensor(Case().sensor.replace({"layout": layout}), wavelength_um)) == groups


def test_the_budget_of_an_interrupted_flight_is_that_of_its_complete_frames(three_cars):
    """The interrupt comes between the channels of a measured frame."""
    keys = {"channels": ["pan", "dolp"]}
    shorter = case(flight={"off_nadir_deg": 0.0, "altitude_m": 3000.0, "frames": 12, "rate_hz": 2.0}, **keys)
    budgets = []
    for design, stop in ((case(**keys), 12), (shorter, 99)):
        steps = FlightBudget(design)

        def watch(epoch, steps=steps, stop=stop):
            steps.measure(epoch)
            if epoch.index == stop:
                raise KeyboardInterrupt

        tree = simulate(design, watch)
        steps.end_at(int(tree.attrs["frames_done"]))
        budgets.append(steps.budgets(tree))
    ended, whole = budgets
    assert ended.keys() == whole.keys() and {"pan", "dolp"} <= whole.keys()
    for name, one in whole.items():
        assert ended[name].attrs["frames"] == one.attrs["frames"] == [4, 8]
        np.testing.assert_array_equal(ended[name]["of_moving"], one["of_moving"])
