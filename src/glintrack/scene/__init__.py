"""What exists on the ground: a city, its materials and its traffic, at any time."""

from glintrack.scene.city import City, Snapshot, build_scene
from glintrack.scene.design import PanelDesign, SceneDesign
from glintrack.scene.geometry import PAINT, Mesh
from glintrack.scene.gltf import glb
from glintrack.scene.materials import load_materials
from glintrack.scene.run_sumo import MissingExtraError

__all__ = [
    "PAINT",
    "City",
    "Mesh",
    "MissingExtraError",
    "PanelDesign",
    "SceneDesign",
    "Snapshot",
    "build_scene",
    "glb",
    "load_materials",
]
