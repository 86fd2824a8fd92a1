"""Which probes light the surfaces of a frame: those that stand still, and those of vehicles that move."""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from jaxtyping import Float, Int

from glintrack.core.arrays import Array
from glintrack.render import probes
from glintrack.render.bounce import Met
from glintrack.render.probe_lookup import BY_HALVES, BY_SIDES, LONG_M
from glintrack.render.probe_table import ProbeTable, joined
from glintrack.render.probes import Bodies, Lookup
from glintrack.render.rays.lit import Lit
from glintrack.render.rays.resolve import Surfaces
from glintrack.render.vehicle_shade import sky_left


@dataclass(frozen=True)
class LightAround:
    """Look-ups of a frame's surfaces and of what is mirrored in them; see `Hits` for the fields."""

    table: ProbeTable
    cell: Int[Array, "ray"]
    part: Int[Array, "ray 2"]
    sky_view: Float[Array, "ray"]
    sky_here: Float[Array, "ray"]
    sky_left: Int[Array, "ray"]
    mirrored: Lookup
    mirrored_left: Int[Array, "mirrored"]


def light_around(scene: Lit, seen, there: Surfaces) -> LightAround:
    """Look up, and where needed find, the probes around every surface of a frame.

    Parameters
    ----------
    scene
        With its instances placed, as they are when this returns.
    seen
        Surfaces of the frame: `Samples` or `Surfaces`.
    there
        What surfaces mirror whose mirrored ray was followed.
    """
    tracer, snapshot = scene.tracer, scene.snapshot
    fixed, known = snapshot.fixed, tracer.probes.toward(scene.sun, scene.surroundings)
    model = np.asarray(snapshot.model)
    transforms = np.ascontiguousarray(snapshot.transforms, np.float64).reshape(-1, 3, 4)
    role = tracer.role[model] if len(model) else np.zeros(0, np.int8)
    role[fixed:] = BY_SIDES
    role[(role == BY_SIDES) & (np.ptp(tracer.boxes[model, :, 0], axis=1) > LONG_M)] = BY_HALVES
    standing = np.flatnonzero(role[:fixed] >= BY_SIDES)
    body = np.full(len(role), -1, np.int32)
    centre = tracer.boxes[model].mean(axis=1) if len(model) else np.zeros((0, 3))
    middle = np.einsum("kij,kj->ki", transforms[:, :, :3], centre) + transforms[:, :, 3]
    follow_still = partial(_follow, replace(scene, past="still"))
    body[standing] = known.stand(Bodies(transforms[standing], tracer.boxes[model[standing]]), follow_still)

    def surfaces(of, some: Array | slice = slice(None)) -> probes.Surfaces:
        point, normal, material, instance = (
            np.ascontiguousarray(x[some]) for x in (of.point, of.normal, of.material, of.instance)
        )
        instances = role, body, tracer.sheets, transforms, middle
        return probes.Surfaces(point, normal, material, instance, *instances)

    both = [known.look(surfaces(of), follow_still) for of in (seen, there)]
    on_moving = [np.flatnonzero(of.instance >= fixed) for of in (seen, there)]
    met = [of.instance[rays] for of, rays in zip((seen, there), on_moving, strict=True)]
    moving = np.unique(np.concatenate(met))
    table = known.table
    if len(moving):
        bodies = Bodies(transforms[moving], tracer.boxes[model[moving]])
        new, cells = known.probe_moving(bodies, partial(_follow, scene))
        body[moving] = cells
        table = joined(table, new)
        both = [
            found.with_rays(rays, known.look_in(surfaces(of, rays), table))
            for found, of, rays in zip(both, (seen, there), on_moving, strict=True)
        ]
    first, mirrored = both
    moved = Bodies(transforms[fixed:], tracer.boxes[model[fixed:]])
    left, left_there = (
        sky_left(of, found, table, moved, fixed, known.rays)
        for of, found in ((seen, first), (there, mirrored))
    )
    view = first.sky_view * (left / np.float32(255))
    return LightAround(table, first.cell, first.part, view, first.sky_here, left, mirrored, left_there)


def _follow(scene: Lit, origins: Array, directions: Array) -> Met:
    """What rays of probes meet."""
    there = scene.meet(origins, origins, directions)
    return Met(
        there.material, scene.sunlight(there) * there.sun_cosine, there.point, there.normal, there.range_m
    )
