"""Pictures of what the sensor saw and the tracker made of it; every function draws into an Axes."""

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection

from glintrack.arrays import Array
from glintrack.plot.colours import DOLP, HIGHEST_DOLP, RADIANCE

TRACK_COLOUR, COAST_COLOUR, TRUTH_COLOUR, QUERY_COLOUR = "#ffb000", "#fe6100", "#35b0ff", "#dc267f"
LOOP_COLOURS = {"pan": "#648fff", "dolp": "#dc267f", "all": "#785ef0"}  # by channel


def show_rgb(ax: Axes, picture: Float[Array, "y x 3"], extent_m: tuple | None = None) -> None:
    """An sRGB picture, on the ground grid if its extent (west, south, east, north) is given."""
    if extent_m is None:
        ax.imshow(picture, interpolation="nearest")
        ax.set_axis_off()
        return
    west, south, east, north = extent_m
    ax.imshow(picture, extent=(west, east, south, north), interpolation="nearest")
    _ground_axes(ax)


def show_pan(ax: Axes, image: xr.Dataset) -> None:
    """Panchromatic radiance of a rectified frame, black to white over its middle 98 %."""
    values = image["pan"].values
    low, high = np.nanpercentile(values, [1, 99]) if np.isfinite(values).any() else (0, 1)
    shown = ax.imshow(
        values, cmap=RADIANCE, vmin=low, vmax=high, extent=_extent(image), interpolation="nearest"
    )
    ax.figure.colorbar(shown, ax=ax, shrink=0.7, label="pan radiance [W m$^{-2}$ sr$^{-1}$ µm$^{-1}$]")
    _ground_axes(ax, image)


def show_dolp(ax: Axes, image: xr.Dataset, highest: float = HIGHEST_DOLP) -> None:
    """Degree of linear polarization of a rectified frame; masked pixels are blue-grey."""
    ax.set_facecolor("#334455")
    shown = ax.imshow(
        image["dolp"].values,
        cmap=DOLP,
        vmin=0,
        vmax=highest,
        extent=_extent(image),
        interpolation="nearest",
    )
    ax.figure.colorbar(shown, ax=ax, shrink=0.7, label="DoLP")
    _ground_axes(ax, image)


def show_dolp_view(ax: Axes, values: Float[Array, "y x"], highest: float = HIGHEST_DOLP) -> None:
    """Degree of linear polarization as the aircraft sees it, in the scale of `show_dolp`. [1]"""
    ax.imshow(values, cmap=DOLP, vmin=0, vmax=highest, interpolation="nearest")
    ax.set_axis_off()


def show_tracks(ax: Axes, rows: xr.Dataset, time_s: float, tail_s: float = 8.0, label: bool = True) -> None:
    """Confirmed tracks at one time with their tails and one-second predictions.

    Parameters
    ----------
    ax
        An Axes in ENU metres.
    rows
        ``/pan/tracks`` of a result.
    time_s
        Which epoch. [s]
    tail_s
        How far back the tails go. [s]
    label
        Write each track's id.
    """
    if not rows.sizes.get("row"):
        return
    t, ident = rows["time_s"].values, rows["track_id"].values
    position = np.stack([rows["east"].values, rows["north"].values], axis=1)
    recent = (t <= time_s + 1e-9) & (t >= time_s - tail_s)
    tails = [position[recent & (ident == i)] for i in np.unique(ident[np.isclose(t, time_s)])]
    ax.add_collection(LineCollection(tails, colors=TRACK_COLOUR, linewidths=0.8))
    now = np.isclose(t, time_s)
    ahead = position + np.stack([rows["east_speed"].values, rows["north_speed"].values], axis=1)
    ax.add_collection(
        LineCollection(list(np.stack([position, ahead], axis=1)[now]), colors="white", linewidths=0.6)
    )
    coasted = rows["coasted"].values.astype(bool)
    for chosen, colour in ((now & ~coasted, TRACK_COLOUR), (now & coasted, COAST_COLOUR)):
        ax.scatter(*position[chosen].T, s=14, facecolors="none", edgecolors=colour, linewidths=0.8)
    if label:
        for i in np.flatnonzero(now):
            ax.annotate(
                str(ident[i]), position[i], (3, 3), textcoords="offset points", fontsize=4.5, color="white"
            )


def show_truth(ax: Axes, truth: xr.Dataset, time_s: float, moving_m_s: float = 1.0) -> None:
    """Moving vehicles of ``/truth`` at one time, as small crosses."""
    if not truth.sizes.get("row"):
        return
    speed = np.hypot(truth["east_speed"].values, truth["north_speed"].values)
    now = np.isclose(truth["time_s"].values, time_s) & (speed >= moving_m_s)
    ax.scatter(truth["east"].values[now], truth["north"].values[now], s=6, marker="x", c=TRUTH_COLOUR, lw=0.5)


def show_completeness(ax: Axes, result: xr.DataTree) -> None:
    """Track completeness against time for every channel of a result."""
    for channel, colour in LOOP_COLOURS.items():
        if channel in result.children:
            node = result[channel]
            label = f"{channel} (purity {node.attrs.get('purity', np.nan):.2f})"
            ax.plot(node["time"], node["completeness"], color=colour, label=label)
    ax.set(xlabel="time [s]", ylabel="track completeness", ylim=(0, 1.02))
    ax.grid(alpha=0.3)
    ax.legend()


def _extent(image: xr.Dataset) -> tuple[float, float, float, float]:
    half = 0.5 * float(image.attrs["gsd_m"])
    x, y = image["x"].values, image["y"].values
    return x[0] - half, x[-1] + half, y[-1] - half, y[0] + half


def _ground_axes(ax: Axes, image: xr.Dataset | None = None) -> None:
    ax.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
    if image is not None:  # overlays outside the image do not widen the view
        west, east, south, north = _extent(image)
        ax.set(xlim=(west, east), ylim=(south, north), autoscale_on=False)
