"""Count what a glTF 2.0 file holds, and refuse by name what would be lost when it is loaded."""

import json
from collections import Counter
from pathlib import Path
from typing import Any

from glintrack.io.untrusted import read_bytes
from glintrack.scene.read.polygon_mesh import MAX_BYTES

# extensions of appearance, which is not read
_APPEARANCE = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "KHR_xmp", "ADOBE_materials_")
_INSTANCING = "EXT_mesh_gpu_instancing"
_TRIANGLES, _STRIP = 4, 5  # modes; lower ones are points and lines


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
        raise ValueError(
            f"a primitive of mode {mode} (6 is TRIANGLE_FAN), which is not read (export triangles)"
        )
    used = [accessors[k] for k in (position, primitive.get("indices", position))]
    if any("sparse" in accessor for accessor in used):
        raise ValueError("sparse accessors, which are not read (export without them)")
    count = used[1]["count"]
    return count // 3 if mode == _TRIANGLES else max(count - 2, 0)
