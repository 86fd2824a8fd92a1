"""Pictures and figures as PNG or JPEG, whole or not at all."""

import os
from pathlib import Path

import matplotlib.image
import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from glintrack.arrays import Array


def write_picture(path: Path, picture: Float[Array, "y x 3"]) -> None:
    """Write an sRGB picture, 0 to 1, as PNG or JPEG by its ending."""
    beside = path.with_name(f".partial-{path.name}")
    quality = _JPEG if path.suffix.lower() in (".jpg", ".jpeg") else None
    try:
        matplotlib.image.imsave(beside, np.clip(picture, 0, 1), pil_kwargs=quality)
        beside.rename(path)
    finally:
        beside.unlink(missing_ok=True)


_JPEG: dict = {"quality": 82}


def write_figure(path: Path, figure: Figure, dpi: int = 150) -> None:
    """Write a figure as PNG or JPEG by its ending, whole or not at all."""
    beside = path.with_name(f".partial-{os.getpid()}-{path.name}")
    try:
        figure.savefig(beside, dpi=dpi)
        beside.rename(path)
    finally:
        beside.unlink(missing_ok=True)
