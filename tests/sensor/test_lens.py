"""Lens prescriptions through optiland: a closed form, the shipped ones, bad files."""

import math
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

from glintrack.sensor import LensDesign, SensorDesign, lens_quality, read_lens
from glintrack.sensor.lens import LensSurface, lens_names, path_errors_um
from glintrack.sensor.wavefront import wavefront_um

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


def test_defocus_has_the_sign_of_the_wavefronts_that_it_is_added_to():
    """The relay with its last distance longer by 50 µm, against the same lens and ``defocus_um`` = 50."""
    pytest.importorskip("optiland")
    relay = read_lens("relay")
    surfaces = [one.model_dump() for one in relay.surfaces]
    along = math.copysign(0.05, surfaces[-1]["thickness_mm"])  # light runs back after a mirror
    surfaces[-1]["thickness_mm"] += along
    longer = relay.replace({"surfaces": surfaces})
    middle = np.array(relay.fields_mm[1:2])
    before, after = (path_errors_um(lens, middle, 0.7)[0, 3] for lens in (relay, longer))
    error_um = wavefront_um(SensorDesign(f_number=relay.f_number, optics={"defocus_um": 50.0}))
    x = np.linspace(-1, 1, len(error_um))
    square = x[:, None] ** 2 + x**2
    inside = square <= 1
    of_design_um = (error_um * math.sqrt(3) * (2 * square - 1))[inside].mean()  # Noll's Z4
    assert -(after - before) == pytest.approx(of_design_um, rel=0.05)  # of a fast beam, to first order


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


HOWTO = Path(__file__).parents[2] / "docs" / "howto"


def zemax(unit="MM", mm=1.0, **other):
    """The packaged relay, and an N-BK7 window of 2 mm before its first mirror, as OpticStudio writes it."""
    relay = read_lens("relay")
    lines = ["MODE SEQ", "NAME window and relay", f"UNIT {unit} X W X CM MR CPMM", "OBNA 0.0892857142857 0"]
    places = [*relay.fields_mm, (0.0, 0.0)]  # OpticStudio pads with zeros
    lines += [f"{k}FLN " + " ".join(f"{p[i] / mm:.9f}" for p in places) for i, k in enumerate("XY")]
    lines += ["FTYP 1 1 6 3 0 0 0", "WAVM 1 0.4 1", "WAVM 2 0.7 1", "WAVM 3 1 1", "WAVM 4 0.55 1", "PWAV 2"]
    rows = [(0, 300.0, ""), (0, 2.0, "GLAS N-BK7 0 0 1.5168 64.17"), (0, 18.0, "")]
    mirror = "GLAS MIRROR 0 0 1.5 40"
    rows += [(1 / s.radius_mm, s.thickness_mm, mirror) for s in relay.surfaces] + [(0, 0.0, "")]
    for k, (curvature, thickness_mm, glass) in enumerate(rows):
        lines += [
            f"SURF {k}",
            *["  STOP"] * (k == 4),
            "  TYPE STANDARD",
            f"  CURV {curvature * mm:.12g} 0 0 0",
        ]
        lines += [f"  DISZ {thickness_mm / mm:.12g}", f"  {glass}", "  CONI 0", "  DIAM 46 0 0 0 1"]
    text = "\r\n".join(lines)
    for old, new in other.values():
        text = text.replace(old, new, 1)
    return text


@pytest.mark.parametrize(
    ("unit", "mm", "encoding"), [("MM", 1.0, "utf-8"), ("IN", 25.4, "utf-16"), ("CM", 10.0, "latin-1")]
)
def test_a_zemax_file_is_converted(tmp_path, monkeypatch, unit, mm, encoding):
    path, made = tmp_path / "relay.zmx", tmp_path / "relay.toml"
    path.write_bytes(zemax(unit, mm).encode(encoding))
    with pytest.raises(ValueError, match=r"Convert it: python docs/howto/my_zemax_lens.py .*relay.zmx"):
        read_lens(str(path))
    monkeypatch.setattr(sys, "argv", ["my_zemax_lens.py", str(path), str(made)])
    runpy.run_path(str(HOWTO / "my_zemax_lens.py"), run_name="__main__")
    lens, relay = read_lens(str(made)), read_lens("relay")
    assert (lens.name, lens.object_distance_mm, lens.telecentric) == ("window and relay", 300.0, True)
    assert lens.f_number == pytest.approx(5.6) and lens.wavelengths_um == (0.4, 0.7, 1.0)
    np.testing.assert_allclose(lens.fields_mm, relay.fields_mm)
    assert [s.material for s in lens.surfaces] == ["N-BK7", "air", "mirror", "mirror", "mirror"]
    assert [s.stop for s in lens.surfaces] == [False, False, False, True, False]
    for mine, first in zip(lens.surfaces[2:], relay.surfaces, strict=True):
        assert (mine.radius_mm, mine.thickness_mm) == pytest.approx((first.radius_mm, first.thickness_mm))
    if unit == "MM":  # optiland's own reader, which takes every file for millimetres
        optic = pytest.importorskip("optiland.fileio").load_zemax_file(str(path))
        radii = [np.inf if s.radius_mm is None else s.radius_mm for s in lens.surfaces]
        np.testing.assert_allclose(np.asarray(optic.surfaces.radii)[1:-1], radii)


@pytest.mark.parametrize(
    ("change", "requirement"),
    [
        (("UNIT MM", "UNIT FURLONG"), "a UNIT of MM, CM, IN, METER"),
        (("FTYP 1", "FTYP 0"), "fields of the type Object Height"),
        (("FTYP 1 1 6 3 0 0 0", "FTYP 1"), "numbers of fields and wavelengths"),
        (("OBNA", "ENPD"), "an aperture of the type Object Space NA"),
        (("DISZ 300", "DISZ INFINITY"), "an object at a finite distance"),
        (("SURF 1\r\n  TYPE STANDARD", "SURF 1\r\n  TYPE BINARY_2"), "got BINARY_2 at SURF 1"),
        (("GLAS N-BK7", "GLAS ___BLANK"), "got a model glass at SURF 1"),
        (
            ("GLAS N-BK7", "CLAP 0 5 0\r\n  GLAS N-BK7"),
            "no apertures other than the stop; got ['CLAP'] at SURF 1",
        ),
    ],
)
def test_what_a_lens_cannot_hold_is_refused_by_name(change, requirement):
    converter = runpy.run_path(str(HOWTO / "my_zemax_lens.py"))
    with pytest.raises(SystemExit) as end:
        converter["convert"](zemax(change=change))
    assert requirement in str(end.value)
