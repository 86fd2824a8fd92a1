"""Points set on a slope, and past its edges."""

import numpy as np
import xarray as xr

from glintrack.ortho import on_ground


def test_points_on_a_slope_and_beyond_its_edges():
    """z = 2 + 0.1·east − 0.05·north on a grid whose y falls."""
    x, y = np.arange(-50.0, 51.0, 10.0), np.arange(40.0, -41.0, -10.0)
    height = 2 + 0.1 * x[None] - 0.05 * y[:, None]
    terrain = xr.Dataset(
        {"height": (("y", "x"), height, {"units": "m"})},
        coords={"y": ("y", y, {"units": "m"}), "x": ("x", x, {"units": "m"})},
    )
    points = np.array([[0.0, 0.0, 99.0], [13.0, -27.0, 0.0], [500.0, 0.0, 0.0], [0.0, -500.0, 0.0]])
    expected = [2.0, 2 + 1.3 + 1.35, 2 + 5.0, 2 + 2.0]
    found = on_ground(terrain, points)
    np.testing.assert_allclose(found[:, 2], expected, atol=1e-9)  # rounding
    np.testing.assert_array_equal(found[:, :2], points[:, :2])
    np.testing.assert_array_equal(on_ground(terrain, points[:, :2]), found)
