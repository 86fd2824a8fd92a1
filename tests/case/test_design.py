"""Cases: what a TOML file may say, and what a wrong one is told."""

import pytest

from glintrack import Case
from glintrack.atmosphere import AtmosphereDesign
from glintrack.case.packaged import find_case
from glintrack.core.designs import validate_design
from glintrack.core.spectral import wavelength_grid
from glintrack.io.toml import to_toml
from glintrack.sensor import build_sensor


def read(tmp_path, text):
    path = tmp_path / "case.toml"
    path.write_text(text, encoding="utf-8")
    return Case.from_toml(path)


def test_an_empty_file_is_the_default_case(tmp_path):
    assert read(tmp_path, "") == Case()


def test_a_written_case_reads_back_the_same(tmp_path):
    case = read(tmp_path, 'name = "a \'quoted\' name"\nchannels = ["dolp"]\n[flight]\noff_nadir_deg = 20.0\n')
    assert read(tmp_path, to_toml(case)) == case


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("[flight]\naltitud_m = 3000", "`flight.altitud_m` must be a known key.*Did you mean `altitude_m`"),
        ("sede = 3", "`sede` must be a known key.*Did you mean `seed`"),
        ("sensor = 3", "`sensor` must be a table; got 3"),
        ("channels = []", r"`channels` must be a list of at least 1 item; got \[\]"),
        ("[sensor]\nband_um = [0.6, 0.5]", "`sensor.band_um` must rise within 0.4 to 2.5 µm; got 0.6 to 0.5"),
        (
            "[atmosphere]\ncloud_optical_depth = 20\ncloud_base_m = 1000",
            "`flight.altitude_m` must be at most atmosphere.cloud_base_m, 1000; got 1928",
        ),
        ("[flight]\naltitude_m = -5", "`flight.altitude_m` must be greater than or equal to 200 m; got -5 m"),
        (
            '[flight]\naltitude_m = "3 km"',
            "`flight.altitude_m` must be a number in m; got '3 km'",
        ),
        (
            '[scene]\ncity = "atlantis"',
            "`scene.city` must be 'embedded', 'braunschweig', 'net', 'osm' or 'mesh'; got 'atlantis'",
        ),
        ("[sensor]\nrows = 561", "`sensor.rows` must be even"),
        ("[sensor]\nband_um = [0.3, 1.0]", "must rise within 0.4 to 2.5 µm; got 0.3 to 1.0"),
        ('channels = ["pan", "pan"]', "`channels` must name each at most once"),
        ("seed = [", "`case` must be valid TOML"),
    ],
)
def test_wrong_cases_get_one_sentence(tmp_path, text, sentence):
    with pytest.raises(ValueError, match=sentence) as error:
        read(tmp_path, text)
    assert "\n" not in str(error.value)


def test_a_case_begins_from_the_packaged_one_that_it_is_like(tmp_path):
    case = read(tmp_path, 'like = "quickstart"\n[sensor]\nrows = 280\n')
    own = {"name": "case", "sensor.rows": 280}
    assert case == Case.from_toml(find_case("quickstart")).replace(own)
    assert case.sensor.polarizer == "grid_b"  # which is not the default


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ('like = "quick"', "`like` must name a packaged case .arterial, braunschweig, .*; got 'quick'"),
        ('like = "table1"', "`like` must name a packaged case"),
        ("like = 3", "`like` must name a packaged case"),
        ('base = "quickstart"', "`base` must not be in a case .`like` names its base."),
    ],
)
def test_what_a_case_is_like_must_be_packaged(tmp_path, text, sentence):
    with pytest.raises(ValueError, match=sentence):
        read(tmp_path, text)


def test_files_of_a_scene_are_meant_from_where_the_case_lies(tmp_path):
    text = '[scene]\ncity = "net"\nnet_file = "a.net.xml"\npolygons_file = "sumo:tools/b.poly.xml"\n'
    panel = '[[scene.panels]]\nmaterial = "panel_20"\neast_m = 3.5\nnorth_m = -2.0\n'
    case = read(tmp_path, text + panel)
    assert case.scene.net_file == str(tmp_path / "a.net.xml")
    assert case.scene.polygons_file == "sumo:tools/b.poly.xml"
    assert read(tmp_path, to_toml(case)) == case


def test_a_missing_or_binary_file_is_named(tmp_path):
    with pytest.raises(ValueError, match=r"`case` must be a readable file; got .*nowhere.toml"):
        Case.from_toml(tmp_path / "nowhere.toml")
    binary = tmp_path / "binary.toml"
    binary.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(ValueError, match="`case` must be UTF-8 text"):
        Case.from_toml(binary)


def test_a_part_alone_is_told_its_own_key(tmp_path):
    with pytest.raises(ValueError, match=r"^`aerosol` must be 'none', 'clear', 'maritime' or 'urban'"):
        validate_design(AtmosphereDesign, {"aerosol": "smog"})
    with pytest.raises(ValueError, match=r"^`atmosphere.aerosol` must be 'none'"):
        read(tmp_path, '[atmosphere]\naerosol = "smog"')


def test_two_exposures_must_fit_into_a_frame(tmp_path):
    """90 ms for pan and 5 ms for mirrors and spectra each: one after the other they take 100 ms."""
    text = "[sensor]\nmax_frame_rate_hz = 10\nintegration_time_ms = 90\n"
    text += 'spectrometer_integration_time_ms = {}\nmirror_settling_ms = 5\n[track.query]\nat = "{}"\n'
    assert read(tmp_path, text.format(5, "detection")).track.query.at == "detection"
    assert read(tmp_path, text.format(6, "prediction")).track.query.at == "prediction"
    with pytest.raises(ValueError, match=r"`track.query.at` must be 'prediction' .* 100 ms .* got 101 ms"):
        read(tmp_path, text.format(6, "detection"))


def test_a_change_puts_right_what_the_file_has_wrong(tmp_path):
    path = tmp_path / "wrong.toml"
    path.write_text("[sensor]\npitch_um = -3\nquantum_efficiency = 'own.csv'\n")
    with pytest.raises(ValueError, match=r"`sensor.pitch_um` must be .*; got -3"):
        Case.from_toml(path)
    case = Case.from_toml(path, changes={"sensor.pitch_um": 8.5})
    assert case.sensor.pitch_um == 8.5
    assert case.sensor.quantum_efficiency == str(tmp_path / "own.csv")
    with pytest.raises(ValueError, match=r"`sensor.rows` must be"):
        Case.from_toml(path, changes={"sensor.pitch_um": 8.5, "sensor.rows": -1})


def test_files_of_changes_lie_anywhere_and_those_of_the_case_do_not(tmp_path):
    path = tmp_path / "case.toml"
    path.write_text("[sensor]\nquantum_efficiency = '/elsewhere/own.csv'\n")
    with pytest.raises(
        ValueError, match=r"`sensor.quantum_efficiency` must name a file in the case's folder"
    ):
        Case.from_toml(path)
    changes = {"sensor.quantum_efficiency": "here.csv"}
    assert Case.from_toml(path, changes=changes).sensor.quantum_efficiency == "here.csv"
    with pytest.raises(
        ValueError, match=r"`sensor.quantum_efficiency` must name a file in the case's folder"
    ):
        Case.from_toml(path, changes={"sensor.pitch_um": 8.5})


def test_a_sensor_without_mirrors_has_no_spectrometer_to_check(tmp_path):
    path = tmp_path / "swir.toml"
    atmosphere = f"[atmosphere]\nwavelengths_um = {wavelength_grid(0.95, 1.7).tolist()}\n"
    sensor = "[sensor]\nlayout = 'pan'\nband_um = [1.0, 1.7]\n"
    path.write_text(f"channels = ['pan']\n{atmosphere}{sensor}")
    case = Case.from_toml(path)
    made = build_sensor(case.sensor, case.atmosphere.wavelength_um)
    assert made.wavelength_um[0] == 0.95
    path.write_text(f"{atmosphere}[sensor]\nband_um = [1.0, 1.7]\n")
    with pytest.raises(ValueError, match=r"`sensor.spectrometer_um` must lie within .*wavelength_stop_um"):
        Case.from_toml(path)


def test_a_packaged_case_is_read_by_its_name():
    assert Case.from_name("quickstart") == Case.from_toml(find_case("quickstart"))
    with pytest.raises(ValueError, match=r"`name` must be a packaged case \(arterial, .*\); got 'table1'"):
        Case.from_name("table1")


@pytest.mark.parametrize(
    ("changes", "key", "remedy"),
    [
        ({"flight.gimbal_depression_deg": 40.0}, "flight.gimbal_depression_deg", "gimbal = 'fixed' uses it"),
        ({"flight.course_deg": 10.0}, "flight.course_deg", "kind = 'straight' uses it"),
        ({"flight.leg_m": 100.0}, "flight.leg_m", "kind = 'racetrack' uses it"),
        ({"flight.waypoint_datum_m": 50.0}, "flight.waypoint_datum_m", "kind = 'waypoints' uses it"),
        (
            {"sensor.polarizer_extinction_ratio": 300.0},
            "sensor.polarizer_extinction_ratio",
            "polarizer = 'constant' uses it",
        ),
        (
            {"sensor.auto_exposure.longest_ms": 2.0},
            "sensor.auto_exposure.longest_ms",
            "Another value of auto_exposure.quantile uses it",
        ),
        ({"track.motion.braking_m_s2": 1.0}, "track.motion.braking_m_s2", "motion.model = 'imm' uses it"),
        ({"track.association.scans": 2}, "track.association.scans", "association.method = 'mht' uses it"),
    ],
)
def test_a_key_that_the_other_keys_ignore_is_refused(changes, key, remedy):
    with pytest.raises(ValueError, match=rf"`{key}` must be left out with .*, which ignores it.*{remedy}"):
        Case().replace(changes)


def test_a_ready_camera_takes_another_polarizer():
    other = Case().replace({"sensor.ready": "imx250mzr", "sensor.polarizer": "ideal"}).sensor
    assert other.polarizer == "ideal" and other.polarizer_transmittance == 1.0
