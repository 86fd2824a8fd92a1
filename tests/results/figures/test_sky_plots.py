import matplotlib
import numpy as np
import pytest

matplotlib.use("Agg")
import matplotlib.pyplot as plt

from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.results.figures import sky as plot_sky


@pytest.fixture
def axes():
    figure = plt.figure()
    yield figure.add_subplot(projection="polar")
    plt.close(figure)


@pytest.mark.parametrize("quantity", ["I", "DoLP", "AoP"])
def test_fisheye_puts_the_sun_in_the_afternoons_west_which_is_right(axes, quantity):
    tables = solve_tables(AtmosphereDesign())
    mesh = plot_sky.fisheye(axes, tables, 0.55, quantity)
    assert np.isfinite(mesh.get_array()).all()
    (sun,) = axes.lines
    at = axes.transData.transform(np.array([sun.get_xdata(), sun.get_ydata()]).T)[0]
    middle = axes.transData.transform([0.0, 0.0])
    assert at[0] > middle[0]  # looking up with north at the top, west is right
    assert abs(at[1] - middle[1]) < at[0] - middle[0]


def test_unknown_quantity_is_named(axes):
    with pytest.raises(ValueError, match="`quantity` must be I, DoLP or AoP; got 'V'"):
        plot_sky.fisheye(axes, solve_tables(AtmosphereDesign()), 0.55, "V")
