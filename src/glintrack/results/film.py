"""The film of a flight: small pictures of every frame, in colours that all eyes can tell apart.

Natural colour, pan radiance, degree and angle of polarization on the ground grid, as WebP. They show the
first channel's frames: the channels look at the same light and differ only in which mirrors were away.
"""

import io
import math
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise

import matplotlib
import numpy as np
import xarray as xr
from jaxtyping import Float, UInt8
from PIL import Image

from glintrack.core.arrays import Array
from glintrack.results.figures import HIGHEST_DOLP, NO_DATA, OF_CHANNEL
from glintrack.stokes import aop

KINDS = ("rgb", "pan", "dolp", "aop")
FILM_BYTES = 18_000_000  # all pictures together; in base64, with its tables, a page stays under 40 MB
AOP_LEAST_DOLP = 0.02  # an angle of less polarized light is mostly noise, and shown as no data
_NO_DATA = tuple(int(NO_DATA[k : k + 2], 16) for k in (1, 3, 5))
_LARGEST = 1e12  # seconds since 1970 and eastings are smaller
# longest side [pixel] and WebP quality, from the best to the least worth looking at
_LEVELS = (
    (960, 80),
    (800, 75),
    (640, 70),
    (560, 60),
    (480, 55),
    (400, 45),
    (320, 40),
    (240, 30),
    (160, 20),
    (96, 10),
)


@dataclass
class Film:
    """Pictures of evenly spread frames, no more bytes together than a budget.

    Parameters
    ----------
    frames
        Indices of the frames to keep.
    budget
        Of all pictures. [byte]
    pictures
        Encoded WebP of each kind and frame; a kind that does not apply is missing.
    times_s
        Of each frame kept. [s]
    size
        Width and height of the first picture; later ones may be smaller. [pixel]
    pan_range
        Radiances that are black and white, fixed by the first frame. [W m⁻² sr⁻¹ µm⁻¹]
    """

    frames: frozenset[int]
    budget: int
    pictures: dict[tuple[str, int], bytes]
    times_s: dict[int, float]
    size: tuple[int, int] = (0, 0)
    pan_range: tuple[float, float] = (0.0, 1.0)
    level: int = 0

    @classmethod
    def of(cls, frames: int, most: int, budget: int = FILM_BYTES) -> "Film":
        """An empty film of at most ``most`` of ``frames`` frames."""
        chosen = np.linspace(0, frames - 1, min(frames, most)).round().astype(int)
        return cls(frozenset(chosen.tolist()), budget, {}, {})

    def add(self, index: int, time_s: float, image: xr.Dataset, rgb: Float[Array, "y x 3"] | None) -> None:
        """Keep one frame's pictures, smaller than the last one's if need be; none if even they are too much.

        Parameters
        ----------
        index, time_s
            Which frame. [s]
        image
            Schema ``image``.
        rgb
            Natural colour on the same grid, sRGB 0 to 1, NaN for no data; or None.
        """
        if not self.times_s:
            self.pan_range = _middle(image["pan"].values)
        shown = colour_pictures(image, self.pan_range)
        if rgb is not None:
            shown = {"rgb": _natural(rgb), **shown}
        share = self.budget // max(len(self.frames), 1)
        while True:
            side, quality = _LEVELS[self.level]
            encoded = {kind: encode(picture, side, quality) for kind, picture in shown.items()}
            if sum(map(len, encoded.values())) <= share:
                break
            if self.level == len(_LEVELS) - 1:
                return
            self.level += 1
        if not self.times_s:
            self.size = Image.open(io.BytesIO(encoded["pan"])).size
        self.pictures.update({(kind, index): data for kind, data in encoded.items()})
        self.times_s[index] = time_s

    def index(self) -> dict:
        """What the film holds, as plain values for its ``film.json``."""
        kept = sorted(self.times_s)
        return {
            "kinds": [kind for kind in KINDS if any((kind, k) in self.pictures for k in kept)],
            "frames": kept,
            "times_s": [self.times_s[k] for k in kept],
            "size": list(self.size),
            "pan_range": list(self.pan_range),
            "dolp_highest": HIGHEST_DOLP,
            "aop_least_dolp": AOP_LEAST_DOLP,
        }


def picture_name(kind: str, frame: int) -> str:
    """File of one picture of a film."""
    return f"{kind}_{frame:05d}.webp"


def colour_pictures(image: xr.Dataset, pan_range: tuple[float, float]) -> dict[str, UInt8[Array, "y x 3"]]:
    """Pan, DoLP and AoP of a rectified frame in colours; grey-blue where there is no data.

    DoLP runs from 0 to `HIGHEST_DOLP`, AoP from 0 to π in the ``meridian`` frame.
    """
    low, high = pan_range
    pan, degree = image["pan"].values, image["dolp"].values
    angle = np.where(degree >= AOP_LEAST_DOLP, aop(np.nan_to_num(image["stokes_radiance"].values)), np.nan)
    scaled = {"pan": (pan - low) / (high - low)}
    if np.isfinite(degree).any():  # a sensor without polarizers has none to show
        scaled |= {"dolp": degree / HIGHEST_DOLP, "aop": angle / math.pi}
    return {kind: _coloured(values, OF_CHANNEL[kind]) for kind, values in scaled.items()}


def encode(picture: UInt8[Array, "y x 3"], longest_side: int, quality: int) -> bytes:
    """A picture as WebP, made smaller where its longest side is above the limit."""
    shown = Image.fromarray(picture)
    shown.thumbnail((longest_side, longest_side), Image.Resampling.BOX)
    buffer = io.BytesIO()
    shown.save(buffer, "WEBP", quality=quality, method=2)
    return buffer.getvalue()


def _coloured(values: Float[Array, "y x"], name: str) -> UInt8[Array, "y x 3"]:
    """Values 0 to 1 through a colour map."""
    known = np.isfinite(values)
    index = np.clip(np.where(known, values, 0) * 255.999, 0, 255).astype(np.uint8)
    picture = _colour_table(name)[index]
    picture[~known] = _NO_DATA
    return picture


@lru_cache
def _colour_table(name: str) -> UInt8[Array, "256 3"]:
    """A colour map of Matplotlib's."""
    return np.round(255 * matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)


def _natural(rgb: Float[Array, "y x 3"]) -> UInt8[Array, "y x 3"]:
    """sRGB 0 to 1 as bytes."""
    known = np.isfinite(rgb.sum(axis=-1))
    picture = np.round(255 * np.clip(np.where(known[..., None], rgb, 0), 0, 1)).astype(np.uint8)
    picture[~known] = _NO_DATA
    return picture


def _middle(values: Array) -> tuple[float, float]:
    """First and 99th percentile, apart from each other."""
    if not np.isfinite(values).any():
        return 0.0, 1.0
    low, high = (float(v) for v in np.nanpercentile(values, [1, 99]))
    return low, max(high, low + 1e-6 * max(abs(low), 1e-6))


def checked_film(film: dict) -> dict:
    """Plain values of a ``film.json`` with their types made sure.

    Raises
    ------
    ValueError, KeyError, TypeError
        If a value is missing, of another type, or makes no sense.
    """
    kinds, frames = [str(k) for k in film["kinds"]], [int(k) for k in film["frames"]]
    times_s, extent_m = [float(t) for t in film["times_s"]], [float(v) for v in film["extent_m"]]
    if len(times_s) != len(frames) or not all(kind in KINDS for kind in kinds):
        raise ValueError("times, frames and kinds of pictures do not match")
    if not all(abs(figure) <= _LARGEST for figure in (*extent_m, *times_s)):
        raise ValueError("a figure is not finite, or larger than any")
    if len(extent_m) != 4 or not (extent_m[0] < extent_m[2] and extent_m[1] < extent_m[3]):
        raise ValueError("its extent is empty")
    if not 0.01 < (extent_m[2] - extent_m[0]) / (extent_m[3] - extent_m[1]) < 100:
        raise ValueError("its extent is a line")
    if any(after <= before for before, after in pairwise(times_s)) or min(frames, default=0) < 0:
        raise ValueError("its times do not rise, or a frame's number is negative")
    if max(frames, default=0) > _LARGEST:
        raise ValueError("a frame's number is larger than any")
    sure = {"kinds": kinds, "frames": frames, "times_s": times_s, "extent_m": extent_m}
    if not frames:
        return sure
    low, high = (float(v) for v in film["pan_range"])
    limits = {name: float(film[name]) for name in ("dolp_highest", "aop_least_dolp")}
    if not all(abs(figure) <= _LARGEST for figure in (low, high, *limits.values())):
        raise ValueError("a figure is not finite, or larger than any")
    return sure | limits | {"pan_range": [low, high], "channel": str(film.get("channel", ""))}
