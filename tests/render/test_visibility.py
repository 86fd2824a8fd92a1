"""Visible fraction: 1 in an empty scene, 0 under a slab, half behind half a slab."""

import numpy as np
import pytest

from glintrack.render import build_bare_tracer, trace, visible_fraction
from tests.conftest import box, nadir, plane, small_camera, snapshot

UP = np.array([0.0, 0.0, 1.0])


def fraction(static, oversampling=1):
    east = [[1.0, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0]]
    far = [[1.0, 0, 0, 500], [0, 1, 0, 0], [0, 0, 1, 0]]
    scene = snapshot(static, [box(4.5, 1.8, 1.5)], [east, far], [0, 0], vehicle_id=[5, 6])
    camera, pose = small_camera(101, 101, 20), nadir()
    hits = trace(scene, camera, pose, UP, np.zeros(2), oversampling=oversampling)
    return visible_fraction(hits, scene, camera, pose, build_bare_tracer(scene))


def slab(west):
    mesh = plane(20, 5.0)
    return type(mesh)(mesh.vertices + np.float32([10 + west, 0, 0]), mesh.faces, mesh.material)


@pytest.mark.parametrize("oversampling", [1, 2])
@pytest.mark.parametrize(("static", "expected"), [(plane(), 1.0), (slab(-10), 0.0), (slab(0), 0.5)])
def test_open_covered_and_half_covered(static, expected, oversampling):
    one_column_of_elements = 1 / 22
    seen = fraction(static, oversampling)
    assert seen[0] == pytest.approx(expected, abs=one_column_of_elements)
    assert seen[1] == 0  # outside the frame
