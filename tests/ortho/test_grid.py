"""Heights under a grid, and grids in another CRS."""

import numpy as np
import pyproj
import pytest

from glintrack.ortho import heights_at, transform_axes

PLANE = np.add.outer(2.0 * np.arange(5), 3.0 * np.arange(7))


def test_a_plane_is_interpolated_exactly_and_held_for_half_a_pixel():
    row, column = np.array([[0.25, 3.9]]), np.array([[5.5, 0.0]])
    np.testing.assert_allclose(heights_at(PLANE, row, column), 2 * row + 3 * column)
    edge = heights_at(PLANE, np.array([[-0.4, 4.4, -0.6, 2.0]]), np.array([[2.0, 6.5, 2.0, 6.6]]))
    np.testing.assert_allclose(edge[0, :2], [6.0, 26.0])
    assert np.isnan(edge[0, 2:]).all()


def test_a_hole_spreads_to_what_touches_it_only():
    holed = PLANE.copy()
    holed[2, 3] = np.nan
    found = heights_at(holed, np.array([[1.5, 1.0, 2.0, 2.5]]), np.array([[2.5, 3.0, 4.0, 4.5]]))
    assert np.isnan(found[0, 0]) and np.isfinite(found[0, 1:]).all()


@pytest.mark.parametrize("count", [10, 400])
def test_a_grid_in_another_crs_is_where_proj_puts_it(count):
    x, y = 604000 + 1.5 * np.arange(count), 5792000 - 1.5 * np.arange(count + 3)
    east, north = transform_axes(x, y, "EPSG:32632", "EPSG:25833")
    to = pyproj.Transformer.from_crs("EPSG:32632", "EPSG:25833", always_xy=True)
    exact = to.transform(*np.meshgrid(x, y))
    hundredth_of_a_cell = 0.015
    np.testing.assert_allclose(east, exact[0], atol=hundredth_of_a_cell)
    np.testing.assert_allclose(north, exact[1], atol=hundredth_of_a_cell)


def test_coarse_degrees_over_a_continent_are_transformed_exactly():
    x, y = np.linspace(5, 15, 100), np.linspace(55, 45, 80)
    east, north = transform_axes(x, y, "EPSG:4326", "EPSG:32632")
    exact = pyproj.Transformer.from_crs("EPSG:4326", "EPSG:32632", always_xy=True).transform(
        *np.meshgrid(x, y)
    )
    np.testing.assert_allclose([east, north], exact, atol=1e-3 * 11000)


def test_one_crs_is_left_alone_and_an_unknown_one_refused():
    x, y = np.arange(4.0), -np.arange(3.0)
    east, north = transform_axes(x, y, "EPSG:32632", "EPSG:32632")
    assert east.shape == (3, 4) and (east[0] == x).all() and (north[:, 0] == y).all()
    with pytest.raises(ValueError, match="coordinate reference system such as"):
        transform_axes(x, y, "EPSG:32632", "EPSG:999999")
    with pytest.raises(ValueError, match="hold the whole grid"):
        transform_axes(np.array([1e9]), np.array([1e9]), "EPSG:32632", "EPSG:4326")
