"""Film of a flight: small pictures of every frame, in colours that are safe for colour-blind eyes.

Natural colour, pan radiance, degree and angle of polarization on the ground grid, as WebP. The angle is the
colour and the degree the brightness, since most of the ground has nearly one angle. They show the first
channel's frames: the channels differ only in the mirrors of their queries.
"""

import io
import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Annotated, Any, Literal, Self

import matplotlib
import numpy as np
import xarray as xr
from jaxtyping import Float, UInt8
from PIL import Image
from pydantic import BaseModel, Field, ValidationError, model_validator

from glintrack.core.arrays import Array
from glintrack.results.figures import MAX_DOLP, NO_DATA, OF_CHANNEL
from glintrack.stokes import aop

KINDS = ("rgb", "pan", "dolp", "aop")
FILM_BYTES = 18_000_000  # all pictures together; in base64, with its tables, a page stays under 40 MB
MIN_AOP_DOLP = 0.02  # an angle of less polarized light is mostly noise, and shown as no data
FULL_AOP_DOLP = 0.15  # the brightest in the picture of the angle
_MIN_BRIGHTNESS = 0.25
_NO_DATA = tuple(int(NO_DATA[k : k + 2], 16) for k in (1, 3, 5))
# longest side [pixel] and WebP quality, from the best to the smallest
_LEVELS = (
    (960, 80), (800, 75), (640, 70), (560, 60), (480, 55), (400, 45), (320, 40), (240, 30), (160, 20),
    (96, 10),
)  # fmt: skip


@dataclass
class Film:
    """Pictures of evenly spread frames, within a budget of bytes.

    Parameters
    ----------
    frames
        Indices of the frames.
    budget
        Size of all pictures. [byte]
    pictures
        Encoded WebP of each kind and frame; a kind that does not apply is missing.
    times_s
        Time of each frame. [s]
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
    def of(cls, frames: int, max_frames: int, budget: int = FILM_BYTES) -> "Film":
        """Empty film of at most ``max_frames`` of ``frames`` frames."""
        chosen = np.linspace(0, frames - 1, min(frames, max_frames)).round().astype(int)
        return cls(frozenset(chosen.tolist()), budget, {}, {})

    def add(self, index: int, time_s: float, image: xr.Dataset, rgb: Float[Array, "y x 3"] | None) -> None:
        """Add one frame's pictures, smaller than the last one's if necessary; none if they are too large.

        Parameters
        ----------
        index, time_s
            Index and time of the frame. [s]
        image
            Schema ``image``.
        rgb
            Natural colour on the same grid, sRGB 0 to 1, NaN for no data; or None.
        """
        if not self.times_s:
            values = image["pan"].values
            low, high = np.nanpercentile(values, [1, 99]) if np.isfinite(values).any() else (0.0, 1.0)
            self.pan_range = float(low), float(max(high, low + 1e-6 * max(abs(low), 1e-6)))
        shown = colour_pictures(image, self.pan_range)
        if rgb is not None:
            known = np.isfinite(rgb.sum(axis=-1))
            picture = np.round(255 * np.clip(np.where(known[..., None], rgb, 0), 0, 1)).astype(np.uint8)
            picture[~known] = _NO_DATA
            shown = {"rgb": picture, **shown}
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

    def remove(self, index: int) -> None:
        """Remove the pictures of one frame, if there are any."""
        self.times_s.pop(index, None)
        self.pictures = {key: data for key, data in self.pictures.items() if key[1] != index}

    def index(self) -> dict:
        """Plain values for ``film.json``."""
        frames = sorted(self.times_s)
        return {
            "kinds": [kind for kind in KINDS if any((kind, k) in self.pictures for k in frames)],
            "frames": frames,
            "times_s": [self.times_s[k] for k in frames],
            "size": list(self.size),
            "pan_range": list(self.pan_range),
            "dolp_highest": MAX_DOLP,
            "aop_least_dolp": MIN_AOP_DOLP,
            "aop_full_dolp": FULL_AOP_DOLP,
        }


def picture_name(kind: str, frame: int) -> str:
    """File name of one picture of a film."""
    return f"{kind}_{frame:05d}.webp"


def colour_pictures(image: xr.Dataset, pan_range: tuple[float, float]) -> dict[str, UInt8[Array, "y x 3"]]:
    """Pan, DoLP and AoP of a rectified frame in colours; grey-blue where there is no data.

    DoLP runs from 0 to `MAX_DOLP`, AoP from 0 to π in the ``meridian`` frame. AoP is the colour, and the root
    of DoLP the brightness.
    """
    low, high = pan_range
    pan, degree = image["pan"].values, image["dolp"].values
    angle = np.where(degree >= MIN_AOP_DOLP, aop(np.nan_to_num(image["stokes_radiance"].values)), np.nan)
    scaled = {"pan": (pan - low) / (high - low)}
    if not np.isfinite(degree).any():  # a sensor without polarizers has none to show
        return {"pan": _apply_colour_map(scaled["pan"], OF_CHANNEL["pan"])}
    scaled |= {"dolp": degree / MAX_DOLP, "aop": angle / math.pi}
    found = {kind: _apply_colour_map(values, OF_CHANNEL[kind]) for kind, values in scaled.items()}
    brightness = np.sqrt(np.clip(np.nan_to_num(degree) / FULL_AOP_DOLP, _MIN_BRIGHTNESS**2, 1))
    shaded = np.round(found["aop"] * brightness[..., None]).astype(np.uint8)
    return found | {"aop": np.where(np.isfinite(angle)[..., None], shaded, found["aop"])}


def encode(picture: UInt8[Array, "y x 3"], longest_side: int, quality: int) -> bytes:
    """Encode a picture as WebP, made smaller where its longest side is above the limit."""
    shown = Image.fromarray(picture)
    shown.thumbnail((longest_side, longest_side), Image.Resampling.BOX)
    buffer = io.BytesIO()
    shown.save(buffer, "WEBP", quality=quality, method=2)
    return buffer.getvalue()


def _apply_colour_map(values: Float[Array, "y x"], name: str) -> UInt8[Array, "y x 3"]:
    """Values 0 to 1 through a colour map."""
    table = np.round(255 * matplotlib.colormaps[name](np.linspace(0, 1, 256))[:, :3]).astype(np.uint8)
    known = np.isfinite(values)
    picture = table[np.clip(np.where(known, values, 0) * 255.999, 0, 255).astype(np.uint8)]
    picture[~known] = _NO_DATA
    return picture


_Figure = Annotated[float, Field(ge=-1e12, le=1e12, allow_inf_nan=False)]  # eastings and times are smaller


class FilmIndex(BaseModel):
    """Content of a ``film.json``."""

    kinds: list[Literal["rgb", "pan", "dolp", "aop"]]
    frames: list[Annotated[int, Field(ge=0, le=10**12)]]
    times_s: list[_Figure]
    extent_m: tuple[_Figure, _Figure, _Figure, _Figure]
    pan_range: tuple[_Figure, _Figure] = (0.0, 1.0)
    dolp_highest: _Figure = MAX_DOLP
    aop_least_dolp: _Figure = MIN_AOP_DOLP
    aop_full_dolp: _Figure = 0.0  # of a film with one brightness
    channel: str = ""

    @model_validator(mode="after")
    def _check_consistency(self) -> Self:
        west, south, east, north = self.extent_m
        if len(self.times_s) != len(self.frames):
            raise ValueError("numbers of times and frames must be equal")
        if not (west < east and south < north and 0.01 < (east - west) / (north - south) < 100):
            raise ValueError("`extent_m` must not be empty or a line")
        if any(after <= before for before, after in pairwise(self.times_s)):
            raise ValueError("`times_s` must rise")
        return self


def validate_film(film: Any) -> dict:
    """Plain values of a ``film.json``.

    Raises
    ------
    ValueError
        If a value is missing, of another type, or out of range.
    """
    try:
        return FilmIndex.model_validate(film).model_dump()
    except ValidationError as error:
        fault = error.errors()[0]
        place = ".".join(map(str, fault["loc"]))
        raise ValueError(f"{place}: {fault['msg']}" if place else fault["msg"]) from error
