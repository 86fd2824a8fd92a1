"""The library is within its bounds, and every figure in it has a source and a licence."""

from importlib import resources

import numpy as np
import pytest

from glintrack.core import schema
from glintrack.io.spectra import read_spectra
from glintrack.scene.materials import MaterialDesign, choose_paints, load_materials

SPECTRA = sorted(
    (p for p in (resources.files("glintrack") / "data" / "spectra").iterdir() if p.name.endswith(".csv")),
    key=lambda p: p.name,
)


def reflectance(name, wavelength_um):
    spectrum = load_materials()["reflectance"].sel(material=name)
    return float(spectrum.sel(wavelength=wavelength_um, method="nearest"))


def test_library_satisfies_its_schema_and_is_large_enough():
    library = schema.check(load_materials(), "materials")
    assert library.sizes["material"] >= 25 and library.sizes["wavelength"] == 211
    assert library["preview_rgb"].values.min() >= 0 and library["preview_rgb"].values.max() <= 1


@pytest.mark.parametrize("path", SPECTRA, ids=lambda p: p.name)
def test_spectrum_header_has_source_and_licence(path):
    header = [line for line in path.read_text(encoding="utf-8").splitlines() if line.startswith("#")]
    text = "\n".join(header)
    assert "# licence:" in text
    assert "# source:" in text or ("synthetic" in text and "# model:" in text)
    assert "um" in text  # the unit of its wavelengths


def test_vegetation_has_its_red_edge_and_asphalt_is_dark():
    for plant in ("grass", "leaf", "leaf_walnut", "leaf_conifer"):
        assert reflectance(plant, 0.85) > 4 * reflectance(plant, 0.67)
    assert 0.05 < reflectance("asphalt", 0.55) < 0.15


@pytest.mark.parametrize("percent", [5, 20, 50, 80])
def test_panels_are_level_lambertian(percent):
    panel = load_materials().sel(material=f"panel_{percent:02d}")
    np.testing.assert_array_equal(panel["reflectance"].values, percent / 100)
    assert float(panel["specular_weight"]) == 0 and float(panel["mottle"]) == 0


def test_paints_take_the_light_from_below_the_clear_coat():
    path = next(p for p in SPECTRA if p.name == "carpaint_black_synthetic.csv")
    wavelength, body, whole = read_spectra(
        path, "spectrum", {"body": (0, 1), "reflectance": (0, 1)}, fill=True
    ).values()
    black = load_materials()["reflectance"].sel(material="paint_black").values
    np.testing.assert_allclose(black, body)
    assert (whole - body > 0.03).all() and wavelength.size == 211  # the mirror part is left to Fresnel


def test_material_needs_exactly_one_base():
    with pytest.raises(ValueError, match="exactly one of spectrum, mix, constant"):
        MaterialDesign(refractive_index=1.5, roughness=0.1, specular_weight=0, constant=0.1, spectrum="x")


def test_paints_come_in_their_proportions_and_stay_with_their_key():
    library, keys = load_materials(), np.arange(20_000)
    paints = choose_paints(library, keys, seed=3)
    share = library["paint_share"].values
    for index in np.flatnonzero(share > 0):
        three_sigma = 3 * np.sqrt(share[index] * (1 - share[index]) / keys.size)
        assert abs(np.mean(paints == index) - share[index]) < three_sigma
    np.testing.assert_array_equal(choose_paints(library, keys[500:600], seed=3), paints[500:600])
    assert (choose_paints(library, keys, seed=4) != paints).any()
    assert share.sum() == pytest.approx(1) and (share > 0).sum() >= 12
