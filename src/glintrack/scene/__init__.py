"""A city on the ground, its materials and its traffic, at any time."""

from glintrack.scene.city import City, Snapshot, build_scene, glb, record_traffic
from glintrack.scene.design import PanelDesign, SceneDesign
from glintrack.scene.materials import load_materials
from glintrack.scene.objects.geometry import PAINT, Mesh
from glintrack.scene.read.fcd import fcd_table
from glintrack.scene.traffic import Recording, write_recording
from glintrack.scene.vehicles import VEHICLE_CLASSES

__all__ = [
    "PAINT", "VEHICLE_CLASSES", "City", "Mesh", "PanelDesign", "Recording", "SceneDesign", "Snapshot",
    "build_scene", "fcd_table", "glb", "load_materials", "record_traffic", "write_recording",
]  # fmt: skip
