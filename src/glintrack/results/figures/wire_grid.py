"""Pictures of wire-grid polarizers: the paper's Figures 5 to 10.

Every function draws on a matplotlib Axes or Figure it is given, from a table of `devices.wire_grid`.
"""

import numpy as np
import xarray as xr
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

_COLOURS = "viridis"


def overview(figure: Figure, table: xr.Dataset) -> None:
    """Figures 6 to 9 of the paper for one grid, on an empty figure."""
    axes = figure.subplots(2, 2)
    transmission(axes[0, 0], table)
    extinction(axes[0, 1], table)
    diattenuation(axes[1, 0], table)
    falloff(axes[1, 1], table)


def transmission(axes: Axes, table: xr.Dataset) -> None:
    """Like the paper's Figure 6: T(λ, ψ) against wavelength, one line an angle of polarization."""
    degrees = np.degrees(table["polarization_angle"].values)
    colours = ScalarMappable(Normalize(degrees[0], degrees[-1]), _COLOURS)
    for column, angle in enumerate(degrees):
        axes.plot(
            table["wavelength"],
            table["transmittance"][:, column],
            color=colours.to_rgba(angle),
            label=f"{angle:.0f}°",
        )
    axes.set(ylabel="transmittance T(λ, ψ)", ylim=(0, 0.8), title="transmission (paper's Figure 6)")
    axes.legend(title="ψ", fontsize="x-small", loc="center left", bbox_to_anchor=(1, 0.5))
    _against_wavelength(axes)


def extinction(axes: Axes, table: xr.Dataset, label: str | None = None) -> None:
    """Like the paper's Figure 7: extinction ratio against wavelength, Eq. (8)."""
    axes.semilogy(table["wavelength"], table["extinction_ratio"], label=label)
    axes.set(ylabel="extinction ratio T(0°)/T(90°)", title="extinction ratio (paper's Figure 7)")
    _against_wavelength(axes)


def diattenuation(axes: Axes, table: xr.Dataset, label: str | None = None) -> None:
    """Like the paper's Figure 8: diattenuation against wavelength, Eq. (9)."""
    axes.plot(table["wavelength"], table["diattenuation"], label=label)
    axes.set(
        ylabel="diattenuation",
        title="diattenuation (paper's Figure 8)",
        ylim=(min(-0.1, axes.get_ylim()[0]), 1.02),
    )
    _against_wavelength(axes)


def falloff(axes: Axes, table: xr.Dataset) -> None:
    """Like the paper's Figure 9: T(λ, ψ)/T(λ, 0°) against ψ for every wavelength, beside the ideal cos²ψ."""
    degrees = np.degrees(table["polarization_angle"].values)
    um = table["wavelength"].values
    colours = ScalarMappable(Normalize(um[0], um[-1]), _COLOURS)
    relative = table["transmittance"].values / table["pass_transmittance"].values[:, None]
    for wavelength, line in zip(um, relative, strict=True):
        axes.plot(degrees, line, color=colours.to_rgba(wavelength), linewidth=0.6)
    fine = np.linspace(0, 90, 91)
    axes.plot(fine, np.cos(np.radians(fine)) ** 2, "k--", linewidth=2, label="ideal cos²ψ")
    axes.set(
        xlabel="ψ [°]",
        ylabel="T(λ, ψ)/T(λ, 0°)",
        title="cosine-squared falloff (paper's Figure 9)",
        xlim=(0, 90),
    )
    axes.set_ylim(0, None)
    axes.grid(alpha=0.3)
    axes.legend(fontsize="small")
    axes.figure.colorbar(colours, ax=axes, label="wavelength [µm]")


def cross_section(figure: Figure, maps: xr.Dataset, title: str) -> None:
    """Like the paper's Figure 5: energy density for E across the wires, snapshot of E along them.

    Parameters
    ----------
    figure
        An empty one.
    maps
        From `devices.wire_grid.field_maps`.
    title
        Heads the figure.
    """
    axes = figure.subplots(1, 2, sharey=True)
    drawn = _map(axes[0], maps, maps["energy_across"].values, "inferno", (0, 2))
    axes[0].set_title("energy density, E across the wires (ψ = 0°)")
    figure.colorbar(drawn, ax=axes[0], shrink=0.8)
    drawn = _map(axes[1], maps, maps["electric_along"].values, "RdBu_r", (-1.5, 1.5))
    axes[1].set_title("E along the wires (ψ = 90°), a snapshot")
    figure.colorbar(drawn, ax=axes[1], shrink=0.8)
    axes[1].set_ylabel("")
    figure.suptitle(f"{title}, λ = {maps.attrs['wavelength_um']:g} µm; incident amplitude 1")


def field_at_angle(figure: Figure, maps: xr.Dataset, title: str, angle_deg: float = 60.0) -> None:
    """Like Figure 10: a wave at ``angle_deg`` from the pass axis, both components, snapshots."""
    axes = figure.subplots(1, 2, sharey=True)
    psi = np.radians(angle_deg)
    for one, name, amplitude in ((axes[0], "across", np.cos(psi)), (axes[1], "along", np.sin(psi))):
        drawn = _map(one, maps, amplitude * maps[f"electric_{name}"].values, "RdBu_r", (-1.2, 1.2))
        one.set_title(f"component {name} the wires")
    axes[1].set_ylabel("")
    figure.colorbar(drawn, ax=axes, shrink=0.8, label="E over the incident amplitude")
    figure.suptitle(f"{title}, λ = {maps.attrs['wavelength_um']:g} µm, polarized at {angle_deg:g}°")


def _map(axes: Axes, maps: xr.Dataset, values: np.ndarray, colours: str, limits: tuple) -> AxesImage:
    """One map with the light from below; the plate is grey."""
    x, z = maps["x"].values, maps["z"].values
    step = (x[1] - x[0]) / 2
    extent = (x[0] - step, x[-1] + step, z[0] - step, z[-1] + step)
    axes.set_facecolor("0.5")
    image = axes.imshow(
        values, cmap=colours, vmin=limits[0], vmax=limits[1], extent=extent, origin="lower", aspect="equal"
    )
    axes.set(xlabel="x across the wires [µm]", ylabel="z along the light [µm]")
    return image


def _against_wavelength(axes: Axes) -> None:
    axes.set_xlabel("wavelength [µm]")
    axes.grid(alpha=0.3, which="both")
