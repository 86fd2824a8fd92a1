"""The whole loop on scenes small enough to know the answer."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import xarray as xr

from glintrack import Case, simulate
from glintrack import simulate as package_function
from glintrack.scene import load_materials
from tests.conftest import box, plane, snapshot

ASPHALT_SPEED_M_S = 9.0


@dataclass(frozen=True)
class ThreeCars:
    """Three white boxes on level asphalt, driving east, north and west: what a run asks of a `City`."""

    materials: xr.Dataset
    extent_m: tuple = (-120.0, -90.0, 120.0, 90.0)
    crs: str = "EPSG:32618"
    origin_easting_m: float = 288000.0
    origin_northing_m: float = 4781000.0

    starts = np.array([[-80.0, -40.0], [30.0, -70.0], [80.0, 30.0]])
    headings = np.array([math.pi / 2, 0.0, 3 * math.pi / 2])

    @property
    def terrain(self):
        edge = np.array([-500.0, 500.0])
        return xr.Dataset(
            {"height": (("y", "x"), np.zeros((2, 2)), {"units": "m"})},
            coords={"y": ("y", -edge, {"units": "m"}), "x": ("x", edge, {"units": "m"})},
        )

    def position(self, t):
        direction = np.stack([np.sin(self.headings), np.cos(self.headings)], axis=1)
        return self.starts + ASPHALT_SPEED_M_S * t * direction, ASPHALT_SPEED_M_S * direction

    def at(self, t):
        names = self.materials.get_index("material")
        place, _ = self.position(t)
        transforms = [
            [[math.sin(h), -math.cos(h), 0, x], [math.cos(h), math.sin(h), 0, y], [0, 0, 1, 0]]
            for h, (x, y) in zip(self.headings, place, strict=True)
        ]
        ground = plane(3000, 0.0, names.get_loc("asphalt"))
        car = box(4.5, 1.8, 1.5, names.get_loc("panel_80"))
        return snapshot(ground, [car], transforms, [0, 0, 0], vehicle_id=[11, 22, 33])

    def truth(self, t):
        place, speed = self.position(t)
        columns = {
            "east": (place[:, 0], "m"),
            "north": (place[:, 1], "m"),
            "up": (np.zeros(3), "m"),
            "east_speed": (speed[:, 0], "m s-1"),
            "north_speed": (speed[:, 1], "m s-1"),
            "heading": (self.headings, "rad"),
            "length": (np.full(3, 4.5), "m"),
            "width": (np.full(3, 1.8), "m"),
            "height": (np.full(3, 1.5), "m"),
        }
        return xr.Dataset(
            {name: ("vehicle", values, {"units": units}) for name, (values, units) in columns.items()},
            coords={"vehicle": [11, 22, 33]},
        )


@pytest.fixture
def three_cars(monkeypatch):
    module = __import__("sys").modules["glintrack.simulate"]
    assert module.simulate is package_function
    monkeypatch.setattr(module, "build_scene", lambda design: ThreeCars(load_materials()))


def case(**changes):
    perfect = {"read_noise_e": 0.0, "full_well_e": 1e9, "integration_time_ms": 50.0, "bits": 24}
    design = {
        "name": "three cars",
        "modalities": ["pan"],
        "flight": {"declination_deg": 0.0, "altitude_m": 3000.0, "frames": 16, "rate_hz": 2.0},
        "sensor": {**perfect, "rows": 240, "columns": 320},
    }
    return Case.model_validate({**design, **changes})


def test_three_cars_and_a_perfect_sensor_are_tracked_completely_and_purely(three_cars):
    tree = simulate(case())
    start_up = 6  # frames in which background and confirmation settle: 3 s
    np.testing.assert_array_equal(tree["pan"]["completeness"].values[start_up:], 1.0)
    assert tree["pan"].attrs["purity"] == 1.0
    assert tree["pan"].attrs["identity_switches"] == 0
    np.testing.assert_array_equal(tree["pan"]["false_tracks"].values, 0)
    assert tree["pan"].attrs["position_rms_m"] < 1.5  # one superpixel


def test_spectra_are_asked_for_and_served(three_cars):
    tree = simulate(case())
    assert tree["pan"]["queries_served"].values[6:].min() >= 1
    assert (tree["pan"]["queries_served"] <= tree["pan"]["queries_asked"]).all()


def test_same_seed_same_result_and_another_seed_another_noise(three_cars):
    short = {"frames": 5, "declination_deg": 0.0, "altitude_m": 3000.0}
    first, again = simulate(case(flight=short)), simulate(case(flight=short))
    for path in ("pan", "pan/tracks", "truth"):
        xr.testing.assert_identical(first[path].to_dataset(), again[path].to_dataset())


def test_an_interrupt_keeps_the_frames_done(three_cars):
    def stop(epoch):
        if epoch.index == 3:
            raise KeyboardInterrupt

    tree = simulate(case(), stop)
    assert tree.attrs["interrupted"] == 1
    assert tree.attrs["frames_done"] == 3
    assert tree["pan"].sizes["time"] == 3
