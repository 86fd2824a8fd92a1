"""Permittivities against measured tables, the closed form of a conductor, and each other."""

from importlib import resources
from pathlib import Path

import numpy as np
import pytest
from scipy.constants import c, epsilon_0

from glintrack.devices.optical_constants import MetalDesign, permittivity

PACKAGED = Path(str(resources.files("glintrack"))) / "data" / "spectra"
PUBLISHED = Path(__file__).parents[1] / "oracles" / "spectra"


def test_conductor_is_a_skin_depth():
    """δ = √(2/(ωμ₀σ)) and λ/(2π k) agree where σ/(ωε₀) ≫ 1, as at 100 µm."""
    um, sigma = 100.0, 35.6e6
    omega = 2 * np.pi * c / (um * 1e-6)
    skin_m = np.sqrt(2 * epsilon_0 * c**2 / (omega * sigma))
    k = np.sqrt(permittivity(MetalDesign(conductivity_s_per_m=sigma), um)).imag
    assert um * 1e-6 / (2 * np.pi * k) == pytest.approx(skin_m, rel=1e-3)  # 1/(2·σ/ωε₀) = 1e-4 is left out


@pytest.mark.parametrize("metal", ["aluminium", "silver", "gold"])
def test_metals_absorb_and_reflect(metal):
    eps = permittivity(MetalDesign(model="lorentz-drude", name=metal), np.linspace(0.4, 2.5, 211))
    assert (eps.imag > 0).all()
    n = np.sqrt(eps)
    reflectance = abs((n - 1) / (n + 1)) ** 2
    assert reflectance[-1] > 0.95


@pytest.mark.parametrize(
    ("metal", "table"),
    [
        ("aluminium", PACKAGED / "aluminium_nk.csv"),
        ("silver", PUBLISHED / "silver_rakic_bb_nk.csv"),
    ],
)
def test_lorentz_drude_is_the_published_metal(metal, table):
    """Reflectance of bulk metal against the same authors' tables: the model's own fit error is under 3 %."""
    um = np.array([0.45, 0.55, 0.65, 1.0, 1.5, 2.0])
    reflectance = [
        abs((np.sqrt(e) - 1) / (np.sqrt(e) + 1)) ** 2
        for e in (
            permittivity(MetalDesign(model="lorentz-drude", name=metal), um),
            permittivity(MetalDesign(model="table", table=table), um),
        )
    ]
    assert np.abs(reflectance[0] - reflectance[1]).max() < 0.03


def test_a_table_gives_its_rows_back(tmp_path):
    path = tmp_path / "metal.csv"
    path.write_text("# source: made up\nwavelength_um,n,k\n0.5,1.0,2.0\n0.7,2.0,4.0\n")
    metal = MetalDesign(model="table", table=path)
    assert permittivity(metal, [0.5, 0.6]) == pytest.approx([(1 + 2j) ** 2, (1.5 + 3j) ** 2])
    assert MetalDesign(model="table", table="metal.csv").resolve_files(tmp_path).table == path


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ("wavelength_um,n\n0.5,1\n0.6,1\n", "must have columns wavelength_um and n and k; got no k"),
        ("wavelength_um,n,k\n0.5,1,x\n0.6,1,1\n", "must hold numbers; got .*'x'"),
        ("wavelength_um,n,k\n0.6,1,1\n0.6,1,1\n", "rising"),
        ("wavelength_um,n,k\n0.5,1,-1\n0.6,1,1\n", "k within 0 to"),
        ("wavelength_um,n,k\n0.5,1,nan\n0.6,1,1\n", "k within 0 to"),
    ],
)
def test_a_bad_table_is_refused(tmp_path, text, complaint):
    path = tmp_path / "metal.csv"
    path.write_text(text)
    with pytest.raises(ValueError, match=complaint):
        permittivity(MetalDesign(model="table", table=path), 0.55)


def test_outside_the_data_is_an_error(tmp_path):
    with pytest.raises(ValueError, match=r"0.207 to 12.4 µm"):
        permittivity(MetalDesign(model="lorentz-drude", name="silver"), 0.1)
    path = tmp_path / "metal.csv"
    path.write_text("wavelength_um,n,k\n0.5,1,1\n0.6,1,1\n")
    with pytest.raises(ValueError, match=r"0.5 to 0.6 µm, where metal.csv holds; got 0.7"):
        permittivity(MetalDesign(model="table", table=path), 0.7)
    with pytest.raises(ValueError, match="if and only if"):
        MetalDesign(model="table")
