"""Read OBJ and PLY files, whose faces are polygons of any number of corners, and triangulate these.

Formats: https://www.loc.gov/preservation/digital/formats/fdd/fdd000507.shtml (OBJ), fdd000501.shtml (PLY).
"""

import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mapbox_earcut
import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.io.readings import report_reading
from glintrack.io.untrusted import read_bytes

MAX_BYTES, MAX_FACES = 2_000_000_000, 8_000_000
_PLY_ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
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
    """Triangulate polygons of three corners or more, concave ones too; triangles run around as they do."""
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
    """Read the faces of an OBJ file by material, else object or group; refuse free-form surfaces."""
    vertices: list[list[float]] = []
    polygons: dict[str, list[list[int]]] = {}
    material = thing = ""
    count, gone = 0, Counter[str]()
    text = read_bytes(path, "mesh_file", MAX_BYTES).decode("utf-8", "replace")
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        key, *words = line.partition("#")[0].split() or [""]
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
            material = " ".join(words)
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


def read_ply(path: Path) -> list[Part]:
    """Read the faces of a PLY file; refuse strips of triangles."""
    content = read_bytes(path, "mesh_file", MAX_BYTES)
    head, found, body = content.partition(b"end_header")
    if not found or not head.startswith(b"ply"):
        raise ValueError("no header of a PLY file")
    body, order, at = body[body.index(b"\n") + 1 :], "", 0
    elements: list[tuple[str, int, list[list[str]]]] = []
    for words in map(str.split, head.decode("ascii", "replace").splitlines()):
        if words[:1] == ["format"]:
            order = _PLY_ORDERS[words[1]]
        elif words[:1] == ["element"]:
            elements.append((words[1], min(int(words[2]), len(body)), []))
        elif words[:1] == ["property"]:
            elements[-1][2].append(words[1:])
    if not order:  # a text becomes one block of numbers
        with warnings.catch_warnings():
            warnings.simplefilter("error", DeprecationWarning)  # of words that are no numbers
            body = np.fromstring(body.decode("ascii"), sep=" ").tobytes()

    def take(kinds: list[str], count: int) -> Array:
        """Next ``count`` rows of numbers of some types."""
        nonlocal at
        row = np.dtype([(str(k), order + _TYPES[kind] if order else "f8") for k, kind in enumerate(kinds)])
        at += count * row.itemsize
        return np.frombuffer(body, row, count, at - count * row.itemsize)

    vertices, polygons = np.zeros((0, 3)), list[list[int]]()
    for name, count, properties in elements:
        if name == "tristrips":
            raise ValueError("strips of triangles (tristrips), which are not read (export faces)")
        if all(words[0] != "list" for words in properties):
            rows = take([kind for kind, _ in properties], count)
            if name == "vertex":
                names = [own for _, own in properties]
                vertices = np.stack([rows[str(names.index(axis))] for axis in "xyz"], 1).astype(float)
            continue
        for _ in range(count):
            for *kinds, own in properties:
                size = int(take(kinds[1:2], 1)["0"][0]) if kinds[0] == "list" else 1
                values = take(kinds[-1:], size)["0"]
                if own in ("vertex_indices", "vertex_index"):
                    polygons.append(values.astype(int).tolist())
    whole = [polygon for polygon in polygons if len(polygon) > 2]
    if whole and not 0 <= min(map(min, whole)) <= max(map(max, whole)) < len(vertices):
        raise ValueError(f"a face with a corner that is none of {len(vertices)}")
    gone = {"faces of fewer than three corners": len(polygons) - len(whole)}
    report_reading(path, "faces", len(polygons), len(whole), gone)
    return [Part(path.stem, vertices, triangulate(vertices, whole))] if whole else []
