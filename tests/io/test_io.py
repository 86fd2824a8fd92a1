"""Files are written whole or not at all."""

import numpy as np
import pytest

from glintrack.io import atomic, images


def test_a_picture_is_written_whole_by_its_ending(tmp_path):
    for name in ("a.png", "a.jpg"):
        images.write_picture(tmp_path / name, np.full((8, 9, 3), 0.5))
    assert sorted(p.name for p in tmp_path.iterdir()) == ["a.jpg", "a.png"]


def test_what_cannot_be_written_leaves_nothing(tmp_path):
    (tmp_path / "page.html").mkdir()  # a folder of that name: the last step fails
    with pytest.raises((IsADirectoryError, PermissionError)):
        atomic.write_text(tmp_path / "page.html", "text")
    assert [p.name for p in tmp_path.iterdir()] == ["page.html"]
