"""Materials polarize as surfaces do in the field: ranges of physics.md, 50° off nadir under the default sky.

Sunlit natural surfaces mostly below 0.10 (foliage, soil below 0.05); paint, glass and water 0.3 and more
toward the sun. The path is left out: the ranges are those of surfaces seen from near.
"""

import math
from dataclasses import replace

import numpy as np
import pytest

from glintrack import stokes
from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.camera import Pose, look_at
from glintrack.core.spectral import channel_weights
from glintrack.render import shade, trace, unpack_sky
from glintrack.scene import load_materials
from tests.conftest import plane, small_camera, snapshot


@pytest.fixture(scope="module")
def level_dolp():
    """DoLP of level ground of a named material, by azimuth from the sun."""
    tables = solve_tables(AtmosphereDesign())
    libraries = {polarized: load_materials(polarized) for polarized in (False, True)}
    sky = unpack_sky(tables, 1928.0)
    sky = replace(sky, path_spectrum=0 * sky.path_spectrum, transmittance=np.ones_like(sky.transmittance))
    weights = channel_weights(sky.wavelength_um, np.ones((1, len(sky.wavelength_um))))
    names = libraries[False]["material"].values.tolist()

    def dolp(name, azimuth_from_sun_deg, polarized_bases=False):
        library = libraries[polarized_bases]
        look = tables.attrs["sun_azimuth_rad"] + math.radians(azimuth_from_sun_deg)
        radius = 1928 * math.tan(math.radians(50))
        pose = look_at(Pose(-radius * math.sin(look), -radius * math.cos(look), 1928.0), [0, 0, 0])
        ground = snapshot(plane(3000, 0, names.index(name)))
        camera = small_camera(1, 1, 0.01, 3000)
        hits = trace(ground, camera, pose, sky.sun_direction, library["roughness"].values)
        return float(stokes.dolp(shade(hits, sky, library, weights).values[0, 0, 0]))

    return dolp


@pytest.mark.parametrize("azimuth", [0, 90, 180])
@pytest.mark.parametrize("name", ["grass", "grass_dry", "soil", "leaf", "leaf_conifer"])
def test_vegetation_and_soil_polarize_little(level_dolp, name, azimuth):
    assert level_dolp(name, azimuth) < 0.05


@pytest.mark.parametrize("name", ["asphalt", "asphalt_worn", "concrete", "brick", "roof_tile"])
def test_mineral_surfaces_polarize_up_to_a_tenth_toward_the_sun(level_dolp, name):
    rounding = 0.01
    assert level_dolp(name, 0) < 0.10 + rounding
    assert level_dolp(name, 180) < level_dolp(name, 0)


@pytest.mark.parametrize("name", ["glass", "water", "paint_black"])
def test_smooth_dark_surfaces_polarize_strongly_toward_the_sun(level_dolp, name):
    assert level_dolp(name, 0) > 0.3


@pytest.mark.parametrize(("polarized_bases", "low", "high"), [(False, 0.0, 0.03), (True, 0.05, 0.11)])
def test_asphalt_across_the_sun_is_that_of_the_decision(level_dolp, polarized_bases, low, high):
    assert low < level_dolp("asphalt", 90, polarized_bases) < high
    assert level_dolp("asphalt", 180, polarized_bases) < 0.01
