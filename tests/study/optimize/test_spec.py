"""The file of an optimization: bad input is one sentence, and candidates cost what the table says."""

import numpy as np
import pytest

from glintrack.study.optimize import read_optimization
from tests.study.optimize.cameras import SPEC, write_spec

PITCH, RATE = "sensor.pitch_um = { from = 8, to = 17 }", "flight.rate_hz = { from = 1, to = 4 }"
REQUIRE = 'require = ["custody >= 0.6", "false_per_km2 <= 20"]'


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        (REQUIRE, 'require = ["custody >= 1.6"]', "`require` must give a share from 0 to 1 for custody"),
        (REQUIRE, 'require = ["false_per_km2 <= -1"]', "`require` must be possible; got false_per_km2 <= -1"),
        (REQUIRE, 'require = ["custody >= 0.6", "custody <= 0.5"]', "which nothing meets"),
        (REQUIRE, 'require = ["custodi >= 0.6"]', "Did you mean `custody`"),
        (REQUIRE, "", "`require`"),
        (REQUIRE, 'require = ["dolp.custody >= 0.6"]', r"must name a channel of the case \(pan\)"),
        (PITCH, "sensor.pitch_um = { from = 8, to = 8 }", "`axes.sensor.pitch_um` must rise"),
        (f"{PITCH}\n{RATE}\n", "", "`axes` must be a table of at least 1 item"),
        (PITCH, "sensor.pitch_um = []", "`axes.sensor.pitch_um` must be a list of values"),
        (
            PITCH,
            "sensor.pich_um = { from = 8, to = 9 }",
            "must be a known key; got an unknown one",
        ),
        (PITCH, 'sensor.ready = ["imx250mzr", "imx9"]', "`sensor.ready` must be one of"),
        (PITCH, 'lens = ["pi-16", "pi-17"]', "`axes.lens` must name lenses .* got 'pi-17'"),
        (
            "[axes]",
            "[cost]\nsensor.rows = nan\n[axes]",
            "must be a finite number; got nan",
        ),
        (
            "[axes]",
            "[cost]\nsensor.rows = inf\n[axes]",
            "must be a finite number; got inf",
        ),
        ("[axes]", "[cost]\nsensor.rows = '2**9'\n[axes]", "must be a finite number; got '2"),
        ("[axes]", "[cost]\nsensor.rowz = 1\n[axes]", "`cost` must name keys .* Did you mean `sensor.rows`"),
        ("[axes]", "[cost]\nsensor.layout = 1\n[axes]", "`cost` must name keys with a number"),
        ("[axes]", "[cost]\nsensor.rows = 1\n[axes]", "`cost` must differ between designs; got 280 for all"),
        ("[axes]", "[cost]\nflight.rate_hz = 1.7e308\n[axes]", "`cost` must be finite for all designs"),
        ("[axes]", "colour = 1\n[axes]", "colour"),
        ("[axes]", "constraints.duration_s = 3\n[axes]", "`constraints.duration_s` must not be given"),
        ("durations_s = [6, 12]", "durations_s = [12, 6]", "`durations_s` must rise"),
        ("durations_s = [6, 12]", "durations_s = [1, 2]", "`durations_s` must end with a longer duration"),
        ("candidates = 64", "candidates = 65", "`candidates` must be a power of two"),
        ("[axes]", "[[conditions]]\nflight.start_s = 3\n[axes]", "`conditions` must each have a `label`"),
    ],
)
def test_bad_input_is_one_sentence(tmp_path, old, new, message):
    text = SPEC.replace(old, new)
    assert text != SPEC
    with pytest.raises(ValueError, match=message) as caught:
        read_optimization(write_spec(tmp_path, text))
    assert "\n" not in str(caught.value) and len(str(caught.value)) < 700


def test_the_default_cost_is_the_data_rate(tmp_path):
    setup = read_optimization(write_spec(tmp_path))
    rates = np.array([levels["flight.rate_hz"] for levels in setup.levels])
    np.testing.assert_allclose(setup.problem.cost, 280 * 440 * 14 * 1e-6 * rates)
    assert setup.problem.places.shape == (64, 2) and setup.problem.places.min() >= 0
    assert [str(one) for one in setup.problem.requirements] == [
        "pan.custody >= 0.6",
        "pan.false_per_km2 <= 20",
    ]


def test_catalogue_rows_conditions_and_prices(tmp_path):
    """Arrays with prices and two lenses at two times: words have no order, and each time has its limits."""
    text = SPEC.replace(
        "[axes]",
        """
[[conditions]]
label = "noon"
atmosphere.date = 2009-07-15
[[conditions]]
label = "part"
flight.start_s = 30
require = ["custody >= 0.4"]
[cost]
flight.rate_hz = 10
[axes]
lens = ["distagon-28", "pi-16"]
array = [
    { label = "small", sensor.columns = 440, cost = 100 },
    { label = "large", sensor.columns = 880, cost = 300 },
]""",
    ).replace(PITCH, "")
    setup = read_optimization(write_spec(tmp_path, text))
    assert {levels["lens"] for levels in setup.levels} == {"distagon-28", "pi-16"}
    keys = dict(zip([levels["lens"] for levels in setup.levels], setup.keys, strict=True))
    assert keys["pi-16"]["sensor.focal_length_mm"] == 16 and keys["pi-16"]["sensor.f_number"] == 1.4
    expected = [
        10 * levels["flight.rate_hz"] + {"small": 100, "large": 300}[levels["array"]]
        for levels in setup.levels
    ]
    np.testing.assert_allclose(setup.problem.cost, expected)
    assert setup.conditions == ("noon", "noon", "part") and setup.problem.runs == 2
    assert setup.problem.places.shape[1] == 5
    assert set(setup.problem.places[:, 0]) == {0.0, 0.7}
