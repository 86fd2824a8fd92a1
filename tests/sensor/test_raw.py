"""Stokes vectors of raw mosaics: known light through known elements, calibration, full ones, bad input."""

import numpy as np
import pytest
import xarray as xr

from glintrack.sensor import RawDesign, measure_polarization, read_analysers
from glintrack.sensor.layouts import LAYOUTS, analyser_matrix, places
from glintrack.sensor.raw import Analysers, white_level

ROWS, COLUMNS = 32, 40
BLACK = 64
# counts are whole numbers: half a count in each of four elements, over S0
QUANTIZER = 0.5


def rows_of(layout, shape=(ROWS, COLUMNS)):
    """Ideal analyser rows of every element; an open one reads twice a polarizer's unpolarized light."""
    side = len(layout)
    tile = np.zeros((side, side, 3))
    tile[..., 0] = 2.0
    for place, row in zip(places(layout, "polarizer"), analyser_matrix(layout, 1.0), strict=True):
        tile[place] = row
    return np.tile(tile, (shape[0] // side, shape[1] // side, 1))


def raw_of(light, rows, black=BLACK):
    """Counts of 16 bits of light (I, Q, U) at every element."""
    return np.rint(black + np.einsum("yxs,yxs->yx", np.broadcast_to(light, rows.shape), rows)).astype(
        np.uint16
    )


def camera(seed=0, layout="0-45-90-135", gain=0.03, diattenuation=0.1, angle_deg=2.0):
    """Rows of a camera whose elements differ, as calibrations of real ones find."""
    rng = np.random.default_rng(seed)
    rows = rows_of(LAYOUTS[layout])
    turn = np.radians(2 * angle_deg) * rng.standard_normal(rows.shape[:2])
    d = 1 - diattenuation * rng.random(rows.shape[:2])
    q, u = rows[..., 1].copy(), rows[..., 2].copy()
    rows[..., 1] = d * (np.cos(turn) * q - np.sin(turn) * u)
    rows[..., 2] = d * (np.sin(turn) * q + np.cos(turn) * u)
    return rows * (1 + gain * rng.standard_normal(rows.shape[:2]))[..., None]


@pytest.mark.parametrize("method", ["superpixel", "bilinear", "ppid", "eari"])
@pytest.mark.parametrize("layout", ["0-45-90-135", "mirror-0-60-120"])
@pytest.mark.parametrize(
    "vector", [(20_000.0, 6000.0, -3000.0), (20_000.0, 0.0, 0.0), (9000.0, -5000.0, 7000.0)]
)
def test_even_light_comes_back_from_any_layout(method, layout, vector):
    raw = raw_of(vector, rows_of(LAYOUTS[layout]))
    found = measure_polarization(raw, RawDesign(layout=layout, demosaic=method, black_level=BLACK))
    np.testing.assert_allclose(
        found["stokes_radiance"], np.broadcast_to(vector, (ROWS // 2, COLUMNS // 2, 3)), atol=4 * QUANTIZER
    )
    degree = np.hypot(*vector[1:]) / vector[0]
    np.testing.assert_allclose(found["dolp"], degree, atol=4 * QUANTIZER / vector[0])
    np.testing.assert_allclose(found["pan"], vector[0], atol=4 * QUANTIZER)
    if degree:
        angle = 0.5 * np.arctan2(vector[2], vector[1]) % np.pi
        np.testing.assert_allclose(found["aop"], angle, atol=4 * QUANTIZER / vector[0])


def test_bilinear_leaves_a_gradient_without_polarization():
    y, x = np.mgrid[:ROWS, :COLUMNS].astype(float)
    light = np.stack([5000 + 40 * y + 60 * x, 0 * y, 0 * y], axis=-1)
    rows = rows_of(LAYOUTS["0-45-90-135"])
    degree = {
        method: measure_polarization(raw_of(light, rows), RawDesign(demosaic=method, black_level=BLACK))[
            "dolp"
        ]
        for method in ("superpixel", "bilinear")
    }
    assert float(degree["bilinear"][1:-1, 1:-1].max()) < 4 * QUANTIZER / 5000
    assert float(degree["superpixel"][1:-1, 1:-1].min()) > 0.003


def test_custom_rows_and_gain():
    layout = ((0.0, 30.0), (75.0, 140.0))
    vector = (15_000.0, 2000.0, 5000.0)
    design = RawDesign(layout=layout, black_level=BLACK, gain=1e-3)
    found = measure_polarization(raw_of(vector, rows_of(layout)), design, time_s=3.5)
    np.testing.assert_allclose(found["stokes_radiance"][4, 4], 1e-3 * np.array(vector), atol=5e-3)
    assert found["stokes_radiance"].attrs["units"] == "W m-2 sr-1 um-1" and found.attrs["time_s"] == 3.5
    assert (
        measure_polarization(raw_of(vector, rows_of(layout)), RawDesign(layout=layout))["pan"].units
        == "count"
    )


def test_agrees_with_polanalyser():
    """OpenCV's bilinear demosaicking and least squares, meaned over a superpixel, on random counts."""
    polanalyser = pytest.importorskip("polanalyser", reason="the dev extra's oracle of polarization images")
    raw = np.random.default_rng(4).integers(2000, 50_000, (ROWS, COLUMNS)).astype(np.uint16)
    images = [image.astype(float) for image in polanalyser.demosaicing(raw)]
    fine = polanalyser.calcLinearStokes(images, np.radians([0, 45, 90, 135])) / 2
    theirs = fine.reshape(ROWS // 2, 2, COLUMNS // 2, 2, 3).mean(axis=(1, 3))[2:-2, 2:-2]
    ours = measure_polarization(raw, RawDesign(demosaic="bilinear"))["stokes_radiance"][2:-2, 2:-2]
    np.testing.assert_allclose(ours, theirs, atol=2 * QUANTIZER)  # OpenCV rounds to whole counts


# --- calibration -----------------------------------------------------------------------------------


@pytest.mark.parametrize("method", ["superpixel", "bilinear", "ppid", "eari"])
def test_a_calibrated_camera_measures_even_light_exactly_and_an_uncalibrated_one_does_not(method):
    rows, vector = camera(), (20_000.0, 6000.0, -3000.0)
    dark = BLACK + 5 * np.random.default_rng(1).random((ROWS, COLUMNS))
    raw = raw_of(vector, rows, dark)
    design = RawDesign(demosaic=method, black_level=BLACK)
    found = measure_polarization(raw, design, Analysers(rows, dark))
    np.testing.assert_allclose(
        found["stokes_radiance"], np.broadcast_to(vector, (ROWS // 2, COLUMNS // 2, 3)), atol=6 * QUANTIZER
    )
    without = measure_polarization(raw, design)
    assert float(np.abs(without["dolp"] - found["dolp"]).mean()) > 0.005


def test_a_calibration_helps_light_that_varies():
    """Stripes across superpixels: what the camera's errors do to DoLP goes, what the mosaic does stays."""
    x = np.mgrid[:ROWS, :COLUMNS][1].astype(float)
    total = 10_000 + 3000 * np.sin(2 * np.pi * x / 9)
    light = np.stack([total, 0.2 * total, -0.1 * total], axis=-1)
    ideal, real = rows_of(LAYOUTS["0-45-90-135"]), camera()
    design = RawDesign(demosaic="bilinear", black_level=BLACK)
    wanted = measure_polarization(raw_of(light, ideal), design)["dolp"]
    raw = raw_of(light, real)
    with_it = measure_polarization(raw, design, Analysers(real))["dolp"] - wanted
    without = measure_polarization(raw, design)["dolp"] - wanted
    a_quarter = 0.25  # stripes of four superpixels: what is left is of second order in errors and contrast
    assert float(np.sqrt((with_it**2).mean())) < a_quarter * float(np.sqrt((without**2).mean()))


def test_an_element_that_is_not_to_be_used_leaves_a_hole():
    rows = camera()
    rows[8, 10] = np.nan
    raw = raw_of((9000.0, 900.0, 0.0), camera())
    found = measure_polarization(raw, RawDesign(demosaic="superpixel"), Analysers(rows))["dolp"].values
    assert np.argwhere(np.isnan(found)).tolist() == [[4, 5]]


def written(tmp_path, **variables):
    path = tmp_path / "calibration.nc"
    xr.Dataset({name: (dims, values) for name, (dims, values) in variables.items()}).to_netcdf(
        path, engine="h5netcdf"
    )
    return path


def test_a_calibration_file_is_read(tmp_path):
    rows = camera()
    path = written(tmp_path, analyser=(("y", "x", "stokes"), rows), dark=(("y", "x"), rows[..., 0] + 60))
    found = read_analysers(path)
    np.testing.assert_array_equal(found.row, rows)
    np.testing.assert_array_equal(found.dark, rows[..., 0] + 60)


@pytest.mark.parametrize(
    ("variables", "message"),
    [
        ({"gain": (("y", "x"), np.ones((4, 4)))}, "`calibration` must hold analyser over y, x, stokes"),
        ({"analyser": (("y", "x", "stokes"), np.ones((4, 4, 4)))}, "must give I, Q and U of each element"),
        ({"analyser": (("y", "x", "stokes"), np.zeros((4, 4, 3)))}, "whose I is positive"),
        (
            {"analyser": (("y", "x", "stokes"), rows_of(LAYOUTS["pan"], (4, 4))), "dark": ("y", np.ones(4))},
            "must have dark counts",
        ),
    ],
)
def test_a_wrong_calibration_is_one_sentence(tmp_path, variables, message):
    with pytest.raises(ValueError, match=message):
        read_analysers(written(tmp_path, **variables))


def test_a_missing_calibration_is_one_sentence(tmp_path):
    with pytest.raises(ValueError, match="`calibration` must be a readable file; got"):
        read_analysers(tmp_path / "none.nc")


# --- full elements and other bad input -------------------------------------------------------------


def test_full_elements_leave_holes_and_too_many_are_refused():
    raw = raw_of((9000.0, 900.0, 0.0), rows_of(LAYOUTS["0-45-90-135"]))
    raw[10:12, 20:22] = 65535
    holes = {
        m: int(measure_polarization(raw, RawDesign(demosaic=m))["dolp"].isnull().sum())
        for m in ("superpixel", "bilinear")
    }
    assert holes == {"superpixel": 1, "bilinear": 9}
    raw[:8] = 65535
    with pytest.raises(
        ValueError, match=r"at most 5 % of its elements full, at 65535 counts; got 25.3 % in the"
    ):
        measure_polarization(raw)
    found = measure_polarization(raw, RawDesign(max_saturated=0.3, demosaic="superpixel"))
    assert np.isnan(found["stokes_radiance"].values[:4]).all()


@pytest.mark.parametrize(
    ("counts", "white"),
    [
        (np.array([[3, 900]], np.uint16), 1023),
        (np.array([[3, 4095]], np.uint16), 4095),
        (np.array([[16, 65520]], np.uint16), 65520),  # 12 bits in the upper part
        (np.array([[3, 65000]], np.uint16), 65535),
        (np.array([[3, 200]], np.uint8), 255),
        (np.zeros((2, 2), np.uint16), 65535),
    ],
)
def test_the_bits_that_a_frame_fills(counts, white):
    assert white_level(counts) == white


@pytest.mark.parametrize(
    ("shape", "design", "message"),
    [
        ((31, 40), {}, "`RAW` must have even rows, 4 at least .* got 31"),
        ((32, 41), {}, "`RAW` must have even columns, 4 at least .* got 41"),
        ((32, 40), {"layout": "45-0"}, "`layout` must be one of mirror-0-60-120, .* got '45-0'"),
        ((32, 40), {"layout": ((0.0, 90.0), (0.0, 90.0))}, "`layout` must hold polarizers that determine"),
        ((32, 40), {"layout": "pan"}, "`layout` must hold polarizers that determine"),
    ],
)
def test_bad_mosaics_are_one_sentence(shape, design, message):
    with pytest.raises(ValueError, match=message):
        measure_polarization(np.full(shape, 100, np.uint8), RawDesign(**design))


def test_a_calibration_of_another_camera_is_refused():
    raw = np.full((ROWS, COLUMNS), 100, np.uint8)
    with pytest.raises(ValueError, match="must be of the raw's 32 × 40 elements; got 8 × 8"):
        measure_polarization(raw, calibration=Analysers(rows_of(LAYOUTS["0-45-90-135"], (8, 8))))
    alike = np.broadcast_to([1.0, 0.5, 0.0], (ROWS, COLUMNS, 3))
    with pytest.raises(
        ValueError, match="determine S0, S1 and S2 in every superpixel; got others in that of row 0"
    ):
        measure_polarization(raw, calibration=Analysers(alike))


def test_the_white_level_of_few_bits_in_a_container_of_12():
    assert white_level(np.array([[4092, 8]], np.uint16)) == 4092  # 10 bits, two low ones are 0
    assert white_level(np.array([[65472, 64]], np.uint16)) == 65472
    assert white_level(np.array([[1023, 1]], np.uint16)) == 1023


@pytest.mark.parametrize("counts_per_light", [0.004, 250.0])
def test_the_dolp_floor_follows_the_calibrations_unit(counts_per_light):
    """Light of 400 counts has a DoLP, and light in the noise has none, whatever the rows count."""
    rows = counts_per_light * rows_of(LAYOUTS["0-45-90-135"])
    design = RawDesign(black_level=BLACK, dark_noise=2.0)
    for counts, is_known in ((400.0, True), (1.0, False)):
        raw = raw_of(counts / counts_per_light * np.array([1.0, 0.3, 0.0]), rows)
        found = measure_polarization(raw, design, Analysers(rows, np.full((ROWS, COLUMNS), float(BLACK))))
        assert bool(np.isfinite(found["dolp"]).all()) == is_known
