"""Placements of a few models that stand in many places and never move: trees, hedges, parked cars."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.core.heights import height_at
from glintrack.scene.objects.plants import HedgePiece, plan_of
from glintrack.scene.objects.layout import Layout, ParkedVehicle, body_to_enu
from glintrack.scene.objects.plants import Tree, tree_model_of
from glintrack.scene.objects.terrain import slope_at


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


def place(
    layout: Layout,
    paints: Int[Array, "vehicle"],
    index: dict[str, int],
    hedge_model: int,
    first_tree_model: int,
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
    hedge_model, first_tree_model
        Where `hedges.hedge_model` and `trees.tree_models` are among the city's models.
    rng
        Turns the trees.
    terrain
        Schema ``terrain``; without it the ground is level.
    """
    return _joined(
        _placed_vehicles(layout.parked, paints, terrain),
        _placed_hedges(layout.hedges, index, hedge_model, terrain),
        _placed_trees(layout.trees, index, first_tree_model, rng, terrain),
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
