"""Page on which a user labels the vehicles in own frames by hand; it works without a network."""

import base64
from collections.abc import Iterable
from pathlib import Path

import xarray as xr

from glintrack.io.atomic import write_text
from glintrack.io.tracks import LABEL_FILE_COLUMNS
from glintrack.report.frames_page import FrameFilm
from glintrack.report.page import render_page, script_json

MAX_SIDE_PX, QUALITY = 2000, 85  # of a picture
MAX_FRAMES, MAX_BYTES = 300, 80_000_000  # of a page that a browser opens


def write_label_page(
    path: Path,
    title: str,
    frames: Iterable[tuple[float, xr.Dataset]],
    area_m: tuple[float, float, float, float] | None = None,
) -> int:
    """Write the page, and return the number of frames on it.

    Parameters
    ----------
    path
        HTML file.
    title
        Name of the frames.
    frames
        Time [s] and Dataset of the schema ``image``, on one grid.
    area_m
        West, south, east, north of the part to show; all of it by default. [m]

    Raises
    ------
    ValueError
        If no frame or no pixel is left, or the page would be too large.
    """
    film = FrameFilm(max_side_px=MAX_SIDE_PX, quality=QUALITY)
    size = 0
    for _ in film.record((time_s, _crop(image, area_m)) for time_s, image in frames):
        size += len(film.pictures[-1])
        if len(film.times_s) > MAX_FRAMES or size > MAX_BYTES:
            raise ValueError(
                f"`frames` must be at most {MAX_FRAMES} and {MAX_BYTES / 1e6:g} MB as pictures; got more at "
                f"frame {len(film.times_s)}. Give fewer frames, or a part of them with --area."
            )
    if film.extent_m is None:
        raise ValueError("`frames` must hold a frame to label; got none.")
    data = {
        "times_s": film.times_s,
        "extent_m": film.extent_m,
        "columns": LABEL_FILE_COLUMNS,
        "pictures": [base64.b64encode(one).decode() for one in film.pictures],
    }
    page = render_page(
        "label.html.j2", scripts=("theme.js", "label.js"), title=title, columns=LABEL_FILE_COLUMNS,
        area=" ".join(f"{round(edge, 3) + 0.0:.12g}" for edge in film.extent_m), last=len(film.times_s) - 1,
        data=script_json(data),
    )  # fmt: skip
    write_text(path, page)
    return len(film.times_s)


def _crop(image: xr.Dataset, area_m: tuple[float, float, float, float] | None) -> xr.Dataset:
    """Part of a frame whose pixels have their middle in an area."""
    if area_m is None:
        return image
    west, south, east, north = area_m
    part = image.sel(x=slice(west, east), y=slice(north, south))
    if min(part.sizes["x"], part.sizes["y"]) < 2:
        x, y = image["x"].values, image["y"].values
        raise ValueError(
            f"`area` must be west south east north with pixels of the frames, {x[0]:.6g} {y[-1]:.6g} "
            f"{x[-1]:.6g} {y[0]:.6g}; got {west:g} {south:g} {east:g} {north:g}."
        )
    return part
