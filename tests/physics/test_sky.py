"""The sky against what is known of it from outside the program."""

import numpy as np
import pytest
import sasktran2 as sk

from glintrack.atmosphere import AtmosphereDesign
from glintrack.atmosphere.assemble import build_medium
from glintrack.atmosphere.gas import LEVELS_M, column_weights, exponential_profile, slant_weights
from glintrack.atmosphere.solve import MOMENTS, Directions, Medium, Particles, solve_fields, solve_ground
from tests.oracles import rayleigh_adding_doubling

HEIGHT = np.array(LEVELS_M, dtype=float)
DEGREE = np.pi / 180
SPHERICAL_AGAINST_PLANE = 0.01  # of I, to 70° from the zenith


def rayleigh_medium(optical_depth):
    """Low-lying Rayleigh scatterers without depolarization, so that the sphere is nearly plane."""
    moments = np.zeros((1, 4, MOMENTS))
    moments[0, 0, 0] = 1.0
    moments[0, 0, 2], moments[0, 1, 2], moments[0, 3, 2] = 0.5, 3.0, np.sqrt(6) / 2
    profile = column_weights(exponential_profile(HEIGHT, 2000.0), HEIGHT)[:, None]
    particles = {"air": Particles(optical_depth * profile, np.ones(1), moments)}
    return Medium(HEIGHT, np.array([0.55]), False, particles, 0.0 * profile)


def sky(optical_depth, mu0, albedo, zenith, azimuth):
    """(zenith, azimuth, 3) light from the sky for a solar flux of π, azimuth clockwise from the sun."""
    directions = Directions(mu0, zenith, np.zeros(1), azimuth, np.array([3000.0]))
    return np.pi * solve_fields(rayleigh_medium(optical_depth), directions, albedo, 16).sky[0]


@pytest.mark.parametrize("optical_depth", [0.1, 0.25])
def test_sky_against_adding_doubling(optical_depth):
    rng = np.random.default_rng(2010)
    mu = np.sort(rng.uniform(np.cos(70 * DEGREE), 0.999, 6))
    azimuth = np.sort(rng.uniform(0, 180, 6)) * DEGREE
    mu0, albedo = 0.8, 0.25
    ours = sky(optical_depth, mu0, albedo, np.arccos(mu), azimuth)
    # oracle: direction of travel counter-clockwise from the beam; ours: look, clockwise from the sun
    _, down = rayleigh_adding_doubling.rayleigh(optical_depth, mu0, albedo, mu, -azimuth / DEGREE)
    theirs = np.array([[down[(m, p)] for p in -azimuth / DEGREE] for m in mu])
    assert abs(ours[..., 0] / theirs[..., 0] - 1).max() < SPHERICAL_AGAINST_PLANE
    ratio = ours[..., 1:] / ours[..., :1] - theirs[..., 1:] / theirs[..., :1]
    assert abs(ratio).max() < 0.005


def test_physics_table_of_the_sky():
    """Two rows of the same oracle, written down: τ 0.25, μ0 0.8, albedo 0.25."""
    zenith, azimuth = np.arccos([0.64, 0.92]), np.array([90, 180]) * DEGREE
    ours = sky(0.25, 0.8, 0.25, zenith, azimuth)
    # travel φ = 180° is looking away from the sun; U at travel φ = 90° counter-clockwise is look 90°
    # clockwise mirrored
    np.testing.assert_allclose(ours[0, 1], [0.103476, -0.062237, 0.0], rtol=0.01, atol=1e-5)
    np.testing.assert_allclose(ours[1, 0], [0.101535, 0.012196, -0.018436], rtol=0.01, atol=1e-5)


def test_optical_depth_of_air():
    """Bucholtz/Hansen–Travis values at sea level."""
    config = sk.Config()
    geometry = sk.Geometry1D(0.6, 0, 6.371e6, HEIGHT, sk.InterpolationMethod.LinearInterpolation)
    air = sk.Atmosphere(
        geometry,
        config,
        calculate_derivatives=False,
        wavelengths_nm=np.array([400.0, 450.0, 550.0, 860.0, 1650.0]),
    )
    sk.climatology.us76.add_us76_standard_atmosphere(air)
    air["air"] = sk.constituent.Rayleigh()
    rays = sk.ViewingGeometry()
    rays.add_ray(sk.GroundViewingSolar(0.6, 0.0, 0.9, 1e5))
    sk.Engine(config, geometry, rays).calculate_radiance(air)
    depth = slant_weights(1.0, HEIGHT) @ air.unscaled_extinction
    np.testing.assert_allclose(depth, [0.36196, 0.22218, 0.09762, 0.01597, 0.00117], rtol=0.01)


@pytest.mark.parametrize("sun_zenith_deg", [30, 60])
def test_polarization_peaks_at_right_angles_to_the_sun(sun_zenith_deg):
    zenith = np.radians(np.arange(0, 88, 1.0))
    in_plane = sky(0.1, np.cos(sun_zenith_deg * DEGREE), 0.0, zenith, np.array([0.0, np.pi]))
    line = np.concatenate([in_plane[::-1, 0], in_plane[:, 1]])
    elongation = np.abs(np.r_[np.degrees(zenith[::-1]), -np.degrees(zenith)] - sun_zenith_deg)
    dolp = np.hypot(line[:, 1], line[:, 2]) / line[:, 0]
    assert abs(elongation[np.argmax(dolp)] - 90) <= 2
    assert 0.8 < dolp.max() < 1


def test_symmetry_about_the_suns_vertical_plane():
    zenith, azimuth = np.radians([10.0, 40.0, 80.0]), np.radians([0.0, 50.0, 180.0, 310.0])
    light = sky(0.25, 0.6, 0.2, zenith, azimuth)
    scale = light[..., 0].max()
    assert abs(light[:, [0, 2], 2]).max() < 1e-6 * scale  # principal plane: U = 0
    np.testing.assert_allclose(light[:, 3, :2], light[:, 1, :2], rtol=1e-6)
    np.testing.assert_allclose(light[:, 3, 2], -light[:, 1, 2], rtol=1e-6)


def test_signs_by_a_low_sun():
    """Light of a Rayleigh sky at 90° from the sun is polarized across the plane of sun and look."""
    light = sky(0.05, np.cos(80 * DEGREE), 0.0, np.radians([0.0, 80.0]), np.radians([0.0, 90.0, 270.0]))
    overhead_along_sun, overhead_across = light[0, 0], light[0, 1]
    assert overhead_along_sun[1] < -0.6 * overhead_along_sun[0]  # zenith, meridian toward the sun: across it
    assert overhead_across[1] > 0.6 * overhead_across[0]
    right, left = light[1, 1], light[1, 2]  # horizon to the right (clockwise) and left of the sun
    assert right[1] > 0.6 * right[0]  # vertical
    # looking with the sun 10° up at one's left, the scattering plane rises to the left, so the vector across
    # it leans clockwise: U < 0; with the sun at the right the other way
    assert right[2] < 0 < left[2]


def test_light_is_conserved():
    """Sun and sky over level ground are the flux that the solver itself reports."""
    mu0, optical_depth, albedo = 0.7, 0.25, 0.2
    zenith, azimuth = np.radians(np.arange(0, 89.5, 1.0)), np.radians(np.arange(0, 181, 5.0))
    directions = Directions(mu0, zenith, np.zeros(1), azimuth, np.array([3000.0]))
    fields = solve_fields(rayleigh_medium(optical_depth), directions, albedo, 16)
    intensity = fields.sky[0, :, :, 0]
    rings = 2 * np.trapezoid(intensity, azimuth, axis=1)
    diffuse = np.trapezoid(rings * np.sin(zenith) * np.cos(zenith), zenith)
    direct = mu0 * np.exp(-slant_weights(mu0, HEIGHT) @ fields.scattering_extinction[:, 0])
    reported = _reported_flux(rayleigh_medium(optical_depth), mu0, albedo)
    assert diffuse + direct == pytest.approx(reported, rel=0.005)
    ground = solve_ground(rayleigh_medium(optical_depth), directions)
    assert ground.irradiance(albedo)[0] == pytest.approx(reported, rel=0.005)


def _reported_flux(medium, mu0, albedo):
    """Flux on the ground of sasktran2's own flux observer, plane atmosphere.

    By what the ground returns: its downward flux (of 2026.10) moves by 3 % with the layering, its upward flux
    by 1e-7.
    """
    config = sk.Config()
    config.num_stokes, config.num_streams, config.num_singlescatter_moments = 3, 16, MOMENTS
    config.multiple_scatter_source = sk.MultipleScatterSource.DiscreteOrdinates
    config.single_scatter_source = sk.SingleScatterSource.DiscreteOrdinates
    config.flux_types = [sk.FluxType.Upwelling]
    config.log_level = sk.LogLevel.Off
    linear, plane = sk.InterpolationMethod.LinearInterpolation, sk.GeometryType.PlaneParallel
    geometry = sk.Geometry1D(mu0, 0, 6.371e6, HEIGHT, linear, plane)
    rays = sk.ViewingGeometry()
    rays.add_flux_observer(sk.FluxObserverSolar(mu0, 0.0))
    air = sk.Atmosphere(geometry, config, numwavel=1, calculate_derivatives=False)
    air.storage.total_extinction[:] = medium.particles["air"].extinction
    air.storage.ssa[:] = 1.0
    coefficients = air.leg_coeff
    assert coefficients.a2 is not None and coefficients.b1 is not None
    coefficients.a1[0], coefficients.a1[2] = 1.0, 0.5
    coefficients.a2[2], coefficients.b1[2] = 3.0, np.sqrt(6) / 2
    air.surface.albedo[:] = albedo
    return sk.Engine(config, geometry, rays).calculate_radiance(air)["upwelling_flux"].item() / albedo


def test_neutral_points_lie_above_and_below_the_sun():
    """Babinet's and Brewster's points: multiple scattering turns the polarization near the sun around."""
    sun_deg, degrees = 45.0, np.arange(5.0, 85.0, 1.0)
    line = sky(0.25, np.cos(sun_deg * DEGREE), 0.2, np.radians(degrees), np.zeros(1))[:, 0]
    crossings = degrees[:-1][np.diff(np.sign(line[:, 1])) != 0]
    assert len(crossings) == 2
    # 10° to 25° from the sun in the literature (Coulson 1988, ch. 5), both sides of it
    assert 5 < sun_deg - crossings[0] < 30
    assert 5 < crossings[1] - sun_deg < 30


def test_haze_lowers_the_peak_of_polarization():
    peaks = []
    zenith, azimuth = np.radians(np.arange(0, 85, 5.0)), np.array([0.0, np.pi])
    for aerosol in ("none", "clear", "urban"):
        design = AtmosphereDesign(
            aerosol=aerosol, sun_zenith_deg=60, sun_azimuth_deg=0, wavelengths_um=(0.55,)
        )
        directions = Directions(0.5, zenith, np.zeros(1), azimuth, np.array([3000.0]))
        light = solve_fields(build_medium(design, 0.5), directions, 0.15, 16).sky[0]
        peaks.append((np.hypot(light[..., 1], light[..., 2]) / light[..., 0]).max())
    assert 0.7 < peaks[0] < 0.9  # air alone over grey ground
    assert peaks[0] > peaks[1] > peaks[2]
