"""Patches of the sky: they cover it once, their rays stand for it, and their light adds up."""

import math

import numpy as np
import pytest

from glintrack.render.sky_patches import PATCHES, even_directions, even_irradiance, patch_of, patch_rays

SUN = np.array([math.sin(0.7) * math.sin(2.0), math.sin(0.7) * math.cos(2.0), math.cos(0.7)])


def test_every_direction_has_one_patch_and_those_at_the_sun_are_small():
    directions = even_directions(20_000)
    patch = patch_of(directions, SUN)
    assert set(patch) == set(range(PATCHES))
    angle = np.degrees(np.arccos(np.clip(directions @ SUN, -1, 1)))
    assert angle[patch == 0].max() <= 12 and angle[patch > 0].min() >= 12 - 0.1
    ring = (patch >= 1) & (patch <= 4)
    assert angle[ring].max() <= 30 and angle[patch > 4].min() >= 30 - 0.1
    solid_angle = np.bincount(patch) * 2 * math.pi / len(directions)
    assert solid_angle.max() < 0.5  # steradians: under 25° across


@pytest.mark.parametrize("sun", [SUN, np.array([0.0, 0.0, 1.0])])
def test_rays_stand_for_the_whole_sphere(sun):
    rays = patch_rays(sun)
    up = rays.patch >= 0
    assert rays.solid_angle[up].sum() == pytest.approx(2 * math.pi, rel=1e-3)
    assert rays.solid_angle[~up].sum() == pytest.approx(2 * math.pi, rel=1e-6)
    np.testing.assert_array_equal(patch_of(rays.direction[up], sun), rays.patch[up])
    np.testing.assert_array_equal(np.bincount(rays.patch[up], minlength=PATCHES), rays.count)
    quadrature = 0.01
    level = (rays.solid_angle * np.maximum(rays.direction[:, 2], 0)).sum()
    assert level == pytest.approx(math.pi, rel=quadrature)


def test_the_patches_of_an_even_sky_add_up():
    """An open facet gets π (1 + cos tilt)/2 of a sky of radiance 1."""
    tilt = np.radians([0.0, 30.0, 90.0, 150.0])
    normals = np.stack([np.sin(tilt), 0 * tilt, np.cos(tilt)], axis=1)
    both = even_irradiance(normals, SUN)
    np.testing.assert_allclose(both.sum(axis=1), math.pi * (1 + np.cos(tilt)) / 2, atol=2e-3 * math.pi)
