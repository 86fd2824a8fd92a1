"""The catalogue: every figure has a page, and full well and noise follow from EMVA 1288."""

import re

import pytest

from glintrack.sensor import SensorDesign
from glintrack.sensor.catalogue import electrons_of, find_item, read_catalogue
from glintrack.sensor.derivation import ORIGINS, derived_values

DETECTORS, LENSES = read_catalogue("detectors"), read_catalogue("lenses")


@pytest.mark.parametrize("item", [*DETECTORS.values(), *LENSES.values()], ids=lambda item: item.name)
def test_every_figure_names_a_page_or_is_assumed(item):
    assert item.figures.keys() == item.sources.keys()
    assert all(source == "assumed" or re.search(r"https?://", source) for source in item.sources.values())


def test_there_are_enough_and_polarization_cameras_among_them():
    assert len(DETECTORS) >= 10 and len(LENSES) >= 5
    assert {name for name, item in DETECTORS.items() if "polarizers" in item.figures} >= {
        "imx250mzr",
        "imx253mzr",
    }


@pytest.mark.parametrize("item", DETECTORS.values(), ids=lambda item: item.name)
def test_figures_are_those_of_a_sensor(item):
    keys = {key: value for key, value in item.figures.items() if key in SensorDesign.model_fields}
    design = SensorDesign(**{**keys, **electrons_of(item), "layout": "pan"})
    left = {"spot_sigma_um", "integration_time_ms"} if electrons_of(item) else ORIGINS.keys()
    assert {value.key for value in derived_values(design)} == left
    assert 300 < design.full_well_e / design.pitch_um**2 < 1500  # silicon


def test_full_well_and_noise_agree_with_another_manual():
    """The Genie Nano manual gives the IMX250 10.7 ke, and EMVA 1288 sheets of it some 2.4 e."""
    found = electrons_of(DETECTORS["imx250"])
    assert found["full_well_e"] == pytest.approx(10_700, rel=0.01)
    assert found["read_noise_e"] == pytest.approx(2.4, abs=0.1)


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(
        ValueError, match=r"`--sensor` must be one of .* got 'imx250mz'\. Did you mean `imx250mzr`\?"
    ):
        find_item("detectors", "imx250mz")
