"""Plan of a city, its static mesh, and the instances of models that appear many times."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float, Int
from shapely.geometry import Polygon, box

from glintrack.core.arrays import Array
from glintrack.core.interpolation import height_at
from glintrack.core.records import Extent
from glintrack.scene.objects.buildings import Building, add_building
from glintrack.scene.objects.geometry import Mesh, MeshBuilder, extrude
from glintrack.scene.objects.plants import HedgePiece, Tree, tree_model_of
from glintrack.scene.objects.surfaces import GroundPatch, RoadAreas, add_ground
from glintrack.scene.objects.terrain import STEP_M, slope_at

PANEL_TOP_M = 0.2  # above every pavement
MARGIN_M = 80.0  # of the city beyond its window, for oblique frames


@dataclass(frozen=True)
class ParkedVehicle:
    """A parked vehicle, not in the truth: centre [m], heading clockwise from north [rad], index of its model.

    ``up_m`` is the height of the street or pavement above the terrain. [m]
    """

    east_m: float
    north_m: float
    heading_rad: float
    model: int
    up_m: float = 0.0


@dataclass(frozen=True)
class Panel:
    """A calibration panel: a slab of one material on the ground, with its plan. [m]"""

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
        Ground between them; earlier patches cover later ones.
    buildings, trees, parked, hedges
        Objects on the ground.
    rest
        Material of the ground without a patch.
    panels
        Calibration panels on top of the ground.
    """

    streets: RoadAreas
    patches: tuple[GroundPatch, ...]
    buildings: tuple[Building, ...]
    trees: tuple[Tree, ...]
    parked: tuple[ParkedVehicle, ...]
    rest: str = "grass"
    panels: tuple[Panel, ...] = ()
    hedges: tuple[HedgePiece, ...] = ()


def expand_extent(extent_m: tuple[float, float, float, float], margin_m: float) -> Extent:
    """Move the edges of an extent out by a margin. [m]"""
    west, south, east, north = extent_m
    return Extent(west - margin_m, south - margin_m, east + margin_m, north + margin_m)


def area_with_margin(extent_m: tuple[float, float, float, float]) -> Polygon:
    """Area of a window (west, south, east, north) and its margin. [m]"""
    return box(*expand_extent(extent_m, MARGIN_M))


def build_mesh(
    layout: Layout,
    extent_m: tuple[float, float, float, float],
    index: dict[str, int],
    rng: np.random.Generator,
    terrain: xr.Dataset | None = None,
) -> Mesh:
    """Build one mesh of ground, streets, buildings and panels.

    Parameters
    ----------
    layout
        The city in plan.
    extent_m
        West, south, east, north of the window. [m]
    index
        Material index by name.
    rng
        Source of chimneys, dormers and roof plant.
    terrain
        Schema ``terrain``; without it the ground is level.
    """
    builder = MeshBuilder(index)
    add_ground(builder, layout.streets, layout.patches, area_with_margin(extent_m), layout.rest, terrain)
    for building in layout.buildings:
        if terrain is None:
            add_building(builder, building, rng)
            continue
        # on a slope the floor is at the mean height under the footprint, and the walls reach the lowest
        corners = np.asarray(building.footprint.exterior.segmentize(STEP_M / 2).coords)
        under = height_at(terrain, corners[:, 0], corners[:, 1])
        floor, mark = float(under.mean()), builder.mark()
        add_building(builder, building, rng, float(under.min()) - floor - 0.1)
        builder.raise_since(mark, floor)
    for panel in layout.panels:
        add_panel(builder, panel, terrain)
    return builder.mesh()


def add_panel(builder: MeshBuilder, panel: Panel, terrain: xr.Dataset | None) -> None:
    """Add a panel on the ground, its underside below it."""
    mark = builder.mark()
    slab = panel.shape if terrain is None else panel.shape.segmentize(STEP_M / 2)
    builder.add(panel.material, extrude(slab, -0.1, PANEL_TOP_M))
    if terrain is not None:
        builder.raise_since(mark, lambda v: height_at(terrain, v[:, 0], v[:, 1]))


def body_to_enu(position: np.ndarray, heading_rad: np.ndarray, slope: np.ndarray | None = None) -> np.ndarray:
    """Compute the transforms from body frame (x forward, y left) to ENU.

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
    transform[:, :, 3] = position
    if slope is not None:
        forward = np.stack([s, c, s * slope[:, 0] + c * slope[:, 1]], axis=1)
        up = np.stack([-slope[:, 0], -slope[:, 1], np.ones(len(s))], axis=1)
        forward /= np.linalg.norm(forward, axis=1, keepdims=True)
        up /= np.linalg.norm(up, axis=1, keepdims=True)
        transform[:, :, :3] = np.stack([forward, np.cross(up, forward), up], axis=2)
        return transform
    transform[:, 0, 0], transform[:, 1, 0] = s, c
    transform[:, 0, 1], transform[:, 1, 1] = -c, s
    transform[:, 2, 2] = 1.0
    return transform


def heading_of(direction: np.ndarray) -> float:
    """Heading of a plan vector, clockwise from north. [rad]"""
    return math.atan2(direction[0], direction[1]) % (2 * math.pi)


@dataclass(frozen=True)
class Instances:
    """Placements of models.

    Parameters
    ----------
    transforms
        Model to ENU: a rotation times a uniform scale, and a translation. [1, m]
    model
        Index into the models of the city.
    paint
        Material for `PAINT` in the model: a vehicle's paint, a tree's leaves.
    """

    transforms: Float[Array, "instance 3 4"]
    model: Int[Array, "instance"]
    paint: Int[Array, "instance"]

    def __len__(self) -> int:
        """Return the number of instances."""
        return len(self.model)


def place_instances(
    layout: Layout,
    paints: Int[Array, "vehicle"],
    index: dict[str, int],
    first_model: int,
    rng: np.random.Generator,
    terrain: xr.Dataset | None,
) -> Instances:
    """Place parked vehicles, hedges and trees on the ground.

    Parameters
    ----------
    layout
        Positions of the objects.
    paints
        Material index of each parked vehicle's paint.
    index
        Material index by name.
    first_model
        Index of `hedge_model` in the city's models; `tree_models` follow it.
    rng
        Source of the trees' headings.
    terrain
        Schema ``terrain``; without it the ground is level.
    """
    cars, hedges, trees = layout.parked, layout.hedges, layout.trees
    foot = _positions(trees, terrain)
    upright = body_to_enu(foot, rng.uniform(0, 2 * np.pi, len(trees)))
    upright[:, :, :3] *= np.array([tree.height_m for tree in trees])[:, None, None]
    groups = (
        (_place(cars, terrain), [car.model for car in cars], paints),
        (_place(hedges, terrain), [first_model] * len(hedges), [index[hedge.leaf] for hedge in hedges]),
        (upright, first_model + 1 + tree_model_of(trees), [index[tree.leaf] for tree in trees]),
    )
    transforms, models, materials = zip(*groups, strict=True)
    return Instances(
        np.concatenate(transforms),
        np.concatenate([np.asarray(model, np.int64) for model in models]),
        np.concatenate([np.asarray(material, np.int16) for material in materials]),
    )


def _positions(
    things: Sequence[ParkedVehicle | HedgePiece | Tree], terrain: xr.Dataset | None
) -> Float[Array, "thing 3"]:
    """Positions on the ground. [m]"""
    position = np.array([(t.east_m, t.north_m, getattr(t, "up_m", 0.0)) for t in things]).reshape(-1, 3)
    if terrain is not None:
        position[:, 2] += height_at(terrain, position[:, 0], position[:, 1])
    return position


def _place(
    things: Sequence[ParkedVehicle | HedgePiece], terrain: xr.Dataset | None
) -> Float[Array, "thing 3 4"]:
    """Place objects on the slope of the ground, as transforms."""
    position = _positions(things, terrain)
    slope = None if terrain is None else slope_at(terrain, position[:, 0], position[:, 1])
    return body_to_enu(position, np.array([t.heading_rad for t in things], float), slope)
