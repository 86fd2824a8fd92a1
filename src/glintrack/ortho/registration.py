"""Registration of rectified frames against a reference: the cure for a navigator's errors, and their measure.

This moves whole frames to the reference's ground coordinates by phase correlation, before the tracker sees
them. The tracker's own `track.register` does something else: it follows what shakes from frame to frame
against its slowly moving background, and leaves slow drift in.
"""

import math

import numpy as np
import xarray as xr
from scipy.ndimage import shift as shifted

from glintrack.core.image_shift import displacement_between
from glintrack.core.schema import check

WORTH_PX = 0.02  # a smaller displacement changes less than the interpolation does


def register(image: xr.Dataset, reference: xr.Dataset, most_px: float = 16.0) -> xr.Dataset:
    """Move a rectified frame to where its panchromatic content lies in the reference.

    Parameters
    ----------
    image, reference
        Schema ``image`` on one grid.
    most_px
        Larger displacements are not looked for. [pixel]

    Returns
    -------
    The frame moved by bilinear interpolation, with attributes ``registration_rows`` and
    ``registration_columns``: the displacement taken out; nought where none stood out. [pixel]
    """
    check(image, "image")
    check(reference, "image")
    rows, columns, clearness = displacement_between(image["pan"].values, reference["pan"].values, most_px)
    found = math.isfinite(rows)
    taken = {
        "registration_rows": rows if found else 0.0,
        "registration_columns": columns if found else 0.0,
        "registration_clearness": clearness,
    }
    if not found or math.hypot(rows, columns) < WORTH_PX:
        return image.assign_attrs(taken)
    moved = {
        name: image[name].copy(
            data=shifted(
                image[name].values,
                (-rows, -columns) + (0,) * (image[name].ndim - 2),
                order=1,
                mode="constant",
                cval=np.nan,
                prefilter=False,
            )
        )
        for name in ("pan", "stokes_radiance", "dolp")
    }
    return check(image.assign(moved).assign_attrs(taken), "image")
