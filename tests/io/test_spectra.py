"""Spectra in other units and orders, with missing values, as CSV and as ECOSTRESS's text."""

import numpy as np
import pytest

from glintrack.io.readings import collect_readings
from glintrack.io.spectra import read_spectra

REFLECTANCE = {"reflectance": (0.0, 1.0)}
# the head and the order of a manmade sample of the library, whose wavelengths fall
ECOSTRESS = """Name: Construction Asphalt\r
Type: manmade\r
Sample No.: 0674UUUASP\r
First Column: X\r
Second Column: Y\r
X Units: Wavelength (micrometers)\r
Y Units: Reflectance (percent)\r
First X Value: 2.5\r
Last X Value: 0.4\r
Number of X Values: 4\r
Additional Information: none\r
\r
  2.5000\t  24.600\r
  1.4000\t-1.23e+34\r
  1.0000\t  20.000\r
  0.4000\t   8.125\r
"""


def write(path, text):
    path.write_text(text, encoding="utf-8", newline="")
    return path


def test_ecostress_falls_and_is_in_percent(tmp_path):
    with collect_readings() as readings:
        found = read_spectra(write(tmp_path / "a.spectrum.txt", ECOSTRESS), "file", REFLECTANCE, fill=True)
    np.testing.assert_allclose(found["wavelength_um"], [0.4, 1.0, 1.4, 2.5])
    between = 0.2 + (0.246 - 0.2) * 0.4 / 1.5  # by hand, for the missing value at 1.4 µm
    np.testing.assert_allclose(found["reflectance"], [0.08125, 0.2, between, 0.246])
    assert readings[0].notes == (
        "0.4 to 2.5 µm",
        "Wavelength (micrometers); Reflectance (percent)",
        "wavelengths fall: turned",
        "1 missing values of reflectance are filled in",
    )


@pytest.mark.parametrize(
    ("head", "rows"),
    [
        ("wavelength_um", [(0.4, 0.1), (1.0, 0.2), (2.5, 0.3)]),
        ("wavelength_um", [(2.5, 0.3), (1.0, 0.2), (0.4, 0.1)]),
        ("wavelength_nm", [(400, 0.1), (1000, 0.2), (2500, 0.3)]),
        ("wavelength_nm", [(2500, 0.3), (1000, 0.2), (400, 0.1)]),
    ],
)
def test_units_and_order_do_not_matter(tmp_path, head, rows):
    text = f"# mine\n{head},reflectance\n" + "".join(f"{x},{y}\n" for x, y in rows)
    found = read_spectra(write(tmp_path / "s.csv", text), "file", REFLECTANCE)
    np.testing.assert_allclose(found["wavelength_um"], [0.4, 1.0, 2.5])
    np.testing.assert_allclose(found["reflectance"], [0.1, 0.2, 0.3])


@pytest.mark.parametrize("blank", ["", "-9999", "-1.23e34"])
def test_missing_values_are_filled_in_or_refused(tmp_path, blank):
    text = f"wavelength_um,reflectance\n0.4,{blank}\n0.5,0.1\n0.6,{blank}\n0.7,0.3\n0.8,{blank}\n"
    path = write(tmp_path / "s.csv", text)
    found = read_spectra(path, "file", REFLECTANCE, fill=True)
    np.testing.assert_allclose(found["reflectance"], [0.1, 0.1, 0.2, 0.3, 0.3])
    with pytest.raises(ValueError, match="`file` must have reflectance within 0 to 1; got"):
        read_spectra(path, "file", REFLECTANCE)


@pytest.mark.parametrize(
    ("name", "text", "sentence"),
    [
        ("s.csv", "wavelength_um,reflectance\n400,0.1\n700,0.2\n", "Perhaps its column is wavelength_nm"),
        ("s.csv", "wavelength_nm,reflectance\n0.4,0.1\n0.7,0.2\n", "Perhaps its column is wavelength_um"),
        ("s.csv", "wavelength_um,reflectance\n0.4,12\n0.7,20\n", "got 12 at 0.4 .* Divide percent by 100"),
        ("s.csv", "wavelength_um,other\n0.4,1\n0.7,1\n", "must have columns wavelength_um and reflectance"),
        ("s.csv", "wavelength_um,reflectance\n0.4,\n0.7,\n", "must hold measured values in column"),
        ("s.csv", "wavelength_um,reflectance\n1,0\n2,0\n1.5,0\n", "rising or falling wavelengths"),
        ("s.txt", ECOSTRESS.replace("micrometers", "cm-1"), "X Units in micrometers or nanometers"),
        ("s.txt", ECOSTRESS.replace("Reflectance (", "Radiance ("), "Y Units of reflectance"),
        ("s.txt", ECOSTRESS.rpartition("  0.4000")[0], "must be whole; got 3 of 4 values"),
        ("s.txt", " splib07a Record=41: Asphalt\n-1.23e34\n 0.1\n", "Write a CSV with columns wavelength_um"),
    ],
)
def test_other_files_are_refused_with_a_remedy(tmp_path, name, text, sentence):
    with pytest.raises(ValueError, match=sentence):
        read_spectra(write(tmp_path / name, text), "file", REFLECTANCE, fill=True)
