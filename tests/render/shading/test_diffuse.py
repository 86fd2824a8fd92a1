"""Light of a few elements is that of the frame."""

import numpy as np

from glintrack.case.build import build_scenario
from tests.render.same_hits import small_case


def test_light_of_a_few_elements_is_that_of_the_frame(three_cars):
    """Only the probes that they need are lit for them."""
    scene = build_scenario(small_case())
    channels = scene.sensor.channels
    hits = scene.observer.trace(scene.city.at(0.0), scene.flight.pose(0.0))
    radiance = scene.observer.radiance(hits)
    whole = radiance(channels).values
    most = int(0.04 * hits.rows * hits.columns)
    pixels = np.argwhere(np.ones((hits.rows, hits.columns)))
    for few in np.array_split(np.random.default_rng(2).permutation(pixels), -(-len(pixels) // most)):
        np.testing.assert_array_equal(radiance(channels, few).values, whole[few[:, 0], few[:, 1]])
