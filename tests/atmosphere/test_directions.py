import numpy as np
import pytest
import xarray as xr

from glintrack import stokes
from glintrack.atmosphere import path_stokes, sky_stokes
from glintrack.atmosphere.directions import to_fixed_azimuth_frame

AZIMUTH = np.radians(np.arange(2.5, 360, 5.0))
ZENITH = np.radians(np.arange(0, 88, 3.0))
# Q and U turn by twice the azimuth in the fixed frame, curvature 4: 4·0.7·(5°)²/8, and 3° rows add a fifth
BILINEAR = 3.3e-3


def look(zenith, azimuth, down=False):
    """Unit direction of look (east, north, up)."""
    up = -np.cos(zenith) if down else np.cos(zenith)
    zero = np.zeros(np.broadcast(zenith, azimuth).shape)
    return np.stack([np.sin(zenith) * np.sin(azimuth), np.sin(zenith) * np.cos(azimuth), up + zero], axis=-1)


def smooth_light(direction):
    """Single Rayleigh scattering of a sun at 50° zenith, 70° azimuth: smooth everywhere, the poles too."""
    sun = look(np.radians(50), np.radians(70))
    travel = -direction
    cosine = direction @ sun
    normal = np.cross(sun, direction)  # polarized across the plane of sun and look
    up = np.array([0.0, 0.0, 1.0])
    polarized = 0.7 * (1 - cosine**2)
    intensity = 1 + 0.3 * cosine**2
    across = np.stack([intensity, polarized, np.zeros_like(cosine)], axis=-1)
    angle = stokes.frame_angle(normal, np.broadcast_to(up, direction.shape), travel)
    return stokes.rotate(across, angle)  # into `meridian`: the reference is the vertical


def tables():
    zenith, azimuth = np.meshgrid(ZENITH, AZIMUTH, indexing="ij")
    pole = np.maximum(zenith, 1e-4)  # the meridian of the pole itself has no meaning but its limit has
    sky = smooth_light(look(pole, azimuth))[None]
    path = smooth_light(look(pole, azimuth, down=True))[None, None]
    return xr.Dataset(
        {
            "sky_map": (("sky_component", "zenith", "azimuth", "stokes"), sky),
            "sky_spectrum": (("sky_component", "wavelength"), np.ones((1, 1))),
            "path_map": (("path_component", "altitude", "view_zenith", "azimuth", "stokes"), path),
            "path_spectrum": (("path_component", "wavelength"), np.ones((1, 1))),
            "path_gas": (("altitude", "wavelength"), np.ones((1, 1))),
        },
        coords={"zenith": ZENITH, "view_zenith": ZENITH, "azimuth": AZIMUTH, "altitude": [3000.0]},
    )


@pytest.mark.parametrize("down", [False, True])
def test_smooth_field_is_met_everywhere_and_across_the_pole(down):
    rng = np.random.default_rng(3)
    zenith = np.r_[rng.uniform(0, np.radians(85), 200), np.radians([0.05, 0.5, 1.0, 1.5, 2.0] * 8)]
    azimuth = rng.uniform(0, 2 * np.pi, zenith.size)
    got = (path_stokes(tables(), 3000.0, zenith, azimuth) if down else sky_stokes(tables(), zenith, azimuth))[
        :, 0
    ]
    np.testing.assert_allclose(got, smooth_light(look(zenith, azimuth, down)), atol=BILINEAR)


def test_walking_over_the_zenith_nothing_jumps():
    step = np.radians(0.2)
    tilt = np.arange(-np.radians(5), np.radians(5), step)
    zenith, azimuth = abs(tilt), np.where(tilt < 0, np.radians(37), np.radians(217))
    light = sky_stokes(tables(), zenith, azimuth)[:, 0]
    # over the pole the meridian's azimuth turns by 180°, which leaves Q and U as they are
    assert abs(np.diff(light, axis=0)).max() < 4 * step


@pytest.mark.parametrize("looking", ["up", "down"])
def test_fixed_frame_is_one_vector_at_the_pole(looking):
    zenith = np.full_like(AZIMUTH, 1e-5)
    field = smooth_light(look(zenith, AZIMUTH, looking == "down"))
    fixed = to_fixed_azimuth_frame(field, AZIMUTH, looking)
    assert np.ptp(field[:, 1]) > 0.1
    assert abs(np.ptp(fixed, axis=0)).max() < 1e-4
    np.testing.assert_allclose(to_fixed_azimuth_frame(fixed, AZIMUTH, looking, -1.0), field, atol=1e-12)


def test_fixed_axis_at_the_pole_is_north():
    """Looking straight up (down) at light polarized north–south: Q' = I in the fixed frame."""
    for looking, down in (("up", False), ("down", True)):
        north = np.array([0.0, 1.0, 0.0])
        direction = look(np.full_like(AZIMUTH, 1e-6), AZIMUTH, down)
        vertical = np.broadcast_to([0.0, 0.0, 1.0], direction.shape)
        to_meridian = stokes.frame_angle(np.broadcast_to(north, direction.shape), vertical, -direction)
        meridian = stokes.rotate(np.array([1.0, 1.0, 0.0]), to_meridian)
        fixed = to_fixed_azimuth_frame(meridian, AZIMUTH, looking)
        np.testing.assert_allclose(fixed, np.tile([1.0, 1.0, 0.0], (AZIMUTH.size, 1)), atol=1e-5)


def test_one_direction_is_one_row_of_many():
    zenith, azimuth = np.radians([10.0, 60.0]), np.radians([350.0, 1.0])
    many = sky_stokes(tables(), zenith, azimuth)
    np.testing.assert_array_equal(many[1], sky_stokes(tables(), zenith[1], azimuth[1]))


def test_out_of_range_is_named():
    with pytest.raises(ValueError, match=r"`view_zenith_rad` must lie within 0 to 1.5"):
        path_stokes(tables(), 3000.0, 1.56, 0.0)
    with pytest.raises(ValueError, match="`altitude_m` must lie within 3000 to 3000; got 100"):
        path_stokes(tables(), 100.0, 0.1, 0.0)
    with pytest.raises(ValueError, match="`looking` must be 'up' or 'down'"):
        to_fixed_azimuth_frame(np.ones(3), np.zeros(()), "sideways")
