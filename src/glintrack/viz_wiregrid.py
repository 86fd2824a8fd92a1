"""Pictures of wire-grid polarizers: the paper's Figures 5 to 10.

Every function draws on a matplotlib Axes or Figure it is given, from a table of `devices.wiregrid`.
"""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure

_ANGLE_COLOURS = "viridis"


def overview(figure: Figure, table: xr.Dataset) -> None:
    """Figures 6 to 9 of the paper for one grid, on an empty figure."""
    axes = figure.subplots(2, 2)
    transmission(axes[0, 0], table)
    extinction(axes[0, 1], table)
    diattenuation(axes[1, 0], table)
    falloff(axes[1, 1], table)


def transmission(axes: Axes, table: xr.Dataset) -> None:
    """Figure 6: T(λ, ψ) against wavelength, one line an angle of polarization."""
    degrees = np.degrees(table["polarization_angle"].values)
    colours = ScalarMappable(Normalize(degrees[0], degrees[-1]), _ANGLE_COLOURS)
    for column, angle in enumerate(degrees):
        axes.plot(
            table["wavelength"],
            table["transmittance"][:, column],
            color=colours.to_rgba(angle),
            label=f"{angle:.0f}°",
        )
    axes.set(ylabel="transmittance T(λ, ψ)", ylim=(0, 0.8), title="Figure 6: transmission")
    axes.legend(title="ψ", ncols=2, fontsize="x-small")
    _against_wavelength(axes)


def extinction(axes: Axes, table: xr.Dataset, label: str | None = None) -> None:
    """Figure 7: extinction ratio against wavelength, Eq. (8)."""
    axes.semilogy(table["wavelength"], table["extinction_ratio"], label=label)
    axes.set(ylabel="extinction ratio T(0°)/T(90°)", title="Figure 7: extinction ratio")
    _against_wavelength(axes)


def diattenuation(axes: Axes, table: xr.Dataset, label: str | None = None) -> None:
    """Figure 8: diattenuation against wavelength, Eq. (9)."""
    axes.plot(table["wavelength"], table["diattenuation"], label=label)
    axes.set(
        ylabel="diattenuation", title="Figure 8: diattenuation", ylim=(min(-0.1, axes.get_ylim()[0]), 1.02)
    )
    _against_wavelength(axes)


def falloff(axes: Axes, table: xr.Dataset) -> None:
    """Figure 9: T(λ, ψ)/T(λ, 0°) against ψ for every wavelength, beside the ideal cos²ψ."""
    degrees = np.degrees(table["polarization_angle"].values)
    um = table["wavelength"].values
    colours = ScalarMappable(Normalize(um[0], um[-1]), "turbo")
    relative = table["transmittance"].values / table["pass_transmittance"].values[:, None]
    for wavelength, line in zip(um, relative, strict=True):
        axes.plot(degrees, line, color=colours.to_rgba(wavelength), linewidth=0.6)
    fine = np.linspace(0, 90, 91)
    axes.plot(fine, np.cos(np.radians(fine)) ** 2, "k--", linewidth=2, label="ideal cos²ψ")
    axes.set(
        xlabel="ψ [°]", ylabel="T(λ, ψ)/T(λ, 0°)", title="Figure 9: cosine-squared falloff", xlim=(0, 90)
    )
    axes.set_ylim(0, None)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    axes.figure.colorbar(colours, ax=axes, label="wavelength [µm]")


def _against_wavelength(axes: Axes) -> None:
    axes.set_xlabel("wavelength [µm]")
    axes.grid(alpha=0.3, which="both")
