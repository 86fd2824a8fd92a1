"""Polarizers over the elements: analyser rows against closed forms, and that they reach a frame."""

import math

import numpy as np
import pytest
import xarray as xr

from glintrack import stokes
from glintrack.camera import Camera, Pose, rays
from glintrack.core.records import NONE_SERVED
from glintrack.devices import wire_grid
from glintrack.sensor import Polarizer, array_readout, build_sensor, expose, load_polarizer
from glintrack.sensor.fixed_pattern import chief_rays, departure_at_incidence
from glintrack.sensor.polarizer import axis_at_incidence, from_table, from_transmittances
from tests.oracles import paper_polarizer
from tests.plain import plain_sensor
from tests.sensor.light import GRID, NOISELESS, sensor_of, uniform

ENDS = np.array([0.4, 2.5])
ROUNDING = 1e-12


def retarder_before(retardance_rad, angle_rad=math.pi / 4):
    """An ideal polarizer along the reference axis behind a retarder, a retardance for each wavelength."""
    ideal = stokes.linear_diattenuator(1, 0)
    matrices = [ideal @ stokes.linear_diattenuator(1, 1, angle_rad, r) for r in retardance_rad]
    return np.array(matrices)


def seen(sensor, vector, seed=0):
    frame = expose(uniform(sensor, vector), sensor, NONE_SERVED, np.random.default_rng(seed))
    return frame["stokes_radiance"].values


# --- the row ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("light_deg", [0.0, 17.0, 90.0, 130.0])
@pytest.mark.parametrize("axis_deg", [0.0, 45.0, 120.0])
def test_malus(light_deg, axis_deg):
    light, axis = math.radians(light_deg), math.radians(axis_deg)
    row = load_polarizer(plain_sensor()).analyser_row(GRID, axis)
    passed = row @ [1, math.cos(2 * light), math.sin(2 * light), 0]
    np.testing.assert_allclose(passed, math.cos(light - axis) ** 2, atol=ROUNDING)


def test_a_retarder_before_a_polarizer_turns_linear_into_circular():
    """Retardance δ at 45°: the row is ½(1, cos δ, 0, ± sin δ); a quarter wave is blind to linear light."""
    retardance = np.array([0.3, math.pi / 2])
    polarizer = Polarizer(ENDS, retarder_before(retardance)[None])
    row = polarizer.analyser_row(ENDS, 0.0)
    np.testing.assert_allclose(row[:, 0], 0.5, atol=ROUNDING)
    np.testing.assert_allclose(row[:, 1], 0.5 * np.cos(retardance), atol=ROUNDING)
    np.testing.assert_allclose(row[:, 2], 0, atol=ROUNDING)
    np.testing.assert_allclose(np.abs(row[:, 3]), 0.5 * np.sin(retardance), atol=ROUNDING)
    turned = polarizer.analyser_row(ENDS, 0.7)
    np.testing.assert_allclose(turned[:, 3], row[:, 3], atol=ROUNDING)  # circular light has no axis
    np.testing.assert_allclose(
        turned[:, 1:3], row[:, 1, None] * [[math.cos(1.4), math.sin(1.4)]], atol=ROUNDING
    )


def test_a_solved_grids_row_is_its_transmittances():
    table = wire_grid.load("grid_b")
    um = table["wavelength"].values
    row = load_polarizer(plain_sensor(polarizer="grid_b")).analyser_row(um, 0.0)
    along, across = (table[f"{k}_transmittance_per_aperture"].values for k in ("pass", "block"))
    np.testing.assert_allclose(row[:, 0], (along + across) / 2, rtol=ROUNDING)
    np.testing.assert_allclose(row[:, 1], (along - across) / 2, rtol=ROUNDING)
    np.testing.assert_allclose(row[:, 2:], 0, atol=ROUNDING)


@pytest.mark.parametrize("vector", [(1.0, 0.0, 0.0), (1.0, 0.3, -0.4), (2.0, 0.0, 2.0)])
@pytest.mark.parametrize("angle_deg", [0.0, 60.0, 120.0])
def test_the_papers_model_passes_the_same_irradiance(vector, angle_deg):
    """Eqs. (10)–(12) differ from the Mueller matrix in the light behind the polarizer, not in how much."""
    angle = math.radians(angle_deg)
    paper = paper_polarizer.behind(vector, 0.68, 0.07, angle)
    row = from_transmittances(ENDS, np.full(2, 0.68), np.full(2, 0.07)).analyser_row(ENDS, angle)
    np.testing.assert_allclose(row[:, :3] @ vector, paper[0], rtol=ROUNDING)
    np.testing.assert_allclose(stokes.dolp(paper), 0.61 / 0.75, atol=ROUNDING)  # whatever came in


def test_the_papers_model_and_the_matrix_differ_behind_the_polarizer():
    matrix = stokes.linear_diattenuator(0.68, 0.07)[:3, :3]
    even = np.array([1.0, 0, 0])
    np.testing.assert_allclose(paper_polarizer.behind(even, 0.68, 0.07), matrix @ even, atol=ROUNDING)
    slanted = np.array([1.0, 0, 1.0])
    assert (matrix @ slanted)[2] == pytest.approx(math.sqrt(0.68 * 0.07))
    assert paper_polarizer.behind(slanted, 0.68, 0.07)[2] == pytest.approx(0)


# --- angle of incidence ----------------------------------------------------------------------------


@pytest.mark.parametrize("incidence_deg", [0.0, 20.0, 50.0])
def test_an_axis_tilted_in_its_plane_of_incidence_is_foreshortened(incidence_deg):
    angle, incidence = math.radians(30), math.radians(incidence_deg)
    along = axis_at_incidence(angle, incidence, 0.0)
    across = axis_at_incidence(angle, incidence, math.pi / 2)
    assert math.tan(along) == pytest.approx(math.tan(angle) * math.cos(incidence))
    assert math.tan(across) == pytest.approx(math.tan(angle) / math.cos(incidence))
    for axis in (0.0, math.pi / 2):  # in the plane of incidence, or square to it
        turned = axis_at_incidence(axis, incidence, 0.0) - axis
        assert math.sin(turned) == pytest.approx(0, abs=ROUNDING)


def test_the_axis_is_what_vectors_say():
    """The pass field is square to ray and wires, measured from the detector's +x, both across the ray."""
    rng = np.random.default_rng(0)
    for angle, azimuth, incidence in rng.uniform([0, 0, 0], [math.pi, 2 * math.pi, 1.2], (50, 3)):
        toward = np.array(
            [
                math.sin(incidence) * math.cos(azimuth),
                math.sin(incidence) * math.sin(azimuth),
                math.cos(incidence),
            ]
        )
        wires = np.array([-math.sin(angle), math.cos(angle), 0.0])
        wanted = stokes.frame_angle(np.array([1.0, 0, 0]), np.cross(toward, wires), toward)
        found = axis_at_incidence(angle, incidence, azimuth)
        assert math.sin(found - float(wanted)) == pytest.approx(0, abs=1e-9)


def test_chief_rays_are_the_cameras():
    """The pinhole's own rays: their angle from its axis, and which side of it they lie on."""
    design = plain_sensor(rows=8, columns=12, focal_length_mm=1.0, pitch_um=100.0)
    incidence, azimuth = chief_rays(design)
    camera = Camera(1e-3, 100e-6, 8, 12)
    pixels = np.stack(np.meshgrid(np.arange(8), np.arange(12), indexing="ij"), axis=-1)
    ahead = rays(camera, Pose(0.0, 0.0, 100.0), pixels.reshape(-1, 2).astype(float)).reshape(8, 12, 3)
    np.testing.assert_allclose(np.cos(incidence), -ahead[..., 2], atol=ROUNDING)
    np.testing.assert_allclose(azimuth, np.arctan2(ahead[..., 1], ahead[..., 0]), atol=1e-9)


def test_oblique_light_departs_as_the_table_says():
    """A polarizer that loses a tenth of its light and half of its diattenuation at 0.2 rad."""
    square = stokes.linear_diattenuator(1.0, 0.0)
    slanted = 0.9 * stokes.linear_diattenuator(0.75, 0.25)
    polarizer = Polarizer(ENDS, np.array([[square] * 2, [slanted] * 2]), np.array([0.0, 0.2]))
    design = plain_sensor(
        rows=8,
        columns=8,
        layout="0-45-90-135",
        polarizer_incidence="chief_ray",
        pitch_um=100.0,
        focal_length_mm=5.0,
    )
    weights = np.full(len(GRID), 1 / len(GRID))
    found = departure_at_incidence(design, polarizer, GRID, weights)
    share = chief_rays(design)[0] / 0.2
    np.testing.assert_allclose(found.gain, 1 - 0.1 * share, atol=1e-9)
    np.testing.assert_allclose(found.diattenuation, 1 - 0.5 * share, atol=1e-9)
    assert departure_at_incidence(plain_sensor(), polarizer, GRID, weights) is None


def test_chief_rays_turn_the_axes_of_a_frame():
    """Light whose field lies along x: what a corner's 45° element reads follows from the tilted axis."""
    keys = {"layout": "0-45-90-135", "focal_length_mm": 10.0, "demosaic": "superpixel", **NOISELESS}
    normal = sensor_of(**keys)
    tilted = sensor_of(polarizer_incidence="chief_ray", **keys)
    read = [
        array_readout(uniform(s, (50.0, 50.0, 0.0))(s.channels).values, s, np.random.default_rng(0))
        for s in (normal, tilted)
    ]
    incidence, azimuth = chief_rays(tilted.design)
    half_a_percent = 0.005 * 50
    for place in ((0, 1), (62, 79), (1, 78)):
        angle = math.radians(tilted.design.superpixel[place[0] % 2][place[1] % 2])
        axis = axis_at_incidence(angle, incidence[place], azimuth[place])
        assert read[1][place] == pytest.approx(50 * (1 + math.cos(2 * axis)), abs=half_a_percent)
        assert read[0][place] == pytest.approx(50 * (1 + math.cos(2 * angle)), abs=half_a_percent)
    assert np.abs(read[1] - read[0]).max() > 2


# --- spread ----------------------------------------------------------------------------------------


def test_each_spread_is_what_its_element_reads():
    """RMS over a frame of polarized light, to first order: ε·S0, 2α·Q in 45° elements, δ·Q in 0° ones."""
    keys = {
        "rows": 256,
        "columns": 256,
        "layout": "0-45-90-135",
        **NOISELESS,
        "optics": {"relative_illumination": "even"},
    }
    light, tenth = (50.0, 20.0, 0.0), 0.04
    where = {45: (slice(0, None, 2), slice(1, None, 2)), 0: (slice(1, None, 2), slice(1, None, 2))}

    def rms(place, **spread):
        s = sensor_of(polarizer_spread=spread, **keys)
        values = array_readout(uniform(s, light)(s.channels).values, s, np.random.default_rng(0))[place]
        return values.astype(float).std()

    assert rms(where[45], gain=0.01) == pytest.approx(0.01 * 50, rel=tenth)
    assert rms(where[45], angle_deg=0.5) == pytest.approx(2 * math.radians(0.5) * 20, rel=tenth)
    assert rms(where[0], diattenuation=0.02) == pytest.approx(0.02 * 20, rel=tenth)
    assert rms(where[45], diattenuation=0.02) < 0.01  # its row has no Q
    assert rms(where[0]) < 0.001


def test_spread_leaves_the_mirrors_alone_and_belongs_to_the_copy():
    keys = {"polarizer_spread": {"gain": 0.05, "angle_deg": 2.0}, **NOISELESS}
    plain, spread = sensor_of(**NOISELESS), sensor_of(**keys)
    np.testing.assert_array_equal(spread.pattern.gain[::2, ::2], plain.pattern.gain[::2, ::2])
    np.testing.assert_array_equal(spread.pattern.offset_e[::2, ::2], plain.pattern.offset_e[::2, ::2])
    assert not np.array_equal(spread.pattern.gain[1::2, 1::2], plain.pattern.gain[1::2, 1::2])
    np.testing.assert_array_equal(spread.pattern.polarizer_turn, sensor_of(**keys).pattern.polarizer_turn)


@pytest.mark.parametrize(
    ("spread", "light", "false_dolp"),
    [
        # r = S0 (1 + ε): Q = (r0 − r90)/2 and U each have the RMS ε S0/√2, so that √(Q² + U²)/S0 is ε
        ({"gain": 0.01}, (50.0, 0.0, 0.0), 0.01),
        # errors of axes and of diattenuation make nothing of unpolarized light
        ({"angle_deg": 1.0}, (50.0, 0.0, 0.0), 0.0),
        ({"diattenuation": 0.05}, (50.0, 0.0, 0.0), 0.0),
        # light along 0° of degree p: the 45° and 135° elements read U = p S0 2α/√2, which turns AoP by α/√2
        ({"angle_deg": 1.0}, (50.0, 25.0, 0.0), 0.5 * 2 * math.radians(1.0) / math.sqrt(2)),
        # and the 0° and 90° elements Q = p S0 (1 + δ/√2)
        ({"diattenuation": 0.02}, (50.0, 25.0, 0.0), 0.5 * 0.02 / math.sqrt(2)),
    ],
)
def test_what_a_spread_does_to_polarization_is_the_closed_form(spread, light, false_dolp):
    """RMS length of what is added to (Q, U)/S0, over a frame demosaicked as it lies."""
    keys = {"rows": 256, "columns": 256, "layout": "0-45-90-135", "demosaic": "superpixel", **NOISELESS}
    even = {"optics": {"relative_illumination": "even"}}
    sensor = sensor_of(polarizer_spread=spread, **keys, **even)
    found = expose(uniform(sensor, light), sensor, NONE_SERVED, np.random.default_rng(0))[
        "stokes_radiance"
    ].values
    added = (found[..., 1:] - np.array(light[1:])) / light[0]
    rms = float(np.sqrt((added.astype(float) ** 2).sum(axis=-1).mean()))
    of_16384_superpixels = 0.02
    assert rms == pytest.approx(false_dolp, rel=of_16384_superpixels, abs=1e-5)


# --- whole matrices --------------------------------------------------------------------------------


@pytest.fixture
def wave_plate_file(tmp_path):
    """Polarizers behind a retarder at 30° whose retardance rises over the band."""
    matrices = retarder_before(np.linspace(0.2, 1.0, len(GRID)), math.radians(30))
    path = tmp_path / "plate.nc"
    xr.Dataset(
        {"mueller_per_aperture": (("wavelength", "stokes_out", "stokes_in"), matrices)},
        coords={"wavelength": GRID},
    ).to_netcdf(path, engine="h5netcdf")
    return path


def test_a_full_matrix_reaches_the_frame(wave_plate_file):
    """Its row has a U about its own axis too; inverted as measured, any vector comes back."""
    design = {"polarizer": str(wave_plate_file), **NOISELESS}
    vector = (50.0, 20.0, -10.0)
    found = {way: seen(sensor_of(stokes=way, **design), vector) for way in ("measured", "fesenkov")}
    np.testing.assert_allclose(found["measured"], np.broadcast_to(vector, found["measured"].shape), atol=2e-3)
    sensor = sensor_of(**design)
    row = load_polarizer(sensor.design).analyser_row(GRID, 0.0)
    mean = sensor.pan_weights[0] @ row
    along = 2 * (mean[1] * vector[1] + mean[2] * vector[2])  # what rows turned by 0°, 60°, 120° share
    np.testing.assert_allclose(found["fesenkov"].mean(axis=(0, 1))[1], along, atol=2e-3)
    assert len(sensor.channels) == 3  # pan, and the shapes of the row's Q and U


@pytest.mark.parametrize("name", ["grid_z", "z" * 300])
def test_a_name_that_is_neither_a_model_nor_a_file_is_refused(name):
    with pytest.raises(
        ValueError, match=r"`sensor.polarizer` must be .* or a NetCDF file; got '(grid_z|zzz)"
    ):
        load_polarizer(plain_sensor(polarizer=name))


def test_a_polarizer_can_be_passed_in():
    polarizer = from_transmittances(ENDS, np.full(2, 0.8), np.full(2, 0.2))
    sensor = build_sensor(plain_sensor(rows=8, columns=8), GRID, polarizer)
    assert sensor.diattenuation == pytest.approx(0.6)


def test_matrices_over_incidence_are_read(wave_plate_file):
    with xr.open_dataset(wave_plate_file, engine="h5netcdf") as opened:
        table = opened.load()["mueller_per_aperture"]
    slanted = xr.concat([table, 0.5 * table], dim="incidence").assign_coords(incidence=[0.0, 0.4])
    polarizer = from_table(xr.Dataset({"mueller_per_aperture": slanted}))
    row = polarizer.analyser_row(GRID, 0.0)
    np.testing.assert_allclose(polarizer.analyser_row(GRID, 0.0, 0.2), 0.75 * row, atol=ROUNDING)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: m[:, :3, :3], r"mueller_per_aperture of 4 × 4 over wavelength"),
        (lambda m: 4 * m, r"must transmit 0 to 1.5 of light"),
        (lambda m: m * np.array([0.5, 1, 1, 1])[None, None], r"no less than nothing of any light"),
    ],
)
def test_matrices_that_no_polarizer_has_are_refused(wave_plate_file, change, message):
    with xr.open_dataset(wave_plate_file, engine="h5netcdf") as opened:
        table = opened.load()
    values = change(table["mueller_per_aperture"].values)
    bad = xr.Dataset(
        {"mueller_per_aperture": (("wavelength", "stokes_out", "stokes_in"), values)},
        coords={"wavelength": GRID},
    )
    with pytest.raises(ValueError, match=message):
        from_table(bad)


def test_chief_rays_beyond_the_table_are_refused():
    square = stokes.linear_diattenuator(1.0, 0.0)
    polarizer = Polarizer(ENDS, np.array([[square] * 2] * 2), np.array([0.0, 0.2]))
    wide = plain_sensor(
        rows=8,
        columns=8,
        layout="0-45-90-135",
        polarizer_incidence="chief_ray",
        focal_length_mm=1.0,
        pitch_um=100.0,
    )
    with pytest.raises(ValueError, match=r"largest angle of the chief rays, 2\d\.\d°; got 11\.5°"):
        departure_at_incidence(wide, polarizer, ENDS, np.ones(2))
