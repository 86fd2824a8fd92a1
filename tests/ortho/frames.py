"""Frames of superpixels and terrains for tests of rectification."""

import numpy as np
import xarray as xr

from glintrack.core.schema import RADIANCE


def level(height_m=0.0):
    """Flat terrain."""
    return terrain(lambda e, n: np.full(np.broadcast_shapes(e.shape, n.shape), height_m))


def terrain(height):
    x, y = np.arange(-200.0, 201, 10), np.arange(200.0, -201, -10)
    metres = {"units": "m"}
    return xr.Dataset(
        {"height": (("y", "x"), height(x[None], y[:, None]), metres)},
        coords={"y": ("y", y, metres), "x": ("x", x, metres)},
    )


def frame_of(pan, polarized, offset=0.0, **attrs):
    """A frame of superpixels; ``offset`` of both arrays' samples from the superpixels' centres."""
    rows, columns = pan.shape
    place = {"units": RADIANCE, "row_offset": offset, "column_offset": offset}
    element = {"units": "element"}
    return xr.Dataset(
        {
            "pan": (("y", "x"), pan, place),
            "stokes_radiance": (("y", "x", "stokes"), polarized, {**place, "stokes_frame": "detector"}),
        },
        coords={
            "y": ("y", 2.0 * np.arange(rows) + 0.5, element),
            "x": ("x", 2.0 * np.arange(columns) + 0.5, element),
            "stokes": ["I", "Q", "U"],
        },
        attrs={"time_s": 4.5, **attrs},
    )


def plain_stokes(pan):
    return np.stack([pan, 0 * pan, 0 * pan], axis=-1)
