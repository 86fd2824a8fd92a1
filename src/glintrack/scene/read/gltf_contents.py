"""Count what a glTF file holds, and refuse by name what would be lost when it is loaded.

References
----------
https://registry.khronos.org/glTF/specs/2.0/glTF-2.0.html
"""

import json
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from glintrack.io.untrusted import read_bytes
from glintrack.scene.read.polygon_mesh import MAX_BYTES

# extensions of appearance, which is not read
_APPEARANCE = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_xmp", "ADOBE_materials_")
_INSTANCING = "EXT_mesh_gpu_instancing"
_POINTS_AND_LINES, _TRIANGLES, _STRIP = range(4), 4, 5
_MAX_INSTANCES = 1_000_000


@dataclass(frozen=True)
class Contents:
    """Primitives of a glTF file, each as often as a node places it.

    Parameters
    ----------
    found
        Number of primitives.
    left_out
        Number of those that have no triangles or are not in the scene, by reason.
    triangles
        Number of triangles of the others.
    """

    found: int
    left_out: dict[str, int]
    triangles: int


def read_contents(path: Path) -> Contents:
    """Count the primitives of a glTF file's nodes.

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
    roots = scenes[tree.get("scene", 0)].get("nodes", []) if scenes else set(range(len(nodes))) - children
    reached, waiting = set(), list(roots)
    while waiting:
        index = waiting.pop()
        if index not in reached:
            reached.add(index)
            waiting += nodes[index].get("children", [])
    gone: Counter[str] = Counter()
    found = triangles = 0
    for index, node in enumerate(nodes):
        if "mesh" not in node:
            continue
        mesh = tree["meshes"][node["mesh"]]
        if "skin" in node or any(node.get("weights", mesh.get("weights", []))):
            feature = "a skin" if "skin" in node else "weights of morph targets"
            raise ValueError(f"a mesh with {feature}, which is not read (apply it, and export again)")
        for primitive in mesh["primitives"]:
            found += 1
            if found > _MAX_INSTANCES:
                raise ValueError(f"more than {_MAX_INSTANCES:,} primitives")
            if index not in reached:
                gone["not in the scene"] += 1
            elif primitive.get("mode", _TRIANGLES) in _POINTS_AND_LINES:
                gone["points and lines"] += 1
            else:
                triangles += _count_triangles(tree, primitive)
    return Contents(found, dict(gone), triangles)


def _count_triangles(tree: dict[str, Any], primitive: dict[str, Any]) -> int:
    """Count the triangles of a primitive of triangles, or of a strip."""
    mode = primitive.get("mode", _TRIANGLES)
    if mode not in (_TRIANGLES, _STRIP):
        raise ValueError(
            f"a primitive of mode {mode} (TRIANGLE_FAN is 6), which is not read (export triangles)"
        )
    position = primitive["attributes"]["POSITION"]
    used = [tree["accessors"][k] for k in {position, primitive.get("indices", position)}]
    if any("sparse" in accessor for accessor in used):
        raise ValueError("sparse accessors, which are not read (export without them)")
    count = tree["accessors"][primitive.get("indices", position)]["count"]
    return count // 3 if mode == _TRIANGLES else max(count - 2, 0)
