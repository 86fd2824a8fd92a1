"""Sky view of the default city's roads and roofs against many rays from the very same points."""

import numpy as np
import pytest

from glintrack.camera import Camera, Pose, look_at
from glintrack.render import build_tracer, trace
from glintrack.render.light.sky import hemisphere_directions
from glintrack.scene import SceneDesign, build_scene

POINTS, RAYS = 500, 1024
KINDS = {"road": ("asphalt", "road_paint", "concrete", "pavement"), "roof": ("roof_",)}

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def frame():
    city = build_scene(SceneDesign())
    now, materials = city.at(0.0).without_traffic(), city.materials
    tracer = build_tracer(now, materials["gap_fraction"].values, window=city.extent_m)
    camera, pose = Camera(1.2, 3e-4, 560, 880), look_at(Pose(0.0, -2300.0, 1930.0), np.zeros(3))
    sun, grass = np.array([0.0, -0.6, 0.8]), materials["material"].values.tolist().index("grass")
    hits = trace(now, camera, pose, sun, materials["roughness"].values, grass, tracer=tracer)
    west, south, east, north = city.extent_m
    x, y = hits.point[:, 0], hits.point[:, 1]
    inside = (hits.material >= 0) & (x > west) & (x < east) & (y > south) & (y < north)
    return tracer, hits, inside, materials["material"].values[hits.material]


@pytest.mark.parametrize("kind", KINDS)
def test_sky_view_of_random_points(frame, kind):
    """Nineteen of twenty within 0.05, the mean within 0.01; the others lie beside what hides the sky."""
    tracer, hits, inside, names = frame
    mine = inside & (hits.normal[:, 2] > 0.5) & np.array([name.startswith(KINDS[kind]) for name in names])
    chosen = np.random.default_rng(17).choice(np.flatnonzero(mine), POINTS, replace=False)
    directions, expected = hemisphere_directions(RAYS).astype(np.float32), np.empty(POINTS)
    for k, one in enumerate(chosen):
        cosine = np.maximum(directions @ hits.normal[one], 0)
        start = np.broadcast_to(hits.point[one] + 3e-3 * hits.normal[one], directions.shape)
        light = tracer.rays.transmittance(np.ascontiguousarray(start), directions, cosine > 0)
        expected[k] = (cosine * light).sum() / cosine.sum()
    error = hits.sky_view[chosen] - expected
    assert tracer.probes.scale == 1.0
    assert expected.min() < 0.7  # some see little of it
    assert abs(error.mean()) < 0.01 and np.sqrt((error**2).mean()) < 0.04
    assert (abs(error) < 0.05).mean() > 0.93 and (abs(error) < 0.1).mean() > 0.98
