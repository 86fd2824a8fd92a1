"""Ghosts by two reflections: a window's and a thin lens's, worked by hand."""

import math
from functools import cache

import numpy as np
import pytest

from glintrack.sensor import LensDesign, ghosts, read_lens, with_window
from glintrack.sensor.ghosts import unfold
from glintrack.sensor.lens import LensSurface, build_optic

UM = 0.5
pytestmark = pytest.mark.slow


@pytest.fixture(autouse=True)
def _needs_optiland():
    pytest.importorskip("optiland")


def lens_of(surfaces, object_mm=200.0, f_number=16.0):
    return LensDesign(
        name="test", object_distance_mm=object_mm, f_number=f_number, fields_mm=((0.0, 0.0),),
        wavelengths_um=(UM,), surfaces=surfaces,
    )  # fmt: skip


MIRROR = lens_of((LensSurface(radius_mm=-200.0, thickness_mm=-200.0, material="mirror", stop=True),))


@cache
def bare():
    """The mirror behind a window."""
    return with_window(MIRROR, 2.0, 3.0)


@cache
def glass_index():
    """Refractive index of the window."""
    return float(np.ravel(build_optic(bare()).surfaces.n(UM))[2])


@pytest.mark.parametrize("image_reflectance", [0.0, 0.3])
def test_a_windows_ghosts_have_the_light_and_the_size_worked_by_hand(image_reflectance):
    """Light of F-number N that covers a further way t in glass and g in air meets the image t/n + g later."""
    found = {(g.later, g.earlier): g for g in ghosts(bare(), image_reflectance=image_reflectance)}
    r, d = ((glass_index() - 1) / (glass_index() + 1)) ** 2, image_reflectance
    expected = {  # later, earlier: light, further way
        (3, 2): (r * r, 2 * 2.0 / glass_index()),
        (4, 3): (d * r, 2 * 3.0),
        (4, 2): (d * r * (1 - r) ** 2, 2 * (2.0 / glass_index() + 3.0)),
    }
    assert set(found) == {pair for pair, (light, _) in expected.items() if light > 0}
    for pair, ghost in found.items():
        light, way_mm = expected[pair]
        assert ghost.share == pytest.approx(light, rel=1e-9)
        slope = math.tan(math.asin(0.5 / 16.0))
        half_percent = 0.005  # spherical aberration of the plate and pupil samples
        assert ghost.spot_rms_um == pytest.approx(1e3 * way_mm * slope / math.sqrt(2), rel=half_percent)
        # an even disc of that size: its light on an element
        disc_um2 = math.pi * (1e3 * way_mm * slope) ** 2
        assert ghost.on_element(17.0) == pytest.approx(light * 17.0**2 / disc_um2, rel=0.01)


def test_a_thin_lens_has_its_ghost_at_its_focal_length_by_3n_less_1():
    """Two more reflections inside add 2n(c₁ − c₂) to the power (n − 1)(c₁ − c₂), twice bent the same way."""
    c, object_mm = 1 / 1000.0, 2000.0
    glass = LensSurface(radius_mm=1 / c, thickness_mm=0.01, material="N-BK7", stop=True)
    focal = 1 / ((glass_index() - 1) * 2 * c)
    image_mm = 1 / (1 / focal - 1 / object_mm)
    lens = lens_of((glass, LensSurface(radius_mm=-1 / c, thickness_mm=image_mm)), object_mm, 64.0)
    (ghost,) = ghosts(lens, image_reflectance=0.0)
    focus_mm = 1 / ((3 * glass_index() - 1) * 2 * c - 1 / object_mm)
    radius_mm = object_mm * 0.5 / 64 * abs(image_mm / focus_mm - 1)
    percent = 0.01  # spherical aberration
    assert ghost.spot_rms_um == pytest.approx(1e3 * radius_mm / math.sqrt(2), rel=percent)


def test_light_of_the_detector_that_the_object_sends_back_is_in_focus_again():
    """A system that images there and back: the ghost lies on the image, twice the relay's own aberrations."""
    (ghost,) = ghosts(read_lens("relay"), 1, image_reflectance=0.3, object_reflectance=0.05)
    assert (ghost.later, ghost.earlier) == (4, 0) and ghost.share == pytest.approx(0.015)
    assert ghost.spot_rms_um < 17.0 and math.hypot(*ghost.shift_um) < 1.0
    assert ghost.on_element(17.0) == pytest.approx(0.015)


def test_a_coating_stands_for_bare_glass_and_the_way_is_the_windows():
    coated = with_window(read_lens("relay"), 1.0, 2.0, reflectance=0.01)
    shares = {(g.later, g.earlier): g.share for g in ghosts(coated, 1, image_reflectance=0.0)}
    assert shares == pytest.approx({(5, 4): 1e-4})
    path = unfold(coated, 5, 4)
    assert [s.material for s in path.surfaces[-4:]] == ["N-BK7", "mirror", "mirror", "air"]
    assert sum(s.thickness_mm for s in path.surfaces) == pytest.approx(
        sum(s.thickness_mm for s in coated.surfaces)
    )
    assert not ghosts(read_lens("relay"), 1, image_reflectance=0.0)


def test_nothing_comes_back_over_a_grating_and_a_window_must_fit():
    assert not ghosts(read_lens("spectrometer"), 1, object_reflectance=0.5)
    huge = (math.nan, math.inf, -math.inf, 1e308, -1e308, 1e12, -1.0)
    for thickness_mm, gap_mm in ((1.0, 400.0), *((v, 1.0) for v in huge), *((1.0, v) for v in huge)):
        with pytest.raises(ValueError, match=r"^`window` must fit into the 320.027 mm before the image; got"):
            with_window(read_lens("relay"), thickness_mm, gap_mm)
