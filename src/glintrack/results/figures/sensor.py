"""Figures of a sensor: lens, modulation transfer function, spectral response, and a frame."""

import matplotlib.pyplot as plt
import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from glintrack.core.arrays import Array
from glintrack.results.figures import AOP, DOLP, MAX_DOLP, RADIANCE, label_axes
from glintrack.sensor.lens import LensDesign, build_optic, ray_paths
from glintrack.stokes import aop

_BRIGHT = 99.5  # percentile of pan that is white
_HATCH = {"in the corner, across": "--", "in the corner, down": ":"}
_SHOWN_UM = 30.0
_OUTLINE = 40


def draw_transfer(axes: Axes, curves: xr.Dataset) -> None:
    """Draw the modulation transfer function over the spatial frequency on the detector array."""
    for name in curves.data_vars:
        axes.plot(curves["frequency"], curves[name], _HATCH.get(str(name), "-"), label=str(name))
    nyquist = curves.attrs["nyquist_per_mm"]
    axes.axvline(nyquist, color="0.6", lw=1)
    axes.annotate("Nyquist", (nyquist, 0.97), rotation=90, va="top", ha="right", color="0.4")
    axes.set(
        xlabel="spatial frequency on the detector array [mm⁻¹]",
        ylabel="modulation transfer",
        xlim=(0, float(curves["frequency"][-1])),
        ylim=(0, 1.02),
        title=f"at {curves.attrs['wavelength_um']:.2f} µm",
    )
    axes.legend(frameon=False)


def draw_response(axes: Axes, curves: xr.Dataset) -> None:
    """Draw electrons per photon at the lens of each kind of element, over wavelength."""
    looks = {
        "bare": ("open element or mirror in pan", "-", "0.75"),
        "pass": ("polarizer, light across the wires", "-", "#b81a63"),
        "block": ("polarizer, light along the wires", "--", "#b81a63"),
        "spectrometer": ("mirror in the spectrometer", "-.", "#2f5fd0"),
    }
    for name in map(str, curves.data_vars):
        label, style, colour = looks.get(name, (f"filter {name} µm", "-", None))
        width = 4 if name == "bare" else 1.5  # often the same as another
        axes.plot(curves["wavelength"], curves[name], style, color=colour, label=label, lw=width)
    title = "elements" + (f", polarizers {curves.attrs['polarizer']}" if "pass" in curves else "")
    label_axes(axes, "wavelength [µm]", "electrons per photon at the lens", title, ylim=(0, None))
    axes.legend(frameon=False, fontsize="small")


def draw_frame(frame: xr.Dataset, degree: Float[Array, "y x"]) -> Figure:
    """Figure of a frame on the detector array: pan, degree and angle of polarization."""
    pan = frame["pan"].values
    angle = np.where(np.isfinite(degree), np.degrees(aop(frame["stokes_radiance"].values)), np.nan)
    white = float(np.nanpercentile(pan, _BRIGHT))
    panels = (
        ("pan radiance [W m⁻² sr⁻¹ µm⁻¹]", pan, RADIANCE, white),
        ("degree of linear polarization", degree, DOLP, MAX_DOLP),
        ("AoP from the image's right [°]", angle, AOP, 180),
    )
    figure, axes = plt.subplots(1, 3, figsize=(15, 4.2), layout="constrained")
    for ax, (label, values, colours, high) in zip(axes, panels, strict=True):
        shown = ax.imshow(values, cmap=colours, vmin=0, vmax=high)
        figure.colorbar(shown, ax=ax, label=label, shrink=0.8)
        ax.set_axis_off()
    return figure


def draw_spots(lens: LensDesign, element_um: float = 17.0) -> Figure:
    """Figure of the spots of every field about their centroid, with an element's outline."""
    optic = build_optic(lens)
    count = len(lens.fields_mm)
    figure, axes = plt.subplots(1, count, figsize=(2.4 * count, 2.9), layout="constrained", squeeze=False)
    colours = plt.get_cmap("turbo")(np.linspace(0.1, 0.9, len(lens.wavelengths_um)))
    for i, ax in enumerate(axes[0]):
        for k, (colour, wavelength) in enumerate(zip(colours, lens.wavelengths_um, strict=True)):
            image = ray_paths(optic, lens, lens.fields_mm[i], wavelength)[-1, :, :2]
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
    """Figure of surfaces and rays in three dimensions, light from the left, like the paper's Figure 11."""
    optic = build_optic(lens)
    figure = plt.figure(figsize=(9, 6), layout="constrained")
    axes = figure.add_subplot(projection="3d")
    colours = plt.get_cmap("turbo")(np.linspace(0.1, 0.9, len(lens.wavelengths_um)))
    hits = []
    for place in lens.fields_mm:
        for colour, wavelength in zip(colours, lens.wavelengths_um, strict=True):
            paths = ray_paths(optic, lens, place, wavelength, 2)
            hits.append(paths)
            for ray in range(paths.shape[1]):
                x, y, z = paths[:, ray].T
                axes.plot(z, x, y, color=colour, lw=0.4, alpha=0.5)
    points = np.concatenate(hits, axis=1)
    for k, surface in enumerate(lens.surfaces, start=1):
        _draw_surface(axes, points[k], surface.radius_mm)
    axes.set(xlabel="z [mm]", ylabel="x [mm]", zlabel="y [mm]", title=lens.name)
    axes.set_box_aspect((2.4, 1, 1.4))
    axes.locator_params(axis="y", nbins=3)
    axes.view_init(18, -70)
    return figure


def _draw_surface(axes, points: Array, radius_mm: float | None) -> None:
    """Draw the used part of a surface: a spherical patch through the rays' points."""
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
