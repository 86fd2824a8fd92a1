"""Video of a flight's film with its tracks, as MP4 or GIF."""

import errno
import math
import subprocess
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import xarray as xr
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from glintrack import metrics
from glintrack.core.arrays import Array, is_at_time
from glintrack.core.installation import require_extra
from glintrack.io.atomic import temporary_path
from glintrack.results.figures import MARKS
from glintrack.results.figures.tracks import missed_rows, track_kinds
from glintrack.results.film import KINDS
from glintrack.results.read import Result, dataset_at, film_file

TITLES = {"rgb": "natural colour", "pan": "pan", "dolp": "DoLP", "aop": "AoP"}
_TAIL_S = 8.0
_RADIUS_PX = 5
_WIDE_PX = 480  # width of a picture with lines of one pixel
_GIF_COLOURS = 128
_GIF_MAX_HZ = 50.0  # browsers slow down anything faster; frames begin at whole hundredths of a second
_MAX_PIXELS = 50e6


@dataclass(frozen=True)
class Composite:
    """Frames of a video: pictures side by side, two per row, with tracks and moving vehicles.

    Parameters
    ----------
    result
        From `read_result`, with a film.
    kinds
        Pictures in order.
    channel
        Channel of the tracks.
    size
        Width and height of one picture. [pixel]
    tracks, truth
        Rows of the result.
    """

    result: Result
    kinds: tuple[str, ...]
    channel: str
    size: tuple[int, int]
    tracks: xr.Dataset
    truth: xr.Dataset

    @classmethod
    def of(
        cls, result: Result, kinds: tuple[str, ...] = (), channel: str | None = None, width: int = 1280
    ) -> "Composite":
        """Frames of a result's film with a total width of ``width`` pixels; all pictures by default.

        Raises
        ------
        ValueError
            If there is no film, or it lacks a picture or the channel.
        """
        film = result.film
        if not film.get("frames"):
            why = [note for note in result.notes if "film" in note]
            raise ValueError(f"`result` must have a film; got {result.path}: {' '.join(why)}")
        present = tuple(kind for kind in KINDS if kind in film["kinds"])
        if missing := [kind for kind in kinds if kind not in present]:
            raise ValueError(f"`pictures` must be in the film ({', '.join(present)}); got {missing[0]!r}.")
        kinds, names = kinds or present, result.channels
        if channel is not None and channel not in names:
            raise ValueError(f"`channel` must be one of {', '.join(names) or 'none'}; got {channel!r}.")
        chosen = channel or (names[0] if names else "")
        west, south, east, north = film["extent_m"]
        one = width // min(2, len(kinds))
        # H.264 needs even sides
        size = tuple(max(2, 2 * round(side / 2)) for side in (one, one * (north - south) / (east - west)))
        rows = dataset_at(result.tree, f"{chosen}/tracks") if chosen else xr.Dataset()
        return cls(result, kinds, chosen, (size[0], size[1]), rows, dataset_at(result.tree, "truth"))

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.result.film["frames"])

    @property
    def rate_hz(self) -> float:
        """Frames per second of the flight. [Hz]"""
        times = self.result.film["times_s"]
        return (len(times) - 1) / (times[-1] - times[0]) if len(times) > 1 else 1.0

    def draw(self, index: int) -> UInt8[Array, "y x 3"]:
        """Draw one frame of the video."""
        film, (width, height) = self.result.film, self.size
        columns = min(2, len(self.kinds))
        rows = -(-len(self.kinds) // columns)
        canvas = Image.new("RGB", (columns * width, rows * height))
        for k, kind in enumerate(self.kinds):
            path = film_file(self.result.path, kind, film["frames"][index])
            picture = Image.new("RGB", self.size)
            if path is not None:
                with Image.open(path) as stored:
                    if stored.width * stored.height > _MAX_PIXELS:
                        raise ValueError(
                            f"`film` must have pictures of at most {_MAX_PIXELS:g} pixels; got {path} with "
                            f"{stored.width} × {stored.height}."
                        )
                    picture = stored.convert("RGB").resize(self.size, Image.Resampling.BICUBIC)
            pen, time_s = ImageDraw.Draw(picture), film["times_s"][index]
            self._overlay(pen, time_s)
            text, font = f"{TITLES[kind]}  {time_s:.1f} s", ImageFont.load_default(size=14)
            pen.rectangle(pen.textbbox((6, 4), text, font=font), fill=(0, 0, 0))
            pen.text((6, 4), text, (255, 255, 255), font=font)
            canvas.paste(picture, ((k % columns) * width, (k // columns) * height))
        return np.asarray(canvas)

    def _overlay(self, pen: ImageDraw.ImageDraw, time_s: float) -> None:
        thick = max(1, round(self.size[0] / _WIDE_PX))
        if self.truth.sizes.get("row"):
            now = missed_rows(self.truth, self.tracks, time_s) & metrics.is_moving(self.truth)
            for x, y in self._pixels(self.truth.isel(row=np.flatnonzero(now))):
                for slope in (1, -1):
                    pen.line([(x - 2, y - 2 * slope), (x + 2, y + 2 * slope)], MARKS["missed"], thick)
        if not self.tracks.sizes.get("row"):
            return
        t, ident = self.tracks["time_s"].values, self.tracks["track_id"].values
        recent = np.flatnonzero((t <= time_s + 1e-6) & (t >= time_s - _TAIL_S))
        places = self._pixels(self.tracks.isel(row=recent))
        kinds = track_kinds(self.tracks)[recent]
        for k in np.flatnonzero(is_at_time(t[recent], time_s)):
            colour = MARKS[kinds[k]]
            tail = places[ident[recent] == ident[recent[k]]]
            if len(tail) > 1:
                pen.line([tuple(p) for p in tail.tolist()], colour, thick)
            _mark(pen, kinds[k], places[k].tolist(), colour, thick)

    def _pixels(self, rows: xr.Dataset) -> Array:
        """Columns and rows of the positions of a table in a picture."""
        west, south, east, north = self.result.film["extent_m"]
        x = (rows["east_m"].values - west) / (east - west) * self.size[0]
        y = (north - rows["north_m"].values) / (north - south) * self.size[1]
        return np.stack([x, y], axis=1)


def write_video(path: str | Path, frames: Iterable[UInt8[Array, "y x 3"]], rate_hz: float) -> None:
    """Write pictures of one size as MP4 (H.264) or GIF, by the ending; complete or not at all.

    Raises
    ------
    ValueError
        If the ending is another one, or the extra ``video`` is missing for an MP4.
    """
    path = Path(path)
    ending = path.suffix.lower()
    if ending not in (".mp4", ".gif"):
        raise ValueError(f"`output` must end in .mp4 or .gif; got {path.name!r}.")
    with temporary_path(path) as partial:
        (_write_mp4 if ending == ".mp4" else _write_gif)(partial, frames, rate_hz)
        partial.rename(path)


def _write_gif(path: Path, frames: Iterable[Array], rate_hz: float) -> None:
    pictures = [Image.fromarray(f).quantize(_GIF_COLOURS, dither=Image.Dither.NONE) for f in frames]
    step = math.ceil(rate_hz / _GIF_MAX_HZ)
    begins = np.round(100 / rate_hz * np.array([*range(0, len(pictures), step), len(pictures)]))
    shown_ms = [max(20, 10 * int(one)) for one in np.diff(begins)]
    first, *rest = pictures[::step]
    first.save(path, save_all=True, append_images=rest, duration=shown_ms, loop=0, optimize=True)


def _write_mp4(path: Path, frames: Iterable[Array], rate_hz: float) -> None:
    ffmpeg = require_extra("imageio_ffmpeg", "video", "write MP4 (GIF needs none)")
    writer, sent = None, 0
    try:
        for frame in frames:
            if writer is None:
                size = (frame.shape[1], frame.shape[0])
                writer = ffmpeg.write_frames(str(path), size, fps=rate_hz, quality=7, macro_block_size=2)
                writer.send(None)
            writer.send(np.ascontiguousarray(frame))
            sent += 1
    finally:
        if writer is not None:
            writer.close()
    try:  # ffmpeg does not say where a disk is full
        whole = ffmpeg.count_frames_and_secs(str(path))[0] == sent
    except (RuntimeError, OSError, subprocess.SubprocessError):
        whole = False
    if not whole:
        raise OSError(errno.ENOSPC, "the video cannot be written whole (is the disk full?)", str(path))


def _mark(pen: ImageDraw.ImageDraw, kind: str, place: tuple[float, float], colour: str, thick: int) -> None:
    """Draw the shapes of the report page: circle, diamond for coasting, triangle for false."""
    (x, y), r = place, _RADIUS_PX
    corners = {"coast": [(0, -r), (r, 0), (0, r), (-r, 0)], "false": [(0, -r), (r, 0.8 * r), (-r, 0.8 * r)]}
    if kind in corners:
        around = [(x + dx, y + dy) for dx, dy in corners[kind]]
        pen.line([*around, around[0]], colour, thick)
    else:
        pen.ellipse([x - r, y - r, x + r, y + r], outline=colour, width=thick)
