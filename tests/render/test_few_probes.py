"""Light of a few elements is that of the frame, whatever lies where probes are that they do not need."""

import numpy as np

from glintrack.case.build import build_scenario
from glintrack.render.shading import probe_light
from tests.render.test_sampling import small_case


def test_only_probes_that_are_lit_are_read(three_cars, monkeypatch):
    scene = build_scenario(small_case())
    channels = scene.sensor.channels
    hits = scene.observer.trace(scene.city.at(0.0), scene.flight.pose(0.0))
    radiance = scene.observer.radiance(hits)
    whole = radiance(channels).values
    lent = []

    def of_nan(*shape):
        lent.append(np.full(shape, np.nan, np.float32))
        return lent[-1]

    monkeypatch.setattr(probe_light, "lent", of_nan)
    most = int(0.04 * hits.rows * hits.columns)
    pixels = np.argwhere(np.ones((hits.rows, hits.columns)))
    for few in np.array_split(np.random.default_rng(2).permutation(pixels), -(-len(pixels) // most)):
        np.testing.assert_allclose(
            radiance(channels, few).values, whole[few[:, 0], few[:, 1]], rtol=2e-3, atol=1e-2
        )
    assert any(np.isnan(one).any() for one in lent)
