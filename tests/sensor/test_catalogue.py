"""The catalogue: every figure has a page, and full well and noise follow from EMVA 1288."""

import re

import pytest

from glintrack.sensor import SensorDesign, design_keys
from glintrack.sensor.catalogue import find_item, read_catalogue
from glintrack.sensor.derivation import ORIGINS, derived_values

DETECTORS, LENSES = read_catalogue("detectors"), read_catalogue("lenses")


@pytest.mark.parametrize("item", [*DETECTORS.values(), *LENSES.values()], ids=lambda item: item.name)
def test_every_figure_names_a_page_or_is_assumed(item):
    assert item.figures.keys() == item.sources.keys()
    assert all(source == "assumed" or re.search(r"https?://", source) for source in item.sources.values())


def test_there_are_enough_and_polarization_cameras_among_them():
    assert len(DETECTORS) >= 10 and len(LENSES) >= 5
    polarized = {name for name, item in DETECTORS.items() if item.figures["layout"] == "0-45-90-135"}
    assert polarized >= {"imx250mzr", "imx253mzr"}


@pytest.mark.parametrize("item", DETECTORS.values(), ids=lambda item: item.name)
def test_figures_are_those_of_a_sensor(item):
    design = SensorDesign(**item.figures)
    assert derived_values(design).keys() == ORIGINS.keys() - item.figures.keys()
    assert 300 < design.full_well_e / design.pitch_um**2 < 1500  # silicon
    assert design_keys(item.name).items() >= item.figures.items()  # one truth, also where it is packaged
    assert SensorDesign(ready=item.name).columns == item.figures["columns"]


def test_full_well_and_noise_agree_with_another_manual():
    """The Genie Nano manual gives the IMX250 10.7 ke, and EMVA 1288 sheets of it some 2.4 e."""
    found = DETECTORS["imx250"].figures
    assert found["full_well_e"] == pytest.approx(10_700, rel=0.01)
    assert found["read_noise_e"] == pytest.approx(2.4, abs=0.1)


def test_an_unknown_name_is_refused_with_the_nearest():
    with pytest.raises(
        ValueError, match=r"`--sensor` must be one of .* got 'imx250mz'\. Did you mean `imx250mzr`\?"
    ):
        find_item("detectors", "imx250mz")
