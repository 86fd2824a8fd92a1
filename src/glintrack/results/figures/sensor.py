"""Pictures of a sensor: its lens, its modulation transfer, its response, and one of its frames."""

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from glintrack.core.arrays import Array
from glintrack.results.figures import AOP, DOLP, HIGHEST_DOLP, RADIANCE
from glintrack.sensor.lens import LensDesign, build_optic, ray_paths
from glintrack.stokes import aop

_BRIGHT = 99.5  # percentile of pan that is white
_HATCH = {"in the corner, across": "--", "in the corner, down": ":"}
_SHOWN_UM = 30.0
_OUTLINE = 40


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


def draw_spots(lens: LensDesign, element_um: float = 17.0) -> Figure:
    """Spots of every field about their centroid, all wavelengths, with an element's outline."""
    optic = build_optic(lens)
    count = len(lens.fields_mm)
    figure, axes = plt.subplots(1, count, figsize=(2.4 * count, 2.9), layout="constrained", squeeze=False)
    colours = plt.get_cmap("turbo")(np.linspace(0.1, 0.9, len(lens.wavelengths_um)))
    for i, ax in enumerate(axes[0]):
        for k, (colour, wavelength) in enumerate(zip(colours, lens.wavelengths_um, strict=True)):
            image = ray_paths(optic, lens, i, wavelength)[-1, :, :2]
            spot = 1e3 * (image - np.nanmean(image, axis=0))
            size = 3 + 1.5 * (len(colours) - 1 - k)  # so that none hides those that lie under it
            ax.plot(*spot.T, ".", ms=size, color=colour, label=f"{wavelength:g} µm")
        half = element_um / 2
        ax.plot([-half, half, half, -half, -half], [-half, -half, half, half, -half], color="0.6", lw=1)
        ax.set(xlim=(-_SHOWN_UM, _SHOWN_UM), ylim=(-_SHOWN_UM, _SHOWN_UM), aspect="equal")
        ax.set_title(f"object at {lens.fields_mm[i][0]:g}, {lens.fields_mm[i][1]:g} mm", fontsize=8)
        ax.tick_params(labelsize=7)
    axes[0, 0].set_ylabel("from the centroid [µm]", fontsize=8)
    figure.supxlabel(f"from the centroid [µm]; the square is an element of {element_um:g} µm", fontsize=8)
    axes[0, -1].legend(fontsize=6, frameon=False, loc="upper right")
    return figure


def draw_layout(lens: LensDesign) -> Figure:
    """Surfaces and rays in three dimensions, like the paper's Figure 11: light comes from the left."""
    optic = build_optic(lens)
    figure = plt.figure(figsize=(9, 6), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    colours = plt.get_cmap("turbo")(np.linspace(0.1, 0.9, len(lens.wavelengths_um)))
    met = []
    for i in range(len(lens.fields_mm)):
        for colour, wavelength in zip(colours, lens.wavelengths_um, strict=True):
            paths = ray_paths(optic, lens, i, wavelength, 2)
            met.append(paths)
            for ray in range(paths.shape[1]):
                x, y, z = paths[:, ray].T
                axes.plot(z, x, y, color=colour, lw=0.4, alpha=0.5)
    points = np.concatenate(met, axis=1)
    for k, surface in enumerate(lens.surfaces, start=1):
        _draw_surface(axes, points[k], surface.radius_mm)
    axes.set(xlabel="z [mm]", ylabel="x [mm]", zlabel="y [mm]", title=lens.name)
    axes.set_box_aspect((2.4, 1, 1.4))
    axes.locator_params(axis="y", nbins=3)
    axes.view_init(18, -70)
    return figure


def _draw_surface(axes, points: Array, radius_mm: float | None) -> None:
    """The used part of a surface: a spherical patch through the points where rays met it."""
    found = points[np.isfinite(points).all(axis=1)]
    middle = found.mean(axis=0)
    half = 1.1 * np.abs(found[:, :2] - middle[:2]).max(axis=0) + 1.0
    x, y = np.meshgrid(
        np.linspace(middle[0] - half[0], middle[0] + half[0], _OUTLINE),
        np.linspace(middle[1] - half[1], middle[1] + half[1], _OUTLINE),
    )
    z = np.full_like(x, middle[2])
    if radius_mm is not None:
        vertex = np.median(found[:, 2] - _sag(found[:, 0], found[:, 1], radius_mm))
        z = vertex + _sag(x, y, radius_mm)
    axes.plot_surface(z, x, y, color="0.6", alpha=0.5, linewidth=0)


def _sag(x: Array, y: Array, radius_mm: float) -> Array:
    square = x * x + y * y
    return square / radius_mm / (1 + np.sqrt(np.maximum(1 - square / radius_mm**2, 0)))
