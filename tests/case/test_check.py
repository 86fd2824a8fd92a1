"""What a case amounts to before it flies, against Table 1 of the paper; nonsense is refused or told."""

import pytest

from glintrack.case.check import assess
from glintrack.case.design import Case
from glintrack.case.packaged import find_case, list_cases
from glintrack.core.designs import validate_design


def test_the_papers_frame():
    """Table 1: 68 mm, 17 µm, 3000 m slant range at 50° off nadir make 0.75 m elements across the view."""
    case = validate_design(Case, {"sensor": {"focal_length_mm": 68.0, "pitch_um": 17.0}})
    of = assess(case)
    assert of.gsd_m[0] == pytest.approx(0.75, rel=1e-3)
    assert of.gsd_m[1] == pytest.approx(0.75 / 0.6428, rel=1e-3)
    assert of.field_m[0] == pytest.approx(880 * 0.75, rel=1e-3)
    assert of.elements_on_car == pytest.approx(4.5 * 1.8 / (of.gsd_m[0] * of.gsd_m[1]))
    assert of.dwell_frames == pytest.approx(2 * of.dwell_s)


def test_the_well_fills_with_time_and_light():
    case = validate_design(Case, {})
    twice = case.replace({"sensor.integration_time_ms": 2 * case.sensor.integration_time_ms})
    assert assess(twice).well_filled == pytest.approx(2 * assess(case).well_filled)
    long = case.replace({"sensor.integration_time_ms": 90.0, "sensor.clock_hz": 10.0})
    assert any("fills the well" in warning for warning in assess(long).of_sensor)


@pytest.mark.parametrize("name", list_cases())
def test_packaged_cases_see_a_car(name):
    of = assess(Case.from_toml(find_case(name)))
    assert of.elements_on_car > 2 and 0.05 < of.well_filled < 1


def test_a_field_of_a_hemisphere_is_refused():
    with pytest.raises(ValueError, match="must give a field of view of at most 120°"):
        validate_design(Case, {"sensor": {"focal_length_mm": 0.068}})


def test_small_and_short_things_are_warned_about():
    case = validate_design(Case, {"sensor": {"focal_length_mm": 20.0}, "flight": {"frames": 3}})
    told = "\n".join(assess(case).of_sensor + assess(case).of_flight)
    assert "a car covers" in told and "3 frames are few" in told


@pytest.mark.parametrize("name", ["a/../b", "..", ".hidden", "a\x1b[31m", "a\nb", "nul|", "ends ", "C:x"])
def test_a_name_that_leaves_the_folder_is_refused(name):
    with pytest.raises(ValueError, match="`name` must be one that a folder can have"):
        validate_design(Case, {"name": name})


def test_files_of_a_case_lie_beside_it(tmp_path):
    folder = tmp_path / "case"
    folder.mkdir()
    path = folder / "mine.toml"
    path.write_text('[sensor]\nresponse = "../r.csv"\n')
    with pytest.raises(ValueError, match=r"`sensor.response` must name a file in the case's folder or below"):
        Case.from_toml(path)
    assert Case.from_toml(path, allow_outside_paths=True).sensor.response == str(tmp_path / "r.csv")
    path.write_text('[sensor]\nresponse = "curves/r.csv"\n[sensor.optics]\nlens = "/etc/passwd.toml"\n')
    with pytest.raises(ValueError, match=r"`sensor.optics.lens` must name a file in the case's folder"):
        Case.from_toml(path)
    path.write_text('[sensor]\nresponse = "curves/r.csv"\n[flight]\n')
    assert Case.from_toml(path).sensor.response == str(folder / "curves" / "r.csv")


def test_a_look_beside_the_window_is_told():
    assert not any("beyond the window" in one for one in assess(Case()).of_sensor)
    aside = Case().replace({"flight.stare_east_m": 5000.0})
    assert any("looks 4670 m beyond the window of 660 m × 420 m" in one for one in assess(aside).of_sensor)
