"""A case from a data sheet: a camera of 3.45 µm is neither blurred over ten elements nor filled to 2 %."""

import re
import sys
import tomllib

import numpy as np
import pytest

from glintrack.case.data_sheet import assumptions, case_text
from glintrack.case.design import Case
from glintrack.case.quantities import light_quantities
from glintrack.cli import app
from glintrack.core.designs import keys_of
from glintrack.sensor.sensor import build_sensor
from glintrack.sensor.wavefront import modulation_transfer

CAMERA = {
    "columns": 2048,
    "rows": 2048,
    "pitch_um": 3.45,
    "focal_length_mm": 100.0,
    "altitude_m": 2000.0,
    "off_nadir_deg": 30.0,
    "rate_hz": 5.0,
}
OPTIONS = "--pixels 2048x2048 --pitch 3.45 --focal-length 100 --altitude 2000 --off-nadir 30 --rate 5".split()


FLIGHT_KEYS = ("altitude_m", "off_nadir_deg", "rate_hz")
SENSOR_KEYS = ("columns", "rows", "pitch_um", "focal_length_mm", "f_number")


def case_of(**changes):
    of = {**CAMERA, **changes}
    flight, camera = ({key: of.pop(key) for key in keys if key in of} for keys in (FLIGHT_KEYS, SENSOR_KEYS))
    text = case_text("mine", flight, camera, **of)
    return text, Case.model_validate({"name": "mine", **tomllib.loads(text)})


@pytest.mark.parametrize("polarizers", ["none", "superpixel", "2x2"])
def test_a_camera_is_sharp_and_well_exposed(polarizers):
    _, case = case_of(polarizers=polarizers)
    sensor = case.sensor
    assert 2.355 * sensor.spot_sigma_um < 2 * sensor.pitch_um  # full width at half maximum
    assert 0.3 < light_quantities(case)["well_fill"] < 0.9
    half_nyquist_per_mm = np.array([250 / sensor.pitch_um])
    assert modulation_transfer(sensor, 0.7, half_nyquist_per_mm)[0] > 0.2
    assert case.flight.frames == 100 and sensor.oversampling == 1
    small = sensor.replace({"rows": 32, "columns": 32})
    assert build_sensor(small, case.atmosphere.wavelength_um).design.has_stokes == (polarizers != "none")


@pytest.mark.parametrize("filters", ["rgb", "four-bands"])
def test_a_colour_camera_is_well_exposed_and_tracks_all_its_elements(filters):
    _, case = case_of(filters=filters)
    assert case.channels == ("pan",) and case.sensor.layout == filters
    assert 0.2 < light_quantities(case)["well_fill"] < 0.9
    plain = case_of()[1].sensor
    assert case.sensor.integration_time_ms > 1.5 * plain.integration_time_ms  # filters absorb


def test_a_slow_camera_ends_with_the_recorded_traffic():
    _, case = case_of(rate_hz=0.2)
    assert (
        (case.flight.frames - 1) / case.flight.rate_hz <= 120 < case.flight.frames / case.flight.rate_hz + 5
    )


def test_the_paper_from_its_figures_is_the_default():
    """880 × 560 elements of 17 µm behind 68 mm: the values of the default, but for the silicon's curve."""
    _, case = case_of(
        columns=880, rows=560, pitch_um=17.0, focal_length_mm=68.0, altitude_m=1928.0, off_nadir_deg=50.0,
        rate_hz=2.0, polarizers="superpixel",
    )  # fmt: skip
    assert case.sensor.replace({"quantum_efficiency": 0.6, "max_frame_rate_hz": 10.0}) == Case().sensor


def test_a_detector_and_a_lens_of_the_catalogue():
    none = dict.fromkeys(("columns", "rows", "pitch_um", "focal_length_mm"))
    text, case = case_of(detector="imx250mzr", lens="ef-100", **none)
    sensor = case.sensor
    assert (sensor.columns, sensor.rows, sensor.pitch_um, sensor.focal_length_mm) == (2464, 2056, 3.45, 100)
    assert sensor.layout == "0-45-90-135" and sensor.full_well_e == 10_500 and sensor.bits == 12
    assert "Balluff" in text and "assumed" in text


def test_the_file_says_what_is_assumed_and_which_key_changes_it():
    text, case = case_of()
    for words in ("43.16", "2010-07-15", "sun 50° high", "azimuth 251°", "0.4 to 1 µm", "polarizers: none"):
        assert words in text, words
    keys = {key.name for _, keys in keys_of(Case) for key in keys}
    for line in assumptions(case):
        assert keys.issuperset(set(re.findall(r"`([^`]+)`", line)) - {"--polarizers"}), line
    assert "straight down" in case_of(off_nadir_deg=0.0)[0]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pitch_um": None}, "`--pitch` must be given, or --sensor with a name of `glintrack sensor list`"),
        ({"focal_length_mm": None}, "`--focal-length` must be given, or --lens with a name"),
        (
            {"lens": "pi-6", "focal_length_mm": None},
            "`--lens` must have an image circle of the array's 9.99 mm at least; got 8 mm",
        ),
        (
            {"lens": "ef-100", "focal_length_mm": None, "f_number": 1.4},
            "`--f-number` must be at least the lens's 2; got 1.4",
        ),
        ({"detector": "imx250mzr"}, "`--sensor` must be given without --pixels; got both"),
        (
            {"detector": "imx250mzr", "polarizers": "none"},
            "`--polarizers` must be left out: imx250mzr has its own; got none",
        ),
        ({"polarizers": "2x2", "filters": "rgb"}, "`--filters` must be left out with polarizers"),
        ({"detector": "imx253mzr", "rate_hz": 60.0}, "`--rate` must be at most the array's 15 Hz; got 60"),
        ({"rows": 2047, "polarizers": "2x2"}, "`sensor.rows` must be even"),
        ({"altitude_m": 12000.0}, "`flight.altitude_m` must be at most the highest of"),
    ],
)
def test_contradictions_are_refused_in_a_sentence(changes, message):
    with pytest.raises(ValueError, match=message):
        case_of(**changes)


def test_units_that_may_be_wrong_are_pointed_out():
    """500 km and 6.07 m, taken for m and mm, see the same ground in a field of 60°."""
    text, _ = case_of(altitude_m=500.0, focal_length_mm=6.07)
    assert "Check the units: a field of view of 60°" in text and "focal length 6.07 in mm" in text
    assert "Check the units" not in case_of()[0]


def test_the_command_writes_a_case_that_check_takes(tmp_path, monkeypatch, capsys):
    def glintrack(*words):
        monkeypatch.setattr(sys, "argv", ["glintrack", *map(str, words)])
        with pytest.raises(SystemExit) as stop:
            app.main()
        return stop.value.code or 0, capsys.readouterr()

    file = tmp_path / "mycam.toml"
    code, printed = glintrack("case", "new", file, *OPTIONS)
    assert not code and "sun 50° high (`atmosphere.date`, `atmosphere.local_time_h`)" in printed.out
    code, printed = glintrack("case", "check", file)
    assert not code and "derived: sensor.full_well_e = 11,000 e" in printed.out
    assert "SUMO is not needed" in printed.out and "the loss budget takes" in printed.out
    conclusion = printed.out.splitlines()[-1]
    assert conclusion.startswith(
        "conclusion: doubtful. No quantity of the design limits tracking. Frame rate"
    )
    assert "100 frames at 5 Hz" in printed.out
    assert "7 frames at 5 Hz" in glintrack("case", "check", file, "--frames", 7)[1].out
    assert re.findall(r"NIIRS [\d.]+", printed.out) == re.findall(
        r"in the case mycam: (NIIRS [\d.]+)", glintrack("sensor", "show", file)[1].out
    )
    slow = tmp_path / "slow.toml"
    assert not glintrack("case", "new", slow, *OPTIONS[:-1], "0.5")[0]
    for words in ((), ("--json",)):  # a bad quantity is an exit code, for scripts
        assert glintrack("case", "check", slow, *words)[0] == 1
    before = file.read_text()
    code, printed = glintrack("case", "new", file, *OPTIONS)
    assert code == 2 and "`file` must not exist yet" in printed.err and file.read_text() == before
    for wrong in (["--pixels", "2048"], ["--rate", "inf"], ["--rate", "nan"]):
        code, printed = glintrack("case", "new", tmp_path / "other.toml", *OPTIONS, *wrong)
        assert code == 2 and f"`{wrong[0]}` must be" in printed.err
    assert not (tmp_path / "other.toml").exists()
    printed = glintrack("case", "new", tmp_path / "other.toml", *OPTIONS, "--off-nadir", "0.52")[1]
    assert "note: `--off-nadir` is in degrees: 0.52° is nearly straight down (0.52 rad would be 29.8°)" in (
        printed.out
    )
