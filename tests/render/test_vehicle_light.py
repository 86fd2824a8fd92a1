"""Light on vehicles: the two halves of a long one's sides."""

from dataclasses import replace

import numpy as np

from glintrack.camera import Pose, look_at
from glintrack.render import trace
from glintrack.scene import Mesh
from tests.conftest import box, plane, small_camera, snapshot

HERE = [[1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0.0]]
NORTH = [[1, 0, 0, 0], [0, 1, 0, 45], [0, 0, 1, 0.0]]


def beside_a_mast(vehicle: Mesh, *others: tuple[Mesh, list]):
    """A vehicle that moves on level ground, beside what stands; a mast far off makes probes be asked for."""
    standing = [(box(0.3, 0.3, 12.0), NORTH), *others]
    models, places = [m for m, _ in standing], [p for _, p in standing]
    count = len(models)
    ids, model = [*count * [-1], 7], list(range(count + 1))
    scene = snapshot(plane(400.0), [*models, vehicle], [*places, HERE], model, vehicle_id=ids)
    return replace(scene, fixed=count)


def test_the_upper_half_of_a_long_vehicle_sees_over_what_stands_beside_it():
    """A wall as high as half of it, 1 m off: the lower half is in its lee; a short vehicle has one probe."""
    wall = box(60.0, 0.5, 1.7), [[1, 0, 0, 0], [0, 1, 0, -2.5], [0, 0, 1, 0]]
    pose = look_at(Pose(0.0, -60.0, 60.0), [0.0, -1.2, 1.7])
    for length, told in ((9.0, True), (4.0, False)):
        scene = beside_a_mast(box(length, 2.4, 3.4), wall)
        hits = trace(scene, small_camera(81, 81, 6.0, 85.0), pose, np.array([0.0, 0.0, 1.0]), np.ones(2))
        side = (hits.vehicle_id == 7) & (hits.normal[:, 1] < -0.9)
        upper, lower = side & (hits.point[:, 2] > 1.75), side & (hits.point[:, 2] < 1.65)
        assert upper.any() and lower.any()
        more = hits.sky_view[upper].mean() - hits.sky_view[lower].mean()
        assert (more > 0.15) == told
