"""Low-poly vehicles at SUMO's dimensions: painted bodies, glass at its true rake, tyres and lamps.

Body frame: x forward, y left, z up, origin on the ground below the centre of the footprint. A body is a skin
over cross-sections along its length; what decides its polarized signature is in the tables below: windscreens
of cars stand 30° above the horizontal (60° from the vertical), of vans 43°, of lorries and buses about 80°,
and roofs are crowned along and across, so that no two roof facets glint at once.
"""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from glintrack.core.arrays import Array
from glintrack.scene.objects.geometry import PAINT, Mesh, MeshBuilder, box_patch

_WHEEL_SIDES, _RIM_SHARE = 12, 0.62


@dataclass(frozen=True)
class Section:
    """One cross-section of a body, symmetric about its middle. All in metres.

    Parameters
    ----------
    back_m
        Distance behind the front bumper.
    heights_m
        Of the sill, the belt line, the roof's edge and the roof's middle strip; on a bonnet the last two are
        its own edge and middle.
    half_widths_m
        At the belt line and at the roof's edge.
    top, side, lower
        Materials of the panels from this section to the next one back: across the top, between belt and roof
        edge, and between sill and belt.
    corner
        Material of the outer strips of the top, where lamps sit; that of the top if empty.
    """

    back_m: float
    heights_m: tuple[float, float, float, float]
    half_widths_m: tuple[float, float]
    top: str = "paint"
    side: str = "paint"
    lower: str = "paint"
    corner: str = ""


@dataclass(frozen=True)
class VehicleDesign:
    """One vehicle model.

    Parameters
    ----------
    length_m, width_m, height_m
        Dimensions of its vType. [m]
    sections
        Cross-sections from front to back.
    crown_share
        Half width of the roof's middle strip over that of its edge.
    axles_m
        Where the axles are, behind the front bumper. [m]
    tyre_m
        Outer diameter of the tyres. [m]
    boxes
        Further closed boxes as (material, back from, back to, width, bottom, top). [m]
    single_track
        One narrow wheel an axle, in the middle.
    """

    length_m: float
    width_m: float
    height_m: float
    sections: tuple[Section, ...]
    crown_share: float
    axles_m: tuple[float, ...]
    tyre_m: float
    boxes: tuple[tuple[str, float, float, float, float, float], ...] = ()
    single_track: bool = False


_SEDAN = VehicleDesign(
    4.5,
    1.8,
    1.5,
    (
        Section(0.00, (0.30, 0.50, 0.62, 0.66), (0.70, 0.62), corner="lamp_front", lower="plastic_black"),
        Section(0.12, (0.22, 0.60, 0.72, 0.78), (0.84, 0.74)),
        Section(1.15, (0.20, 0.88, 0.95, 1.00), (0.89, 0.72), top="glass", side="glass"),
        Section(1.95, (0.20, 0.90, 1.40, 1.46), (0.90, 0.60), side="glass"),
        Section(2.60, (0.20, 0.91, 1.43, 1.50), (0.90, 0.61), side="glass"),
        Section(3.15, (0.20, 0.92, 1.38, 1.45), (0.90, 0.60), top="glass", side="glass"),
        Section(3.90, (0.22, 0.93, 1.00, 1.05), (0.88, 0.70)),
        Section(4.38, (0.26, 0.86, 0.96, 1.01), (0.84, 0.74), corner="lamp_rear", lower="plastic_black"),
        Section(4.50, (0.34, 0.60, 0.82, 0.86), (0.74, 0.66)),
    ),
    crown_share=0.55,
    axles_m=(0.85, 3.55),
    tyre_m=0.62,
)
_HATCHBACK = VehicleDesign(
    4.0,
    1.75,
    1.5,
    (
        Section(0.00, (0.30, 0.52, 0.64, 0.68), (0.68, 0.60), corner="lamp_front", lower="plastic_black"),
        Section(0.12, (0.22, 0.62, 0.75, 0.81), (0.82, 0.72)),
        Section(0.95, (0.20, 0.90, 0.97, 1.02), (0.865, 0.70), top="glass", side="glass"),
        Section(1.72, (0.20, 0.92, 1.40, 1.46), (0.875, 0.60), side="glass"),
        Section(2.40, (0.20, 0.93, 1.43, 1.50), (0.875, 0.61), side="glass"),
        Section(3.35, (0.20, 0.95, 1.38, 1.45), (0.87, 0.59), top="glass", side="paint"),
        Section(3.72, (0.22, 0.95, 1.00, 1.04), (0.85, 0.64)),
        Section(3.90, (0.26, 0.86, 0.94, 0.98), (0.82, 0.70), corner="lamp_rear", lower="plastic_black"),
        Section(4.00, (0.34, 0.60, 0.80, 0.84), (0.74, 0.64)),
    ),
    crown_share=0.55,
    axles_m=(0.78, 3.20),
    tyre_m=0.60,
)
_VAN = VehicleDesign(
    6.0,
    2.1,
    2.6,
    (
        Section(0.00, (0.35, 0.60, 0.80, 0.84), (0.85, 0.80), corner="lamp_front", lower="plastic_black"),
        Section(0.12, (0.30, 0.75, 0.97, 1.02), (1.00, 0.92)),
        Section(0.75, (0.28, 1.18, 1.25, 1.32), (1.05, 0.95), top="glass", side="glass"),
        Section(1.90, (0.28, 1.30, 2.28, 2.39), (1.05, 0.92), side="glass"),
        Section(2.70, (0.28, 1.32, 2.46, 2.57), (1.05, 0.93)),
        Section(4.20, (0.28, 1.32, 2.48, 2.60), (1.05, 0.94)),
        Section(5.85, (0.30, 1.30, 2.45, 2.57), (1.04, 0.93), lower="plastic_black"),
        Section(6.00, (0.36, 1.20, 2.36, 2.48), (0.98, 0.88)),
    ),
    crown_share=0.8,
    axles_m=(0.95, 4.75),
    tyre_m=0.70,
)
_BUS = VehicleDesign(
    12.0,
    2.5,
    3.1,
    (
        Section(0.00, (0.30, 0.95, 1.02, 1.08), (1.15, 1.10), top="glass", side="glass"),
        Section(0.32, (0.30, 1.15, 2.62, 2.90), (1.25, 1.21), side="glass"),
        Section(0.90, (0.30, 1.20, 2.70, 3.02), (1.25, 1.22), side="glass"),
        Section(4.20, (0.30, 1.20, 2.72, 3.06), (1.25, 1.22), side="glass"),
        Section(8.00, (0.30, 1.20, 2.72, 3.05), (1.25, 1.22), side="glass"),
        Section(11.75, (0.30, 1.20, 2.66, 3.00), (1.25, 1.20), corner="lamp_rear"),
        Section(12.00, (0.36, 1.15, 2.55, 2.82), (1.20, 1.15)),
    ),
    crown_share=0.85,
    axles_m=(2.7, 8.7),
    tyre_m=0.95,
    boxes=(("metal", 3.0, 5.4, 1.7, 2.95, 3.10),),
)
_LORRY = VehicleDesign(
    9.0,
    2.4,
    3.4,
    (
        Section(0.00, (0.40, 1.30, 1.42, 1.50), (1.12, 1.08), top="glass", side="paint", lower="paint"),
        Section(0.25, (0.40, 1.45, 2.55, 2.70), (1.20, 1.10), side="glass"),
        Section(0.80, (0.40, 1.50, 2.72, 2.88), (1.20, 1.10), side="glass"),
        Section(1.60, (0.40, 1.50, 2.74, 2.90), (1.20, 1.10)),
        Section(2.00, (0.45, 1.50, 2.60, 2.75), (1.18, 1.06)),
    ),
    crown_share=0.8,
    axles_m=(1.35, 6.6, 7.8),
    tyre_m=0.95,
    boxes=(
        ("siding", 2.2, 9.0, 2.4, 0.98, 3.40),
        ("plastic_black", 2.05, 8.9, 1.0, 0.50, 0.96),
    ),
)

_SUV = VehicleDesign(
    4.7,
    1.9,
    1.75,
    (
        Section(0.00, (0.38, 0.66, 0.84, 0.90), (0.78, 0.70), corner="lamp_front", lower="plastic_black"),
        Section(0.14, (0.30, 0.78, 0.96, 1.03), (0.90, 0.80), lower="plastic_black"),
        Section(1.20, (0.28, 1.06, 1.14, 1.20), (0.94, 0.78), top="glass", side="glass"),
        Section(1.93, (0.28, 1.08, 1.64, 1.70), (0.95, 0.66), side="glass"),
        Section(2.75, (0.28, 1.09, 1.68, 1.75), (0.95, 0.67), side="glass"),
        Section(3.95, (0.28, 1.10, 1.63, 1.70), (0.94, 0.66), top="glass", side="glass"),
        Section(4.45, (0.32, 1.10, 1.18, 1.23), (0.92, 0.72), corner="lamp_rear", lower="plastic_black"),
        Section(4.60, (0.36, 0.96, 1.06, 1.10), (0.88, 0.76), lower="plastic_black"),
        Section(4.70, (0.42, 0.70, 0.90, 0.94), (0.80, 0.70)),
    ),
    crown_share=0.55,
    axles_m=(0.92, 3.72),
    tyre_m=0.72,
)
# The body is fuel tank, seat and tail; a rider in dark clothes sits on it, and handlebars and engine
# are boxes.
_MOTORCYCLE = VehicleDesign(
    2.2,
    0.8,
    1.6,
    (
        Section(0.28, (0.62, 0.74, 0.92, 0.98), (0.10, 0.08), corner="lamp_front"),
        Section(0.40, (0.58, 0.78, 1.00, 1.06), (0.20, 0.16), top="glass"),
        Section(0.62, (0.56, 0.80, 1.02, 1.08), (0.21, 0.16)),
        Section(1.10, (0.56, 0.74, 0.86, 0.90), (0.19, 0.15), top="plastic_black"),
        Section(1.60, (0.60, 0.72, 0.80, 0.84), (0.16, 0.13), top="plastic_black"),
        Section(2.06, (0.66, 0.74, 0.82, 0.86), (0.09, 0.07), corner="lamp_rear"),
    ),
    crown_share=0.55,
    axles_m=(0.31, 1.89),
    tyre_m=0.62,
    boxes=(
        ("metal", 0.75, 1.35, 0.36, 0.22, 0.60),
        ("metal", 0.52, 0.60, 0.80, 1.06, 1.10),
        ("plastic_black", 1.02, 1.30, 0.44, 0.84, 1.34),
        ("paint", 1.00, 1.26, 0.26, 1.34, 1.60),
    ),
    single_track=True,
)

MODELS: Mapping[str, VehicleDesign] = {
    "car": _SEDAN,
    "hatch": _HATCHBACK,
    "van": _VAN,
    "truck": _LORRY,
    "bus": _BUS,
    "suv": _SUV,
    "motorcycle": _MOTORCYCLE,
}
VEHICLE_CLASSES = tuple(MODELS)  # by a snapshot's model index; what comes after is no vehicle


def build_models(index: dict[str, int]) -> tuple[Mesh, ...]:
    """One mesh for each entry of `MODELS`, in its order.

    Parameters
    ----------
    index
        Material index by name.
    """
    return tuple(build_model(design, index) for design in MODELS.values())


def build_model(design: VehicleDesign, index: dict[str, int]) -> Mesh:
    """Closed mesh of one vehicle in its body frame, faces outward."""
    builder = MeshBuilder(index)
    _add_skin(builder, design)
    front = design.length_m / 2
    # outer faces 1 cm inside the vType's width, so that they show below the tucked-in sills
    beside, thick = ((0.0,), 0.14) if design.single_track else ((-1.0, 1.0), 0.20)
    for axle in design.axles_m:
        for side in beside:
            across = side * (design.width_m / 2 - 0.11)
            _add_wheel(builder, front - axle, across, design.tyre_m / 2, thick)
    for material, start, stop, width, bottom, top in design.boxes:
        centre = np.array([front - (start + stop) / 2, 0.0, (bottom + top) / 2])
        builder.add(material, box_patch(centre, np.array([stop - start, width, top - bottom])))
    return builder.mesh()


def _add_wheel(builder: MeshBuilder, x_m: float, y_m: float, radius_m: float, thick_m: float) -> None:
    """A closed twelve-sided tyre with bare metal discs, its lowest corners on the ground. [m]"""
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


def _ring(section: Section, front_m: float, crown_share: float) -> Float[Array, "8 3"]:
    """Corners of a cross-section from the left sill over the roof to the right sill."""
    sill, belt, edge, crown = section.heights_m
    half_belt, half_edge = section.half_widths_m
    left = [(half_belt * 0.96, sill), (half_belt, belt), (half_edge, edge), (crown_share * half_edge, crown)]
    profile = left + [(-y, z) for y, z in reversed(left)]
    return np.array([(front_m - section.back_m, y, z) for y, z in profile])


def _add_skin(builder: MeshBuilder, design: VehicleDesign) -> None:
    rings = [_ring(s, design.length_m / 2, design.crown_share) for s in design.sections]
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
