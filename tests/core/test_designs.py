"""Designs: keys replaced by name, and every fault told at once, a sentence each."""

import pytest
from pydantic import ValidationError

from glintrack.case.design import Case
from glintrack.case.packaged import find_case, list_cases, list_studies
from glintrack.core.designs import Design, suggest_name, validate_design
from glintrack.io.toml import read_toml, to_toml, toml_value
from glintrack.sensor import SensorDesign


class Wheel(Design):
    size_m: float = 1.0
    """Diameter."""


class Cart(Design):
    wheel: Wheel = Wheel()
    spare: tuple[Wheel, ...] = ()
    load: float | str = 0.0


def test_a_truth_value_is_no_count():
    with pytest.raises(ValueError, match=r"`flight\.frames` must be a whole number; got True"):
        Case().replace({"flight.frames": True})
    assert Case().replace({"scene.trees": False}).scene.trees == 0  # a share, where it means none


@pytest.mark.parametrize(
    ("key", "text", "said"),
    [
        ("sensor.pitch_um", "8.5", r"a number in µm; got '8\.5'"),
        ("sensor.pitch_um", "8.5 um", r"a number in µm; got '8\.5 um'"),
        ("sensor.rows", "12", "a whole number; got '12'"),
        ("atmosphere.aod_550", "0.1", r"a number; got '0\.1'"),
        ("track.roads.prior", "true", "true or false; got 'true'"),
    ],
)
def test_a_text_is_no_number(key, text, said):
    with pytest.raises(ValueError, match=f"`{key}` must be {said}"):
        Case().replace({key: text})


def test_a_dotted_key_reaches_into_a_table_and_leaves_the_rest():
    case = Case().replace({"flight.frames": 7}).replace({"sensor.pitch_um": 8.5, "seed": 3})
    assert (case.flight.frames, case.sensor.pitch_um, case.seed) == (7, 8.5, 3)
    assert case.replace({"flight.frames": 60, "sensor.pitch_um": 17.0, "seed": 0}) == Case()
    assert Case().replace({}) == Case()


def test_all_faults_are_told_at_once_each_with_its_key_and_the_nearest_one():
    with pytest.raises(ValueError, match="Did you mean `pitch_um`") as caught:
        Case().replace({"sensor.pich_um": 8.5, "flight.frames": 0, "sede": 1, "track.qqq.like": 2})
    lines = str(caught.value).splitlines()
    assert len(lines) == 4
    for key, remedy in (
        ("`sensor.pich_um`", "Did you mean `pitch_um`"),
        ("`sede`", "Did you mean `seed`"),
        ("`flight.frames`", "greater than or equal to 1; got 0"),
        ("`track.qqq`", "Known: "),
    ):
        assert any(line.startswith(key) and remedy in line for line in lines), (key, lines)


def test_what_is_no_table_cannot_be_reached_into():
    with pytest.raises(ValueError, match="`seed` must be a whole number"):
        Case().replace({"seed.low": 3})


def test_a_value_that_fits_none_of_several_types_is_one_fault():
    with pytest.raises(ValueError, match="`load") as caught:
        validate_design(Cart, {"load": [1], "spare": [{"size": 2}]})
    assert str(caught.value).splitlines() == [
        "`spare.0.size` must be a known key; got an unknown one. Did you mean `size_m`?",
        "`load` must be a number; got [1].",
    ]


@pytest.mark.parametrize("value", [float("nan"), float("inf"), -float("inf")])
def test_every_number_is_finite(value):
    with pytest.raises(ValueError, match=r"`wheel.size_m` must be a finite number"):
        Cart().replace({"wheel.size_m": value})


def test_a_design_is_frozen_and_describes_its_fields():
    with pytest.raises(ValidationError, match="frozen"):
        Wheel().size_m = 2.0
    assert Wheel.model_json_schema()["properties"]["size_m"]["description"] == "Diameter."


def test_another_ready_design_replaces_the_first_ones_values():
    from glintrack.sensor import design_names

    first, second, *_ = design_names()
    begun = validate_design(SensorDesign, {"ready": first, "bits": 9})
    assert begun.replace({"ready": second}) == validate_design(SensorDesign, {"ready": second, "bits": 9})


def test_packaged_cases_and_studies_are_listed_and_the_nearest_is_offered():
    assert "quickstart" in list_cases() and "table1" in list_studies()
    assert not set(list_cases()) & set(list_studies())
    for name in list_cases():
        assert Case.from_toml(find_case(name)).name
    with pytest.raises(ValueError, match=r"`case` must be a TOML file .*Did you mean `quickstart`"):
        find_case("quikstart")
    with pytest.raises(ValueError, match=r"`study` must be a TOML file .*Did you mean `standard`"):
        find_case("standrd", "study")


def test_a_study_is_no_case():
    with pytest.raises(ValueError, match=r"got the study table1.*Run `glintrack study table1`"):
        Case.from_toml(find_case("table1"))


@pytest.mark.parametrize(
    ("key", "value", "meant"),
    [
        ("sensor.layout", "plan", "pan"),
        ("ortho.method", "bilinar", "bilinear"),
        ("scene.city", "braunschwieg", "braunschweig"),
        ("sensor.ready", "paperr", "paper"),
    ],
)
def test_the_nearest_choice_is_offered(key, value, meant):
    with pytest.raises(ValueError, match=rf"`{key}` must be .*; got '{value}'\. Did you mean `{meant}`\?$"):
        Case().replace({key: value})


def test_no_choice_is_offered_where_none_is_near():
    with pytest.raises(ValueError, match=r"`ortho.method` must be .*; got 'xyz'\.$"):
        Case().replace({"ortho.method": "xyz"})
    with pytest.raises(ValueError, match=r"`sensor.rows` must be a whole number; got 'ten'\.$"):
        Case().replace({"sensor.rows": "ten"})


@pytest.mark.parametrize(
    ("wrong", "known", "meant"),
    [
        ("yaw_deg", ("heading_deg", "omega_deg"), "heading_deg"),
        ("lat_deg", ("latitude_deg", "azimuth_deg"), "latitude_deg"),
        ("f_numbr", ("f_number", "focal_length_mm"), "f_number"),
    ],
)
def test_words_of_other_programs_are_known(wrong, known, meant):
    assert suggest_name(wrong, known) == f"Did you mean `{meant}`?"


@pytest.mark.parametrize(
    ("wrong", "meant"),
    [
        ("sensor.frame_count", "flight.frames"),
        ("sensor.altitude", "flight.altitude_m"),
        ("flight.pitch_um", "sensor.pitch_um"),
        ("flight.speed", "speed_m_s"),
        ("flight.duration_s", "frames"),
        ("sensor.pich_um", "pitch_um"),
    ],
)
def test_a_key_of_another_table_is_offered_where_its_own_has_none_like_it(wrong, meant):
    with pytest.raises(ValueError, match=f"Did you mean `{meant}`"):
        Case().replace({wrong: 3})


def test_toml_goes_out_and_comes_back_with_its_nested_tables(tmp_path):
    case = Case().replace({"sensor.optics.defocus_um": 3.0, "sensor.optics.zernike_rms_nm": {4: 20.0}})
    path = tmp_path / "case.toml"
    path.write_text(to_toml(case), encoding="utf-8")
    assert Case.from_toml(path) == case
    assert read_toml(path, "case")["sensor"]["optics"]["zernike_rms_nm"] == {"4": 20.0}


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("8.5", 8.5),
        ("true", True),
        ('["pan"]', ["pan"]),
        ('"dolp"', "dolp"),
        ("dolp", "dolp"),
        ("{a = 1}", {"a": 1}),
    ],
)
def test_one_value_is_read_as_toml_and_a_bare_word_as_itself(text, value):
    assert toml_value(text) == value


def test_a_file_nested_too_deeply_is_refused(tmp_path):
    path = tmp_path / "deep.toml"
    path.write_text("a = " + "[" * 100_000, encoding="utf-8")
    with pytest.raises(ValueError, match="`case` must be valid TOML"):
        read_toml(path, "case")
    path.write_text(f"[{'.'.join('a' * 3000)}]\n", encoding="utf-8")
    with pytest.raises(ValueError, match=r"`case` must hold tables at most 64 deep; got .*, nested deeper"):
        read_toml(path, "case")


def test_a_number_of_more_digits_than_python_reads_is_refused(tmp_path):
    path = tmp_path / "long.toml"
    path.write_text(f"a = {'9' * 5000}", encoding="utf-8")
    with pytest.raises(ValueError, match=r"`case` must be valid TOML; got .*: Exceeds the limit"):
        read_toml(path, "case")
    assert toml_value("9" * 5000) == "9" * 5000


def test_a_key_of_thousands_of_parts_is_refused():
    with pytest.raises(
        ValueError, match=r"`a\.a\..*…` must name a key of a table; got one nested too deeply"
    ):
        Case().replace({".".join("a" * 3000): 1})


def test_a_number_with_its_unit_is_told_the_unit_of_its_key():
    with pytest.raises(ValueError, match="a number in µm") as caught:
        Case().replace({"sensor.pitch_um": "8.5um", "sensor.rows": "many"})
    assert str(caught.value).splitlines() == [
        "`sensor.pitch_um` must be a number in µm; got '8.5um'. Write the number without its unit.",
        "`sensor.rows` must be a whole number; got 'many'.",
    ]


def test_a_word_like_none_gets_all_that_are_known():
    assert suggest_name("foo", ["ortho", "track"]) == "Known: ortho, track."


def test_a_decimal_comma_is_recognized(tmp_path):
    with pytest.raises(ValueError, match=r"`sensor.pitch_um` must be a number.* got '3,45'\. Write 3\.45"):
        Case().replace({"sensor.pitch_um": toml_value("3,45")})
    path = tmp_path / "case.toml"
    path.write_text("[sensor]\nf_number = 4\npitch_um = 3,45  # of a data sheet\n")
    with pytest.raises(ValueError, match=r"valid TOML.*line 3.*pitch_um = 3,45\. Write 3\.45"):
        read_toml(path, "case")
