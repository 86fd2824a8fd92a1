"""A prescription that makes the frame: against its own rays."""

import sys

import numpy as np
import pytest

from glintrack.camera import Camera, Pose, project
from glintrack.core.distortion import Distortion
from glintrack.sensor import OpticsDesign, read_lens, with_lens
from glintrack.sensor.lens import _distortion, build_optic, image_of, ray_paths
from glintrack.sensor.wavefront import _nodes_at, wavefront_um, zernike
from tests.plain import plain_sensor

RELAY = OpticsDesign(lens="relay")
DESIGN = plain_sensor(optics=RELAY, columns=880, rows=580)  # 15 × 10 mm, as the relay was made for


@pytest.fixture(scope="module")
def design():
    pytest.importorskip("optiland")
    return with_lens(DESIGN)


def test_a_design_without_a_lens_stays_as_it_is():
    plain = plain_sensor()
    assert with_lens(plain) is plain


@pytest.mark.parametrize(("field", "place"), [(3, (-1, -1)), (5, (-1, 1)), (1, (0, 0))])
def test_rays_go_where_the_wavefront_says(design, field, place):
    """Off their mean by 2N times the path error's gradient over the pupil. [µm]"""
    lens = read_lens("relay")
    optic = build_optic(lens)
    rings = 12
    image = 1e3 * ray_paths(optic, lens, lens.fields_mm[field], 0.7, rings)[-1, :, :2]
    ring = np.concatenate([[0.0], *(np.full(6 * r, r / rings) for r in range(1, rings + 1))])
    turn = np.concatenate([[0.0], *(2 * np.pi * np.arange(6 * r) / (6 * r) for r in range(1, rings + 1))])
    x, y = ring * np.cos(turn), ring * np.sin(turn)
    right, down = place
    diagonal = np.hypot(design.rows, design.columns)
    at = right * design.columns / diagonal, -down * design.rows / diagonal
    terms = {}
    for node, share in _nodes_at(design, at):
        for index, value in node.items():
            terms[index] = terms.get(index, 0.0) + 1e-3 * share * value

    def error_um(x, y):
        polar = np.hypot(x, y), np.arctan2(y, x)
        return sum(v * zernike(k, *polar) for k, v in terms.items())

    step = 1e-4
    slope = np.stack(
        [error_um(x + step, y) - error_um(x - step, y), error_um(x, y + step) - error_um(x, y - step)],
        axis=-1,
    )
    expected = 2 * 5.6 * 1.02 * slope / (2 * step)
    inner = ring < 0.99
    found, expected = (a[inner] - a[inner].mean(axis=0) for a in (image, expected))
    spot_um = np.sqrt((found**2).sum(axis=1).mean())
    assert np.sqrt(((found - expected) ** 2).sum(axis=1).mean()) < 0.05 * spot_um
    # and the kernels take that wavefront
    across = np.linspace(-1, 1, 64)
    surface = error_um(*np.meshgrid(across, across))
    np.testing.assert_allclose(wavefront_um(design, at, 64), surface, atol=1e-9)


def test_the_fit_finds_the_coefficients():
    """Of places moved by them, whatever the scale and shift: those are the design's own."""
    x, y = np.meshgrid(np.linspace(-7.5, 7.5, 5), np.linspace(-5, 5, 5))
    ideal = np.stack([x, y], axis=-1).reshape(-1, 2)
    lens = Distortion(k1=-0.3, k2=2.0, p1=0.002, p2=-0.001)
    camera = Camera(0.02, 1e-5, 1200, 1600, distortion=lens)
    pixel = project(camera, Pose(0, 0, 1), np.column_stack([ideal / 20, np.zeros(25)]))
    image = 1e-2 * np.stack([pixel[:, 1], -pixel[:, 0]], axis=-1)
    for name, value in _distortion(ideal, image, 20.0):
        assert value == pytest.approx(getattr(lens, name), rel=1e-6, abs=1e-9)
    # an uneven scale and a skew, y up
    found = _distortion(ideal, ideal @ np.array([[0.97, 0.0], [-0.004, 1.0]]), 20.0)
    for name, value in found:
        assert value == pytest.approx({"b1": -0.03, "b2": 0.004}.get(name, 0.0), abs=1e-9)


def test_the_relays_distortion_goes_into_the_camera(design):
    """Most of its sixteenth of an element is another scale down than across."""
    lens = read_lens("relay")
    x, y = np.meshgrid(np.linspace(-7, 7, 5), np.linspace(-4.5, 4.5, 4))
    objects = np.stack([x, y], axis=-1).reshape(-1, 2)
    image, *_ = image_of(lens, objects + (0.0, 41.0), 0.7)
    left = []
    for distortion in (None, design.optics.distortion):
        camera = Camera(0.068, 17e-6, 580, 880, distortion=distortion)
        seen = np.column_stack([-1.02 * objects / 68.0, np.zeros(len(objects))])  # straight down from 1 m
        pixel = project(camera, Pose(0, 0, 1), seen)
        unit = np.stack([pixel[:, 1], -pixel[:, 0]], axis=-1)
        unit, true = unit - unit.mean(axis=0), image - image.mean(axis=0)
        error = true / 17e-3 - unit * (true / 17e-3 * unit).sum() / (unit * unit).sum()
        left.append(np.sqrt((error**2).sum(axis=1).mean()))
    plain, ours = left
    assert plain > 0.04 and ours < plain / 20  # elements


def test_it_sets_only_what_a_prescription_knows(design):
    assert design.optics.lens == "" and design.optics.vignetting == 0.0  # the relay passes all its rays
    assert len(design.optics.field_zernikes_rms_nm) == 5
    assert design.model_copy(update={"optics": RELAY}) == DESIGN


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"f_number": 4.0}, "`sensor.f_number` must be the lens's, 5.7"),
        ({"columns": 2000}, "`sensor.optics.lens` must reach the array's corners"),
        ({"optics": OpticsDesign(lens="planar")}, "`lens` must be one of relay"),
    ],
)
def test_what_does_not_fit_is_refused(change, message):
    pytest.importorskip("optiland")
    with pytest.raises(ValueError, match=message):
        with_lens(DESIGN.model_copy(update=change))


def test_keys_that_the_lens_sets_are_refused_beside_it():
    with pytest.raises(ValueError, match="must not be given with"):
        OpticsDesign(lens="relay", vignetting=0.3)
    with pytest.raises(ValueError, match="matrix of two rows"):
        OpticsDesign(field_zernikes_rms_nm=(({4: 1.0},),))


def test_a_missing_extra_is_named(monkeypatch):
    for name in ("optiland", "optiland.optic", "optiland.optic.optic"):
        monkeypatch.setitem(sys.modules, name, None)
    with pytest.raises(ValueError, match=r"extra `optics`.*\[optics\]"):
        with_lens(DESIGN)
