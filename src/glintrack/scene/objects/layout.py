"""Plan of a city as data, and the mesh of what stands in it once."""

import math
from dataclasses import dataclass

import numpy as np
import xarray as xr
from shapely.geometry import Polygon, box

from glintrack.core.heights import height_at
from glintrack.scene.objects.buildings import Building, add_building
from glintrack.scene.objects.geometry import Mesh, MeshBuilder, extrude
from glintrack.scene.objects.plants import HedgePiece
from glintrack.scene.objects.surfaces import GroundPatch, RoadAreas, add_ground
from glintrack.scene.objects.plants import Tree
from glintrack.scene.objects.terrain import STEP_M

PANEL_TOP_M = 0.2  # above every pavement
MARGIN_M = 80.0  # the city goes on this far beyond its window, because an oblique frame sees beyond it


@dataclass(frozen=True)
class ParkedVehicle:
    """A vehicle that never moves: part of the city, not of the truth.

    Parameters
    ----------
    east_m, north_m
        Centre. [m]
    heading_rad
        Clockwise from north. [rad]
    model
        Index into the vehicle models.
    up_m
        Height of the ground under it. [m]
    """

    east_m: float
    north_m: float
    heading_rad: float
    model: int
    up_m: float = 0.0


@dataclass(frozen=True)
class Panel:
    """A calibration panel: a slab on the ground.

    Parameters
    ----------
    material
        [name]
    shape
        Plan. [m]
    """

    material: str
    shape: Polygon


@dataclass(frozen=True)
class Layout:
    """A city in plan.

    Parameters
    ----------
    streets
        Street areas.
    patches
        Ground between them, in the order it is laid.
    buildings, trees, parked
        What stands on it.
    rest
        Material of the ground that no patch covers.
    panels
        Calibration panels, on top of whatever lies there.
    hedges
        Pieces of hedge.
    """

    streets: RoadAreas
    patches: tuple[GroundPatch, ...]
    buildings: tuple[Building, ...]
    trees: tuple[Tree, ...]
    parked: tuple[ParkedVehicle, ...]
    rest: str = "grass"
    panels: tuple[Panel, ...] = ()
    hedges: tuple[HedgePiece, ...] = ()


def grown(extent_m: tuple[float, float, float, float], margin_m: float) -> tuple[float, float, float, float]:
    """West, south, east, north, moved out by a margin. [m]."""
    west, south, east, north = extent_m
    return west - margin_m, south - margin_m, east + margin_m, north + margin_m


def covered_area(extent_m: tuple[float, float, float, float]) -> Polygon:
    """The window and its margin, west, south, east, north. [m]."""
    return box(*grown(extent_m, MARGIN_M))


def build_mesh(
    layout: Layout,
    extent_m: tuple[float, float, float, float],
    index: dict[str, int],
    rng: np.random.Generator,
    terrain: xr.Dataset | None = None,
) -> Mesh:
    """One mesh of ground, streets, buildings and panels; trees and parked vehicles are `instances.place`'s.

    Parameters
    ----------
    layout
        The city in plan.
    extent_m
        West, south, east, north of the window. [m]
    index
        Material index by name.
    rng
        Draws chimneys, dormers and roof plant.
    terrain
        Schema ``terrain``; without it the ground is level.
    """
    builder = MeshBuilder(index)
    add_ground(builder, layout.streets, layout.patches, covered_area(extent_m), layout.rest, terrain)
    for building in layout.buildings:
        _add_building(builder, building, rng, terrain)
    for panel in layout.panels:
        add_panel(builder, panel, terrain)
    return builder.mesh()


def _add_building(
    builder: MeshBuilder, building: Building, rng: np.random.Generator, terrain: xr.Dataset | None
) -> None:
    """On a slope the floor lies at the mean height under the footprint, and the walls reach the lowest."""
    if terrain is None:
        add_building(builder, building, rng)
        return
    corners = np.asarray(building.footprint.exterior.segmentize(STEP_M / 2).coords)
    under = height_at(terrain, corners[:, 0], corners[:, 1])
    floor = float(under.mean())
    mark = builder.mark()
    add_building(builder, building, rng, float(under.min()) - floor - 0.1)
    builder.raise_since(mark, floor)


def add_panel(builder: MeshBuilder, panel: Panel, terrain: xr.Dataset | None) -> None:
    """Build a panel on the ground, its underside below it."""
    mark = builder.mark()
    slab = panel.shape if terrain is None else panel.shape.segmentize(STEP_M / 2)
    builder.add(panel.material, extrude(slab, -0.1, PANEL_TOP_M))
    if terrain is not None:
        builder.raise_since(mark, lambda v: height_at(terrain, v[:, 0], v[:, 1]))


def body_to_enu(position: np.ndarray, heading_rad: np.ndarray, slope: np.ndarray | None = None) -> np.ndarray:
    """Transforms from body frame (x forward, y left) to ENU.

    Parameters
    ----------
    position
        Origin of each body frame, shape (k, 3). [m]
    heading_rad
        Clockwise from north, shape (k,). [rad]
    slope
        Rise of the ground to the east and to the north, shape (k, 2); level without it. [1]

    Returns
    -------
    Shape (k, 3, 4): rotation and translation.
    """
    s, c = np.sin(heading_rad), np.cos(heading_rad)
    transform = np.zeros((len(s), 3, 4))
    if slope is not None:
        forward = np.stack([s, c, s * slope[:, 0] + c * slope[:, 1]], axis=1)
        up = np.stack([-slope[:, 0], -slope[:, 1], np.ones(len(s))], axis=1)
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        transform[:, :, :3] = np.stack([forward, np.cross(up, forward), up], axis=2)
        transform[:, :, 3] = position
        return transform
    transform[:, 0, 0], transform[:, 1, 0] = s, c
    transform[:, 0, 1], transform[:, 1, 1] = -c, s
    transform[:, 2, 2] = 1.0
    transform[:, :, 3] = position
    return transform


def heading_of(direction: np.ndarray) -> float:
    """Heading clockwise from north of a plan vector. [rad]."""
    return math.atan2(direction[0], direction[1]) % (2 * math.pi)
