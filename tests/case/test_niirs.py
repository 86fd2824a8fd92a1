"""GIQE-5 against pyBSM, edge responses against closed forms, and the figures of the statement on tracking."""

import csv
import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from glintrack.case.design import Case
from glintrack.case.niirs import (
    describe_niirs,
    giqe5,
    image_quality,
    relative_edge_response,
)
from glintrack.case.packaged import find_case
from glintrack.case.quantities import ground_light
from glintrack.io.toml import read_toml
from glintrack.sensor import OpticsDesign, modulation_transfer
from glintrack.study.design import flat

# GSD [m], edge responses, SNR, elevation [°], NIIRS of `pybsm.metrics.functional.giqe5`, pyBSM 0.16.1; the
# first is the example of the NGA's report: 20.8 inches, NIIRS 5
PYBSM = [
    (0.52832, 0.35, 0.35, 50, 90, 5.015165),
    (0.1, 0.9, 0.9, 3, 90, 6.922764),
    (0.1, 0.6, 0.5, 20, 40, 7.250733),
    (0.1, 0.2, 0.3, 80, 40, 7.026236),
    (0.5, 0.9, 0.9, 80, 90, 5.247393),
    (0.5, 0.6, 0.5, 3, 40, 4.074990),
    (0.5, 0.2, 0.3, 20, 90, 4.654704),
    (1.5, 0.9, 0.9, 20, 40, 3.426345),
    (1.5, 0.6, 0.5, 80, 90, 3.634147),
    (1.5, 0.2, 0.3, 3, 40, 1.596664),
]
PYBSM_EDGES = {
    1.0: 0.5997904,
    1.5: 0.4747194,
    2.0: 0.3827066,
}  # Q, relative_edge_response of lens and element
SAMPLED = 2e-3  # of an edge response: steps of the pupil's autocorrelation
DOCS = Path(__file__).parents[2] / "docs"


@pytest.mark.parametrize(("gsd_m", "one", "other", "snr", "elevation_deg", "niirs"), PYBSM)
def test_it_equals_pybsm(gsd_m, one, other, snr, elevation_deg, niirs):
    elevation_rad = math.radians(elevation_deg)
    assert giqe5(gsd_m, (one, other), snr, elevation_rad) == pytest.approx(niirs, abs=1e-6)
    assert giqe5(gsd_m, (other, one), snr, elevation_rad) == pytest.approx(niirs, abs=1e-6)
    # by definition, half the sample distance is one more
    assert giqe5(gsd_m / 2, (one, other), snr, elevation_rad) == pytest.approx(niirs + 1, abs=1e-3)


@pytest.mark.parametrize("sigma", [0.3, 0.5, 1.0])
def test_the_edge_response_of_a_gaussian_is_an_error_function(sigma):
    frequency = np.arange(0, 6, 1e-3)
    transfer = np.exp(-2 * (np.pi * sigma * frequency) ** 2)
    expected = math.erf(0.5 / (sigma * math.sqrt(2)))
    assert relative_edge_response(frequency, transfer) == pytest.approx(expected, abs=1e-6)


def test_a_square_element_alone_sees_the_whole_edge():
    frequency = np.arange(0, 400, 1e-3)
    assert relative_edge_response(frequency, np.sinc(frequency)) == pytest.approx(1, abs=1e-3)


@pytest.mark.parametrize(("q", "expected"), PYBSM_EDGES.items())
def test_the_edge_response_of_a_perfect_lens_is_pybsms(q, expected):
    design = Case().sensor.model_copy(update={"spot_sigma_um": 0.0, "optics": OpticsDesign()})
    pitch_um = 0.55 * design.f_number / q
    frequency = np.arange(0, 1 / q, 1e-3)
    lens = modulation_transfer(design, 0.55, 1e3 * frequency / pitch_um, element=False)
    found = relative_edge_response(frequency, lens * np.sinc(frequency))
    assert found == pytest.approx(expected, abs=SAMPLED)


def test_the_signal_is_the_electrons_between_15_and_7_percent():
    case = Case()
    light, found = ground_light(case), image_quality(case)
    assert found is not None
    bright_e, dark_e = light.electrons(0.15), light.electrons(0.07)
    noise_e = math.sqrt(bright_e + case.sensor.dark_noise_e**2)
    assert found.snr == pytest.approx((bright_e - dark_e) / noise_e, rel=1e-12)
    longer = image_quality(case.replace({"sensor.integration_time_ms": 4 * case.sensor.integration_time_ms}))
    assert longer is not None and 1.9 < longer.snr / found.snr < 2.2  # most of the noise is shot noise
    assert (longer.gsd_m, longer.edge_response) == (found.gsd_m, found.edge_response)


def test_frame_rate_and_detector_do_not_change_it():
    case = Case()
    faster = case.replace({"sensor.max_frame_rate_hz": 30.0, "flight.rate_hz": 10.0})
    other = case.replace({"track.detect.detector": "median-motion"})
    assert image_quality(case) == image_quality(faster) == image_quality(other)


def test_it_says_where_the_equation_is_extrapolated():
    assert "Q = 0.23, outside the fitted 1 to 2" in describe_niirs(Case())
    sharp = Case().replace({"sensor.pitch_um": 2.0, "flight.rate_hz": 1.0})
    assert "fitted" not in describe_niirs(sharp)
    blurred = describe_niirs(Case().replace({"sensor.optics.defocus_um": 5000.0}))
    assert blurred.startswith("NIIRS below 0 ")
    assert describe_niirs(Case().replace({"sensor.focal_length_mm": 3000.0})).startswith("NIIRS above 9 ")


def test_the_statement_on_tracking_is_what_the_studies_recorded():
    table = read_toml(find_case("table1", "study"), "study")
    base = Case.from_toml(find_case(table["case"])).replace(flat(table["base"]))
    designs = [base.replace({"sensor.pitch_um": pitch}) for pitch in (17, 10.8, 8.5)]
    rated = [found.niirs for design in designs if (found := image_quality(design))]
    steps = [f"{after - before:.2f}" for before, after in pairwise(rated)]
    effects = recorded("table1") | recorded("traffic")
    fine, finer = effects["10.8 µm against 17 µm"], effects["8.5 µm against 17 µm"]
    faster = effects["2 Hz against 1 Hz"]
    expected = [steps[0], f"+{fine:.2f}", steps[1], f"+{finer - fine:.2f}", f"{faster:+.2f}"]
    page = (DOCS / "guide/case.md").read_text(encoding="utf-8")
    (statement,) = re.findall(
        r"NIIRS rates one picture and does not predict tracking\.[^.]*(?:.*\n)+?\n", page
    )
    assert re.findall(r"[+−]?\d\.\d\d", statement) == [one.replace("-", "−") for one in expected]


def recorded(study):
    """Return the effects on the completeness of visible vehicles in pan, by level."""
    with (DOCS / f"findings/{study}_effects.csv").open(encoding="utf-8") as file:
        return {
            row["level"]: float(row["effect"])
            for row in csv.DictReader(file)
            if row["channel"] == "pan" and row["response"] == "completeness_visible"
        }
