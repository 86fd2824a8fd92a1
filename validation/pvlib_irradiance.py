"""Print direct normal irradiance and that of pvlib's spectrl2 (Bird and Riordan 1986) as a Markdown table.

    python validation/pvlib_irradiance.py

The table in docs/theory/atmosphere.md is this command's output.
"""

import numpy as np
import pvlib

from glintrack.atmosphere import AtmosphereDesign
from glintrack.atmosphere.aerosol import aerosol_optics
from glintrack.atmosphere.design import GROUND_ALBEDO
from glintrack.atmosphere.gas import LEVELS_M, OZONE_DU, effective_absorption, gas_amounts, slant_weights
from glintrack.atmosphere.sun import earth_sun_distance, solar_irradiance, sun_direction

BANDS_UM = (0.40, 0.45, 0.50, 0.55, 0.60, 0.65, 0.69, 0.72, 0.76, 0.78, 0.82, 0.86, 0.91, 0.94, 0.97, 1.04)
BANDS_UM += (1.13, 1.24, 1.40, 1.50, 1.60, 1.67, 1.87, 2.01, 2.10, 2.20, 2.30, 2.45)
AIR_DEPTH_550 = 0.09762  # Rayleigh, sea level (Bucholtz 1995)


def ours(design: AtmosphereDesign, um: np.ndarray) -> np.ndarray:
    """Direct normal irradiance from the pieces of the product, no solver needed. [W m⁻² µm⁻¹]"""
    height, cos_sun = np.array(LEVELS_M, dtype=float), np.cos(sun_direction(design)[0])
    # Bucholtz's fit of the Rayleigh depth's wavelength dependence, to the depth at 0.55 µm
    exponent = np.where(
        um < 0.5, 3.55212 + 1.35579 * um + 0.11563 / um, 3.99668 + 1.10298e-3 * um + 2.71393e-2 / um
    )
    scale = np.where(um < 0.5, 6.50362e-3, 8.64627e-3)
    air = scale * um**-exponent
    aerosol = design.aerosol_optical_depth_550 * aerosol_optics(design.aerosol, um).extinction
    mass = 1 / cos_sun
    gas = slant_weights(cos_sun, height) @ effective_absorption(
        gas_amounts(design.water_cm), height, cos_sun, um
    )
    top = solar_irradiance(um, earth_sun_distance(design))
    return top * np.exp(-(air + aerosol) * mass - gas)


def spectrl2(design: AtmosphereDesign, um: np.ndarray) -> np.ndarray:
    """Compute the same by pvlib, as 10-nm means of its own wavelengths. [W m⁻² µm⁻¹]"""
    zenith_deg = np.degrees(sun_direction(design)[0])
    at_500, at_400 = aerosol_optics(design.aerosol, np.array([0.5, 0.55])).extinction
    depth_500 = design.aerosol_optical_depth_550 * at_500
    result = pvlib.spectrum.spectrl2(
        apparent_zenith=zenith_deg,
        aoi=zenith_deg,
        surface_tilt=0,
        ground_albedo=GROUND_ALBEDO,
        surface_pressure=101325,
        relative_airmass=pvlib.atmosphere.get_relative_airmass(zenith_deg),
        precipitable_water=design.water_cm,
        ozone=OZONE_DU / 1000,
        aerosol_turbidity_500nm=depth_500,
        alpha=float(np.log(at_500 / at_400) / np.log(0.55 / 0.5)),
        dayofyear=design.date.timetuple().tm_yday,
    )
    dense = np.linspace(-0.005, 0.005, 21)
    return np.array(
        [np.interp(x + dense, result["wavelength"] / 1e3, np.ravel(result["dni"]) * 1e3).mean() for x in um]
    )


def main() -> None:
    """Print the table."""
    design, um = AtmosphereDesign(), np.array(BANDS_UM)
    one, other = ours(design, um), spectrl2(design, um)
    print("| µm | glintrack | spectrl2 | ratio |\n| --- | --- | --- | --- |")
    for x, a, b in zip(um, one, other, strict=True):
        print(f"| {x:.2f} | {a:.1f} | {b:.1f} | {a / b:.3f} |")


if __name__ == "__main__":
    main()
