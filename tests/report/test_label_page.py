"""The page for labels: it holds the frames, and its CSV file is read by the commands that score."""

import base64
import io
import json
import re

import numpy as np
import pandas as pd
import pytest
from PIL import Image

from glintrack.dataset.sequences import read_sequence
from glintrack.io.detections import read_truth
from glintrack.io.orthoimages import FrameSource, Geotransform, image_of
from glintrack.report.frames_page import write_label_page

GRID = Geotransform(1000.0, 2000.0, 0.5)
TIMES_S = [0.0, 0.1 + 0.2, 1.0]


def frames(count=3, side=(40, 60)):
    for k in range(count):
        pan = np.full(side, 10, np.float32)
        pan[5 % side[0], (4 + k) % side[1]] = 200
        yield TIMES_S[k] if k < 3 else float(k), image_of({"pan": pan}, GRID)


def data_of(path):
    text = path.read_text()
    return text, json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])


def test_page_holds_the_frames_and_needs_no_network(tmp_path):
    assert write_label_page(tmp_path / "labels.html", "a <b>", frames()) == 3
    text, data = data_of(tmp_path / "labels.html")
    assert data["times_s"] == TIMES_S and data["extent_m"] == [1000.0, 1980.0, 1030.0, 2000.0]
    pictures = [Image.open(io.BytesIO(base64.b64decode(one))) for one in data["pictures"]]
    assert [one.size for one in pictures] == [(60, 40)] * 3
    assert [int(np.asarray(one)[5].argmax()) for one in pictures] == [4, 5, 6]
    assert "a &lt;b&gt;" in text and "default-src 'none'" in text
    page = re.sub(r'id="data">.*?</script>', "", text, flags=re.DOTALL)
    assert not re.search(r'\beval\(|\bfetch\(|XMLHttpRequest|(src|href)="(?!data:|#)', page)
    assert "--area 1000 1980 1030 2000" in text


def test_part_of_the_ground_and_its_limits(tmp_path):
    write_label_page(tmp_path / "part.html", "part", frames(), (1002.0, 1990.0, 1012.0, 2000.0))
    _, data = data_of(tmp_path / "part.html")
    assert data["extent_m"] == [1002.0, 1990.0, 1012.0, 2000.0]
    with pytest.raises(ValueError, match="`area` must be west south east north with pixels"):
        write_label_page(tmp_path / "no.html", "none", frames(), (0.0, 0.0, 10.0, 10.0))
    with pytest.raises(ValueError, match="must be at most 300 and 80 MB"):
        write_label_page(tmp_path / "no.html", "many", frames(302, (4, 4)))
    assert not (tmp_path / "no.html").exists()


def labels_as_the_page_writes_them(columns):
    """A vehicle at 12 m/s east and a second one in two frames, rows as label.js joins them."""
    rows = [(t, 1, f"{1002.25 + 12 * t:.3f}", "1997.250", k, 1) for k, t in enumerate(TIMES_S)]
    rows += [(TIMES_S[k], 2, "1010.000", f"{1985 + 5 * k:.3f}", k, 1) for k in (1, 2)]
    lines = [columns, *sorted(rows, key=lambda row: (row[4], row[1]))]
    return "".join(",".join(map(str, line)) + "\n" for line in lines)


def test_labels_are_truth_for_score_and_a_sequence_for_the_comparison(tmp_path):
    write_label_page(tmp_path / "labels.html", "x", frames())
    _, data = data_of(tmp_path / "labels.html")
    path = tmp_path / "labels.csv"
    path.write_text(labels_as_the_page_writes_them(data["columns"]))
    truth = read_truth(path)
    assert truth["time_s"].values.tolist() == sorted([*TIMES_S, *TIMES_S[1:]])
    first = truth["vehicle_id"].values == 1
    np.testing.assert_allclose(truth["east_speed_m_s"].values[first], 12.0, atol=0.01)

    sequence = read_sequence(FrameSource(3, None, False, frames()), path)
    assert sequence.frames.shape == (3, 40, 60) and sequence.gsd_m == 0.5
    cells = sequence.cells(sequence.labels[["east_m", "north_m"]].to_numpy(float))
    assert cells[0].tolist() == [5, 4] and sequence.labels["asked"].all()
    path.write_text(path.read_text().replace(f"\n{TIMES_S[2]},", "\n0.9,"))
    with pytest.raises(ValueError, match="must be of these frames and their times"):
        read_sequence(FrameSource(3, None, False, frames()), path)
    pd.read_csv(path).drop(columns="asked").to_csv(path, index=False)
    with pytest.raises(ValueError, match="got no asked"):
        read_sequence(FrameSource(3, None, False, frames()), path)
