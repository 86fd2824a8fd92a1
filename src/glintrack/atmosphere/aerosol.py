"""Aerosol mixtures of the WMO basic components: extinction, albedo and phase matrix by Mie theory.

The components' Mie results are a packaged table (``tools/make_aerosol_tables.py``); a mixture is a sum by
volume, external, of spheres.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.core.installation import data_file, read_data

MIXTURES: Mapping[str, Mapping[str, float]] = read_data("atmosphere", "mixtures.toml")


@dataclass(frozen=True)
class AerosolOptics:
    """Scattering by one aerosol at given wavelengths.

    Parameters
    ----------
    extinction
        Relative to that at 0.55 µm, shape (wavelength,). [1]
    single_scattering_albedo
        Shape (wavelength,). [1]
    moments
        Expansion of the phase matrix in generalized spherical functions, rows a1, a2, a3, b1 with
        a1[0] = 1, shape (wavelength, 4, moment). [1]
    """

    extinction: Float[Array, "wavelength"]
    single_scattering_albedo: Float[Array, "wavelength"]
    moments: Float[Array, "wavelength 4 moment"]


def read_components() -> xr.Dataset:
    """Read the packaged Mie table of the basic components, `wavelength` in µm."""
    return xr.load_dataset(data_file("atmosphere", "aerosol_components.nc"), engine="h5netcdf")


def aerosol_optics(aerosol: str, wavelength_um: Float[Array, "wavelength"]) -> AerosolOptics:
    """Optical properties of a named aerosol, interpolated from the Mie table.

    Extinction is interpolated as log against log wavelength, scattering and its phase matrix by the same
    weights: between the published wavelengths the refractive indices themselves are only interpolated.

    Parameters
    ----------
    aerosol
        Key of `MIXTURES`.
    wavelength_um
        Within 0.4 to 2.5 µm. [µm]

    Raises
    ------
    ValueError
        For an unknown aerosol.
    """
    if aerosol not in MIXTURES:
        raise ValueError(f"`aerosol` must be one of {', '.join(MIXTURES)}; got {aerosol!r}.")
    table = read_components()
    grid_um = table["wavelength"].values
    names = list(table["component"].values)
    volume = np.array([MIXTURES[aerosol].get(name, 0.0) for name in names])
    extinction_by = volume[:, None] * table["extinction_per_volume"].values
    scattering_by = extinction_by * table["single_scattering_albedo"].values
    extinction, scattering = extinction_by.sum(0), scattering_by.sum(0)
    moments = np.einsum("cw,cwkm->wkm", scattering_by, table["moments"].values.astype(float))
    moments /= moments[:, :1, :1]  # exactly one photon out for one scattered; Mie's quadrature has 2e-4

    at_550 = extinction[int(np.argmin(abs(grid_um - 0.55)))]
    log_grid, log_at = np.log(grid_um), np.log(np.asarray(wavelength_um, dtype=float))
    extinction_at = np.exp(np.interp(log_at, log_grid, np.log(extinction)))
    scattering_at = np.exp(np.interp(log_at, log_grid, np.log(scattering)))
    right = np.clip(np.searchsorted(log_grid, log_at), 1, log_grid.size - 1)
    weight = ((log_at - log_grid[right - 1]) / (log_grid[right] - log_grid[right - 1]))[:, None, None]
    return AerosolOptics(
        extinction=extinction_at / at_550,
        single_scattering_albedo=scattering_at / extinction_at,
        moments=(1 - weight) * moments[right - 1] + weight * moments[right],
    )


def without_forward_peak(optics: AerosolOptics, moments: int = 64) -> AerosolOptics:
    """Count the aerosol's forward peak as light not scattered (delta-M).

    Light within about 180°/``moments`` of the sun cannot be resolved by the sky map, and would ring there.
    It stays in the direct beam, as in the reading of a pyrheliometer.

    Parameters
    ----------
    optics
        Optics by Mie theory.
    moments
        Number of moments of the result.

    References
    ----------
    Wiscombe, J. Atmos. Sci. 34, 1408 (1977).
    """
    degree = np.arange(moments)
    peak = optics.moments[:, 0, moments] / (2 * moments + 1)
    truncated = optics.moments[:, :, :moments].copy()
    truncated[:, :3] -= (
        peak[:, None, None] * np.where(degree < 2, np.array([1, 0, 0])[:, None], 1) * (2 * degree + 1)
    )
    albedo = optics.single_scattering_albedo
    return AerosolOptics(
        extinction=optics.extinction * (1 - albedo * peak),
        single_scattering_albedo=albedo * (1 - peak) / (1 - albedo * peak),
        moments=truncated / (1 - peak)[:, None, None],
    )
