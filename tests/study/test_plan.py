"""What a study's file asks for, and what is wrong with it, before anything flies."""

import numpy as np
import pytest

from glintrack.case.identity import without_paths
from glintrack.study import read_plan
from glintrack.study.design import Axis, Range
from glintrack.study.plan import design_notes
from tests.study.cases import TWELVE, write_study


def plan(tmp_path, text, **more):
    return read_plan(write_study(tmp_path, text, **more))


def test_factorial_combines_everything_with_every_replicate(tmp_path):
    found = plan(tmp_path, TWELVE)
    assert len(found.points) == len(found.cases) == 12
    seen = {(p.levels["sensor.pitch_um"], p.levels["atmosphere.aerosol"], p.replicate) for p in found.points}
    assert len(seen) == 12
    assert {case.seed for case in found.cases.values()} == {1, 2}
    assert {case.sensor.pitch_um for case in found.cases.values()} == {17, 10.8, 8.5}


def test_one_at_a_time_leaves_the_rest_at_their_first_value(tmp_path):
    found = plan(tmp_path, "[axes]\nsensor.pitch_um = [17, 8.5]\nsensor.f_number = [4.0, 5.6, 8.0]\n")
    levels = [(p.levels["sensor.pitch_um"], p.levels["sensor.f_number"]) for p in found.points]
    assert levels == [(17, 4.0), (8.5, 4.0), (17, 5.6), (17, 8.0)]


def test_latin_hypercube_has_one_point_in_each_stripe(tmp_path):
    text = 'design = "latin-hypercube"\nsamples = 8\n[axes]\nsensor.pitch_um = {from = 8, to = 16}\n'
    pitch = sorted(p.levels["sensor.pitch_um"] for p in plan(tmp_path, text).points)
    np.testing.assert_array_equal(np.floor(pitch), np.arange(8, 16))


def test_saltelli_takes_one_axis_after_the_other_from_the_second_sample(tmp_path):
    text = (
        'design = "saltelli"\nsamples = 4\n[axes]\nsensor.pitch_um = {from = 8, to = 16}\n'
        "sensor.f_number = {from = 2, to = 8, log = true}\n"
    )
    points = plan(tmp_path, text).points
    assert len(points) == 4 * (2 + 2)
    a, b, first, second = ([*p.levels.values()] for p in points[:4])
    assert first == [b[0], a[1]] and second == [a[0], b[1]]


def test_a_list_names_its_cases(tmp_path):
    found = plan(tmp_path, 'design = "list"\n[[cases]]\nlabel = "small"\nsensor.rows = 280\n')
    assert found.points[0].levels == {"label": "small"}
    assert next(iter(found.cases.values())).sensor.rows == 280


def test_altitude_follows_off_nadir_angle_at_constant_slant_range(tmp_path):
    text = "[constraints]\nslant_range_m = 3000\n[axes]\nflight.off_nadir_deg = [0, 20, 50]\n"
    altitude = [c.flight.altitude_m for c in plan(tmp_path, text).cases.values()]
    np.testing.assert_allclose(altitude, [3000, 2819, 1928], atol=0.5)  # Table 1


def test_frames_follow_rate_and_clock_and_the_field_of_view_stays(tmp_path):
    text = (
        "[constraints]\nduration_s = 10\nat_max_frame_rate = true\nconstant_field = true\n"
        "[axes]\nsensor.max_frame_rate_hz = [2, 10]\nsensor.pitch_um = [17, 8.5]\n"
    )
    slow, fast, fine = plan(tmp_path, text).cases.values()
    assert (slow.flight.frames, fast.flight.frames, fast.flight.rate_hz) == (20, 100, 10)
    assert (slow.sensor.rows, slow.sensor.columns) == (560, 880)
    assert (fine.sensor.rows, fine.sensor.columns) == (1120, 1760)


def test_a_value_that_sets_the_number_of_elements_gives_up_the_field(tmp_path):
    text = (
        "[constraints]\nconstant_field = true\n[axes]\n"
        "pitch = [{label = 'held', sensor.pitch_um = 8.5}, "
        "{label = 'as many', sensor.pitch_um = 8.5, sensor.rows = 560, sensor.columns = 880}]\n"
    )
    held, as_many = plan(tmp_path, text).cases.values()
    assert (held.sensor.rows, held.sensor.columns) == (1120, 1760)
    assert (as_many.sensor.rows, as_many.sensor.columns) == (560, 880)


def test_a_value_may_set_several_keys(tmp_path):
    text = (
        "[axes]\nnavigator = [{label = 'perfect', navigation.preset = 'perfect'}, "
        "{label = 'poor', navigation.position_rms_m = 2.0, navigation.heading_rms_deg = 0.1}]\n"
    )
    found = plan(tmp_path, text)
    assert [p.levels["navigator"] for p in found.points] == ["perfect", "poor"]
    assert [c.navigation.position_rms_m for c in found.cases.values()] == [0.0, 2.0]


def test_a_case_is_named_by_its_content(tmp_path):
    first = plan(tmp_path / "a", TWELVE)
    again = plan(tmp_path / "b", f'name = "another"\n{TWELVE}')
    other = plan(tmp_path / "c", TWELVE.replace("8.5", "8.6"))
    assert list(first.cases) == list(again.cases) and first.key == again.key
    assert len(set(first.cases) & set(other.cases)) == 8 and first.key != other.key


def test_a_file_counts_by_what_is_in_it(tmp_path):
    text = "[axes]\nsensor.response = ['r.csv']\n"
    for name in "ab":
        (tmp_path / name).mkdir()
        (tmp_path / name / "r.csv").write_text("wavelength_um,response\n0.4,1\n1.0,1\n")
    here, there = plan(tmp_path / "a", text), plan(tmp_path / "b", text)
    assert list(here.cases) == list(there.cases)
    (tmp_path / "b" / "r.csv").write_text("wavelength_um,response\n0.4,1\n1.0,0.5\n")
    assert list(plan(tmp_path / "b", text).cases) != list(here.cases)


def test_a_file_that_a_file_names_counts_too(tmp_path):
    (tmp_path / "m").mkdir()
    table = tmp_path / "m" / "materials.toml"
    table.write_text('[materials.lilac]\nfile = "lilac.csv"\n')
    spectrum = table.with_name("lilac.csv")
    spectrum.write_text("wavelength_um,reflectance\n0.4,0.05\n2.5,0.05\n")
    dark = without_paths({"scene": {"materials_file": str(table)}})
    spectrum.write_text("wavelength_um,reflectance\n0.4,0.9\n2.5,0.9\n")
    assert without_paths({"scene": {"materials_file": str(table)}}) != dark


def test_whole_numbers_are_even_in_the_logarithm():
    axis = Axis(
        "track.query.budget", span=Range.model_validate({"from": 1, "to": 1000, "log": True, "integer": True})
    )
    assert [axis.at(place)[0] for place in (0.0, 0.25, 0.5, 0.75, 1.0)] == [1, 6, 32, 178, 1000]


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("[axes]\nsensor.pich_um = [17]", "Did you mean `pitch_um`"),
        ("[axes]\nsensr.pitch_um = [17]", "Did you mean `sensor`"),
        ("[axes]\nsensor.pitch_um = [17, 'wide']", "values of one type"),
        ("[axes]\nsensor.pitch_um = ['wide']", "`sensor.pitch_um` must be a number in µm"),
        ("[axes]\nsensor.pitch_um = [17, 0.5]", "`sensor.pitch_um` must be greater than or equal to 1"),
        ("[axes]\nsensor.pitch_um = [17, 17]", "each value once"),
        ("[axes]\nsensor.pitch_um = 17", "must be a list of values"),
        ("[axes]\nsensor.pitch_um = {from = 8, to = 17}", "must be a list of values for design"),
        ("[axes]\natmosphere.aerosol = ['clear', 'smog']", "aerosol` must be 'none', 'clear'"),
        ("[axes]\natmosphere.local_time_h = [12, 23]", "local_time_h"),
        ("[axes]\nseed.root = [1]", "`seed` must be a whole number"),
        ("desing = 'list'", "Did you mean `design`"),
        ("", "`axes` must name at least one key"),
        ("design = 'sobol'\n[axes]\nsensor.pitch_um = {from = 8, to = 17}", "`samples` must be given"),
        ("design = 'sobol'\nsamples = 12\n[axes]\nsensor.pitch_um = {from = 8, to = 17}", "power of two"),
        (
            "design = 'sobol'\nsamples = 2\n[axes]\nsensor.pitch_um = {from = 8, to = 170}",
            "less than or equal",
        ),
        (
            "design = 'sobol'\nsamples = 2\n[axes]\nsensor.pitch_um = {from = 8, too = 9}",
            "`axes.sensor.pitch_um.to` must be given",
        ),
        ("design = 'sobol'\nsamples = 2\n[axes]\nsensor.pitch_um = {from = 9, to = 8}", "must rise"),
        (
            "[constraints]\nslant_range_m = 3000\n[axes]\nflight.altitude_m = [1000, 2000]",
            "must not be varied where a constraint sets it",
        ),
        ("[constraints]\nslant_range_m = 9000\n[axes]\nflight.off_nadir_deg = [0]\n", None),
        ("[constraints]\nslant_range_m = 15000\n[axes]\nflight.off_nadir_deg = [50, 0]\n", "altitude_m"),
        (
            "design = 'factorial'\n[axes]\nflight.rate_hz = [2, 10]\nsensor.max_frame_rate_hz = [10, 2]",
            "sensor.max_frame_rate_hz",
        ),
        ("seeds = [1]\nreplicates = [{seed = 2}]\n[axes]\nsensor.pitch_um = [17]", "together with"),
        ("replicates = 2\n[axes]\nsensor.pitch_um = [17]", "For replicates that differ in noise"),
        ("[axes]\nsensor.pitch_um = [17]\nsize = [{label = 'a', sensor.pitch_um = 8}]", "as `axes."),
        ("[axes]\nsize = [{sensor.pitch_um = 8}]", "a `label`"),
        ("[axes]\nstatus = [{label = 'a', seed = 1}]", "must not be named as a column"),
        ("case = 'twice'", "valid TOML"),
        (f'[axes]\n"{".".join("a" * 3000)}" = [17]', "nested too deeply"),
    ],
)
def test_what_is_wrong_is_found_before_the_first_case(tmp_path, text, complaint):
    path = write_study(tmp_path, text)
    if complaint is None:
        read_plan(path)
        return
    with pytest.raises(ValueError, match=r".*") as caught:
        read_plan(path)
    first, *others = str(caught.value).splitlines()
    assert complaint in first and all(line.startswith("`axes.") for line in others)


def test_a_missing_file_or_base_is_told(tmp_path):
    with pytest.raises(ValueError, match="`study` must be a readable file"):
        read_plan(tmp_path / "none.toml")
    (tmp_path / "s.toml").write_text("case = 'nowhere'\n[axes]\nseed = [1]\n")
    with pytest.raises(ValueError, match=r"`case` must be a TOML file .*got nowhere"):
        read_plan(tmp_path / "s.toml")


def test_a_study_names_no_file_outside_its_folder_unless_allowed(tmp_path):
    """What a colleague sends has no business with the rest of a disk."""
    text = f'[axes]\nsensor.reference_spectrum = ["flat", "{tmp_path / "light.csv"}"]\n'
    (tmp_path / "light.csv").write_bytes(b"")
    path = write_study(tmp_path / "sent", text)
    with pytest.raises(ValueError, match=r"must name a file in the case's folder.*allow-outside-paths"):
        read_plan(path)
    assert len(read_plan(path, allow_outside_paths=True).points) == 2
    (tmp_path / "sent" / "light.csv").write_bytes(b"")
    inside = write_study(tmp_path / "sent", text.replace(str(tmp_path), str(tmp_path / "sent")))
    assert len(read_plan(inside).points) == 2


def test_a_study_has_no_base_outside_its_folder_unless_allowed(tmp_path):
    write_study(tmp_path, "[axes]\nseed = [1]\n")
    path = tmp_path / "sent" / "study.toml"
    path.parent.mkdir()
    path.write_text('case = "../base.toml"\n[axes]\nseed = [1]\n')
    with pytest.raises(ValueError, match="`case` must name a file in the folder of"):
        read_plan(path)
    assert len(read_plan(path, allow_outside_paths=True).points) == 1


def test_the_field_of_view_stays_as_the_focal_length_changes(tmp_path):
    text = (
        "[constraints]\nconstant_field = true\n[axes]\nsensor.focal_length_mm = [51, 102]\n"
        "sensor.pitch_um = [17, 8.5]\n"
    )
    cases = list(plan(tmp_path, 'design = "factorial"\n' + text).cases.values())
    base = cases[0].sensor
    seen = [c.sensor.columns * c.sensor.pitch_um / c.sensor.focal_length_mm for c in cases]
    one_superpixel = 2 * base.pitch_um / base.focal_length_mm
    np.testing.assert_allclose(seen, seen[0], atol=one_superpixel)
    assert [c.sensor.columns / base.columns for c in cases] == pytest.approx([1, 2, 2, 4], abs=0.01)


def test_bad_designs_are_named_and_stay_in_the_study(tmp_path):
    text = 'design = "factorial"\nseeds = [1, 2]\n[axes]\nsensor.integration_time_ms = [0.085, 50, 90]\n'
    found = plan(tmp_path, text)
    (note,) = design_notes(found)
    assert note.startswith("bad in 2 of 3 designs, which are simulated nevertheless: white paint")
    assert len(found.cases) == 6
