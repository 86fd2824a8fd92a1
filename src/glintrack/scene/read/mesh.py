"""Read meshes: OBJ and PLY by their polygons, glTF and STL through trimesh (extra ``mesh``).

What trimesh loads is compared with what the file holds, and features that it ignores are refused by name.
"""

import json
import logging
import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.designs import suggest_name
from glintrack.core.installation import MissingExtraError, require_extra
from glintrack.core.records import Extent
from glintrack.io.readings import report_reading
from glintrack.io.untrusted import check_file, plain, read_bytes, resolve_path
from glintrack.scene.objects.geometry import Mesh
from glintrack.scene.read.polygon_mesh import MAX_BYTES, MAX_FACES, Part, read_obj, read_ply

_ENDINGS = (".glb", ".gltf", ".obj", ".ply", ".stl")
_MIN_WIDTH_M, _MAX_WIDTH_M, _MAX_HEIGHT_M = 20.0, 20e3, 2000.0  # of a scene: others have wrong units
_NAMED = (".bin",)
# extensions of glTF for appearance, which is not read
_APPEARANCE = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_xmp", "ADOBE_materials_")
_INSTANCING = "EXT_mesh_gpu_instancing"
_TRIANGLES, _STRIP = 4, 5  # modes of glTF; lower ones are points and lines
_UNITS_M = {"millimetres": 0.001, "centimetres": 0.01, "inches": 0.0254, "feet": 0.3048, "kilometres": 1000.0}


@dataclass(frozen=True)
class NamedMesh:
    """Triangles in ENU, each with the name the mesh gives its material.

    Parameters
    ----------
    vertices
        [m]
    faces
        Indices into ``vertices``, counter-clockwise seen from outside.
    names
        Materials, or objects where there are none.
    name_of
        Index of each face into ``names``.
    """

    vertices: Float[Array, "vertex 3"]
    faces: Int[Array, "face 3"]
    names: tuple[str, ...]
    name_of: Int[Array, "face"]

    @property
    def extent_m(self) -> Extent:
        """Smallest extent with all vertices. [m]"""
        return Extent(*self.vertices[:, :2].min(axis=0).tolist(), *self.vertices[:, :2].max(axis=0).tolist())

    def mesh(self, material_of: Mapping[str, str], index: Mapping[str, int]) -> Mesh:
        """Assign the library's materials.

        Parameters
        ----------
        material_of
            Name of a material of the library for each of the mesh's own; ``*`` stands for all others.
        index
            Index of each material by name.
        """
        if foreign := sorted(set(material_of) - {*self.names, "*"}):
            raise ValueError(
                f"`materials_file` must name materials of the mesh under [mesh]; got {foreign[0]!r}. "
                f"{suggest_name(foreign[0], self.names)}"
            )
        numbers = []
        for name in self.names:
            material = material_of.get(name, material_of.get("*"))
            if material is None:
                raise ValueError(
                    "`materials_file` must give under [mesh] a material for each of the mesh's own; "
                    f"got none for {name!r}. Its names: {', '.join(map(repr, self.names[:12]))}; "
                    "'*' stands for all others."
                )
            if material not in index:
                raise ValueError(
                    f"`materials_file` must name materials of the library under [mesh]; got {material!r} for "
                    f"{name!r}. Known: {', '.join(sorted(index))}."
                )
            numbers.append(index[material])
        material = np.array(numbers, dtype=np.int16)[self.name_of]
        return Mesh(self.vertices.astype(np.float32), self.faces.astype(np.int32), material)


def default_up(path: Path) -> str:
    """Axis of a mesh that points up by default: y for glTF, else z."""
    return "y" if path.suffix.lower() in (".glb", ".gltf") else "z"


def read_mesh(path: Path, up: str | None = None, unit_m: float | None = None) -> NamedMesh:
    """Read a mesh and transform it to ENU.

    Parameters
    ----------
    path
        ``.glb``, ``.gltf``, ``.obj``, ``.ply`` or ``.stl``.
    up
        ``y`` (east is x, north is −z) or ``z`` (east is x, north is y); by default y for glTF, else z.
    unit_m
        Length of the mesh's unit, 1 m by default. [m]

    Raises
    ------
    ValueError
        If the file is damaged, empty, not finite, or not of a scene's size.
    """
    if path.suffix.lower() not in _ENDINGS:
        raise ValueError(f"`mesh_file` must end in {', '.join(_ENDINGS)}; got {path.name!r}.")
    check_file(path, "mesh_file", MAX_BYTES)
    try:
        parts = _read_parts(path)
    except MissingExtraError:
        raise
    except Exception as error:  # a dozen parsers have many errors for damaged files
        raise ValueError(
            f"`mesh_file` must be a whole mesh; got {path.name!r}: {plain(error, 200)}.".split("\n")[0]
        ) from error
    if not parts:
        raise ValueError(f"`mesh_file` must hold triangles; got none in {path.name!r}.")
    counts = [len(part.vertices) for part in parts]
    vertices = np.concatenate([part.vertices for part in parts])
    starts = np.cumsum(counts) - counts
    faces = np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)])
    names = tuple(dict.fromkeys(part.name for part in parts))
    name_of = np.concatenate([np.full(len(part.faces), names.index(part.name)) for part in parts])
    bad = ~np.isfinite(vertices).all(axis=1)
    if bad.any():
        raise ValueError(
            "`mesh_file` must have finite coordinates; "
            f"got {int(bad.sum())} of {len(vertices)} vertices that are not."
        )
    if len(faces) > MAX_FACES:
        raise ValueError(f"`mesh_file` must have at most {MAX_FACES} triangles; got {len(faces)}.")
    if up is None:
        _check_up(path, vertices, faces)
    if (up or default_up(path)) == "y":
        vertices = np.stack([vertices[:, 0], -vertices[:, 2], vertices[:, 1]], axis=1)
    vertices = vertices * (unit_m or 1.0)
    _check_size(vertices)
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    flat = np.linalg.norm(np.cross(b - a, c - a), axis=1) < 1e-9
    if flat.all():
        raise ValueError(f"`mesh_file` must have triangles with an area; got {len(faces)} without.")
    kept = np.flatnonzero(~flat)
    _, joined = np.unique(np.round(vertices, 4), axis=0, return_inverse=True)
    _, first = np.unique(np.sort(joined.ravel()[faces[kept]], axis=1), axis=0, return_index=True)
    gone = {"without area": int(flat.sum()), "on others: the first is used": kept.size - first.size}
    kept = kept[np.sort(first)]  # a ray would meet either at random
    corners = np.sort(joined.ravel()[faces[kept]][:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    _, uses = np.unique(corners, axis=0, return_counts=True)
    sheets, edges = int((uses > 2).sum()), int((uses == 1).sum())
    notes = [f"{sheets} edges join more than two triangles, which are sheets of their own"] * (sheets > 0)
    notes += [f"{edges} edges are open: surfaces are seen from both sides alike"] * (edges > 0)
    report_reading(path, "triangles", len(faces), len(kept), gone, notes)
    return NamedMesh(vertices, faces[kept], names, name_of[kept])


def _check_up(path: Path, vertices: Array, faces: Array) -> None:
    """Refuse a mesh that is taller than wide and has more horizontal area if the other axis points up."""
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    level = np.abs(np.cross(b - a, c - a)).sum(axis=0)
    size = np.ptp(vertices, axis=0)
    own, other = (2, 1) if default_up(path) == "z" else (1, 2)
    if size[own] > size[other] and level[other] > level[own]:
        raise ValueError(
            f"`scene.mesh_up` must be given for a mesh that seems to have its {'xyz'[other]} axis up, "
            f"{size[0]:.3g} × {size[1]:.3g} × {size[2]:.3g} along x, y, z; got none for {path.name}. "
            "Give y or z."
        )


def _read_parts(path: Path) -> list[Part]:
    """Read the parts of a mesh, in the file's own frame."""
    match path.suffix.lower():
        case ".obj":
            return read_obj(path)
        case ".ply":
            return read_ply(path)
        case ".stl":
            content = read_bytes(path, "mesh_file", MAX_BYTES)
            text = re.findall(rb"^\s*facet\b", content, re.MULTILINE | re.IGNORECASE)
            binary = int.from_bytes(content[80:84], "little")
            found = binary if len(content) == 84 + 50 * binary else len(text)
            parts = _load(path)
            report_reading(path, "facets", found, sum(len(part.faces) for part in parts))
            return parts
    found, triangles, left_out = count_primitives(path)
    parts = _load(path)
    report_reading(path, "primitives", found, len(parts), left_out)
    report_reading(path, "triangles of primitives", triangles, sum(len(part.faces) for part in parts))
    return parts


def _load(path: Path) -> list[Part]:
    """Load the parts of a mesh by trimesh."""
    trimesh = require_extra("trimesh", "mesh", "read meshes")

    class FolderResolver(trimesh.resolvers.FilePathResolver):
        """Reads the buffers in the mesh's folder or below, and no pictures."""

        def get(self, name: str) -> bytes:
            file = resolve_path(path.parent / name)
            if not file.is_relative_to(resolve_path(path.parent)) or file.suffix.lower() not in _NAMED:
                raise FileNotFoundError(f"{name}, no {' or '.join(_NAMED)} file in the mesh's folder")
            return read_bytes(file, "mesh_file", MAX_BYTES)

    log = logging.getLogger("trimesh.util")  # of all its modules; it logs errors that it recovers from
    before, log.disabled = log.disabled, True
    try:
        scene = trimesh.load(path, resolver=FolderResolver(str(path)), force="scene", process=False)
    finally:
        log.disabled = before
    found = []
    for node in sorted(scene.graph.nodes_geometry):
        matrix, geometry = scene.graph[node]
        mesh = scene.geometry[geometry]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        vertices = np.asarray(mesh.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3]
        faces = np.asarray(mesh.faces, int)
        if faces.min() < 0 or faces.max() >= len(vertices):
            raise ValueError(f"a triangle with a corner that is none of {len(vertices)}")
        if np.linalg.det(matrix[:3, :3]) < 0:
            faces = faces[:, ::-1]
        own = getattr(getattr(mesh.visual, "material", None), "name", None)
        found.append(Part(str(own or geometry or node), vertices, faces))
    return found


def _check_size(vertices: Float[Array, "vertex 3"]) -> None:
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    wide, tall = float(max(high[0] - low[0], high[1] - low[1])), float(high[2] - low[2])
    far = float(np.abs(np.r_[low[:2], high[:2]]).max())
    if not _MIN_WIDTH_M <= wide <= _MAX_WIDTH_M or tall > _MAX_HEIGHT_M:
        fitting = [f"{m:g} for {name}" for name, m in _UNITS_M.items() if 100 <= wide * m <= 3000]
        remedy = f"Set mesh_unit_m, perhaps {' or '.join(fitting)}." if fitting else "Set mesh_unit_m."
        raise ValueError(
            f"`mesh_file` must be {_MIN_WIDTH_M:g} to {_MAX_WIDTH_M:g} m wide and at most "
            f"{_MAX_HEIGHT_M:g} m tall; got {wide:.4g} m and {tall:.4g} m. {remedy}"
        )
    if far > 2 * _MAX_WIDTH_M:
        raise ValueError(
            f"`mesh_file` must lie about its origin; got coordinates up to {far:.6g} m. "
            "Move it, and say where it lies by crs and origin_m."
        )


def ground_under(mesh: NamedMesh, x: Float[Array, "x"], y: Float[Array, "y"]) -> Float[Array, "y x"]:
    """Height of the lowest upward surface over each point of a grid; NaN where there is none. [m]

    The eastings rise and the northings fall in even steps.
    """
    height = np.full((y.size, x.size), np.nan)
    corners = mesh.vertices[mesh.faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    up = normal[:, 2] > 0.5 * np.linalg.norm(normal, axis=1)
    step = x[1] - x[0]
    for a, b, c in corners[up]:
        low, high = np.minimum(np.minimum(a, b), c), np.maximum(np.maximum(a, b), c)
        i0, i1 = math.ceil((low[0] - x[0]) / step), math.floor((high[0] - x[0]) / step)
        j0, j1 = math.ceil((y[0] - high[1]) / step), math.floor((y[0] - low[1]) / step)
        i0, j0, i1, j1 = max(i0, 0), max(j0, 0), min(i1, x.size - 1), min(j1, y.size - 1)
        if i0 > i1 or j0 > j1:
            continue
        px, py = x[None, i0 : i1 + 1] - a[0], y[j0 : j1 + 1, None] - a[1]
        e, f = b - a, c - a
        twice = e[0] * f[1] - e[1] * f[0]
        u, v = (px * f[1] - py * f[0]) / twice, (e[0] * py - e[1] * px) / twice
        inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
        block = height[j0 : j1 + 1, i0 : i1 + 1]
        block[inside] = np.fmin(block, a[2] + u * e[2] + v * f[2])[inside]
    return height


def count_primitives(path: Path) -> tuple[int, int, dict[str, int]]:
    """Count the primitives of a glTF file, each as often as a node places it.

    Returns
    -------
    Number of all, the number of triangles of those used, and the number of others by reason.

    Raises
    ------
    ValueError
        If the file needs an extension or a feature that changes the geometry and is not read.
    """
    content = read_bytes(path, "mesh_file", MAX_BYTES)
    if content[:4] == b"glTF":
        content = content[20 : 20 + int.from_bytes(content[12:16], "little")]
    tree = json.loads(content.decode("utf-8-sig"))
    required = set(tree.get("extensionsRequired", [])) | ({_INSTANCING} & set(tree.get("extensionsUsed", [])))
    if unknown := sorted(name for name in required if not name.startswith(_APPEARANCE)):
        raise ValueError(f"the extension {unknown[0]}, which is not read (export without it)")
    nodes, scenes = tree.get("nodes", []), tree.get("scenes", [])
    children = {child for node in nodes for child in node.get("children", [])}
    waiting = scenes[tree.get("scene", 0)].get("nodes", []) if scenes else set(range(len(nodes))) - children
    waiting, reached = list(waiting), set()
    while waiting:
        if (index := waiting.pop()) not in reached:
            reached.add(index)
            waiting += nodes[index].get("children", [])
    found, triangles, gone = 0, 0, Counter[str]()
    for index, node in enumerate(nodes):
        mesh = tree["meshes"][node["mesh"]] if "mesh" in node else {"primitives": []}
        if "skin" in node or any(node.get("weights", mesh.get("weights", []))):
            feature = "a skin" if "skin" in node else "weights of morph targets"
            raise ValueError(f"a mesh with {feature}, which is not read (apply it, and export again)")
        for primitive in mesh["primitives"]:
            found += 1
            if index not in reached:
                gone["not in the scene"] += 1
            elif primitive.get("mode", _TRIANGLES) < _TRIANGLES:
                gone["points and lines"] += 1
            else:
                triangles += _count_triangles(tree["accessors"], primitive)
    return found, triangles, dict(gone)


def _count_triangles(accessors: list[dict[str, Any]], primitive: dict[str, Any]) -> int:
    """Count the triangles of a primitive of triangles, or of a strip."""
    mode, position = primitive.get("mode", _TRIANGLES), primitive["attributes"]["POSITION"]
    if mode > _STRIP:
        raise ValueError(f"a primitive of mode {mode} (6: TRIANGLE_FAN), which is not read (use triangles)")
    used = [accessors[k] for k in (position, primitive.get("indices", position))]
    if any("sparse" in accessor for accessor in used):
        raise ValueError("sparse accessors, which are not read (export without them)")
    count = used[1]["count"]
    return count // 3 if mode == _TRIANGLES else max(count - 2, 0)
