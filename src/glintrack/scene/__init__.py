"""What exists on the ground: a city, its materials and its traffic, at any time."""

from glintrack.scene.city import City, Snapshot, build_scene, record_traffic
from glintrack.scene.design import PanelDesign, SceneDesign
from glintrack.scene.geometry import PAINT, Mesh
from glintrack.scene.gltf import glb
from glintrack.scene.materials import load_materials
from glintrack.scene.read_fcd import fcd_table
from glintrack.scene.recording import Recording, write_recording
from glintrack.scene.run_sumo import MissingExtraError

__all__ = [
    "PAINT",
    "City",
    "Mesh",
    "MissingExtraError",
    "PanelDesign",
    "Recording",
    "SceneDesign",
    "Snapshot",
    "build_scene",
    "fcd_table",
    "glb",
    "load_materials",
    "record_traffic",
    "write_recording",
]
