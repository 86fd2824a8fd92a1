"""Figures of an atmosphere: fisheye maps of the sky and spectra of sun, sky and path.

Every function draws on a matplotlib Axes. A fisheye is the sky looking up: north up, **east left**, zenith in
the middle, radius proportional to the zenith angle.
"""

from typing import Any, Literal, cast

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.collections import QuadMesh
from matplotlib.projections.polar import PolarAxes

from glintrack import stokes
from glintrack.results.figures import AOP, DOLP, RADIANCE, label_axes

Quantity = Literal["I", "DoLP", "AoP"]
LABELS = {
    "I": "log$_{10}$ radiance [W m$^{-2}$ sr$^{-1}$ µm$^{-1}$]",
    "DoLP": "degree of linear polarization",
    "AoP": "angle of polarization from the vertical [°]",
}


def fisheye(axes: Axes, tables: xr.Dataset, wavelength_um: float, quantity: Quantity = "DoLP") -> QuadMesh:
    """Draw the sky's intensity, degree or angle of polarization at one wavelength.

    Parameters
    ----------
    axes
        Polar axes (``projection="polar"``).
    tables
        Schema ``atmosphere``.
    wavelength_um
        The nearest tabulated wavelength is drawn. [µm]
    quantity
        ``"I"``, drawn as log10 of W m⁻² sr⁻¹ µm⁻¹, ``"DoLP"`` [1], or ``"AoP"`` from the vertical,
        `meridian` frame [°].
    """
    band = int(np.argmin(abs(tables["wavelength"].values - wavelength_um)))
    light = np.einsum(
        "k,k...->...", tables["sky_spectrum"].values[:, band], tables["sky_map"].values.astype(float)
    )
    light = np.concatenate([light, light[:, :1]], axis=1)
    azimuth, zenith = tables["azimuth"].values, np.degrees(tables["zenith"].values)
    azimuth = np.r_[azimuth, azimuth[0] + 2 * np.pi]
    style: dict[str, Any]
    if quantity == "I":
        values, style = np.log10(light[..., 0]), {"cmap": RADIANCE}
    elif quantity == "DoLP":
        values, style = stokes.dolp(light), {"cmap": DOLP, "vmin": 0.0}
    elif quantity == "AoP":
        values = np.degrees(stokes.aop(light))
        style = {"cmap": f"{AOP}_shifted", "vmin": 0, "vmax": 180}
    else:
        raise ValueError(f"`quantity` must be I, DoLP or AoP; got {quantity!r}.")
    mesh = axes.pcolormesh(azimuth, zenith, values, shading="gouraud", rasterized=True, **style)
    sun = tables.attrs["sun_azimuth_rad"], np.degrees(tables.attrs["sun_zenith_rad"])
    axes.plot(*sun, marker="o", markersize=7, markerfacecolor="none", markeredgecolor="red")
    polar = cast(PolarAxes, axes)
    polar.set_theta_zero_location("N")
    polar.set_theta_direction(1)  # looking up the compass runs counter-clockwise
    polar.set_thetagrids([0, 90, 180, 270], ["N", "E", "S", "W"])
    polar.set_rgrids([30, 60], [])
    polar.set_rmax(90)
    axes.grid(alpha=0.3)
    label = {"I": "sky radiance"}.get(quantity, quantity)
    axes.set_title(f"{label} at {1e3 * tables['wavelength'].values[band]:.0f} nm")
    return mesh


def spectra(axes: Axes, tables: xr.Dataset, altitude_m: float = 3000.0) -> None:
    """Draw the sun's and the sky's irradiance and the path's radiance straight down.

    Parameters
    ----------
    axes
        Plain axes; logarithmic ordinate.
    tables
        Schema ``atmosphere``.
    altitude_m
        The nearest tabulated sensor altitude is drawn. [m]
    """
    um = tables["wavelength"].values
    nearest = int(np.argmin(abs(tables["altitude"].values - altitude_m)))
    path = tables["path_map"].values[:, nearest, 0, :, 0].mean(axis=-1) @ tables["path_spectrum"].values
    path = path * tables["path_gas"].values[nearest]
    axes.semilogy(um, tables["sun_irradiance"], label="sun, normal to the beam [W m⁻² µm⁻¹]")
    axes.semilogy(um, tables["sky_irradiance"], label="sky on level ground [W m⁻² µm⁻¹]")
    height = tables["altitude"].values[nearest]
    axes.semilogy(um, path, label=f"path to {height:.0f} m, straight down [W m⁻² sr⁻¹ µm⁻¹]")
    ylim = (max(float(path.max()) * 1e-3, 1e-6), None)
    label_axes(axes, "wavelength [µm]", "", "Sun, sky and path", ylim=ylim)
    axes.legend(fontsize="small")
