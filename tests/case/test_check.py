"""What a case amounts to before it is simulated, judged by the table of limits; nonsense is refused."""

import math

import pytest

from glintrack.case.advice import conclude
from glintrack.case.check import assess_case
from glintrack.case.design import Case
from glintrack.case.packaged import find_case, list_cases
from glintrack.case.quantities import CITY_SPEED_M_S
from glintrack.core.designs import keys_of, validate_design
from glintrack.core.units import format_number
from glintrack.io.toml import read_toml
from glintrack.track.calibration import calibration_file


def judged(case, *groups, **options):
    """Judgements of a case by name."""
    return {one.name: one for one in assess_case(case, groups or ("view", "sensor", "motion"), **options)}


def bad_reasons(case):
    return [one.reason for one in assess_case(case) if one.answer == "bad"]


def case_of(flight, **sensor):
    """Case without polarizers, in the table that `glintrack case new` writes."""
    rate = {"max_frame_rate_hz": flight["rate_hz"], "layout": "pan"}
    return validate_design(
        Case, {"channels": ["pan"], "flight": flight, "sensor": rate | sensor | {"oversampling": 1}}
    )


DRONE = case_of(
    {"altitude_m": 300.0, "off_nadir_deg": 0.0, "rate_hz": 30.0, "frames": 301},
    columns=3840,
    rows=2160,
    pitch_um=2.4,
    focal_length_mm=35.0,
)
SATELLITE = case_of(
    {
        "altitude_m": 1e4,
        "off_nadir_deg": 0.0,
        "rate_hz": 1.0,
        "kind": "straight",
        "speed_m_s": 141.0,
        "frames": 80,
    },
    columns=1280,
    rows=1080,
    pitch_um=8.5,
    focal_length_mm=121.0,
)


@pytest.mark.parametrize("name", list_cases())
def test_packaged_cases_are_not_bad(name):
    """On the motorway vehicles drive at 36 m/s, which is doubtful."""
    fastest_m_s = 36.0 if name == "motorway" else CITY_SPEED_M_S
    found = judged(Case.from_toml(find_case(name)), fastest_m_s=fastest_m_s).values()
    fast = {"speed_share", "displacement_share"} if name == "motorway" else set()
    assert {one.name for one in found if one.rank} == fast
    assert not any(one.answer == "bad" for one in found)


def test_every_limit_is_of_a_quantity_and_says_why():
    limits = read_toml(calibration_file("design_limits"), "limits")
    assert {one.name for one in assess_case(Case())} == set(limits)
    keys = {key.name for _, keys in keys_of(Case) for key in keys}
    for name, of in limits.items():
        assert of["source"], name
        if "good" in of:  # else it is that of a calibration
            (low, high), (least, most) = of["good"], of["usable"]
            assert least <= low <= high <= most, name
            assert ("low" in of) == (low > 0) and ("high" in of) == (high < math.inf), name
        for key in of.get("low_keys", []) + of.get("high_keys", []):
            assert key[0] in "+-" and key[1:] in keys, (name, key)


def test_a_camera_for_17_um_on_3_um_elements_is_bad():
    """The lens's spot of a 17 µm element and its exposure, on elements of 3.45 µm."""
    sensor = {"pitch_um": 3.45, "spot_sigma_um": 12.0, "full_well_e": 267e3, "integration_time_ms": 0.085}
    found = judged(validate_design(Case, {"sensor": sensor}))
    assert found["blur_elements"].answer == "bad" and found["blur_elements"].text == "8.69 elements"
    assert found["well_fill"].answer == "bad"
    assert "raise `sensor.integration_time_ms`" in found["well_fill"].reason
    assert found["mtf_nyquist"].answer == "doubtful"


def test_the_well_fills_with_time():
    found = [
        judged(Case().replace({"sensor.integration_time_ms": ms}), "sensor")["well_fill"]
        for ms in (0.085, 0.17, 0.34, 60.0)
    ]
    assert [one.answer for one in found] == ["good", "good", "doubtful", "bad"]
    assert found[1].value == pytest.approx(2 * found[0].value)
    assert "fills the well 332 times over: lower" in found[3].reason


def test_automatic_exposure_fills_the_well_to_its_target_where_its_limit_allows():
    for longest_ms, fill in ((1.0, 0.8), (0.1, None)):
        automatic = {"sensor.auto_exposure": {"quantile": 0.999, "longest_ms": longest_ms}}
        found = judged(Case().replace(automatic), "sensor")["well_fill"].value
        fixed = judged(Case().replace({"sensor.integration_time_ms": longest_ms}), "sensor")[
            "well_fill"
        ].value
        assert found == pytest.approx(fill or fixed)


def test_a_fixed_gimbal_passes_over_the_ground():
    """The footprint of 270 m along the path passes a place in 3.4 s at 80 m/s, too little to learn it."""
    passing = {"flight.kind": "straight", "flight.gimbal": "fixed", "flight.off_nadir_deg": 0.0}
    found = judged(Case().replace(passing), "motion")
    assert found["ground_dwell_s"].answer == "bad"
    assert found["ground_dwell_s"].value == pytest.approx(560 * 17e-6 / 68e-3 * 1928 / 80, rel=1e-3)
    assert judged(Case(), "motion")["ground_dwell_s"].text == "no limit"


def test_fast_and_sparse_traffic_is_held_against_the_tracker():
    city, motorway = (judged(Case(), "motion", fastest_m_s=speed) for speed in (13.9, 45.0))
    assert city["speed_share"].answer == "good" and motorway["speed_share"].answer == "bad"
    assert city["displacement_share"].answer == "good" and motorway["displacement_share"].answer == "doubtful"
    assert "raise `track.detect.max_speed_m_s`" in motorway["speed_share"].reason
    once_in_two_seconds = judged(Case().replace({"flight.rate_hz": 0.5}), "motion")
    assert once_in_two_seconds["displacement_share"].answer == "bad"


def test_a_fixed_gimbal_sets_the_angle():
    """Depressed by 5°, the line of sight is 85° off nadir whatever `flight.off_nadir_deg` is."""
    up = {"flight.gimbal": "fixed", "flight.gimbal_depression_deg": 5.0, "flight.kind": "straight"}
    found = judged(Case().replace(up), "view")
    ratio = found["gsd_along_m"].value / found["gsd_across_m"].value
    assert found["gsd_along_m"].answer == "bad" and ratio == pytest.approx(1 / math.cos(math.radians(85)))


def test_a_short_flight_is_doubtful_and_never_refused():
    short = Case().replace({"flight.frames": 3})
    assert judged(short)["duration_s"].answer == "doubtful" and not bad_reasons(short)


def test_a_look_beside_the_window_is_bad():
    assert judged(Case(), "view")["beyond_window"].value == 0
    aside = Case().replace({"flight.stare_east_m": 5000.0})
    (reason,) = bad_reasons(aside)
    assert "beyond the window" in reason


def test_a_run_too_large_for_the_machine_is_bad(monkeypatch):
    monkeypatch.setattr("glintrack.case.quantities.machine_memory_bytes", lambda: 2e9)
    monkeypatch.setattr("os.cpu_count", lambda: 1)
    long = Case().replace({"flight.frames": 100_000})
    found = judged(long, "cost")
    assert found["run_s"].answer == "bad" and found["memory_share"].answer == "bad"


def test_a_judgement_is_a_record_without_infinite_numbers():
    records = {one["name"]: one for one in (one.record() for one in assess_case(Case(), ("motion",)))}
    assert records["ground_dwell_s"]["value"] is None and records["ground_dwell_s"]["text"] == "no limit"
    assert records["overlap"]["answer"] == "good" and records["overlap"]["reason"] == ""


def test_jitter_that_is_not_stated_is_not_judged():
    row = judged(Case(), "motion")["platform_blur_elements"]
    assert row.answer == "not stated" and "`flight.jitter_rms_urad`" in row.reason
    found = [judged(Case().replace({"flight.jitter_rms_urad": rms}), "motion") for rms in (0.0, 1e4)]
    assert [one["platform_blur_elements"].answer for one in found] == ["good", "doubtful"]


def test_a_footprint_has_no_share_of_itself():
    assert "footprint_share" not in judged(DRONE, "view")
    assert judged(DRONE.replace({"scene.area": "window"}), "view")["footprint_share"].answer == "doubtful"


def test_the_worst_view_of_a_straight_flight_counts():
    """After 79 s at 141 m/s a nadir view from 10 km is 48.1° off nadir."""
    found, first = (
        judged(SATELLITE, "view", "motion"),
        judged(SATELLITE.replace({"flight.frames": 1}), "view"),
    )
    ratio = math.cos(math.atan(141 * 79 / 1e4))
    along, across = found["gsd_along_m"], found["gsd_across_m"]
    assert along.view == across.view == "last" and along.answer == "doubtful"
    assert along.value == pytest.approx(first["gsd_along_m"].value / ratio**2, rel=1e-6)
    assert across.value == pytest.approx(first["gsd_across_m"].value / ratio, rel=1e-6)
    assert found["footprint_across_m"].view == "first" and found["displacement_share"].view == ""
    assert all(one.view == "" for one in assess_case(Case()))


def test_the_advice_for_a_drone_is_to_fly_higher_and_contradicts_nothing():
    """A footprint of 79 m × 44 m: what is advised makes all of it good, and asks for nothing back."""
    found = assess_case(DRONE)
    text = conclude(DRONE, found)
    assert "limited by footprint across, footprint along, time of a fast car in view" in text
    assert "Change `flight.altitude_m` from 300 to 960 m" in text
    asked = {key for one in found for key in one.keys}
    assert not {key for key in asked if "+-".replace(key[0], "") + key[1:] in asked}
    higher = DRONE.replace({"flight.altitude_m": 960.0})
    assert not any(one.rank for one in assess_case(higher, ("view", "sensor", "motion")))


def test_a_conclusion_names_rows_that_no_key_mends():
    tiny = case_of(
        {"altitude_m": 3000.0, "off_nadir_deg": 0.0, "rate_hz": 2.0, "stare_east_m": 5000.0},
        columns=600, rows=600, pitch_um=17.0, focal_length_mm=68.0,
    )  # fmt: skip
    text = conclude(tiny, assess_case(tiny))
    assert "limited by stare point beyond window. No change of one key makes" in text
    good = assess_case(Case())
    assert conclude(Case(), good) == "No quantity of the design limits tracking"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (1105.4, "1,110"),
        (0.07967, "0.0797"),
        (999.6, "1,000"),
        (99.9999, "100"),
        (1.2e7, "12,000,000"),
        (0, "0"),
        (1e-9, "0"),
    ],
)
def test_numbers_are_for_people(value, text):
    assert format_number(value) == text


def test_a_satellite_is_outside_the_range_and_told_what_to_do():
    """The ground track of a circular orbit at 500 km passes 7.06 km in a second."""
    message = r"Orbits are outside .*focal_length_mm` × 0.02, `flight.kind` = .straight. and .* = 141 "
    with pytest.raises(ValueError, match=message):
        validate_design(Case, {"flight": {"altitude_m": 500e3}})


@pytest.mark.parametrize(("altitude_m", "units"), [(120.0, False), (2.0, True)])
def test_a_low_flight_is_told_how_to_approximate_it(altitude_m, units):
    with pytest.raises(ValueError, match=rf"focal_length_mm` × {200 / altitude_m:.3g} ") as error:
        validate_design(Case, {"flight": {"altitude_m": altitude_m}})
    assert ("If it is in km" in str(error.value)) == units


def test_a_field_of_a_hemisphere_is_refused():
    with pytest.raises(ValueError, match="must give a field of view of at most 120°"):
        validate_design(Case, {"sensor": {"focal_length_mm": 0.068}})


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
