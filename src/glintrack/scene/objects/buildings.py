"""Buildings from footprints: walls, windows as panes of glass on them, roofs, chimneys and roof plant."""

import itertools
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import shapely
from shapely.geometry import Polygon

from glintrack.core.arrays import Array
from glintrack.scene.objects import geometry

_PARAPET_M = 0.5  # of flat roofs, above the deck
_INSET_M = 2.2  # of a mansard roof's flat top from the eaves
_PANE_OFFSET_M = 0.03  # of panes before the wall, so that rays meet them first


@dataclass(frozen=True)
class Building:
    """One building.

    Parameters
    ----------
    footprint
        Plan. [m]
    eaves_m
        Height of the walls. [m]
    roof
        ``gable`` and ``hip`` cover the footprint's smallest rectangle, ``mansard`` any shape, ``flat`` has a
        parapet.
    wall, roof_material
        Materials.
    glazing
        ``rows`` of single windows, ``curtain`` for walls of glass, ``shopfront`` for glass on the ground
        floor only.
    slope_rad
        Slope of the roof's planes. [rad]
    storey_m
        Height of a storey. [m]
    """

    footprint: Polygon
    eaves_m: float
    roof: Literal["gable", "hip", "mansard", "flat"] = "gable"
    wall: str = "plaster"
    roof_material: str = "roof_tile"
    glazing: Literal["none", "rows", "curtain", "shopfront"] = "rows"
    slope_rad: float = math.radians(38)
    storey_m: float = 2.9


def add_building(
    builder: geometry.MeshBuilder, building: Building, rng: np.random.Generator, foot_m: float = -0.1
) -> None:
    """Build walls, panes and roof.

    Parameters
    ----------
    builder
        Receives the surfaces.
    building
        Shape and materials.
    rng
        Source of chimneys, skylights and roof plant.
    foot_m
        Height of the walls' lower edge relative to the floor. [m]
    """
    footprint = geometry.outline(building.footprint, tolerance_m=0.05)
    parapet_m = _PARAPET_M if building.roof == "flat" else 0.0
    builder.add(building.wall, geometry.walls(footprint, foot_m, building.eaves_m + parapet_m))
    builder.add("glass", _panes(footprint, building))
    match building.roof:
        case "gable" | "hip":
            hip = building.roof == "hip"
            planes, rest = geometry.gable_or_hip_roof(footprint, building.eaves_m, building.slope_rad, hip)
            builder.add(building.roof_material, planes)
            builder.add(building.wall, rest)
            centre, axis, length, width = geometry.bounding_rectangle(footprint)
            if rng.random() <= 0.7:  # a chimney
                place = centre + rng.uniform(-0.2, 0.2) * length * axis
                ridge = building.eaves_m + 0.5 * width * math.tan(building.slope_rad)
                builder.add(
                    "brick", geometry.box_patch(np.array([*place, ridge + 0.2]), np.array([0.9, 0.7, 1.6]))
                )
            _add_dormers(builder, building, footprint, rng)
        case "mansard":
            planes, top = geometry.mansard_roof(footprint, building.eaves_m, building.slope_rad, _INSET_M)
            builder.add(building.roof_material, planes)
            builder.add("roof_bitumen", top)
        case "flat":
            deck, parapet = geometry.parapet_roof(footprint, building.eaves_m, parapet_m)
            builder.add(building.roof_material, deck)
            builder.add("concrete", parapet)
            _add_plant(builder, building, footprint, rng)


def rise_m(building: Building) -> float:
    """Height of the top of a roof above its eaves, without chimneys and plant. [m]"""
    footprint = geometry.outline(building.footprint, tolerance_m=0.05)
    match building.roof:
        case "flat":
            return _PARAPET_M
        case "mansard":
            planes, _ = geometry.mansard_roof(footprint, 0.0, building.slope_rad, _INSET_M)
        case _:
            planes, _ = geometry.gable_or_hip_roof(footprint, 0.0, building.slope_rad, building.roof == "hip")
    return float(planes[0][:, 2].max(initial=0.0))


def _panes(footprint: Polygon, building: Building) -> geometry.Patch:
    """Glass on the walls, as upright rectangles 3 cm before them."""
    if building.glazing == "none":
        return geometry.join([])
    corners = np.asarray(footprint.exterior.coords)[:, :2]
    storeys = max(int((building.eaves_m + 0.2) / building.storey_m), 1)
    spacing, width, sill, top = {
        "rows": (2.6, 1.25, 0.95, 2.30),
        "curtain": (3.0, 2.9, 0.35, building.storey_m - 0.25),
        "shopfront": (4.0, 3.6, 0.3, 2.8),
    }[building.glazing]
    levels = range(1 if building.glazing == "shopfront" else storeys)
    found = []
    for a, b in itertools.pairwise(corners):
        length = float(np.hypot(*(b - a)))
        count = int((length - 0.5) / spacing)
        if count < 1:
            continue
        along = (length - count * spacing) / 2 + spacing * (np.arange(count) + 0.5)
        bottoms = np.array([level * building.storey_m + sill for level in levels])
        tops = np.minimum(bottoms + top - sill, building.eaves_m - 0.1)
        direction = (b - a) / np.hypot(*(b - a))
        outward = np.array([direction[1], -direction[0]]) * _PANE_OFFSET_M
        middle = np.repeat(along, len(bottoms))
        low, high = np.tile(bottoms, len(along)), np.tile(tops, len(along))
        left, right = (a + outward + (middle + d)[:, None] * direction for d in (-width / 2, width / 2))
        found.append(geometry.upright(left, right, low, high))
    return geometry.join(found)


def _add_dormers(
    builder: geometry.MeshBuilder, building: Building, footprint: Polygon, rng: np.random.Generator
) -> None:
    """One or two gabled dormers on a side or both of a roof that is high enough for a room."""
    centre, axis, length, width = geometry.bounding_rectangle(footprint)
    draw = rng.random(3)
    rise = 0.5 * width * math.tan(building.slope_rad)
    front_rise, cheek, gable = 0.2 * rise, 1.0, 0.4  # of the front wall's foot, and its two parts
    if draw[0] > 0.6 or rise < front_rise + cheek + gable + 0.4:
        return
    ridge_half = length / 2 - (width / 2 if building.roof == "hip" else 1.5)
    places = (0.0,) if draw[1] < 0.4 or ridge_half < 2.0 else (-0.55 * ridge_half, 0.55 * ridge_half)
    across = np.array([-axis[1], axis[0]])
    for side in (1.0, -1.0) if draw[2] < 0.5 else (1.0,):
        out = side * across
        right = np.array([-out[1], out[0]])  # of one who looks at the front
        foot = building.eaves_m + front_rise
        for along in places:
            front = centre + along * axis + (width / 2 - front_rise / math.tan(building.slope_rad)) * out
            back = front - (cheek + gable) / math.tan(building.slope_rad) * out
            ends = front, back, right
            _add_dormer(builder, building, ends, (foot, foot + cheek, foot + cheek + gable))


def _add_dormer(
    builder: geometry.MeshBuilder,
    building: Building,
    plan: tuple[Array, Array, Array],
    heights_m: tuple[float, float, float],
) -> None:
    """Add a closed house-shaped body with a window.

    ``plan`` has the middle of its front, of its back in the roof, and the unit vector along the front;
    ``heights_m`` those of the front wall's foot, its eaves and its ridge. [m]
    """
    front, back, right = plan
    foot_m, eaves_m, ridge_m = heights_m
    out = np.array([right[1], -right[0]])
    profile = [(-0.85, foot_m - 0.6), (0.85, foot_m - 0.6), (0.85, eaves_m), (0.0, ridge_m)]
    profile.append((-0.85, eaves_m))
    body = np.array([(*(end + x * right), z) for end in (front, back) for x, z in profile])
    k, after = np.arange(5), (np.arange(5) + 1) % 5
    sides = np.stack([np.c_[k, k + 5, after + 5], np.c_[k, after + 5, after]], axis=1)
    fan = np.array([(0, 1, 2), (0, 2, 4), (2, 3, 4)])
    walls_of = np.vstack([sides[[0, 1, 4]].reshape(-1, 3), fan, 5 + fan[:, ::-1]])
    builder.add(building.wall, (body, walls_of))
    builder.add(building.roof_material, (body, sides[[2, 3]].reshape(-1, 3)))
    pane = front + _PANE_OFFSET_M * out
    corners = [(-0.55, foot_m + 0.25), (0.55, foot_m + 0.25), (0.55, eaves_m), (-0.55, eaves_m)]
    glass = np.array([(*(pane + x * right), z) for x, z in corners])
    builder.add("glass", (glass, np.array([(0, 1, 2), (0, 2, 3)])))


def _add_plant(
    builder: geometry.MeshBuilder, building: Building, footprint: Polygon, rng: np.random.Generator
) -> None:
    """Stair heads, ventilation and cooling units on a flat roof: about one box in 150 m²."""
    deck = footprint.buffer(-2.5)
    _, axis, _, _ = geometry.bounding_rectangle(footprint)
    heading = math.atan2(axis[1], axis[0])
    west, south, east, north = footprint.bounds
    for _ in range(min(int(footprint.area / 150), 12)):
        x, y = rng.uniform(west, east), rng.uniform(south, north)
        size = rng.uniform([1.2, 1.0, 0.8], [4.0, 2.5, 2.2])
        if deck.contains(shapely.Point(x, y)):
            material = "metal" if rng.random() < 0.6 else "concrete"
            centre = np.array([x, y, building.eaves_m + size[2] / 2 + 0.02])
            builder.add(material, geometry.box_patch(centre, size, heading))
    if building.roof_material == "roof_bitumen" and deck.area > 60 and rng.random() < 0.5:
        lights = deck.representative_point()
        centre = np.array([lights.x, lights.y, building.eaves_m + 0.35])
        builder.add("glass", geometry.box_patch(centre, np.array([2.4, 1.6, 0.6]), heading))
