"""The 3DS reader on a file built chunk by chunk, and on damaged ones."""

import struct

import numpy as np
import pytest

from glintrack.scene.sources.braunschweig import read_3ds


def chunk(kind, *content):
    body = b"".join(content)
    return struct.pack("<HI", kind, len(body) + 6) + body


def model(face=(0, 1, 2), count=3):
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 0, 2]], "<f4").tobytes()
    faces = struct.pack("<H4H", 1, *face, 0)
    material = chunk(0x4130, b"roof\0", struct.pack("<2H", 1, 0))
    mesh = chunk(0x4100, chunk(0x4110, struct.pack("<H", count), vertices), chunk(0x4120, faces, material))
    return chunk(0x4D4D, chunk(0x0002, b"\3\0\0\0"), chunk(0x3D3D, chunk(0x4000, b"house\0", mesh)))


def test_one_triangle(tmp_path):
    path = tmp_path / "m.3ds"
    path.write_bytes(model())
    (house,) = read_3ds(path)
    assert house.name == "house" and house.faces.tolist() == [[0, 1, 2]]
    assert house.vertices[2].tolist() == [0, 0, 2]
    assert house.material_faces["roof"].tolist() == [0]


@pytest.mark.parametrize(
    "data",
    [b"", b"PK\3\4 no model", model()[:-9], model(count=60000)],
    ids=["empty", "other format", "truncated", "count beyond the file"],
)
def test_damaged_files_are_refused(tmp_path, data):
    path = tmp_path / "m.3ds"
    path.write_bytes(data)
    with pytest.raises(ValueError, match=r"`m.3ds` must be a whole 3DS file"):
        read_3ds(path)
