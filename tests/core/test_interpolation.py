"""Heights of a terrain against the plane it holds, beyond its edge, and where there is no place."""

import numpy as np
import pytest
import xarray as xr

from glintrack.core.interpolation import height_at

ROUNDING_M = 1e-12


def terrain(x, y):
    x, y = np.asarray(x, float), np.asarray(y, float)
    return xr.Dataset({"height": (("y", "x"), 0.05 * x - 0.02 * y[:, None] + 3)}, {"x": x, "y": y})


@pytest.mark.parametrize(("x", "y"), [(np.arange(0, 50, 10), np.arange(40, -1, -10)), ([0, 40], [40, 0])])
def test_a_plane_is_met_between_its_nodes(x, y):
    east, north = np.meshgrid(np.linspace(0, 40, 9), np.linspace(0, 40, 7))
    found = height_at(terrain(x, y), east, north)
    np.testing.assert_allclose(found, 0.05 * east - 0.02 * north + 3, atol=ROUNDING_M)


def test_the_edge_holds_beyond_it_and_no_place_has_no_height():
    ground = terrain([0, 10, 20], [20, 10, 0])
    found = height_at(ground, np.array([-5.0, 25.0, np.nan]), np.array([-5.0, 10.0, 0.0]))
    np.testing.assert_allclose(found, [3.0, 3.8, np.nan], atol=ROUNDING_M)


def test_one_node_is_level_ground():
    np.testing.assert_array_equal(
        height_at(terrain([5], [5]), [[-1.0, 9.0]], [[3.0], [4.0]]), np.full((2, 2), 3.15)
    )


def test_axes_broadcast():
    ground = terrain([0, 10, 20], [20, 10, 0])
    x, y = np.linspace(0, 20, 5), np.linspace(0, 20, 4)
    np.testing.assert_array_equal(
        height_at(ground, x[None], y[:, None]), height_at(ground, *np.meshgrid(x, y))
    )
