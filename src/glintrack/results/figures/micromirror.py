"""Pictures of etalon and micromirror, and of the rays at a superpixel like the paper's Figure 4c."""

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from glintrack.core.arrays import Array

_TILT_COLOUR, _LIGHT, _METAL = "#dc267f", "#ffb000", "#8a8f99"


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
