"""The etalon's reference table (§3.1): gap, peak and width of order 1 with 30 nm of silver."""

from pathlib import Path

import numpy as np
import pytest

from glintrack.devices.etalon import EtalonDesign, drive_voltage, find_peaks

PUBLISHED = Path(__file__).parents[1] / "oracles" / "spectra"
LAST_DIGIT = 0.005
ONE_NM = 1e-3  # the table's gaps and widths are whole nanometres, found on half-nanometre grids
WAVELENGTH = [0.45, 0.55, 0.65, 0.80, 1.00]


def test_peaks_of_lorentz_drude_silver():
    found = find_peaks(EtalonDesign(), WAVELENGTH)
    np.testing.assert_allclose(found["gap"], [0.162, 0.214, 0.266, 0.342, 0.443], atol=ONE_NM)
    np.testing.assert_allclose(found["peak_transmittance"], [0.56, 0.52, 0.47, 0.40, 0.32], atol=LAST_DIGIT)
    np.testing.assert_allclose(found["fwhm"], [0.068, 0.046, 0.037, 0.030, 0.026], atol=1.2 * ONE_NM)


def test_tabulated_silver_passes_more():
    metal = {"model": "table", "table": str(PUBLISHED / "silver_nk.csv")}
    found = find_peaks(EtalonDesign.model_validate({"metal": metal}), [0.55])
    assert found["peak_transmittance"].item() == pytest.approx(0.71, abs=2 * LAST_DIGIT)


def test_the_travel_of_281_nm_needs_electrodes_of_their_own_gap():
    own = EtalonDesign.model_validate({"actuator": {"rest_gap_nm": 443, "electrode_gap_um": 1.5}})
    assert drive_voltage(own, [0.162])[0] < 33.6
    shared_gap = EtalonDesign.model_validate({"actuator": {"rest_gap_nm": 443, "electrode_gap_um": 0.443}})
    with pytest.raises(ValueError, match=r"must lie within 0 to 147.7 nm.* got 281 nm"):
        drive_voltage(shared_gap, [0.162])
