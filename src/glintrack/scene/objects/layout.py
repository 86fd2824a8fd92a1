"""Plan of a city as data, the mesh of what stands in it once, and the instances of what stands often."""

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
from glintrack.scene.objects.plants import HedgePiece, Tree, plan_of, tree_model_of
from glintrack.scene.objects.surfaces import GroundPatch, RoadAreas, add_ground
from glintrack.scene.objects.terrain import STEP_M, slope_at

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


def grown(extent_m: tuple[float, float, float, float], margin_m: float) -> Extent:
    """The extent with its edges moved out by a margin. [m]."""
    west, south, east, north = extent_m
    return Extent(west - margin_m, south - margin_m, east + margin_m, north + margin_m)


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
    """One mesh of ground, streets, buildings and panels; trees and parked vehicles are `place_instances`'s.

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
        Material of what is `PAINT` in the model: a vehicle's paint, a tree's leaves.
    """

    transforms: Float[Array, "instance 3 4"]
    model: Int[Array, "instance"]
    paint: Int[Array, "instance"]

    def __len__(self) -> int:
        """How many there are."""
        return len(self.model)


def no_instances() -> Instances:
    """Nothing placed."""
    return Instances(np.zeros((0, 3, 4)), np.zeros(0, np.int64), np.zeros(0, np.int16))


def place_instances(
    layout: Layout,
    paints: Int[Array, "vehicle"],
    index: dict[str, int],
    first_model: int,
    rng: np.random.Generator,
    terrain: xr.Dataset | None,
) -> Instances:
    """Stand parked vehicles, hedges and trees on the ground.

    Parameters
    ----------
    layout
        What stands where.
    paints
        Material index of each parked vehicle's paint.
    index
        Material index by name.
    first_model
        Where `hedge_model` is among the city's models; `tree_models` follow it.
    rng
        Turns the trees.
    terrain
        Schema ``terrain``; without it the ground is level.
    """
    return _joined(
        _placed_vehicles(layout.parked, paints, terrain),
        _placed_hedges(layout.hedges, index, first_model, terrain),
        _placed_trees(layout.trees, index, first_model + 1, rng, terrain),
    )


def _placed_vehicles(
    parked: Sequence[ParkedVehicle], paints: Int[Array, "vehicle"], terrain: xr.Dataset | None
) -> Instances:
    position = np.array([(v.east_m, v.north_m, v.up_m) for v in parked]).reshape(-1, 3)
    slope = None
    if terrain is not None:
        position[:, 2] += height_at(terrain, position[:, 0], position[:, 1])
        slope = slope_at(terrain, position[:, 0], position[:, 1])
    heading = np.array([v.heading_rad for v in parked], float)
    model = np.array([v.model for v in parked], np.int64)
    return Instances(body_to_enu(position, heading, slope), model, np.asarray(paints, np.int16))


def _placed_hedges(
    pieces: Sequence[HedgePiece], index: dict[str, int], model: int, terrain: xr.Dataset | None
) -> Instances:
    plan = plan_of(pieces)
    position, slope = np.c_[plan[:, :2], np.zeros(len(plan))], None
    if terrain is not None:
        position[:, 2] = height_at(terrain, plan[:, 0], plan[:, 1])
        slope = slope_at(terrain, plan[:, 0], plan[:, 1])
    leaf = np.array([index[p.leaf] for p in pieces], np.int16)
    return Instances(body_to_enu(position, plan[:, 2], slope), np.full(len(plan), model, np.int64), leaf)


def _placed_trees(
    trees: Sequence[Tree],
    index: dict[str, int],
    first_model: int,
    rng: np.random.Generator,
    terrain: xr.Dataset | None,
) -> Instances:
    """Upright on any slope, as trees grow."""
    if not trees:
        return no_instances()
    foot = np.array([(t.east_m, t.north_m, 0.0) for t in trees])
    if terrain is not None:
        foot[:, 2] = height_at(terrain, foot[:, 0], foot[:, 1])
    transforms = body_to_enu(foot, rng.uniform(0, 2 * np.pi, len(trees)))
    transforms[:, :, :3] *= np.array([t.height_m for t in trees])[:, None, None]
    leaf = np.array([index[t.leaf] for t in trees], np.int16)
    return Instances(transforms, first_model + tree_model_of(trees), leaf)


def _joined(*parts: Instances) -> Instances:
    return Instances(
        *(np.concatenate([getattr(p, name) for p in parts]) for name in ("transforms", "model", "paint"))
    )
