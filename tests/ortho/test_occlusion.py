"""What a box hides from an oblique camera, by its shadow's closed form."""

import math

import numpy as np
import pytest
import xarray as xr

from glintrack.camera import Camera, Pose, look_at
from glintrack.ortho import occlusion_mask, orthorectify
from tests.ortho.frames import frame_of, level, plain_stokes

STEP_M = 0.5
ROOF_M = 20.0
FAR_M = 1e6  # so far that every line of sight has one direction


def boxed(height_m=ROOF_M):
    """Level ground with a box over 10 m < east < 30 m, −15 m < north < 15 m."""
    x, y = np.arange(-100, 100.1, STEP_M), np.arange(60, -60.1, -STEP_M)
    roof = (x > 10) & (x < 30) & (np.abs(y[:, None]) < 15)
    metres = {"units": "m"}
    return xr.Dataset(
        {"height": (("y", "x"), np.where(roof, height_m, 0.0), metres)},
        coords={"y": ("y", y, metres), "x": ("x", x, metres)},
    )


def grid():
    return np.meshgrid(np.arange(-90.25, 90, 0.5), np.arange(30.25, -30, -0.5))


def seen_from(off_nadir_deg, azimuth_deg=90.0):
    """A pose far off, its azimuth as seen from the origin."""
    angle, azimuth = math.radians(off_nadir_deg), math.radians(azimuth_deg)
    across = FAR_M * math.sin(angle)
    return Pose(across * math.sin(azimuth), across * math.cos(azimuth), FAR_M * math.cos(angle))


@pytest.mark.parametrize("off_nadir_deg", [20, 50, 70])
def test_a_box_hides_a_strip_behind_it_as_long_as_its_height_times_the_tangent(off_nadir_deg):
    east, north = grid()
    dark = occlusion_mask(
        boxed(), seen_from(off_nadir_deg), east, north, np.zeros_like(east), clearance_m=0.0
    )
    length = ROOF_M * math.tan(math.radians(off_nadir_deg))
    expected = (east > 10 - length) & (east < 30) & (np.abs(north) < 15)
    # the sampled wall leans over one cell, and north-south edges likewise
    edge_m = 1.5 * STEP_M
    near = (
        (np.abs(east - (10 - length)) < edge_m)
        | (np.abs(east - 30) < edge_m)
        | (np.abs(np.abs(north) - 15) < edge_m)
    )
    np.testing.assert_array_equal(dark[~near], expected[~near])


def test_from_straight_above_only_the_ground_under_the_roof_is_hidden():
    east, north = grid()
    dark = occlusion_mask(boxed(), Pose(0, 0, FAR_M), east, north, np.zeros_like(east), clearance_m=0.0)
    inside = (east > 10.5) & (east < 29.5) & (np.abs(north) < 14.5)
    outside = (east < 9.5) | (east > 30.5) | (np.abs(north) > 15.5)
    assert dark[inside].all() and not dark[outside].any()


def test_roofs_rectified_onto_the_surface_model_are_seen():
    east, north = grid()
    surface = boxed()
    height = (
        surface["height"].interp(x=("p", east.ravel()), y=("p", north.ravel())).values.reshape(east.shape)
    )
    dark = occlusion_mask(surface, seen_from(50), east, north, height)
    roof = (east > 11) & (east < 29) & (np.abs(north) < 14)
    behind = (east > -10) & (east < 9) & (np.abs(north) < 14)
    assert not dark[roof].any() and dark[behind].all()


def test_level_ground_hides_nothing_and_ground_over_the_lens_is_hidden():
    east, north = grid()
    assert not occlusion_mask(boxed(0.0), seen_from(70), east, north, np.zeros_like(east)).any()
    assert occlusion_mask(boxed(), Pose(0, 0, 100), east, north, np.full_like(east, 200.0)).all()


def test_orthorectify_flags_and_masks_what_is_hidden():
    camera = Camera(0.068, 17e-6, 240, 320)
    pose = look_at(Pose(2298.0, 0, 1928.0, kind="reported"), (0, 0, 0))
    ones = np.ones((120, 160))
    area = (-60.0, -45.0, 60.0, 45.0)
    image = orthorectify(
        frame_of(ones, plain_stokes(ones)), camera, pose, level(), 1.5, area, surface=boxed()
    )
    dark = image["occluded"].values == 1
    assert 0.02 < dark.mean() < 0.3
    for name in ("pan", "stokes_radiance", "dolp"):
        values = image[name].values.reshape(*dark.shape, -1)[..., 0]
        np.testing.assert_array_equal(np.isnan(values), dark)


def test_uneven_surfaces_are_refused():
    east, north = grid()
    uneven = boxed().isel(x=[0, 1, 5])
    with pytest.raises(ValueError, match="evenly spaced"):
        occlusion_mask(uneven, seen_from(50), east, north, np.zeros_like(east))
