"""Pictures of wire-grid polarizers (the paper's Figures 5 to 10), etalon, micromirror and superpixel (4c).

Every function draws on a matplotlib Axes or Figure it is given, from a table of `devices`.
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

_TILT_COLOUR, _LIGHT, _METAL = "#dc267f", "#ffb000", "#8a8f99"
_COLOURS = "viridis"


def wire_grid_overview(figure: Figure, table: xr.Dataset) -> None:
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


def etalon_overview(figure: Figure, table: xr.Dataset) -> None:
    """Response map, single gaps, drive voltage and peaks of one etalon, on an empty figure."""
    axes = figure.subplots(2, 2)
    response_map(axes[0, 0], table)
    response_curves(axes[0, 1], table)
    axes[1, 0].plot(table["gap"] * 1e3, table["voltage"], color=_TILT_COLOUR)
    axes[1, 0].set(xlabel="gap [nm]", ylabel="voltage [V]", title="drive")
    peaks(axes[1, 1], table)
    for axis in axes.flat[1:]:
        axis.grid(alpha=0.3)


def response_map(axes: Axes, table: xr.Dataset) -> None:
    """Transmittance over wavelength and gap: orders are the bright bands."""
    shown = axes.pcolormesh(
        *(table["wavelength"], table["gap"] * 1e3, table["transmittance"]),
        cmap="magma",
        vmin=0,
        shading="nearest",
    )
    axes.set(xlabel="wavelength [µm]", ylabel="gap [nm]", title="transmittance over a sweep")
    axes.figure.colorbar(shown, ax=axes, label="transmittance")


def response_curves(axes: Axes, table: xr.Dataset, count: int = 6) -> None:
    """Transmittance against wavelength at a few gaps."""
    for i in np.linspace(0, table.sizes["gap"] - 1, count).astype(int):
        one = table.isel(gap=i)
        axes.plot(table["wavelength"], one["transmittance"], label=f"{float(one['gap']) * 1e3:.0f} nm")
    axes.set(xlabel="wavelength [µm]", ylabel="transmittance", title="at single gaps", ylim=(0, None))
    axes.legend(title="gap", fontsize="x-small", ncols=2)


def peaks(axes: Axes, table: xr.Dataset) -> None:
    """Peak transmittance and width of order 1 against wavelength."""
    axes.plot(table["peak_wavelength"], table["peak_transmittance"], color=_TILT_COLOUR, label="peak")
    axes.set(xlabel="wavelength [µm]", ylabel="peak transmittance", title="order 1", ylim=(0, 1))
    beside = axes.twinx()
    beside.plot(table["peak_wavelength"], table["fwhm"] * 1e3, "--", color="0.3", label="width")
    beside.set(ylabel="full width at half maximum [nm], dashed", ylim=(0, None))


def micromirror_overview(figure: Figure, table: xr.Dataset) -> None:
    """Travel against voltage, step, shape, bow, heat and scatter of one mirror, on an empty figure."""
    axes = figure.subplots(2, 3)
    travel(axes[0, 0], table)
    step(axes[0, 1], table)
    scattered(axes[0, 2], table)
    if "deflection" not in table:
        for axis in axes[1]:
            axis.set_axis_off()
        axes[1, 1].text(0.5, 0.5, "plate not bent: needs the extra em", ha="center")
        return
    plate_map(axes[1, 0], table, table["deflection"] * 1e9, "deflection to the electrodes [nm]")
    plate_map(axes[1, 1], table, bow(table) * 1e12, "bow: deflection less its plane [pm]", "coolwarm")
    plate_map(axes[1, 2], table, table["temperature_rise"] * 1e3, "temperature rise [mK]", "inferno")


def travel(axes: Axes, table: xr.Dataset) -> None:
    """Piston under the same voltage on all electrodes up to pull-in."""
    axes.plot(table["even_voltage"], table["even_piston"] * 1e9, color=_TILT_COLOUR)
    axes.axvline(float(table["even_voltage"][-1]), color="0.4", linestyle=":", label="pull-in")
    sudden = table.attrs["dynamic_pull_in_v"]
    axes.axvline(sudden, color=_LIGHT, linestyle="--", label="pull-in by a sudden step")
    axes.set(xlabel="voltage on all electrodes [V]", ylabel="piston [nm]", title="travel")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)


def step(axes: Axes, table: xr.Dataset) -> None:
    """Piston and slopes after the voltages are switched on."""
    axes.plot(table["time"] * 1e6, table["piston"] * 1e9, color="0.2", label="piston [nm]")
    for name, colour in (("tip", "#35b0ff"), ("tilt", _TILT_COLOUR)):
        axes.plot(table["time"] * 1e6, table[name] * 1e3, color=colour, label=f"{name} [mrad]")
    settled = table.attrs["settling_time_s"]
    if np.isfinite(settled):
        axes.axvline(settled * 1e6, color="0.4", linestyle=":", label=f"settled, {settled * 1e6:.1f} µs")
    axes.set(xlabel="time [µs]", title="step")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3)


def scattered(axes: Axes, table: xr.Dataset) -> None:
    """Scattered share against wavelength, in all and beyond the relay's stop."""
    axes.semilogy(table["wavelength"], table["scattered"], color="0.2", label="all")
    beyond = table["scattered_beyond_stop"]
    axes.semilogy(table["wavelength"], beyond, color=_TILT_COLOUR, label="beyond the relay's stop")
    axes.set(xlabel="wavelength [µm]", ylabel="share of the reflected light", title="scatter")
    axes.legend(fontsize="small")
    axes.grid(alpha=0.3, which="both")


def plate_map(
    axes: Axes, table: xr.Dataset, values: xr.DataArray, label: str, colours: str = "viridis"
) -> None:
    """One quantity over the plate."""
    shown = axes.pcolormesh(table["x"] * 1e6, table["y"] * 1e6, values, cmap=colours, shading="gouraud")
    axes.set(xlabel="x [µm]", ylabel="y [µm]", title=label, aspect="equal")
    axes.figure.colorbar(shown, ax=axes, shrink=0.8)


def bow(table: xr.Dataset) -> xr.DataArray:
    """Deflection less its best plane. [m]"""
    level, along_x, along_y = (table.attrs[name] for name in ("piston_m", "tip_rad", "tilt_rad"))
    plane = level + along_x * table["x"] + along_y * table["y"]
    return (table["deflection"] - plane).transpose("y", "x")


def superpixel_rays(
    axes: Axes,
    tilt_rad: float,
    pass_transmittance: float,
    pitch_um: float = 17.0,
    f_number: float = 5.6,
    rays: int = 7,
) -> None:
    """A cross-section of mirror and polarizer with the cone of the lens: what goes where, angles to scale.

    Parameters
    ----------
    tilt_rad
        Of the mirror; light leaves it at twice the tilt. [rad]
    pass_transmittance
        Of the polarizer, for its own polarization; opacity of the rays below it. [1]
    """
    half = np.arcsin(0.5 / f_number)
    angles = np.linspace(-half, half, rays)
    height, below, centres = 60.0, 25.0, (-pitch_um / 2, pitch_um / 2)
    for angle in angles:
        down = np.array([np.sin(angle), -np.cos(angle)])
        for k, x in enumerate(centres):
            focus = np.array([x, 0.0])
            start = focus - down * height / np.cos(angle)
            _ray(axes, start, focus, "#c98a00")
            if k == 0:
                away = mirrored(down, tilt_rad)
                _ray(axes, focus, focus + away * height / max(away[1], 0.2), _TILT_COLOUR)
            else:
                stop = focus + down * below / np.cos(angle)
                _ray(axes, focus, stop, "#0077bb", float(np.clip(pass_transmittance, 0.05, 1)))
    side = 0.45 * pitch_um
    edge = side * np.array([np.cos(tilt_rad), np.sin(tilt_rad)])
    plate = [centres[0] - edge[0], centres[0] + edge[0]], [-edge[1], edge[1]]
    axes.plot(*plate, color=_METAL, linewidth=4, label="mirror")
    wires, under = centres[1] + np.linspace(-side, side, 20), [centres[1] - side, centres[1] + side]
    axes.plot(wires, np.zeros(20), "s", color=_METAL, markersize=3, label="wires")
    axes.plot(under, [-below, -below], color="0.2", linewidth=5, label="detector")
    axes.plot([], [], color="#c98a00", label=f"from the lens, F/{f_number:g}")
    axes.plot([], [], color=_TILT_COLOUR, label=f"mirrored, {2 * np.degrees(tilt_rad):.1f}° aside")
    axes.plot([], [], color="#0077bb", label=f"through the wires, T = {pass_transmittance:.2f}")
    axes.set(xlabel="x [µm]", ylabel="height [µm]", aspect="equal", xlim=(-45, 45), ylim=(-30, height))
    axes.legend(fontsize="x-small", loc="upper right")


def mirrored(direction: Float[Array, "2"], tilt_rad: float) -> Float[Array, "2"]:
    """Direction after a mirror whose normal leans from the vertical by a tilt."""
    normal = np.array([-np.sin(tilt_rad), np.cos(tilt_rad)])
    return direction - 2 * (direction @ normal) * normal


def _ray(axes: Axes, start: Array, stop: Array, colour: str, opacity: float = 1.0) -> None:
    axes.plot([start[0], stop[0]], [start[1], stop[1]], color=colour, alpha=opacity, linewidth=0.9)
