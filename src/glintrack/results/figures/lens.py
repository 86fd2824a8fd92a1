"""Pictures of a lens prescription: its spots, and its layout in three dimensions."""

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.figure import Figure

from glintrack.core.arrays import Array
from glintrack.sensor.lens.prescription import LensDesign, build_optic, ray_paths

_SHOWN_UM = 30.0
_OUTLINE = 40


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
