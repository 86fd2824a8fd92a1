"""Files a run leaves: truth for other people's programs."""

import numpy as np
import pytest
import xarray as xr

from glintrack.io import files

AREA_M = (-100.0, -50.0, 100.0, 50.0)


def truth_rows(**columns):
    return xr.Dataset({name: ("row", np.asarray(values)) for name, values in columns.items()})


@pytest.fixture
def rows():
    """One vehicle driving east over two frames, one turned by 30°, and one outside."""
    return truth_rows(
        time_s=[0.0, 0.5, 0.5, 0.5],
        vehicle_id=[0, 0, 7, 8],
        east=[-10.0, 0.0, 20.0, 150.0],
        north=[20.0, 20.0, -5.0, 0.0],
        heading=np.radians([90.0, 90.0, 30.0, 0.0]),
        length=[4.0, 4.0, 6.0, 4.0],
        width=[2.0, 2.0, 2.0, 2.0],
        visible_fraction=[1.0, 0.25, 0.5, 0.0],
    )


def test_mot_boxes_worked_by_hand(tmp_path, rows):
    files.write_mot_truth(tmp_path / "gt.txt", rows, AREA_M, 0.5)
    lines = [[float(v) for v in line.split(",")] for line in (tmp_path / "gt.txt").read_text().splitlines()]
    # 4 m by 2 m heading east about (-10, 20): from west -12 to -8 and from north 21 to 19, in cells of 0.5 m
    assert lines[0] == [1, 1, (100 - 12) / 0.5 + 1, (50 - 21) / 0.5 + 1, 8, 4, 1, 3, 1]
    assert [line[:2] for line in lines] == [[1, 1], [2, 1], [2, 8]]
    wide, high = 6 * 0.5 + 2 * np.sqrt(0.75), 6 * np.sqrt(0.75) + 2 * 0.5
    two_decimals = 0.005
    assert lines[2][4:6] == pytest.approx([wide / 0.5, high / 0.5], abs=two_decimals)
    assert [line[8] for line in lines] == [1, 0.25, 0.5]


def test_nobody_is_an_empty_file(tmp_path):
    files.write_mot_truth(tmp_path / "gt.txt", xr.Dataset(), AREA_M, 0.5)
    assert (tmp_path / "gt.txt").read_text() == ""


def test_a_picture_is_written_whole_by_its_ending(tmp_path):
    for name in ("a.png", "a.jpg"):
        files.write_picture(tmp_path / name, np.full((8, 9, 3), 0.5))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.jpg", "a.png"]


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / "page.html").mkdir()  # a folder of that name: the last step fails
    with pytest.raises(OSError):
        files.write_text(tmp_path / "page.html", "text")
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]
