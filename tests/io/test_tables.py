"""The one reader of CSV files: text or numbers, comments, and files that are none."""

import pytest

from glintrack.io.tables import read_csv


def written(folder, text):
    path = folder / "t.csv"
    path.write_bytes(text.encode())
    return path


def test_names_are_trimmed_and_comment_lines_left_out(tmp_path):
    table = read_csv(
        written(tmp_path, "\ufeff# by hand\na, b ,c\n1, 2,\n  # more\n3,x#4,5\n\n"), "t", types=str
    )
    assert table.to_dict("list") == {"a": ["1", "3"], "b": ["2", "x#4"], "c": ["", "5"]}


def test_cells_are_what_they_look_like(tmp_path):
    table = read_csv(written(tmp_path, "a,b\r\n1,0.5\r\n2,\r\n"), "t")
    assert table["a"].tolist() == [1, 2] and table["b"].isna().tolist() == [False, True]


def test_wanted_columns_of_a_file_without_comments(tmp_path):
    path = written(tmp_path, "a;b\n#1;2\n")
    options = {"types": {"a": "str"}, "only": lambda name: name == "a", "comments": False}
    assert read_csv(path, "t", separator=";", **options).to_dict("list") == {"a": ["#1"]}


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "`t` must have a header row; got the empty file"),
        ("# only\n", "`t` must have a header row"),
        ("a,b\n1,2,3\n4,5,6\n", "`t` must be a CSV file in UTF-8.*does not match.*Write numbers with points"),
        ("a,b\n1,2\n4,5,6\n", "`t` must be a CSV file in UTF-8.*saw 3.*Write numbers with points"),
        ('a,b\n"x,1\n', "`t` must be a CSV file in UTF-8.*inside string"),
    ],
)
@pytest.mark.parametrize("types", [str, None])
def test_what_is_no_table_is_refused_in_a_sentence(tmp_path, text, message, types):
    with pytest.raises(ValueError, match=message) as caught:
        read_csv(written(tmp_path, text), "t", types=types)
    assert "\n" not in str(caught.value)


def test_other_encodings_and_large_files_are_refused(tmp_path):
    path = tmp_path / "t.csv"
    path.write_bytes(b"a\n\xff\n")
    with pytest.raises(ValueError, match="must be a CSV file in UTF-8"):
        read_csv(path, "t", types=str)
    with pytest.raises(ValueError, match=r"must have at most 1e-06 MB"):
        read_csv(path, "t", most_bytes=1)
