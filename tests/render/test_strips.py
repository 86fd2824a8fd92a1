"""A frame in strips against the same frame traced whole: hits bit for bit, light but for rounding.

A compiled loop over elements rounds by where it begins; two runs of one loop over other rows differ as much.
"""

from dataclasses import replace

import numpy as np
import pytest

from glintrack.case import build as scenario
from glintrack.render import strips
from glintrack.render.frame import cube_blocks, cube_layout, render_product
from glintrack.render.hits import take_rows
from glintrack.render.observer import FrameRadiance
from glintrack.render.probes import MOST_PROBES
from glintrack.render.strips import StripRadiance
from glintrack.scene import Mesh, load_materials
from tests.conftest import ThreeCars, box
from tests.render.same_hits import assert_same_hits
from tests.render.test_sampling import small_case


def assert_same_light(one, other):
    """But for the rounding of single precision; Q and U lie beside an I of some 30."""
    np.testing.assert_allclose(one, other, rtol=3e-7, atol=3e-6)


class WithHouse(ThreeCars):
    """A house in the middle: probes stand around it."""

    def at(self, t):
        now = super().at(t)
        house, ground = box(30.0, 20.0, 9.0, int(now.static.material[0])), now.static
        vertices = np.concatenate([ground.vertices, house.vertices])
        faces = np.concatenate([ground.faces, house.faces + len(ground.vertices)])
        both = Mesh(vertices, faces, np.concatenate([ground.material, house.material]))
        return replace(now, static=both)


@pytest.fixture
def both(monkeypatch, request):
    """A frame whole, and in strips of at most twelve of its rows."""
    monkeypatch.setattr(scenario, "build_scene", lambda design: WithHouse(load_materials()))
    case = small_case().replace({"sensor.oversampling": request.param})
    whole = scenario.trace_frame(case)
    side = request.param or 3
    row_bytes = strips._RAY_BYTES * side * case.sensor.columns
    monkeypatch.setattr(strips, "AT_ONCE_BYTES", 12.5 * row_bytes / strips._STRIP_PART)
    cut = scenario.trace_frame(case)
    assert isinstance(whole.radiance, FrameRadiance)
    assert isinstance(cut.radiance, StripRadiance) and cut.radiance.rows == 12
    return whole, cut


@pytest.mark.parametrize("both", [1, 2, 0], indirect=True)
def test_strips_are_the_whole_frame(both):
    whole, cut = both
    shape = whole.camera.rows, whole.camera.columns
    assert shape[0] % 12  # the last strip is a smaller one
    for first, hits in cut.radiance._strips():
        assert_same_hits(hits, take_rows(whole.hits, slice(first, first + hits.rows)))
    for product in ("radiance", "rgb"):
        (layout, light), (other_layout, strip_light) = (render_product(v, product) for v in both)
        assert layout == other_layout and light.std() > 0
        assert_same_light(strip_light, light)
    channels = np.ones((1, len(whole.sky.wavelength_um)))
    pixels = np.array([[0, 0], [11, 5], [12, 5], [shape[0] - 1, shape[1] - 1]])
    one, other = (view.radiance(channels, pixels) for view in both)
    assert_same_light(other.values, one.values)
    assert one.dims == other.dims == ("pixel", "channel", "stokes")
    assert cut.hits.material.size == whole.hits.material.size


@pytest.mark.parametrize("both", [1], indirect=True)
def test_a_cube_in_strips_has_blocks_of_its_own(both):
    cubes = []
    for view in both:
        layout = cube_layout(view, (0.5, 0.6))
        filled = np.full((layout.rows, layout.columns, len(layout.channels), 3), np.nan, np.float32)
        for row, channel, block in cube_blocks(view, layout, (0.5, 0.6)):
            filled[row : row + len(block), :, channel : channel + block.shape[2]] = block
        cubes.append(filled)
    assert_same_light(*cubes)


@pytest.mark.parametrize("both", [1], indirect=True)
def test_probes_that_fill_half_the_room_are_forgotten_and_found_again(both, monkeypatch):
    whole, cut = both
    probes = cut.observer.tracer.probes
    cut.radiance(np.ones((1, len(whole.sky.wavelength_um))))
    monkeypatch.setattr("glintrack.render.probes.MOST_PROBES", 2)
    before = len(probes.table.view)
    probes.make_room()
    assert len(probes.table.view) == 0 < before < MOST_PROBES
    monkeypatch.undo()
    first = strips.frame_light(cut.observer, cut.radiance.snapshot, cut.pose)
    channels = np.ones((1, len(whole.sky.wavelength_um)))
    assert_same_light(first(channels).values, whole.radiance(channels).values)
