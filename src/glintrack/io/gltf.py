"""Write glTF 2.0 binary files: meshes with flat colours, and instances of them.

glTF's axes are x right, y up, z toward the viewer. Our x, y, z (z up) become x, −z, y.
"""

import json
import struct
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.colour import decode_srgb

_FLOAT, _UINT = 5126, 5125  # component types of the standard
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_JSON, _BIN, _MAGIC = 0x4E4F534A, 0x004E4942, 0x46546C67
_Z_UP = [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]  # z up to y up, column by column


@dataclass
class Document:
    """Parts of one glTF file, which `bytes` writes."""

    materials: list[dict] = field(default_factory=list)
    nodes: list[dict] = field(default_factory=list)
    meshes: list[dict] = field(default_factory=list)
    accessors: list[dict] = field(default_factory=list)
    views: list[dict] = field(default_factory=list)
    chunks: list[bytes] = field(default_factory=list)
    length: int = 0

    def add_material(
        self,
        name: str,
        srgb: Float[Array, "3"],
        metallic: float = 0.0,
        roughness: float = 1.0,
        opacity: float = 1.0,
    ) -> int:
        """Add a material with a gamma-encoded colour, and return its number."""
        colour = [*(float(c) for c in decode_srgb(np.asarray(srgb, float))), float(opacity)]
        shares = {"metallicFactor": float(metallic), "roughnessFactor": float(roughness)}
        look = {"baseColorFactor": colour, **shares}
        made = {"name": name, "doubleSided": True, "pbrMetallicRoughness": look}
        self.materials.append(made if opacity >= 1 else {**made, "alphaMode": "BLEND"})
        return len(self.materials) - 1

    def add_mesh(
        self,
        vertices: Float[Array, "vertex 3"],
        faces: Int[Array, "face 3"],
        material: Int[Array, "face"],
        name: str,
    ) -> int:
        """Add a mesh with a primitive for each material, and return its number."""
        primitives = []
        for number in np.unique(material):
            used, corners = np.unique(faces[material == number], return_inverse=True)
            points = np.asarray(vertices)[used].astype(np.float32)
            position = self._add(points, _VERTICES, _FLOAT, "VEC3", len(points))
            self.accessors[position] |= {
                "min": [float(v) for v in points.min(axis=0)],
                "max": [float(v) for v in points.max(axis=0)],
            }
            flat = corners.ravel().astype(np.uint32)
            index = self._add(flat, _INDICES, _UINT, "SCALAR", flat.size)
            primitives.append(
                {"attributes": {"POSITION": position}, "indices": index, "material": int(number)}
            )
        self.meshes.append({"name": name, "primitives": primitives})
        return len(self.meshes) - 1

    def add_node(self, name: str, mesh: int, transform: Float[Array, "3 4"] | None = None) -> None:
        """Add an instance of a mesh; without a transform, at the position of its vertices."""
        node = {"name": name, "mesh": mesh}
        if transform is not None:
            matrix = np.vstack([transform, [0, 0, 0, 1]]).T.ravel()  # column by column
            node["matrix"] = [float(m) for m in matrix]
        self.nodes.append(node)

    def _add(self, values: Array, target: int, component: int, kind: str, count: int) -> int:
        data = np.ascontiguousarray(values).tobytes()
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": len(data), "target": target})
        self.accessors.append(
            {"bufferView": len(self.views) - 1, "componentType": component, "count": count, "type": kind}
        )
        self.chunks.append(data)  # every piece is whole four-byte words: what follows stays aligned
        self.length += len(data)
        return len(self.accessors) - 1

    def bytes(self, root: str = "z up") -> bytes:
        """Content of the file: a JSON chunk and a binary one.

        Parameters
        ----------
        root
            Name of the node that turns z up into glTF's y up.
        """
        axes = {"name": root, "matrix": _Z_UP, "children": list(range(1, len(self.nodes) + 1))}
        document = {
            "asset": {"version": "2.0", "generator": "glintrack"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [axes, *self.nodes],
            "meshes": self.meshes,
            "materials": self.materials,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.length}],
        }
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        data = b"".join(self.chunks)
        head = struct.pack("<5I", _MAGIC, 2, 28 + len(text) + len(data), len(text), _JSON)
        return b"".join([head, text, struct.pack("<2I", len(data), _BIN), data])
