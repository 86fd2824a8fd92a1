"""A scene as glTF 2.0 binary: one file that any viewer opens, cars and trees as instances of their models.

glTF's axes are x right, y up, z toward the viewer; ENU east, north, up are put at x, −z, y. Colours are the
materials' preview colours, glossy where the material has an interface; spectra and polarization have no place
there.
"""

import json
import struct
from dataclasses import dataclass, field

import numpy as np
import xarray as xr
from jaxtyping import Float

from glintrack.scene.city import Snapshot
from glintrack.scene.geometry import PAINT, Mesh

Array = np.ndarray
_FLOAT, _UINT = 5126, 5125  # component types of the standard
_VERTICES, _INDICES = 34962, 34963  # targets of buffer views
_JSON, _BIN, _MAGIC = 0x4E4F534A, 0x004E4942, 0x46546C67


def glb(snapshot: Snapshot, materials: xr.Dataset) -> bytes:
    """A city at one instant as the bytes of a ``.glb`` file.

    Parameters
    ----------
    snapshot
        From `City.at`.
    materials
        The city's library.
    """
    document = _Document()
    rgb = materials["preview_rgb"].values
    rough, gloss, metal = (
        materials[name].values for name in ("roughness", "specular_weight", "extinction_index")
    )
    for k, name in enumerate(materials["material"].values):
        document.materials.append(
            {
                "name": str(name),
                "doubleSided": True,
                "pbrMetallicRoughness": {
                    "baseColorFactor": [*(float(c) for c in _linear(rgb[k])), 1.0],
                    "metallicFactor": 1.0 if metal[k] > 1 else 0.0,
                    "roughnessFactor": float(np.clip(np.sqrt(rough[k]) if gloss[k] > 0.2 else 1.0, 0.05, 1)),
                },
            }
        )
    document.nodes.append(
        {"name": "ground and buildings", "mesh": document.add_mesh(snapshot.static, "static")}
    )
    made: dict[tuple[int, int], int] = {}
    for model, paint, transform, vehicle in zip(
        snapshot.model, snapshot.paint, snapshot.transforms, snapshot.vehicle_id, strict=True
    ):
        key = int(model), int(paint)
        if key not in made:
            made[key] = document.add_mesh(snapshot.models[key[0]], f"model {key[0]}", key[1])
        matrix = np.vstack([transform, [0, 0, 0, 1]]).T.ravel()  # column by column
        name = f"vehicle {int(vehicle)}" if vehicle >= 0 else "planted"
        node = {"name": name, "mesh": made[key], "matrix": [float(m) for m in matrix]}
        document.nodes.append(node)
    return document.bytes()


@dataclass
class _Document:
    """Collects the parts of one file."""

    materials: list[dict] = field(default_factory=list)
    nodes: list[dict] = field(default_factory=list)
    meshes: list[dict] = field(default_factory=list)
    accessors: list[dict] = field(default_factory=list)
    views: list[dict] = field(default_factory=list)
    chunks: list[bytes] = field(default_factory=list)
    length: int = 0

    def add_mesh(self, mesh: Mesh, name: str, paint: int = 0) -> int:
        """One mesh with a primitive a material; its number."""
        material = np.where(mesh.material == PAINT, paint, mesh.material)
        primitives = []
        for number in np.unique(material):
            used, faces = np.unique(mesh.faces[material == number], return_inverse=True)
            vertices = mesh.vertices[used].astype(np.float32)
            position = self._add(vertices, _VERTICES, _FLOAT, "VEC3", len(vertices))
            self.accessors[position] |= {
                "min": [float(v) for v in vertices.min(axis=0)],
                "max": [float(v) for v in vertices.max(axis=0)],
            }
            flat = faces.ravel().astype(np.uint32)
            index = self._add(flat, _INDICES, _UINT, "SCALAR", flat.size)
            primitives.append(
                {"attributes": {"POSITION": position}, "indices": index, "material": int(number)}
            )
        self.meshes.append({"name": name, "primitives": primitives})
        return len(self.meshes) - 1

    def _add(
        self,
        values: Array,
        target: int,
        component: int,
        kind: str,
        count: int,
    ) -> int:
        data = np.ascontiguousarray(values).tobytes()
        self.views.append({"buffer": 0, "byteOffset": self.length, "byteLength": len(data), "target": target})
        self.accessors.append(
            {"bufferView": len(self.views) - 1, "componentType": component, "count": count, "type": kind}
        )
        self.chunks.append(data)  # every piece is whole four-byte words: what follows stays aligned
        self.length += len(data)
        return len(self.accessors) - 1

    def bytes(self) -> bytes:
        """The file: a JSON chunk and a binary one."""
        root = {"name": "ENU", "matrix": [1, 0, 0, 0, 0, 0, -1, 0, 0, 1, 0, 0, 0, 0, 0, 1]}
        document = {
            "asset": {"version": "2.0", "generator": "glintrack"},
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": [{**root, "children": list(range(1, len(self.nodes) + 1))}, *self.nodes],
            "meshes": self.meshes,
            "materials": self.materials,
            "accessors": self.accessors,
            "bufferViews": self.views,
            "buffers": [{"byteLength": self.length}],
        }
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        data = b"".join(self.chunks)
        total = 12 + 8 + len(text) + 8 + len(data)
        return b"".join(
            [
                struct.pack("<3I", _MAGIC, 2, total),
                *(struct.pack("<2I", len(text), _JSON), text),
                *(struct.pack("<2I", len(data), _BIN), data),
            ]
        )


def _linear(srgb: Float[Array, "3"]) -> Float[Array, "3"]:
    """Linear light of a gamma-encoded colour (IEC 61966-2-1)."""
    return np.where(srgb <= 0.04045, srgb / 12.92, ((srgb + 0.055) / 1.055) ** 2.4)
