"""One number and three sentences, all of 100 moving vehicles, and what recorded studies suggest."""

import csv
import re
from dataclasses import replace
from pathlib import Path

import pytest
import xarray as xr

from glintrack.case.design import Case
from glintrack.io.toml import read_toml
from glintrack.results.headline import headline
from glintrack.results.losses import LOSSES, Loss, find_remedy, largest_loss
from glintrack.results.read import Result
from glintrack.track.calibration import calibration_file
from tests.results.test_verdict import STAGES

CASE = Case().replace({"flight.rate_hz": 2.0, "flight.off_nadir_deg": 50.0})


def result(stages=None, **attributes):
    scores = {
        "pan": {"completeness": 0.331, "false_per_frame": 6.0, "vehicles_per_frame": 120.0, "frames": 22}
    }
    scores |= {"dolp": {"completeness": 0.13}}
    curve = {"completeness": ("time", [0.3, 0.4])}
    groups = {f"/{k}": xr.Dataset(curve, {"time": [0.0, 0.5]}, of) for k, of in scores.items()}
    groups["/pan"].attrs.update(attributes)
    if stages:
        budget = {"of_moving": ("stage", list(stages.values()))}
        groups["/bound/pan"] = xr.Dataset(budget, {"stage": list(stages)})
    tree = xr.DataTree.from_dict(groups)
    return Result(Path("x"), tree, CASE, "", {}, {}, ())


def test_the_number_and_the_sentences_have_one_denominator():
    said = headline(result(STAGES))
    assert said is not None
    assert (said.number, said.words) == ("33", "of 100 moving vehicles in the window are tracked")
    assert (
        said.tracked
        == "Pan tracks 33, with 5 false tracks per 100 vehicles. DoLP (degree of polarization) alone 13."
    )  # 6 to 120
    assert said.lost == "Detection: 59 are left before this stage, 35 after it."
    assert said.stage == "detector" and said.warning == ""
    assert said.denominator == (
        "All numbers of vehicles here are per 100 moving vehicles in the window (120 move there at a time), "
        "in the mean of 22 frames."
    )
    assert re.findall(r"visible|km²", f"{said.tracked}{said.lost}") == []


def test_without_a_loss_budget_it_says_how_to_get_one():
    said = headline(result())
    assert said is not None and said.stage == ""
    assert "loss budget was not measured" in said.lost
    assert "`glintrack bound case.toml`" in said.advice and "`bound.every`" in said.advice


def test_a_run_too_short_to_judge_is_marked():
    said = headline(result(STAGES, learning_frames=2))
    assert said is not None and said.warning.startswith("Undecided: the run is too short.")


def test_nothing_scored_has_no_headline():
    assert headline(replace(result(), tree=None)) is None


def test_a_remedy_holds_only_for_designs_like_those_of_the_study():
    slow = find_remedy("tracker", CASE)
    assert slow is not None and "5 Hz instead of 2 Hz raised custody" in slow.evidence
    fast = find_remedy("tracker", CASE.replace({"flight.rate_hz": 10.0, "sensor.max_frame_rate_hz": 10.0}))
    assert fast is not None and "`sensor.pitch_um`" in fast.advice
    low = CASE.replace({"flight.rate_hz": 10.0, "sensor.max_frame_rate_hz": 10.0, "flight.altitude_m": 600.0})
    assert find_remedy("tracker", low) is None  # finer than what was simulated
    assert find_remedy("tracker", None) is None


def test_every_loss_has_a_remedy_and_every_remedy_a_loss():
    remedies = read_toml(calibration_file("sensitivities"), "sensitivities")["remedies"]
    assert {stage for one in remedies for stage in one["stages"]} == {*LOSSES, "oracle_association"}


def test_no_loss_is_none():
    assert largest_loss({"in_view": 1.0, "visible": 1.0}) is None
    assert largest_loss({"in_view": 0.75}) == Loss("in_view", 1.0, 0.75)


@pytest.mark.parametrize(
    ("change", "percent"), [("pitch = 8.5 µm", 19), ("angle = 20°", -14),
                            ("pitch = 8.5 µm, as many elements", -62)]
)  # fmt: skip
def test_the_evidence_is_what_table1_recorded(change, percent):
    rows = (Path(__file__).parents[2] / "docs/findings/table1_points.csv").read_text(encoding="utf-8")
    held = {}
    for name in ("base", change):
        found = re.search(rf'^"?{re.escape(name)}"?,([\d.]+),.*,pan,tracked_per_km2$', rows, re.MULTILINE)
        assert found is not None
        held[name] = float(found[1])
    assert round(100 * (held[change] / held["base"] - 1)) == percent
    text = calibration_file("sensitivities").read_text(encoding="utf-8")
    assert f"{abs(percent)} % {'more' if percent > 0 else 'fewer'}" in text


def test_the_evidence_on_frame_rates_is_what_traffic_recorded():
    with (Path(__file__).parents[2] / "docs/findings/traffic_points.csv").open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["channel"] == "all"]
    means = {}
    for response in ("custody", "false_per_km2"):
        for rate in ("2", "5"):
            scores = [
                float(row["score"])
                for row in rows
                if row["response"] == response and row["point"].endswith(f"rate = {rate} Hz")
            ]
            assert len(scores) == 5
            means[response, rate] = sum(scores) / 5
    text = calibration_file("sensitivities").read_text(encoding="utf-8")
    assert "custody from {:.2f} to {:.2f}".format(*(means["custody", rate] for rate in "25")) in text
    assert "tracks from {:.0f} to {:.0f} per".format(*(means["false_per_km2", rate] for rate in "25")) in text
