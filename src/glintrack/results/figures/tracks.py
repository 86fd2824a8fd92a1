"""Figures of rectified frames with tracks; every function draws on a matplotlib Axes."""

from collections.abc import Mapping

import numpy as np
import xarray as xr
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.patheffects import AbstractPathEffect, withStroke

from glintrack.core.arrays import Array, is_at_time
from glintrack.core.installation import read_data
from glintrack.core.records import Extent
from glintrack.core.schema import CHANNEL_WORDS
from glintrack.results.figures import DOLP, LOOP_STYLES, MARKS, MAX_DOLP, NO_DATA, RADIANCE, label_axes

QUERY_COLOUR = "#dc267f"
_SHAPES: Mapping[str, tuple[str, int, str]] = read_data("page", "scores.toml")["shapes"]
_OUTLINE: list[AbstractPathEffect] = [withStroke(linewidth=2.4, foreground=(0, 0, 0, 0.65))]


def show_rgb(ax: Axes, picture: Float[Array, "y x 3"], extent_m: tuple | None = None) -> None:
    """Draw an sRGB picture, on the ground grid with its extent (west, south, east, north); NaN is grey."""
    ax.set_facecolor(NO_DATA)
    known = np.isfinite(picture).all(axis=-1, keepdims=True)
    shown = np.concatenate([np.clip(np.nan_to_num(picture), 0, 1), known], axis=-1)
    if extent_m is None:
        ax.imshow(shown, interpolation="nearest")
        ax.set(xticks=[], yticks=[])
        return
    west, south, east, north = extent_m
    ax.imshow(shown, extent=(west, east, south, north), interpolation="nearest")
    _ground_axes(ax)


def show_pan(ax: Axes, image: xr.Dataset) -> None:
    """Draw panchromatic radiance of a rectified frame, black to white over its middle 98 %."""
    values = image["pan"].values
    low, high = np.nanpercentile(values, [1, 99]) if np.isfinite(values).any() else (0, 1)
    label = "pan radiance [W m$^{-2}$ sr$^{-1}$ µm$^{-1}$]"
    _show(ax, values, label, cmap=RADIANCE, vmin=low, vmax=high, extent=_extent(image))
    _ground_axes(ax, image)


def show_dolp(ax: Axes, image: xr.Dataset, highest: float = MAX_DOLP) -> None:
    """Draw the degree of linear polarization of a rectified frame; masked pixels are blue-grey."""
    style = {"cmap": DOLP, "vmin": 0, "vmax": highest}
    _show(ax, image["dolp"].values, "degree of linear polarization", extent=_extent(image), **style)
    _ground_axes(ax, image)


def show_dolp_view(ax: Axes, values: Float[Array, "y x"]) -> None:
    """Draw the degree of linear polarization in the aircraft's view, in the scale of `show_dolp`. [1]"""
    _show(ax, values, "degree of linear polarization", cmap=DOLP, vmin=0, vmax=MAX_DOLP)
    ax.set(xticks=[], yticks=[])  # the frame alone, so that unknown pixels stay grey


def _show(ax: Axes, values: Float[Array, "y x"], label: str, extent: Extent | None = None, **style) -> None:
    """Draw values through a colour map with its bar; blue-grey where there is no data."""
    ax.set_facecolor(NO_DATA)
    sides = extent and (extent.west_m, extent.east_m, extent.south_m, extent.north_m)
    shown = ax.imshow(values, interpolation="nearest", extent=sides, **style)
    ax.figure.colorbar(shown, ax=ax, shrink=0.8, label=label)


def show_tracks(ax: Axes, rows: xr.Dataset, time_s: float, tail_s: float = 8.0, label: bool = False) -> None:
    """Draw confirmed tracks at one time with their tails, in the colours and shapes of the report page.

    Parameters
    ----------
    ax
        Axes in ENU metres.
    rows
        ``/pan/tracks`` of a result; without its columns ``valid`` and ``false`` every track counts as true.
    time_s
        Time of the epoch. [s]
    tail_s
        Length of the tails. [s]
    label
        Whether to write each track's id.
    """
    if not rows.sizes.get("row"):
        return
    t, ident = rows["time_s"].values, rows["track_id"].values
    position = np.stack([rows["east_m"].values, rows["north_m"].values], axis=1)
    recent = (t <= time_s + 1e-9) & (t >= time_s - tail_s)
    now = is_at_time(t, time_s)
    kinds = track_kinds(rows)
    for kind, (shape, size, name) in _SHAPES.items():
        chosen = now & (kinds == kind)
        if not chosen.any():
            continue
        tails = [position[recent & (ident == i)] for i in np.unique(ident[chosen])]
        ax.add_collection(LineCollection(tails, colors=MARKS[kind], linewidths=0.8, path_effects=_OUTLINE))
        style = {"facecolors": "none", "edgecolors": MARKS[kind], "linewidths": 1.2, "path_effects": _OUTLINE}
        ax.scatter(*position[chosen].T, s=size, marker=shape, label=name, zorder=3, **style)
    for i in np.flatnonzero(now) if label else ():
        text = ax.annotate(str(ident[i]), position[i], (4, 4), textcoords="offset points", fontsize=7)
        text.set(color="white", path_effects=_OUTLINE)


def show_missed(
    ax: Axes, truth: xr.Dataset, rows: xr.Dataset, time_s: float, moving_m_s: float = 1.0
) -> None:
    """Draw moving vehicles of ``/truth`` without a true track of ``rows`` at one time, as crosses."""
    if not truth.sizes.get("row"):
        return
    speed = np.hypot(truth["east_speed_m_s"].values, truth["north_speed_m_s"].values)
    now = missed_rows(truth, rows, time_s) & (speed >= moving_m_s)
    shape, size, name = _SHAPES["missed"]
    style = {"c": MARKS["missed"], "linewidths": 1.0, "path_effects": _OUTLINE}
    place = truth["east_m"].values[now], truth["north_m"].values[now]
    ax.scatter(*place, s=size, marker=shape, label=name, **style)


def show_legend(ax: Axes) -> None:
    """Draw the legend of the marks on grey below the figure."""
    handles, labels = ax.get_legend_handles_labels()
    if handles:
        ax.figure.legend(
            handles, labels, loc="outside lower center", ncols=len(labels), fontsize=9, facecolor="#5d6671",
            labelcolor="white", framealpha=1.0,
        )  # fmt: skip


def missed_rows(truth: xr.Dataset, rows: xr.Dataset, time_s: float) -> Array:
    """Return True for each row of a truth at a time with a scored vehicle without a true track."""
    now = is_at_time(truth["time_s"].values, time_s)
    if "inside" in truth:
        now &= truth["inside"].values.astype(bool)
    if {"vehicle_id", "valid"} <= set(rows.variables):
        on = is_at_time(rows["time_s"].values, time_s) & (rows["valid"].values > 0)
        now &= ~np.isin(truth["vehicle_id"].values, rows["vehicle_id"].values[on])
    return now


def track_kinds(rows: xr.Dataset) -> Array:
    """Kind of each row, a key of `figures.MARKS`."""
    count = rows.sizes["row"]
    flags = {
        name: rows[name].values > 0 if name in rows else np.full(count, name == "valid")
        for name in ("valid", "false")
    }
    unmeasured = ["coasted", "stopped"]
    coasted = np.isin(rows["status"], unmeasured) if "status" in rows else np.zeros(count, bool)
    kinds = np.where(flags["valid"], np.where(coasted, "coast", "true"), "other")
    return np.where(flags["false"], "false", kinds)


def show_completeness(ax: Axes, result: xr.DataTree) -> None:
    """Draw track completeness against time for every channel of a result."""
    for channel, style in LOOP_STYLES.items():
        if channel in result.children:
            node = result[channel]
            purity = float(node.attrs.get("purity", np.nan))
            name = CHANNEL_WORDS[channel]
            label = f"{name} (purity {purity:.2f})" if np.isfinite(purity) else name
            ax.plot(node["time"], node["completeness"], label=label, **style)
    label_axes(ax, "time [s]", "track completeness", "Track completeness, Eq. (13)", ylim=(0, 1.02))
    ax.legend()


def _extent(image: xr.Dataset) -> Extent:
    """Ground that a rectified frame shows, to the edges of its pixels. [m]"""
    return Extent.of_cells(image["x"].values, image["y"].values, float(image.attrs["gsd_m"]))


def _ground_axes(ax: Axes, image: xr.Dataset | None = None) -> None:
    ax.set(xlabel="east [m]", ylabel="north [m]", aspect="equal")
    if image is not None:  # overlays outside the image do not widen the view
        west, south, east, north = _extent(image)
        ax.set(xlim=(west, east), ylim=(south, north), autoscale_on=False)
