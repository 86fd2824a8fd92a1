"""Heights of what stands still, and what they hide in the loop's images."""

import numpy as np
import pytest
import xarray as xr

from glintrack import simulate
from glintrack.camera import Pose, look_at
from glintrack.ortho import occlusion_mask
from glintrack.render import Observer, build_tracer, surface_model
from glintrack.scene import Mesh
from tests.conftest import box, plane, snapshot
from tests.system.test_loop import case

ROOF_M, AREA = 20.0, (-60.0, -60.0, 60.0, 60.0)


def house_and_car():
    ground, house = plane(400.0), box(30.0, 10.0, ROOF_M)
    vertices = np.concatenate([ground.vertices, house.vertices])
    faces = np.concatenate([ground.faces, house.faces + len(ground.vertices)])
    static = Mesh(vertices, faces, np.concatenate([ground.material, house.material]))
    at = [[[1, 0, 0, 40.0], [0, 1, 0, 40.0], [0, 0, 1, 0]]]
    return snapshot(static, [box(4.5, 1.8, 1.5)], at, [0])


def test_roofs_stand_and_cars_do_not():
    scene = house_and_car()
    surface = surface_model(build_tracer(scene), scene, AREA, 1.0)
    x, y = np.meshgrid(surface["x"], surface["y"])
    roof = (np.abs(x) < 15) & (np.abs(y) < 5)
    np.testing.assert_allclose(surface["height"], np.where(roof, ROOF_M, 0.0), atol=1e-3)
    with pytest.raises(ValueError, match="`area_m` must hold two cells"):
        surface_model(build_tracer(scene), scene, AREA, 100.0)


def test_what_the_roof_hides_is_the_strip_behind_it():
    """From the south at 45°: as deep as the roof is high."""
    scene = house_and_car()
    surface = surface_model(build_tracer(scene), scene, AREA, 1.0)
    far = 5000.0
    pose = look_at(Pose(0.0, -far, far), (0.0, 0.0, 0.0))
    north = np.arange(-40.0, 40.0, 0.5)[:, None]
    dark = occlusion_mask(surface, pose, np.zeros_like(north), north, np.zeros_like(north))[:, 0]
    behind = north[dark & (north[:, 0] > 5), 0]
    assert behind.max() == pytest.approx(5 + ROOF_M, abs=1.5)  # a cell, and the clearance
    assert not dark[north[:, 0] < -6].any()


def test_the_loop_leaves_out_what_roofs_hide(three_cars, monkeypatch):
    """Cars are no part of the surface model: over open ground its images are the same."""
    flight = {"off_nadir_deg": 50.0, "altitude_m": 3000.0, "frames": 1, "rate_hz": 2.0}
    sensor = {"rows": 60, "columns": 80, "pitch_um": 60.0}

    def images(surface):
        kept = []
        run = case(flight=flight, sensor=sensor, ortho={"surface": surface, "gsd_m": 4.0})
        simulate(run, lambda epoch: kept.append(epoch.image))
        return kept

    for plain, masked in zip(images("terrain"), images("surface"), strict=True):
        assert int(masked["occluded"].sum()) == 0 and "occluded" not in plain
        xr.testing.assert_identical(masked.drop_vars("occluded"), plain)

    tall = xr.Dataset(
        {"height": (("y", "x"), np.full((2, 2), 0.0), {"units": "m"})},
        coords={"y": ("y", [90.0, -90.0], {"units": "m"}), "x": ("x", [-120.0, 120.0], {"units": "m"})},
    )
    wall = tall.interp(x=np.arange(-118.0, 119, 4), y=np.arange(88.0, -89, -4))
    wall["height"][:, 29:31] = 30.0
    for name in "xy":
        wall[name].attrs["units"] = "m"
    wall["height"].attrs["units"] = "m"
    monkeypatch.setattr(Observer, "surface_model", lambda *arguments: wall)
    for masked in images("surface"):
        dark = masked["occluded"].values == 1
        assert 0.01 < dark.mean() < 0.5
        assert np.isnan(masked["pan"].values[dark]).all() and np.isfinite(masked["pan"].values[~dark]).any()
