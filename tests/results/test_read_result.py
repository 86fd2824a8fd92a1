"""Results whole, half finished, foreign and broken."""

import shutil

import numpy as np
import pytest
import xarray as xr

import glintrack
from glintrack.io import images, netcdf
from glintrack.report import build_page
from glintrack.results.read import read_result
from tests.report.made import tree, write_small_result


@pytest.fixture
def folder(tmp_path):
    return write_small_result(tmp_path / "result")


def test_a_result_comes_back_as_arrays(folder):
    loaded = glintrack.load_result(folder)
    xr.testing.assert_allclose(
        loaded["pan/queries"].to_dataset(False), tree()["pan/queries"].to_dataset(False)
    )
    assert "completeness" in loaded["pan"]._repr_html_()
    np.testing.assert_array_equal(loaded["vehicles"]["paint"].values, ["red", "blue", "blue"])
    assert read_result(folder).notes == ()


def test_what_is_missing_is_said(folder):
    (folder / "result.nc").unlink()
    shutil.rmtree(folder / "film")
    (folder / "provenance.toml").unlink()
    found = read_result(folder)
    assert found.tree is None and found.case is not None
    assert [note.split()[0] for note in found.notes] == ["result.nc", "provenance.toml", "There"]
    with pytest.raises(ValueError, match=r"`path` must be a finished result; got .*result.nc is missing"):
        glintrack.load_result(folder)


def test_a_flight_that_ended_before_its_first_frame_lacks_no_film(folder):
    shutil.rmtree(folder / "film")
    (folder / "provenance.toml").write_text("interrupted = 1\nframes_done = 0\nframes_asked = 9")
    assert read_result(folder).notes == ("The flight was interrupted after 0 of 9 frames.",)


@pytest.mark.parametrize(
    ("name", "text", "note"),
    [
        ("result.nc", "no netcdf", "result.nc cannot be read"),
        (
            "case.toml",
            "[sensor]\nfrom_tomorrow = 3\n",
            "case.toml is not a case of this version: `sensor.from",
        ),
        ("case.toml", "= 3", "case.toml is not a case of this version: `case` must be valid TOML"),
        ("provenance.toml", "= 3", "provenance.toml cannot be read"),
        ("provenance.toml", 'glintrack_version = "99.0"', "Written by glintrack 99.0, shown by"),
        ("provenance.toml", "interrupted = 1\nframes_done = 3\nframes_asked = 9", "after 3 of 9 frames"),
        ("film/film.json", "{", "film/film.json cannot be read"),
        ("film/film.json", '{"kinds": [], "frames": [], "times_s": [], "extent_m": [0, 0, 1, 1]}', "no film"),
        ("film/film.json", '{"kinds": ["../x"]}', "film/film.json cannot be read"),
        (
            "film/film.json",
            '{"kinds": ["pan"], "frames": [0], "times_s": [0], "extent_m": [0, 0, 0, 0]}',
            "must not be empty or a line",
        ),
        (
            "film/film.json",
            '{"kinds": ["pan"], "frames": [' + "9" * 300 + '], "times_s": [0], "extent_m": [0, 0, 1, 1]}',
            "film.json cannot be read",
        ),
        ("film/pan_00000.webp", "RIFF", "1 of the film's 12 pictures are missing or broken"),
        ("pictures/sky.png", "\x89PNG", "pictures/sky.png is broken and not shown"),
    ],
)
def test_a_broken_part_is_a_note(folder, name, text, note):
    (folder / "pictures").mkdir()
    (folder / name).write_text(text)
    found = read_result(folder)
    assert any(note in one for one in found.notes)
    assert "</html>" in build_page(found) and "<div" in found._repr_html_()


@pytest.mark.parametrize(
    ("table", "column"),
    [("pan/tracks", "east_m"), ("truth", "north_m"), ("pan/queries", "radiance"), ("vehicles", "paint")],
)
def test_a_table_without_a_column_is_left_out(folder, table, column):
    whole = glintrack.load_result(folder)
    parts = {path: node.to_dataset(inherit=False) for path, node in whole.subtree_with_keys}
    parts[table] = parts[table].drop_vars(column)
    (folder / "result.nc").unlink()
    netcdf.write_tree(folder / "result.nc", xr.DataTree.from_dict(parts))
    found = read_result(folder)
    assert found.notes == (
        f"result.nc: the table {table} lacks {column} and is not shown. "
        "Another version wrote it, or the file is damaged: simulate the case again.",
    )
    assert "</html>" in build_page(found)


def test_a_folder_that_is_no_result(tmp_path):
    (tmp_path / "file").write_text("")
    for name, what in (
        ("nothing", "which does not exist"),
        ("file", "which is a file"),
        (".", "without any of case"),
    ):
        with pytest.raises(ValueError, match=f"must be a folder that `glintrack run` wrote; got .*{what}"):
            read_result(tmp_path / name)
    (tmp_path / "study.json").write_text("{}")
    with pytest.raises(ValueError, match=r"got a study.*glintrack report"):
        read_result(tmp_path)


def test_a_notebook_shows_scores_and_a_picture(folder):
    (folder / "pictures").mkdir()
    images.write_picture(folder / "pictures" / "pan.png", np.full((20, 30, 3), 0.5))
    found = glintrack.read_result(folder)
    html = found._repr_html_()
    for text in ("<th>pan</th>", "track purity</th><td>0.75</td>", 'src="data:image/webp;base64,'):
        assert text in html
    assert repr(found) == (f"<glintrack result 'small' in {folder}; pan: completeness 0.45, purity 0.75>")


@pytest.mark.parametrize("kept", ["case.toml", "provenance.toml", "result.nc"])
def test_a_notebook_shows_half_a_result_with_its_notes(folder, kept):
    shutil.rmtree(folder / "film")
    for path in folder.iterdir():
        if path.name != kept:
            path.unlink()
    html = read_result(folder)._repr_html_()
    assert "is missing" in html and html.count("<div") == html.count("</div>")


def test_names_in_a_notebook_are_escaped(folder):
    (folder / "provenance.toml").write_text("case = '<img src=x onerror=alert(1)>'\n")
    assert "<img src=x" not in read_result(folder)._repr_html_()
