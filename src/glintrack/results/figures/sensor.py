"""Pictures of a sensor: its modulation transfer, its response, and one of its frames."""

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from glintrack.core.arrays import Array
from glintrack.results.figures.colours import AOP, DOLP, HIGHEST_DOLP, RADIANCE
from glintrack.stokes import aop

_BRIGHT = 99.5  # percentile of pan that is white
_HATCH = {"in the corner, across": "--", "in the corner, down": ":"}


def draw_transfer(axes: Axes, curves: xr.Dataset) -> None:
    """Draw modulation transfer over spatial frequency on the detector, with Nyquist's frequency marked."""
    for name in curves.data_vars:
        axes.plot(curves["frequency"], curves[name], _HATCH.get(str(name), "-"), label=str(name))
    nyquist = curves.attrs["nyquist_per_mm"]
    axes.axvline(nyquist, color="0.6", lw=1)
    axes.annotate("Nyquist", (nyquist, 0.97), rotation=90, va="top", ha="right", color="0.4")
    axes.set(
        xlabel="spatial frequency on the detector [mm⁻¹]",
        ylabel="modulation transfer",
        xlim=(0, float(curves["frequency"][-1])),
        ylim=(0, 1.02),
        title=f"at {curves.attrs['wavelength_um']:.2f} µm",
    )
    axes.legend(frameon=False)


def draw_response(axes: Axes, curves: xr.Dataset) -> None:
    """Draw what each kind of element makes of a photon at the lens, over wavelength."""
    looks = {
        "bare": ("open element or mirror in pan", "-", "0.75"),
        "pass": ("polarizer, light across the wires", "-", "#b81a63"),
        "block": ("polarizer, light along the wires", "--", "#b81a63"),
        "spectrometer": ("mirror in the spectrometer", "-.", "#2f5fd0"),
    }
    for name, (label, style, colour) in looks.items():
        if name in curves:
            width = 4 if name == "bare" else 1.5  # often the same as another
            axes.plot(curves["wavelength"], curves[name], style, color=colour, label=label, lw=width)
    said = f", polarizers {curves.attrs['polarizer']}" if "pass" in curves else ""
    axes.set(
        xlabel="wavelength [µm]",
        ylabel="electrons a photon at the lens",
        title=f"elements{said}",
        ylim=(0, None),
    )
    axes.grid(alpha=0.3)
    axes.legend(frameon=False, fontsize="small")


def draw_frame(frame: xr.Dataset, degree: Float[Array, "y x"]) -> Figure:
    """Figure of a frame: pan, degree and angle of polarization, as the detector sees them."""
    pan = frame["pan"].values
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    white = float(np.nanpercentile(pan, _BRIGHT))
    shown = axes[0].imshow(pan, cmap=RADIANCE, vmin=0, vmax=white)
    figure.colorbar(shown, ax=axes[0], label="pan radiance [W m⁻² sr⁻¹ µm⁻¹]", shrink=0.8)
    shown = axes[1].imshow(degree, cmap=DOLP, vmin=0, vmax=HIGHEST_DOLP)
    figure.colorbar(shown, ax=axes[1], label="degree of linear polarization", shrink=0.8)
    angle = np.where(np.isfinite(degree), np.degrees(aop(frame["stokes_radiance"].values)), np.nan)
    shown = axes[2].imshow(angle, cmap=AOP, vmin=0, vmax=180)
    figure.colorbar(shown, ax=axes[2], label="AoP from the image's right [°]", shrink=0.8)
    for ax in axes:
        ax.set_axis_off()
    return figure
