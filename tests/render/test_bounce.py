"""Light from what stands around, against closed forms: a sunlit wall, its colour, and what lies in shade."""

import math

import numpy as np

from glintrack.render import build_tracer, trace
from glintrack.render.bounce import BY_SKY, BY_SUN, CLASSES, material_classes
from glintrack.render.sky_view import BOUNCE_UNIT
from glintrack.scene import Mesh, load_materials
from tests.conftest import box, nadir, plane, small_camera, snapshot

HEIGHT, RAYS_AND_LATTICE = 12.0, 0.12  # twenty rays meet the wall, two metres apart


def beside_a_wall(sun):
    """Level ground west of a long building, seen from above; materials: black ground, a wall of 0.5."""
    wall = box(40, 2000, HEIGHT)
    ground = plane()
    mesh = Mesh(
        np.concatenate([ground.vertices, wall.vertices + np.float32([20, 0, 0])]),
        np.concatenate([ground.faces, wall.faces + len(ground.vertices)]),
        np.concatenate([ground.material, wall.material]),
    )
    shares = np.zeros((4, CLASSES))
    shares[1, 0] = 1.0  # the wall alone sends light on
    scene = snapshot(mesh)
    hits = trace(
        scene, small_camera(61, 61, 40), nadir(), sun, np.ones(2), tracer=build_tracer(scene, None, shares)
    )
    return hits, (hits.material == 0) & (hits.point[:, 0] < -1)


def test_the_ground_before_a_sunlit_wall():
    """E = cos θ · ½ (1 − d/√(d² + h²)) of the wall's class, on level ground at distance d."""
    sun = np.array([-math.sin(1.0), 0.0, math.cos(1.0)])
    hits, ground = beside_a_wall(sun)
    d = -hits.point[ground, 0]
    expected = math.sin(1.0) * 0.5 * (1 - d / np.hypot(d, HEIGHT))
    found = hits.bounced[ground].astype(float) * BOUNCE_UNIT
    by_sun = found[:, BY_SUN * CLASSES]
    near = d < 10
    assert abs((by_sun / expected - 1)[near].mean()) < 0.05
    np.testing.assert_allclose(by_sun[near], expected[near], rtol=2 * RAYS_AND_LATTICE)
    assert not found[:, BY_SUN * CLASSES + 1].any()  # no other class
    assert (found[:, BY_SKY * CLASSES] < by_sun)[near].all()


def test_a_wall_in_its_own_shade_sends_none_of_the_suns_light():
    sun = np.array([math.sin(1.0), 0.0, math.cos(1.0)])
    hits, ground = beside_a_wall(sun)
    assert not hits.bounced[ground][:, BY_SUN * CLASSES].any()
    assert hits.bounced[ground][:, BY_SKY * CLASSES].any()


def test_three_spectra_stand_for_the_library():
    """Every spectrum is a sum of three of them, to what matters of a second reflection."""
    library = load_materials()
    classes = material_classes(library)
    rows = np.concatenate([library["reflectance"].values, library["transmittance"].values])
    off = classes.shares @ rows[classes.rows] - rows
    assert np.sqrt((off**2).mean()) < 0.05 and (classes.shares >= 0).all()
