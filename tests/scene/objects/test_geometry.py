"""Areas, volumes and directions of faces against plain geometry."""

import math

import numpy as np
import pytest
from shapely.geometry import Polygon, box

from glintrack.scene.objects.geometry import (
    PAINT,
    Mesh,
    MeshBuilder,
    box_patch,
    cut_into_tiles,
    extrude,
    flat,
    gable_or_hip_roof,
    mansard_roof,
    parapet_roof,
    walls,
)

ROUNDING = 1e-9  # float64 coordinates of tens of metres


def corners(patch):
    vertices, faces = patch
    return (np.asarray(vertices)[faces[:, i]] for i in range(3))


def normals(patch):
    a, b, c = corners(patch)
    return 0.5 * np.cross(b - a, c - a)


def volume(patch):
    a, b, c = corners(patch)
    return np.sum(a * np.cross(b, c)) / 6


HOLED = Polygon([(0, 0), (10, 0), (10, 6), (0, 6)], [[(2, 2), (4, 2), (4, 4), (2, 4)]])


def test_flat_covers_the_polygon_and_faces_up():
    n = normals(flat(HOLED, 3.0))
    assert (n[:, 2] > 0).all()
    assert n[:, 2].sum() == pytest.approx(HOLED.area, rel=ROUNDING)


def test_extruded_polygon_with_a_hole_is_closed_and_outward():
    patch = extrude(HOLED, 1.0, 3.5)
    assert volume(patch) == pytest.approx(HOLED.area * 2.5, rel=ROUNDING)
    assert np.abs(normals(patch).sum(axis=0)).max() < ROUNDING  # a closed surface's normals sum to zero


def test_walls_face_away_from_the_shape_and_inward_ones_into_it():
    square = box(-1, -1, 1, 1)
    a, b, c = corners(walls(square, 0, 2))
    middle = (a + b + c) / 3
    assert (np.sum(normals(walls(square, 0, 2))[:, :2] * middle[:, :2], axis=1) > 0).all()
    assert (np.sum(normals(walls(square, 0, 2, inward=True))[:, :2] * middle[:, :2], axis=1) < 0).all()


def test_tiling_keeps_the_area():
    shape = box(-100, -70, 130, 20).difference(box(-10, -10, 15, 10))
    assert sum(p.area for p in cut_into_tiles(shape)) == pytest.approx(shape.area, rel=ROUNDING)


def test_box_patch_is_closed_and_turned_counter_clockwise():
    patch = box_patch(np.array([5.0, 0, 1]), np.array([4.0, 2, 2]), math.pi / 2)
    assert volume(patch) == pytest.approx(16.0, rel=ROUNDING)
    assert np.ptp(patch[0][:, 1]) == pytest.approx(4.0) and np.ptp(patch[0][:, 0]) == pytest.approx(2.0)


@pytest.mark.parametrize("hip", [False, True])
def test_pitched_roof_is_closed_with_the_slope_asked_for(hip):
    slope = math.radians(35)
    planes, rest = gable_or_hip_roof(box(0, 0, 12, 8), 3.0, slope, hip, overhang_m=0.0)
    joined = np.vstack([normals(planes), normals(rest)])
    assert np.abs(joined.sum(axis=0)).max() < ROUNDING
    n = normals(planes)
    tilt = np.arccos(n[:, 2] / np.linalg.norm(n, axis=1))
    np.testing.assert_allclose(tilt, slope, atol=1e-12)
    # a gable's ridge runs the whole length, a hip's is shorter by the width
    ridge = 4.0 * math.tan(slope)
    prism = 0.5 * 8 * ridge * 12
    expected = prism if not hip else prism - 2 * (0.5 * 8 * ridge * 4) + 2 * (8 * ridge * 4 / 3)
    assert volume(planes) + volume(rest) == pytest.approx(expected, rel=1e-9)


def test_mansard_planes_rise_inward_and_top_is_level():
    planes, top = mansard_roof(box(0, 0, 20, 15), 6.0, math.radians(40), inset_m=2.0)
    assert np.concatenate([planes[0], top[0]])[:, 2].max() == pytest.approx(
        6 + 2 * math.tan(math.radians(40))
    )
    plan_area = normals(planes)[:, 2].sum() + normals(top)[:, 2].sum()
    assert plan_area == pytest.approx(300.0, rel=ROUNDING)


def test_mansard_of_a_narrow_footprint_falls_back_to_a_flat_top():
    planes, top = mansard_roof(box(0, 0, 20, 3), 6.0, math.radians(40), inset_m=2.0)
    assert len(planes[1]) == 0 and normals(top)[:, 2].sum() == pytest.approx(60.0)


def test_parapet_roof_covers_its_footprint():
    deck, parapet = parapet_roof(box(0, 0, 10, 10), 5.0, 0.6)
    assert normals(deck)[:, 2].sum() + normals(parapet)[:, 2].sum() == pytest.approx(100.0, rel=ROUNDING)


def test_mesh_refuses_faces_that_name_no_vertex():
    with pytest.raises(ValueError, match="`faces` must index the 3 vertices; got 0 to 3"):
        Mesh(np.zeros((3, 3), np.float32), np.array([[0, 1, 3]], np.int32), np.zeros(1, np.int16))


def test_builder_makes_paint_good_and_moves_copies():
    builder = MeshBuilder({"a": 0})
    builder.add("paint", (np.eye(3), np.array([[0, 1, 2]])))
    model = builder.mesh()
    assert model.material.tolist() == [PAINT]
    parked = MeshBuilder({"a": 0})
    parked.add_mesh(model, np.hstack([np.eye(3), [[10.0], [0], [0]]]), paint=7)
    mesh = parked.mesh()
    assert mesh.material.tolist() == [7] and mesh.vertices[0].tolist() == [11, 0, 0]
