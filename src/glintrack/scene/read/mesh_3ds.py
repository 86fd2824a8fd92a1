"""Reader of triangle meshes in Autodesk's 3DS chunks: vertices, faces and the faces of each material."""

import struct
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array

_MAIN, _EDITOR, _OBJECT, _TRIMESH = 0x4D4D, 0x3D3D, 0x4000, 0x4100
_VERTICES, _FACES, _FACE_MATERIAL = 0x4110, 0x4120, 0x4130
_HEADER_BYTES = 6


@dataclass(frozen=True)
class Object3ds:
    """One object of the file.

    Parameters
    ----------
    name
        As stored.
    vertices
        In the file's own axes and unit.
    faces
        Vertex indices.
    material_faces
        Indices into ``faces`` by material name.
    """

    name: str
    vertices: Float[Array, "vertex 3"]
    faces: Int[Array, "face 3"]
    material_faces: dict[str, Int[Array, "face"]]


def read_3ds(path: Path) -> tuple[Object3ds, ...]:
    """Objects of a 3DS file that have faces.

    Raises
    ------
    ValueError
        If a chunk or an array reaches beyond its end, or a face names a vertex that is not there.
    """
    data = path.read_bytes()
    if len(data) < _HEADER_BYTES or struct.unpack_from("<H", data)[0] != _MAIN:
        raise ValueError(f"`{path.name}` must start with a 3DS main chunk, got {data[:2].hex() or 'nothing'}")
    objects = []
    for main, start, stop in _chunks(path, data, 0, len(data)):
        if main != _MAIN:
            continue
        for editor, a, b in _chunks(path, data, start, stop):
            if editor != _EDITOR:
                continue
            objects += [
                _object(path, data, c, d) for kind, c, d in _chunks(path, data, a, b) if kind == _OBJECT
            ]
    return tuple(o for o in objects if len(o.faces))


def _chunks(path: Path, data: bytes, start: int, stop: int) -> list[tuple[int, int, int]]:
    """(kind, first byte, one past the last byte) of the chunks between two places."""
    found = []
    while start + _HEADER_BYTES <= stop:
        kind, length = struct.unpack_from("<HI", data, start)
        if length < _HEADER_BYTES or start + length > stop:
            raise ValueError(
                f"`{path.name}` must hold whole chunks, got one of {length} bytes with {stop - start} left"
            )
        found.append((kind, start + _HEADER_BYTES, start + length))
        start += length
    return found


def _name(path: Path, data: bytes, start: int, stop: int) -> tuple[str, int]:
    end = data.find(b"\0", start, stop)
    if end < 0:
        raise ValueError(f"`{path.name}` must end its names with a zero byte, got none")
    return data[start:end].decode("latin-1"), end + 1


def _array(path: Path, data: bytes, start: int, stop: int, dtype: str, width: int) -> tuple[Array, int]:
    """A counted array at a place, and the place behind it."""
    if start + 2 > stop:
        raise ValueError(f"`{path.name}` must give a count before an array, got {stop - start} bytes")
    (count,) = struct.unpack_from("<H", data, start)
    end = start + 2 + count * width * np.dtype(dtype).itemsize
    if end > stop:
        raise ValueError(f"`{path.name}` must hold {count} entries of an array, got {stop - start - 2} bytes")
    values = np.frombuffer(data, dtype, count * width, start + 2).reshape(count, width)
    return values, end


def _object(path: Path, data: bytes, start: int, stop: int) -> Object3ds:
    name, start = _name(path, data, start, stop)
    vertices, faces = np.zeros((0, 3)), np.zeros((0, 3), dtype=int)
    materials: dict[str, Array] = {}
    for mesh, a, b in _chunks(path, data, start, stop):
        if mesh != _TRIMESH:
            continue
        for kind, c, d in _chunks(path, data, a, b):
            if kind == _VERTICES:
                vertices = _array(path, data, c, d, "<f4", 3)[0].astype(float)
            elif kind == _FACES:
                table, behind = _array(path, data, c, d, "<u2", 4)  # the fourth number is edge flags
                faces = table[:, :3].astype(int)
                for part, e, f in _chunks(path, data, behind, d):
                    if part == _FACE_MATERIAL:
                        material, e = _name(path, data, e, f)
                        materials[material] = _array(path, data, e, f, "<u2", 1)[0][:, 0].astype(int)
    if len(faces) and faces.max() >= len(vertices):
        raise ValueError(f"`{path.name}` must name one of {len(vertices)} vertices, got {faces.max()}")
    if any(len(m) and m.max() >= len(faces) for m in materials.values()):
        raise ValueError(f"`{path.name}` must give materials to its {len(faces)} faces, got one beyond")
    return Object3ds(name, vertices, faces, materials)
