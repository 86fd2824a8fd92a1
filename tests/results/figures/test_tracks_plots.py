"""Marks of tracks: which kind each is, and which vehicles are missed."""

import numpy as np
import xarray as xr
from matplotlib.colors import to_hex
from matplotlib.figure import Figure

from glintrack.results.figures import MARKS
from glintrack.results.figures.tracks import (
    missed_rows,
    show_legend,
    show_missed,
    show_rgb,
    show_tracks,
    track_kinds,
)


def table(**columns):
    return xr.Dataset({name: ("row", np.array(values)) for name, values in columns.items()})


ROWS = table(
    time_s=[1.0, 1.0, 1.0, 1.0], track_id=[1, 2, 3, 4], east_m=[0.0, 1, 2, 3], north_m=[0.0, 1, 2, 3],
    vehicle_id=[11, 12, -1, 14], valid=[1, 1, 0, 0], false=[0, 0, 1, 0],
    status=["measured", "coasted", "measured", "measured"],
)  # fmt: skip
TRUTH = table(
    time_s=[1.0, 1.0, 1.0, 2.0], vehicle_id=[11, 13, 15, 13], east_m=[0.0, 5, 6, 5], north_m=[0.0, 5, 6, 5],
    east_speed_m_s=[5.0, 5, 0, 5], north_speed_m_s=[0.0, 0, 0, 0],
)  # fmt: skip


def test_each_track_is_of_one_kind():
    assert track_kinds(ROWS).tolist() == ["true", "coast", "false", "other"]
    bare = ROWS[["time_s", "track_id"]].assign(status=ROWS["status"])
    assert track_kinds(bare).tolist() == ["true", "coast", "true", "true"]  # nobody judged them


def test_missed_are_those_of_the_time_without_a_true_track():
    assert missed_rows(TRUTH, ROWS, 1.0).tolist() == [False, True, True, False]


def test_marks_have_the_pages_colours_and_are_named():
    figure = Figure(layout="constrained")
    ax = figure.add_subplot()
    show_missed(ax, TRUTH, ROWS, 1.0)
    show_tracks(ax, ROWS, 1.0)
    show_legend(ax)
    drawn = {str(c.get_label()): c for c in ax.collections if not str(c.get_label()).startswith("_")}
    assert to_hex(drawn["true track"].get_edgecolor()[0]) == MARKS["true"]
    assert to_hex(drawn["false track"].get_edgecolor()[0]) == MARKS["false"]
    np.testing.assert_allclose(drawn["moving vehicle missed"].get_offsets(), [[5, 5]])  # 15 stands
    assert [t.get_text() for t in figure.legends[0].get_texts()] == list(drawn)


def test_what_is_not_known_is_left_out_of_a_picture():
    ax = Figure().add_subplot()
    picture = np.full((2, 2, 3), 0.5)
    picture[0, 0] = np.nan
    show_rgb(ax, picture)
    assert np.asarray(ax.images[0].get_array())[..., 3].tolist() == [[0, 1], [1, 1]]
