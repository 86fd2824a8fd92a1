"""Pictures and figures as PNG or JPEG, whole or not at all."""

import io
from pathlib import Path

import matplotlib.image
import numpy as np
import PIL.Image
from jaxtyping import Float, UInt
from matplotlib.figure import Figure

from glintrack.core.arrays import Array
from glintrack.io.atomic import beside, write_bytes

DOTS_PER_INCH = 150  # of a figure


def write_picture(path: Path, picture: Float[Array, "y x 3"]) -> None:
    """Write an sRGB picture, 0 to 1, as PNG or JPEG by its ending."""
    quality = _JPEG if path.suffix.lower() in (".jpg", ".jpeg") else None
    with beside(path) as partial:
        matplotlib.image.imsave(partial, np.clip(picture, 0, 1), pil_kwargs=quality)
        partial.rename(path)


_JPEG: dict = {"quality": 82}


def write_figure(path: Path, figure: Figure, dpi: int = DOTS_PER_INCH) -> None:
    """Write a figure as PNG or JPEG by its ending, whole or not at all."""
    with beside(path) as partial:
        figure.savefig(partial, dpi=dpi)
        partial.rename(path)


def write_counts(path: Path, counts: UInt[Array, "row column"]) -> None:
    """Write counts of 16 bits as a PNG without loss, whole or not at all."""
    buffer = io.BytesIO()
    PIL.Image.fromarray(np.ascontiguousarray(counts, np.uint16)).save(buffer, "PNG")
    write_bytes(path, buffer.getvalue())
