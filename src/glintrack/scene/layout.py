"""What stands where in a city, as plan data, and its conversion into one mesh."""

import math
from dataclasses import dataclass

import numpy as np
from shapely.geometry import Polygon, box

from glintrack.scene.buildings import Building, add_building
from glintrack.scene.geometry import Mesh, MeshBuilder
from glintrack.scene.surfaces import GroundPatch, RoadAreas, add_ground
from glintrack.scene.trees import Tree, add_tree

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
    """

    streets: RoadAreas
    patches: tuple[GroundPatch, ...]
    buildings: tuple[Building, ...]
    trees: tuple[Tree, ...]
    parked: tuple[ParkedVehicle, ...]
    rest: str = "grass"


def covered_area(extent_m: tuple[float, float, float, float]) -> Polygon:
    """The window and its margin, west, south, east, north. [m]."""
    west, south, east, north = extent_m
    return box(west - MARGIN_M, south - MARGIN_M, east + MARGIN_M, north + MARGIN_M)


def build_mesh(
    layout: Layout,
    extent_m: tuple[float, float, float, float],
    index: dict[str, int],
    models: tuple[Mesh, ...],
    paints: np.ndarray,
    rng: np.random.Generator,
) -> Mesh:
    """One mesh of everything that does not move.

    Parameters
    ----------
    layout
        The city in plan.
    extent_m
        West, south, east, north of the window. [m]
    index
        Material index by name.
    models
        Vehicle models, for parked vehicles.
    paints
        Material index of each parked vehicle's paint.
    rng
        Draws crowns, chimneys and roof plant.
    """
    builder = MeshBuilder(index)
    tree_rng, building_rng = rng.spawn(2)  # so that a city without trees has the same buildings
    add_ground(builder, layout.streets, layout.patches, covered_area(extent_m), layout.rest)
    for building in layout.buildings:
        add_building(builder, building, building_rng)
    for tree in layout.trees:
        add_tree(builder, tree, tree_rng)
    for vehicle, paint in zip(layout.parked, paints, strict=True):
        pose = body_to_enu(
            np.array([[vehicle.east_m, vehicle.north_m, vehicle.up_m]]), np.array([vehicle.heading_rad])
        )
        builder.add_mesh(models[vehicle.model], pose[0], int(paint))
    return builder.mesh()


def body_to_enu(position: np.ndarray, heading_rad: np.ndarray) -> np.ndarray:
    """Transforms from body frame (x forward, y left) to ENU.

    Parameters
    ----------
    position
        Origin of each body frame, shape (k, 3). [m]
    heading_rad
        Clockwise from north, shape (k,). [rad]

    Returns
    -------
    Shape (k, 3, 4): rotation and translation.
    """
    s, c = np.sin(heading_rad), np.cos(heading_rad)
    transform = np.zeros((len(s), 3, 4))
    transform[:, 0, 0], transform[:, 1, 0] = s, c
    transform[:, 0, 1], transform[:, 1, 1] = -c, s
    transform[:, 2, 2] = 1.0
    transform[:, :, 3] = position
    return transform


def heading_of(direction: np.ndarray) -> float:
    """Heading clockwise from north of a plan vector. [rad]."""
    return math.atan2(direction[0], direction[1]) % (2 * math.pi)
