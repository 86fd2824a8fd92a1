"""Read OBJ and PLY files, whose faces are polygons of any number of corners, and triangulate these.

References
----------
Wavefront OBJ: https://www.loc.gov/preservation/digital/formats/fdd/fdd000507.shtml
PLY: http://gamma.cs.unc.edu/POWERPLANT/papers/ply.pdf
"""

import warnings
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import mapbox_earcut
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.io.readings import report_reading
from glintrack.io.untrusted import read_bytes

MAX_BYTES, MAX_FACES = 2_000_000_000, 8_000_000
_FEW_ROWS = 64  # of a PLY element that are tried together after lists of different lengths
_FLAT = 1e-9  # of the square of a polygon's extent: a smaller area has no normal
_TYPES = {
    **{"char": "i1", "int8": "i1", "uchar": "u1", "uint8": "u1", "short": "i2", "int16": "i2"},
    **{"ushort": "u2", "uint16": "u2", "int": "i4", "int32": "i4", "uint": "u4", "uint32": "u4"},
    **{"float": "f4", "float32": "f4", "double": "f8", "float64": "f8"},
}


@dataclass(frozen=True)
class Part:
    """Triangles of one name in the file's own frame."""

    name: str
    vertices: Float[Array, "vertex 3"]
    faces: Int[Array, "face 3"]


def triangulate(
    vertices: Float[Array, "vertex 3"], polygons: Sequence[Sequence[int]]
) -> Int[Array, "face 3"]:
    """Triangulate polygons, concave ones too; triangles run around as their polygon does.

    Parameters
    ----------
    vertices
        [m]
    polygons
        Corners of each, three or more, as indices into ``vertices``.
    """
    faces = [np.array([p for p in polygons if len(p) == 3], int).reshape(-1, 3)]
    quads = np.array([p for p in polygons if len(p) == 4], int).reshape(-1, 4)
    convex = _are_convex(vertices[quads])
    faces += [quads[convex][:, [0, 1, 2]], quads[convex][:, [0, 2, 3]]]
    rest = [*quads[~convex], *(np.array(p) for p in polygons if len(p) > 4)]
    return np.concatenate([*faces, *(polygon[_cut(vertices[polygon])] for polygon in rest)])


def _are_convex(corners: Float[Array, "quad 4 3"]) -> Array:
    """Return True for each quadrangle whose corners all turn the same way."""
    side = np.roll(corners, -1, axis=1) - corners
    turn = np.cross(np.roll(side, 1, axis=1), side)
    return (np.einsum("qci,qi->qc", turn, turn.sum(axis=1)) >= 0).all(axis=1)


def _cut(corners: Float[Array, "corner 3"]) -> Int[Array, "face 3"]:
    """Triangles of one polygon by ear clipping in the plane of its mean normal (Newell's)."""
    around = corners - corners[0]
    normal = np.cross(around, np.roll(around, -1, axis=0)).sum(axis=0)
    fan = np.array([(0, k, k + 1) for k in range(1, len(corners) - 1)])
    if np.linalg.norm(normal) <= _FLAT * np.ptp(corners, axis=0).max() ** 2:
        return fan  # of no area, whose triangles are left out later
    drop = int(np.abs(normal).argmax())
    plan = np.delete(around, drop, axis=1).astype(np.float64)
    found = mapbox_earcut.triangulate_float64(plan, np.array([len(plan)], np.uint32)).reshape(-1, 3)
    faces = found.astype(int)
    a, b, c = (around[faces[:, k]] for k in range(3))
    back = np.cross(b - a, c - a) @ normal < 0
    faces[back] = faces[back, ::-1]
    return faces


def read_obj(path: Path) -> list[Part]:
    """Read the faces of a Wavefront OBJ file, by material, else by object or group.

    Raises
    ------
    ValueError
        If the file is damaged, or has free-form curves or surfaces.
    """
    vertices: list[list[float]] = []
    polygons: dict[str, list[list[int]]] = {}
    material = thing = ""
    count, gone = 0, Counter[str]()
    for line in _obj_lines(path):
        key, *words = line.split()
        if key == "v":
            vertices.append([float(word) for word in words[:3]])
        elif key == "f":
            corners = [int(word.partition("/")[0]) for word in words]
            count += 1
            if count > MAX_FACES:
                raise ValueError(f"more than {MAX_FACES:,} faces")
            if len(corners) < 3:
                gone["faces of fewer than three corners"] += 1
                continue
            polygon = [k - 1 if k > 0 else len(vertices) + k for k in corners]
            if 0 in corners or not 0 <= min(polygon) <= max(polygon) < len(vertices):
                raise ValueError(f"a face with a corner that is none of {len(vertices)} before it")
            polygons.setdefault(material or thing or path.stem, []).append(polygon)
        elif key == "usemtl":
            material = line.partition(" ")[2].strip()
        elif key in ("o", "g") and words:
            thing = " ".join(words)
        elif key in ("l", "p"):
            count += 1
            gone["lines and points"] += 1
        elif key in ("curv", "curv2", "surf"):
            raise ValueError(f"a free-form curve or surface ({key}), which is not read (export polygons)")
    report_reading(path, "faces", count, count - gone.total(), gone)
    points = np.array(vertices, float).reshape(-1, 3)
    return [Part(name, points, triangulate(points, mine)) for name, mine in polygons.items()]


def _obj_lines(path: Path) -> Iterator[str]:
    """Lines that hold something; one that ends in a backslash continues on the next."""
    text = read_bytes(path, "mesh_file", MAX_BYTES).decode("utf-8", "replace")
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        if stripped := line.partition("#")[0].strip():
            yield stripped


@dataclass(frozen=True)
class _Property:
    """Property of a PLY element; a list has the type of its length."""

    name: str
    kind: str
    length_kind: str | None = None


def read_ply(path: Path) -> list[Part]:
    """Read the faces of a PLY file.

    Raises
    ------
    ValueError
        If the file is damaged, or has strips of triangles.
    """
    content = read_bytes(path, "mesh_file", MAX_BYTES)
    head, found, body = content.partition(b"end_header")
    if not found or not head.startswith(b"ply"):
        raise ValueError("no header of a PLY file")
    body = body[body.index(b"\n") + 1 :]
    order, elements = _ply_header(head.decode("ascii", "replace"))
    with warnings.catch_warnings():
        warnings.simplefilter("error", DeprecationWarning)  # of texts that are no numbers
        text = order is None
        numbers = np.fromstring(body.decode("ascii"), sep=" ") if text else np.frombuffer(body, np.uint8)
    tables, start = {}, 0
    for name, count, properties in elements:
        tables[name], start = _ply_rows(numbers, start, count, properties, order)
    if "tristrips" in tables:
        raise ValueError("strips of triangles (tristrips), which are not read (export faces)")
    vertex, face = tables.get("vertex", {}), tables.get("face", {})
    polygons = next((face[name] for name in ("vertex_indices", "vertex_index") if name in face), [])
    points = np.stack([np.asarray(vertex[axis], float) for axis in "xyz"], axis=1)
    whole = [polygon for polygon in polygons if len(polygon) > 2]
    if whole and not 0 <= min(map(min, whole)) <= max(map(max, whole)) < len(points):
        raise ValueError(f"a face with a corner that is none of {len(points)}")
    gone = {"faces of fewer than three corners": len(polygons) - len(whole)}
    report_reading(path, "faces", len(polygons), len(whole), gone)
    return [Part(path.stem, points, triangulate(points, whole))] if whole else []


def _ply_header(head: str) -> tuple[str | None, list[tuple[str, int, list[_Property]]]]:
    """Byte order, None for text; and name, number and properties of each element."""
    orders = {"ascii": None, "binary_little_endian": "<", "binary_big_endian": ">"}
    order, elements = None, []
    for words in map(str.split, head.splitlines()):
        match words:
            case ["format", name, _]:
                order = orders[name]
            case ["element", name, count]:
                elements.append((name, int(count), []))
            case ["property", "list", length, kind, name]:
                elements[-1][2].append(_Property(name, _TYPES[kind], _TYPES[length]))
            case ["property", kind, name]:
                elements[-1][2].append(_Property(name, _TYPES[kind]))
    return order, elements


def _ply_rows(
    numbers: Array, start: int, count: int, properties: list[_Property], order: str | None
) -> tuple[dict[str, Sequence], int]:
    """Columns of an element by name, and where the next element starts.

    All rows are read at once where their lists are as long as those of the first, else one after the other.
    """
    if not 0 <= count <= min(len(numbers), 3 * MAX_FACES) or not properties:
        raise ValueError(f"{count} elements in {len(numbers)} numbers")
    columns: dict[str, list] = {one.name: [] for one in properties}
    done, most_rows = 0, count
    while done < count:
        fields, at = [], start
        for k, one in enumerate(properties):
            length = 1
            if one.length_kind is not None:
                kind = np.dtype("f8" if order is None else order + one.length_kind)
                step = 1 if order is None else kind.itemsize
                first = numbers[at : at + step]
                length = int(first[0] if order is None else first.view(kind)[0])
                fields.append((f"length {k}", kind))
                at += step
            kind = np.dtype("f8" if order is None else order + one.kind)
            if not 0 <= length <= len(numbers):
                raise ValueError(f"a list of {length} numbers")
            fields.append((one.name, kind, (length,) if one.length_kind else ()))
            at += length * (1 if order is None else kind.itemsize)
        row = np.dtype(fields)
        most = (len(numbers) - start) // (at - start) if at > start else 0
        if not most:
            raise ValueError("fewer numbers than its header says")
        block = np.ascontiguousarray(
            numbers[start : start + min(most, count - done, most_rows) * (at - start)]
        )
        rows = block.view(row)
        same = np.ones(len(rows), bool)
        for k, one in enumerate(properties):
            if one.length_kind is not None:
                same &= rows[f"length {k}"] == row[one.name].shape[0]
        good = len(rows) if same.all() else int(same.argmin())
        most_rows = 2 * most_rows if good == len(rows) else _FEW_ROWS
        for one in properties:
            values = rows[one.name][:good]
            columns[one.name] += values.astype(int).tolist() if one.length_kind else values.tolist()
        done, start = done + good, start + good * (at - start)
    return columns, start
