"""Figures of wire-grid polarizers (the paper's Figures 5 to 10), etalon, micromirror and superpixel (4c).

Every function draws a table of `devices` on a matplotlib Axes or Figure.
"""

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.colors import Normalize
from matplotlib.figure import Figure
from matplotlib.image import AxesImage

from glintrack.core.arrays import Array
from glintrack.results.figures import label_axes

_TILT_COLOUR, _LIGHT, _METAL = "#dc267f", "#ffb000", "#8a8f99"
_WAVELENGTH = "wavelength [µm]"
_COLOURS = "viridis"


def wire_grid_overview(figure: Figure, table: xr.Dataset) -> None:
    """Figures 6 to 9 of the paper for one grid, on an empty figure."""
    draw = (transmission, extinction, diattenuation, falloff)
    for axes, panel in zip(figure.subplots(2, 2).flat, draw, strict=True):
        panel(axes, table)


def transmission(axes: Axes, table: xr.Dataset) -> None:
    """Draw T(λ, ψ) against wavelength, one line for each angle, like the paper's Figure 6."""
    degrees = np.degrees(table["polarization_angle"].values)
    colours = ScalarMappable(Normalize(degrees[0], degrees[-1]), _COLOURS)
    for angle, line in zip(degrees, table["transmittance"].values.T, strict=True):
        axes.plot(table["wavelength"], line, color=colours.to_rgba(angle), label=f"{angle:.0f}°")
    label_axes(axes, _WAVELENGTH, "transmittance T(λ, ψ)", "transmission (paper's Figure 6)", ylim=(0, 0.8))
    axes.legend(title="ψ", fontsize="x-small", loc="center left", bbox_to_anchor=(1, 0.5))


def extinction(axes: Axes, table: xr.Dataset, label: str | None = None) -> None:
    """Draw the extinction ratio against wavelength, Eq. (8), like the paper's Figure 7."""
    axes.semilogy(table["wavelength"], table["extinction_ratio"], label=label)
    label_axes(axes, _WAVELENGTH, "extinction ratio T(0°)/T(90°)", "extinction ratio (paper's Figure 7)")


def diattenuation(axes: Axes, table: xr.Dataset, label: str | None = None) -> None:
    """Draw the diattenuation against wavelength, Eq. (9), like the paper's Figure 8."""
    axes.plot(table["wavelength"], table["diattenuation"], label=label)
    ylim = (min(-0.1, axes.get_ylim()[0]), 1.02)
    label_axes(axes, _WAVELENGTH, "diattenuation", "diattenuation (paper's Figure 8)", ylim=ylim)


def falloff(axes: Axes, table: xr.Dataset) -> None:
    """Draw T(λ, ψ)/T(λ, 0°) against ψ for every wavelength, and cos²ψ, like the paper's Figure 9."""
    degrees = np.degrees(table["polarization_angle"].values)
    um = table["wavelength"].values
    colours = ScalarMappable(Normalize(um[0], um[-1]), _COLOURS)
    relative = table["transmittance"].values / table["pass_transmittance"].values[:, None]
    for wavelength, line in zip(um, relative, strict=True):
        axes.plot(degrees, line, color=colours.to_rgba(wavelength), linewidth=0.6)
    fine = np.linspace(0, 90, 91)
    axes.plot(fine, np.cos(np.radians(fine)) ** 2, "k--", linewidth=2, label="ideal cos²ψ")
    title = "cosine-squared falloff (paper's Figure 9)"
    label_axes(axes, "ψ [°]", "T(λ, ψ)/T(λ, 0°)", title, xlim=(0, 90), ylim=(0, None))
    axes.legend(fontsize="small")
    axes.figure.colorbar(colours, ax=axes, label=_WAVELENGTH)


def cross_section(figure: Figure, maps: xr.Dataset, title: str) -> None:
    """Draw the energy density for E across the wires and a snapshot of E along them, like Figure 5.

    Parameters
    ----------
    figure
        An empty one.
    maps
        From `devices.wire_grid.field_maps`.
    title
        Title of the figure.
    """
    axes = figure.subplots(1, 2, sharey=True)
    panels = (
        ("energy density, E across the wires (ψ = 0°)", "energy_across", "inferno", (0, 2)),
        ("E along the wires (ψ = 90°), a snapshot", "electric_along", "RdBu_r", (-1.5, 1.5)),
    )
    for ax, (name, key, colours, limits) in zip(axes, panels, strict=True):
        figure.colorbar(_map(ax, maps, maps[key].values, colours, limits), ax=ax, shrink=0.8)
        ax.set_title(name)
    axes[1].set_ylabel("")
    figure.suptitle(f"{title}, λ = {maps.attrs['wavelength_um']:g} µm; incident amplitude 1")


def field_at_angle(figure: Figure, maps: xr.Dataset, title: str, angle_deg: float = 60.0) -> None:
    """Draw snapshots of both components of a wave at ``angle_deg`` from the pass axis, like Figure 10."""
    axes, drawn = figure.subplots(1, 2, sharey=True), None
    psi = np.radians(angle_deg)
    for ax, name, amplitude in ((axes[0], "across", np.cos(psi)), (axes[1], "along", np.sin(psi))):
        drawn = _map(ax, maps, amplitude * maps[f"electric_{name}"].values, "RdBu_r", (-1.2, 1.2))
        ax.set_title(f"component {name} the wires")
    axes[1].set_ylabel("")
    figure.colorbar(drawn, ax=axes, shrink=0.8, label="E over the incident amplitude")
    figure.suptitle(f"{title}, λ = {maps.attrs['wavelength_um']:g} µm, polarized at {angle_deg:g}°")


def _map(axes: Axes, maps: xr.Dataset, values: np.ndarray, colours: str, limits: tuple) -> AxesImage:
    """One map with the light from below; the plate is grey."""
    x, z = maps["x"].values, maps["z"].values
    step = (x[1] - x[0]) / 2
    extent = (x[0] - step, x[-1] + step, z[0] - step, z[-1] + step)
    axes.set_facecolor("0.5")
    axes.set(xlabel="x across the wires [µm]", ylabel="z along the light [µm]")
    style = {"cmap": colours, "vmin": limits[0], "vmax": limits[1], "aspect": "equal"}
    return axes.imshow(values, extent=extent, origin="lower", **style)


def etalon_overview(figure: Figure, table: xr.Dataset) -> None:
    """Response map, single gaps, drive voltage and peaks of one etalon, on an empty figure."""
    axes = figure.subplots(2, 2)
    response_map(axes[0, 0], table)
    response_curves(axes[0, 1], table)
    axes[1, 0].plot(table["gap"] * 1e3, table["voltage"], color=_TILT_COLOUR)
    label_axes(axes[1, 0], "gap [nm]", "voltage [V]", "drive")
    peak, width = axes[1, 1], axes[1, 1].twinx()
    peak.plot(table["peak_wavelength"], table["peak_transmittance"], color=_TILT_COLOUR)
    label_axes(peak, _WAVELENGTH, "peak transmittance", "order 1", ylim=(0, 1))
    width.plot(table["peak_wavelength"], table["fwhm"] * 1e3, "--", color="0.3")
    width.set(ylabel="full width at half maximum [nm], dashed", ylim=(0, None))


def response_map(axes: Axes, table: xr.Dataset) -> None:
    """Draw transmittance over wavelength and gap: orders are the bright bands."""
    values = table["wavelength"], table["gap"] * 1e3, table["transmittance"]
    shown = axes.pcolormesh(*values, cmap="magma", vmin=0, shading="nearest")
    axes.set(xlabel=_WAVELENGTH, ylabel="gap [nm]", title="transmittance over a sweep")
    axes.figure.colorbar(shown, ax=axes, label="transmittance")


def response_curves(axes: Axes, table: xr.Dataset, count: int = 6) -> None:
    """Draw transmittance against wavelength at a few gaps."""
    for i in np.linspace(0, table.sizes["gap"] - 1, count).astype(int):
        one = table.isel(gap=i)
        axes.plot(table["wavelength"], one["transmittance"], label=f"{float(one['gap']) * 1e3:.0f} nm")
    label_axes(axes, _WAVELENGTH, "transmittance", "at single gaps", ylim=(0, None))
    axes.legend(title="gap", fontsize="x-small", ncols=2)


def micromirror_overview(figure: Figure, table: xr.Dataset) -> None:
    """Travel against voltage, step, shape, bow, heat and scatter of one mirror, on an empty figure."""
    axes = figure.subplots(2, 3)
    _draw_travel(axes[0, 0], table)
    _draw_step(axes[0, 1], table)
    wavelength, beyond = table["wavelength"], "beyond the relay's stop"
    axes[0, 2].semilogy(wavelength, table["scattered"], color="0.2", label="all")
    axes[0, 2].semilogy(wavelength, table["scattered_beyond_stop"], color=_TILT_COLOUR, label=beyond)
    label_axes(axes[0, 2], _WAVELENGTH, "share of the reflected light", "scatter")
    axes[0, 2].legend(fontsize="small")
    if "deflection" not in table:
        for axis in axes[1]:
            axis.set_axis_off()
        axes[1, 1].text(0.5, 0.5, "plate not bent: needs the extra em", ha="center")
        return
    piston, tip, tilt = (table.attrs[name] for name in ("piston_m", "tip_rad", "tilt_rad"))
    bow = (table["deflection"] - piston - tip * table["x"] - tilt * table["y"]).transpose("y", "x")
    panels = (
        ("deflection to the electrodes [nm]", table["deflection"] * 1e9, "viridis"),
        ("bow: deflection less its plane [pm]", bow * 1e12, "coolwarm"),
        ("temperature rise [mK]", table["temperature_rise"] * 1e3, "inferno"),
    )
    for ax, (name, values, colours) in zip(axes[1], panels, strict=True):
        plate = table["x"] * 1e6, table["y"] * 1e6, values
        shown = ax.pcolormesh(*plate, cmap=colours, shading="gouraud")
        ax.set(xlabel="x [µm]", ylabel="y [µm]", title=name, aspect="equal")
        figure.colorbar(shown, ax=ax, shrink=0.8)


def _draw_travel(axes: Axes, table: xr.Dataset) -> None:
    """Piston under the same voltage on all electrodes up to pull-in."""
    axes.plot(table["even_voltage"], table["even_piston"] * 1e9, color=_TILT_COLOUR)
    axes.axvline(float(table["even_voltage"][-1]), color="0.4", linestyle=":", label="pull-in")
    sudden = table.attrs["dynamic_pull_in_v"]
    axes.axvline(sudden, color=_LIGHT, linestyle="--", label="pull-in by a sudden step")
    label_axes(axes, "voltage on all electrodes [V]", "piston [nm]", "travel")
    axes.legend(fontsize="small")


def _draw_step(axes: Axes, table: xr.Dataset) -> None:
    """Piston and slopes after the voltages are switched on."""
    axes.plot(table["time"] * 1e6, table["piston"] * 1e9, color="0.2", label="piston [nm]")
    for name, colour in (("tip", "#35b0ff"), ("tilt", _TILT_COLOUR)):
        axes.plot(table["time"] * 1e6, table[name] * 1e3, color=colour, label=f"{name} [mrad]")
    settled = table.attrs["settling_time_s"]
    if np.isfinite(settled):
        axes.axvline(settled * 1e6, color="0.4", linestyle=":", label=f"settled, {settled * 1e6:.1f} µs")
    label_axes(axes, "time [µs]", "", "step")
    axes.legend(fontsize="small")


def superpixel_rays(
    axes: Axes,
    tilt_rad: float,
    pass_transmittance: float,
    pitch_um: float = 17.0,
    f_number: float = 5.6,
    rays: int = 7,
) -> None:
    """Draw a cross-section of mirror and polarizer with the cone of the lens, angles to scale.

    Parameters
    ----------
    axes
        Axes to draw on.
    tilt_rad
        Tilt of the mirror; light leaves it at twice the tilt. [rad]
    pass_transmittance
        Transmittance of the polarizer for its own polarization: opacity of the rays below it. [1]
    pitch_um, f_number, rays
        Pitch of the elements, F-number of the lens, and number of rays. [µm, 1, 1]
    """
    half = np.arcsin(0.5 / f_number)
    height, below, centres = 60.0, 25.0, (-pitch_um / 2, pitch_um / 2)
    colours = {
        f"from the lens, F/{f_number:g}": "#c98a00",
        f"mirrored, {2 * np.degrees(tilt_rad):.1f}° aside": _TILT_COLOUR,
        f"through the wires, T = {pass_transmittance:.2f}": "#0077bb",
    }
    lens, mirror, wire = colours.values()
    opacity = float(np.clip(pass_transmittance, 0.05, 1))
    for angle in np.linspace(-half, half, rays):
        down = np.array([np.sin(angle), -np.cos(angle)])
        for k, x in enumerate(centres):
            focus = np.array([x, 0.0])
            away = reflect(down, tilt_rad)
            stop = focus + down * below / np.cos(angle) if k else focus + away * height / max(away[1], 0.2)
            start = focus - down * height / np.cos(angle)
            axes.plot(*np.transpose([start, focus]), color=lens, linewidth=0.9)
            colour, alpha = (wire, opacity) if k else (mirror, 1.0)
            axes.plot(*np.transpose([focus, stop]), color=colour, alpha=alpha, linewidth=0.9)
    side = 0.45 * pitch_um
    edge = side * np.array([np.cos(tilt_rad), np.sin(tilt_rad)])
    plate = [centres[0] - edge[0], centres[0] + edge[0]], [-edge[1], edge[1]]
    axes.plot(*plate, color=_METAL, linewidth=4, label="mirror")
    wires, under = centres[1] + np.linspace(-side, side, 20), [centres[1] - side, centres[1] + side]
    axes.plot(wires, np.zeros(20), "s", color=_METAL, markersize=3, label="wires")
    axes.plot(under, [-below, -below], color="0.2", linewidth=5, label="detector array")
    for name, colour in colours.items():
        axes.plot([], [], color=colour, label=name)
    axes.set(xlabel="x [µm]", ylabel="height [µm]", aspect="equal", xlim=(-45, 45), ylim=(-30, height))
    axes.legend(fontsize="x-small", loc="upper right")


def reflect(direction: Float[Array, "2"], tilt_rad: float) -> Float[Array, "2"]:
    """Direction after a mirror with its normal at a tilt from the vertical."""
    normal = np.array([-np.sin(tilt_rad), np.cos(tilt_rad)])
    return direction - 2 * (direction @ normal) * normal
