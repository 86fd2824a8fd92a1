"""Lens prescriptions through optiland: a closed form, the shipped ones, bad files."""

import math

import numpy as np
import pytest

from glintrack.sensor import LensDesign, lens_quality, read_lens
from glintrack.sensor.lens import LensSurface, lens_names, path_errors_um

MIRROR = LensSurface(radius_mm=-200.0, thickness_mm=-200.0, material="mirror", stop=True)


def test_lenses_come_with_the_package():
    assert set(lens_names()) >= {"relay", "spectrometer"}
    assert all(isinstance(read_lens(name), LensDesign) for name in lens_names())


def test_a_sphere_images_its_centre_without_error():
    pytest.importorskip("optiland")
    lens = LensDesign(
        name="sphere",
        object_distance_mm=200.0,
        f_number=3.0,
        fields_mm=((0.0, 0.0), (0.0, 0.5)),
        wavelengths_um=(0.5,),
        surfaces=(MIRROR,),
    )
    quality = lens_quality(lens)
    assert float(quality["spot_rms"][0, 0]) < 1e-6
    assert float(quality["image_y"][1, 0]) == pytest.approx(-0.5, abs=1e-4)


def test_a_glass_that_no_catalogue_has_is_told_by_its_surface():
    pytest.importorskip("optiland")
    relay = read_lens("relay")
    surfaces = [one.model_dump() for one in relay.surfaces]
    surfaces[0]["material"] = "BK9"
    with pytest.raises(
        ValueError, match=r"`surfaces\.0\.material` must be air, mirror or a glass .* got 'BK9'"
    ):
        lens_quality(relay.replace({"surfaces": surfaces}))


def test_the_relay_images_all_wavelengths_within_an_element():
    pytest.importorskip("optiland")
    half_an_element_um = 8.5
    quality = lens_quality(read_lens("relay"))
    assert float(quality["spot_rms"].max()) < half_an_element_um
    assert float(quality["passed"].min()) == 1.0
    assert float(quality["distortion"].max()) < 0.2 * 17e-3
    size = np.ptp(quality["image_y"].values[:3, 1])
    assert size == pytest.approx(10.0, rel=0.025)  # the best magnification came out at 1.02
    middle = np.array(read_lens("relay").fields_mm[1:2])
    (error_um,) = path_errors_um(read_lens("relay"), middle, 0.7)
    assert np.hypot.reduce(error_um[4:]) < 0.1 * 0.7  # a tenth of a wave without piston, tilts and focus


def test_the_spectrometer_spreads_its_range_over_61_elements():
    """Grating at the stop, a distance R from the image on both ways: Δy = (R/2)(1 + …)Δλ/d, about."""
    pytest.importorskip("optiland")
    quality = lens_quality(read_lens("spectrometer"))
    spread = np.ptp(quality["image_y"].values, axis=1)
    np.testing.assert_allclose(spread, 61 * 17e-3, rtol=0.02)
    steps = np.diff(quality["image_y"].values, axis=1)
    np.testing.assert_allclose(steps, steps.mean(), rtol=0.01)  # the dispersion is even
    assert float(quality["spot_rms"].max()) < 8.5
    smile = np.abs(quality["image_y"].values[:3] - quality["image_y"].values[3:])
    assert smile.max() < 17e-3 / 2


def test_prescriptions_that_are_none_are_refused(tmp_path):
    with pytest.raises(ValueError, match="`lens` must be one of relay, spectrometer or a readable TOML file"):
        read_lens("planar")
    bad = tmp_path / "bad.toml"
    bad.write_text('name = "x"\nobject_distance_mm = 1\nf_number = 5\nfields_mm = [[0, 0]]\n')
    with pytest.raises(ValueError, match=r"`wavelengths_um` must be given; got only name"):
        read_lens(str(bad))
    with pytest.raises(ValueError, match="must have one stop; got 0"):
        LensDesign(
            name="x",
            object_distance_mm=math.pi,
            f_number=5,
            fields_mm=((0, 0),),
            wavelengths_um=(0.5,),
            surfaces=(MIRROR.model_copy(update={"stop": False}),),
        )
