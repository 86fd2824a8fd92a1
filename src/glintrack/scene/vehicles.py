"""Low-poly vehicles at SUMO's dimensions: painted bodies, glass at its true rake, tyres and lamps.

Body frame: x forward, y left, z up, origin on the ground below the centre of the footprint. A body is a skin
over cross-sections along its length. ``data/vehicles.toml`` holds the sections, which decide the polarized
signature: windscreens of cars stand 30° above the horizontal (60° from the vertical), of vans 43°, of lorries
and buses about 80°. Roofs are crowned along and across, so that no two roof facets glint at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache

import numpy as np

from glintrack.core.installation import read_data
from glintrack.scene.objects.geometry import PAINT, Mesh, MeshBuilder, box_patch

VEHICLE_CLASSES = ("car", "hatch", "van", "truck", "bus", "suv", "motorcycle")  # order of the model indices
_WHEEL_SIDES, _RIM_SHARE = 12, 0.62


@dataclass(frozen=True)
class Section:
    """One cross-section of a body, symmetric about its middle; see the head of ``data/vehicles.toml``. [m]"""

    back_m: float
    heights_m: tuple[float, float, float, float]
    half_widths_m: tuple[float, float]
    top: str = "paint"
    side: str = "paint"
    lower: str = "paint"
    corner: str = ""


@dataclass(frozen=True)
class VehicleDesign:
    """One vehicle model; see the head of ``data/vehicles.toml``. [m]"""

    length_m: float
    width_m: float
    height_m: float
    sections: tuple[Section, ...]
    crown_share: float
    axles_m: tuple[float, ...]
    tyre_m: float
    boxes: tuple[tuple[str, float, float, float, float, float], ...] = ()
    single_track: bool = False


@cache
def load_vehicles() -> Mapping[str, VehicleDesign]:
    """Load the packaged vehicle models by name, in the order of `VEHICLE_CLASSES`."""
    tables = read_data("vehicles.toml")
    for table in tables.values():
        table["sections"] = tuple(Section(**section) for section in table["sections"])
    return {name: VehicleDesign(**tables[name]) for name in VEHICLE_CLASSES}


def build_models(index: dict[str, int]) -> tuple[Mesh, ...]:
    """Build one mesh for each of `VEHICLE_CLASSES`.

    Parameters
    ----------
    index
        Material index by name.
    """
    return tuple(build_model(design, index) for design in load_vehicles().values())


def build_model(design: VehicleDesign, index: dict[str, int]) -> Mesh:
    """Build the closed mesh of one vehicle in its body frame, faces outward."""
    builder = MeshBuilder(index)
    _add_skin(builder, design)
    front = design.length_m / 2
    # outer faces 1 cm inside the vType's width, so that they show below the tucked-in sills
    sides, thick = ((0.0,), 0.14) if design.single_track else ((-1.0, 1.0), 0.20)
    for axle in design.axles_m:
        for side in sides:
            across = side * (design.width_m / 2 - 0.11)
            _add_wheel(builder, front - axle, across, design.tyre_m / 2, thick)
    for material, start, stop, width, bottom, top in design.boxes:
        centre = np.array([front - (start + stop) / 2, 0.0, (bottom + top) / 2])
        builder.add(material, box_patch(centre, np.array([stop - start, width, top - bottom])))
    return builder.mesh()


def _add_wheel(builder: MeshBuilder, x_m: float, y_m: float, radius_m: float, thick_m: float) -> None:
    """Add a closed twelve-sided tyre with bare metal discs, its lowest corners on the ground. [m]"""
    n = _WHEEL_SIDES
    angle = 2 * np.pi * np.arange(n) / n - np.pi / 2
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1) * radius_m
    rings = []
    for y, share in ((1, _RIM_SHARE), (1, 1.0), (-1, 1.0), (-1, _RIM_SHARE)):  # from disc over tread to disc
        ring = np.c_[x_m + share * circle[:, 0], np.full(n, y_m + y * thick_m / 2), share * circle[:, 1]]
        rings.append(ring + [0.0, 0.0, radius_m])
    vertices = np.concatenate(rings)
    k, after = np.arange(n), (np.arange(n) + 1) % n
    tyre = [
        np.vstack([np.c_[a + k, a + after, a + n + after], np.c_[a + k, a + n + after, a + n + k]])
        for a in (0, n, 2 * n)
    ]
    fan = np.c_[np.zeros(n - 2, int), np.arange(1, n - 1), np.arange(2, n)]
    faces = np.vstack([*tyre, fan[:, ::-1], 3 * n + fan])
    material = np.full(len(faces), builder.index["tyre_rubber"], np.int16)
    material[-2 * (n - 2) :] = builder.index["metal"]
    builder.add_mesh(Mesh(vertices.astype(np.float32), faces.astype(np.int32), material), np.eye(3, 4), PAINT)


def _add_skin(builder: MeshBuilder, design: VehicleDesign) -> None:
    rings = []
    for section in design.sections:  # corners from the left sill over the roof to the right sill
        half_belt, half_edge = section.half_widths_m
        half_widths = half_belt * 0.96, half_belt, half_edge, design.crown_share * half_edge
        left = list(zip(half_widths, section.heights_m, strict=True))
        profile = left + [(-y, z) for y, z in reversed(left)]
        rings.append([(design.length_m / 2 - section.back_m, y, z) for y, z in profile])
    n, last = len(rings[0]), (len(rings) - 1) * len(rings[0])
    panels: list[tuple[str, tuple[int, int, int]]] = []
    for i, section in enumerate(design.sections[:-1]):
        corner = section.corner or section.top
        strips = (section.lower, section.side, corner, section.top, corner, section.side, section.lower)
        for k, material in enumerate((*strips, "plastic_black")):
            a, b = i * n + k, i * n + (k + 1) % n
            c, d = b + n, a + n
            panels += [(material, (a, c, b)), (material, (a, d, c))]
    for k in range(1, n - 1):
        panels += [("paint", (0, k, k + 1)), ("paint", (last, last + k + 1, last + k))]
    numbers = [PAINT if name == "paint" else builder.index[name] for name, _ in panels]
    skin = Mesh(
        np.concatenate(rings).astype(np.float32),
        np.array([face for _, face in panels], dtype=np.int32),
        np.array(numbers, dtype=np.int16),
    )
    builder.add_mesh(skin, np.eye(3, 4), PAINT)
