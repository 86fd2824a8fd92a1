"""Pages of a user's own frames: the film with its tracks and their counts, and one to label vehicles."""

import base64
import io
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import xarray as xr
from PIL import Image

from glintrack.core.arrays import Array
from glintrack.core.records import Extent
from glintrack.io.atomic import write_text
from glintrack.io.tracks import LABEL_FILE_COLUMNS
from glintrack.report.page import render_page, script_json

MAX_SIDE_PX, QUALITY = 1000, 60  # of a picture
LABEL_SIDE_PX, LABEL_QUALITY = 2000, 85
MAX_LABEL_FRAMES, MAX_LABEL_BYTES = 300, 80_000_000  # of a page to label that a browser opens
MAX_PICTURES = 300  # of frames after these the page shows the tracks alone
_LEVELS = (0.005, 0.985)  # quantiles of the first frame that become black and white
TRACK_COLUMNS = ("track", "frames", "first [s]", "last [s]", "mean speed [m/s]")


@dataclass
class FrameFilm:
    """Pictures of frames, recorded while the frames are tracked.

    Parameters
    ----------
    times_s
        Times of the frames. [s]
    pictures
        Frames as JPEG, at most `MAX_PICTURES`.
    extent_m
        Ground of the pictures; None before the first. [m]
    levels
        Values that are shown black and white.
    max_side_px, quality
        Largest side of a picture [pixel], and its JPEG quality.
    """

    times_s: list[float] = field(default_factory=list)
    pictures: list[bytes] = field(default_factory=list)
    extent_m: Extent | None = None
    levels: tuple[float, float] = (0.0, 1.0)
    max_side_px: int = MAX_SIDE_PX
    quality: int = QUALITY

    def record(self, frames: Iterable[tuple[float, xr.Dataset]]) -> Iterator[tuple[float, xr.Dataset]]:
        """Yield the frames unchanged, and keep a picture of each."""
        for time_s, image in frames:
            if self.extent_m is None:
                x, y = image["x"].values, image["y"].values
                self.extent_m = Extent.of_cells(x, y, float(x[1] - x[0]))
                known = image["pan"].values[np.isfinite(image["pan"].values)]
                self.levels = tuple(np.quantile(known, _LEVELS).tolist()) if len(known) else self.levels
            self.times_s.append(time_s)
            if len(self.pictures) < MAX_PICTURES:
                self.pictures.append(self._jpeg(image["pan"].values))
            yield time_s, image

    def _jpeg(self, values: Array) -> bytes:
        low, high = self.levels
        grey = np.clip((np.nan_to_num(values, nan=low) - low) / max(high - low, 1e-12), 0, 1)
        picture = Image.fromarray(np.rint(255 * np.sqrt(grey)).astype(np.uint8))
        picture.thumbnail((self.max_side_px, self.max_side_px))
        out = io.BytesIO()
        picture.save(out, "JPEG", quality=self.quality)
        return out.getvalue()


def write_frames_page(path: Path, title: str, film: FrameFilm, rows: xr.Dataset) -> None:
    """Write the report of tracks.

    Parameters
    ----------
    path
        HTML file.
    title
        Name of the frames.
    film
        Recorded film of all frames.
    rows
        Rows of the tracks, see `track.files.as_rows`.
    """
    ids = rows["track_id"].values if "track_id" in rows else np.empty(0, int)
    frames = len(film.times_s)
    counts = [
        ("frames", str(frames)),
        ("duration [s]", f"{film.times_s[-1] - film.times_s[0]:.3g}" if frames else "0"),
        ("tracks", str(len(np.unique(ids)))),
        ("vehicles in a frame, mean", f"{len(ids) / max(frames, 1):.3g}"),
    ]
    west, south, east, north = film.extent_m or Extent(0.0, 0.0, 1.0, 1.0)
    paths, table = [], []
    for ident in np.unique(ids):
        at = np.flatnonzero(ids == ident)
        times_s, x, y = (rows[name].values[at] for name in ("time_s", "east_m", "north_m"))
        across, down = ((x - west) / (east - west)).round(5), ((north - y) / (north - south)).round(5)
        index = np.searchsorted(film.times_s, times_s - 1e-6)
        paths.append([int(ident), list(zip(index.tolist(), across.tolist(), down.tolist(), strict=True))])
        way_m, passed_s = float(np.hypot(np.diff(x), np.diff(y)).sum()), float(times_s[-1] - times_s[0])
        speed = f"{way_m / passed_s:.3g}" if passed_s > 0 else "–"
        table.append([str(ident), str(len(at)), f"{times_s[0]:.2f}", f"{times_s[-1]:.2f}", speed])
    data = {
        "times_s": film.times_s,
        "tracks": paths,
        "shape": (north - south) / (east - west),
        "pictures": [base64.b64encode(one).decode() for one in film.pictures],
    }
    page = render_page(
        "frames.html.j2", scripts=("theme.js", "frames.js"), title=title, counts=counts,
        last=max(frames - 1, 0), columns=TRACK_COLUMNS, rows=table, data=script_json(data),
    )  # fmt: skip
    write_text(path, page)


def write_label_page(
    path: Path,
    title: str,
    frames: Iterable[tuple[float, xr.Dataset]],
    area_m: tuple[float, float, float, float] | None = None,
) -> int:
    """Write the page on which a user labels vehicles by hand, and return the number of frames on it.

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
    film = FrameFilm(max_side_px=LABEL_SIDE_PX, quality=LABEL_QUALITY)
    size = 0
    for _ in film.record((time_s, _crop(image, area_m)) for time_s, image in frames):
        size += len(film.pictures[-1])
        if len(film.times_s) > MAX_LABEL_FRAMES or size > MAX_LABEL_BYTES:
            raise ValueError(
                f"`frames` must be at most {MAX_LABEL_FRAMES} and {MAX_LABEL_BYTES / 1e6:g} MB as pictures; "
                f"got more at frame {len(film.times_s)}. Give fewer frames, or a part of them with --area."
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
