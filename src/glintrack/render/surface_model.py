"""Heights of roofs and crowns on a grid, by rays straight down: what can hide the ground from the camera."""

import numpy as np
import xarray as xr

from glintrack.render.rays.tracer import SceneTracer, standing_box
from glintrack.scene import Snapshot

_ABOVE_M = 10.0
_ROWS_AT_A_TIME = 256


def surface_model(
    tracer: SceneTracer,
    snapshot: Snapshot,
    area_m: tuple[float, float, float, float],
    step_m: float,
) -> xr.Dataset:
    """Surface model of all that stands still.

    Parameters
    ----------
    tracer
        Of the scene; what moves is taken out of it until the next `SceneTracer.place`.
    snapshot
        The scene at any time.
    area_m
        West, south, east, north, ENU. [m]
    step_m
        Between the rays, one a cell. [m]

    Returns
    -------
    Schema ``terrain``, heights of what a ray from above meets first: of ground, roof, or leaf where none of a
    crown's holes lets it through. 0 where there is nothing, as beyond the scene's edge. [m]

    Raises
    ------
    ValueError
        If the area does not hold two cells a side.
    """
    west, south, east, north = area_m
    columns, rows = int((east - west) / step_m), int((north - south) / step_m)
    if min(columns, rows) < 2:
        raise ValueError(f"`area_m` must hold two cells of {step_m:g} m a side at least, got {area_m}")
    x = west + step_m * (np.arange(columns) + 0.5)
    y = north - step_m * (np.arange(rows) + 0.5)
    with tracer.busy:
        tracer.rays.update(snapshot.transforms[:0], snapshot.model[:0])
        top = float(standing_box(snapshot)[1][2]) + _ABOVE_M
        height = np.empty((rows, columns))
        for start in range(0, rows, _ROWS_AT_A_TIME):
            block = y[start : start + _ROWS_AT_A_TIME]
            origins = np.empty((len(block), columns, 3), np.float32)
            origins[..., 0], origins[..., 1], origins[..., 2] = x[None], block[:, None], top
            down = np.zeros((origins[..., 0].size, 3), np.float32)
            down[:, 2] = -1
            reach = tracer.rays.intersect(origins.reshape(-1, 3), down)[0].reshape(origins.shape[:2])
            height[start : start + len(block)] = np.where(np.isfinite(reach), top - reach, 0.0)
    metres = {"units": "m"}
    return xr.Dataset(
        {"height": (("y", "x"), height, metres)}, coords={"y": ("y", y, metres), "x": ("x", x, metres)}
    )
