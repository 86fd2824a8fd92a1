"""A scene as glTF 2.0 binary: one file that any viewer opens, cars and trees as instances of their models.

Colours are the materials' preview colours, glossy where the material has an interface; spectra and
polarization have no place there.
"""

import numpy as np
import xarray as xr

from glintrack.io.gltf import Document
from glintrack.scene.city import Snapshot
from glintrack.scene.objects.geometry import PAINT, Mesh


def glb(snapshot: Snapshot, materials: xr.Dataset) -> bytes:
    """A city at one instant as the bytes of a ``.glb`` file.

    Parameters
    ----------
    snapshot
        From `City.at`.
    materials
        The city's library.
    """
    document = Document()
    rgb = materials["preview_rgb"].values
    rough, gloss, metal = (
        materials[name].values for name in ("roughness", "specular_weight", "extinction_index")
    )
    for k, name in enumerate(materials["material"].values):
        roughness = float(np.clip(np.sqrt(rough[k]) if gloss[k] > 0.2 else 1.0, 0.05, 1))
        document.add_material(str(name), rgb[k], 1.0 if metal[k] > 1 else 0.0, roughness)
    document.add_node("ground and buildings", _add(document, snapshot.static, "static"))
    made: dict[tuple[int, int], int] = {}
    for model, paint, transform, vehicle in zip(
        snapshot.model, snapshot.paint, snapshot.transforms, snapshot.vehicle_id, strict=True
    ):
        key = int(model), int(paint)
        if key not in made:
            made[key] = _add(document, snapshot.models[key[0]], f"model {key[0]}", key[1])
        name = f"vehicle {int(vehicle)}" if vehicle >= 0 else "planted"
        document.add_node(name, made[key], transform)
    return document.bytes("ENU")


def _add(document: Document, mesh: Mesh, name: str, paint: int = 0) -> int:
    """A mesh of the scene, its paint filled in; its number."""
    material = np.where(mesh.material == PAINT, paint, mesh.material)
    return document.add_mesh(mesh.vertices, mesh.faces, material, name)
