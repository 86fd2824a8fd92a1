"""Small scenes and skies with known answers."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
import xarray as xr

from glintrack.camera import Camera, Pose
from glintrack.case import build as scenario
from glintrack.scene import Mesh, Snapshot, load_materials


def plane(size_m=2000.0, height_m=0.0, material=0):
    """A level square facing up."""
    h = size_m / 2
    vertices = np.array(
        [[-h, -h, height_m], [h, -h, height_m], [h, h, height_m], [-h, h, height_m]], np.float32
    )
    return Mesh(vertices, np.array([[0, 1, 2], [0, 2, 3]], np.int32), np.full(2, material, np.int16))


def box(length_m, width_m, height_m, material=1):
    """A closed box on the ground, x forward, outward faces."""
    x, y = length_m / 2, width_m / 2
    v = np.array([[i, j, k] for k in (0, height_m) for j in (-y, y) for i in (-x, x)], np.float32)
    quads = [(0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (2, 6, 7, 3), (0, 4, 6, 2), (1, 3, 7, 5)]
    faces = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))], np.int32)
    return Mesh(v, faces, np.full(len(faces), material, np.int16))


def snapshot(static, models=(), transforms=(), model=(), vehicle_id=None):
    """A scene at one instant."""
    count = len(model)
    return Snapshot(
        static,
        tuple(models),
        np.asarray(transforms, float).reshape(count, 3, 4),
        np.asarray(model, int),
        np.zeros(count, np.int16),
        np.arange(count) if vehicle_id is None else np.asarray(vehicle_id),
    )


def materials(*rows):
    """Materials given as (reflectance, n, k, roughness, specular_weight)."""
    wavelength = np.array([0.4, 2.5])
    table = np.array(rows, float)

    def column(i):
        return ("material", table[:, i], {"units": "1"})

    def spectrum(values):
        return (("material", "wavelength"), np.repeat(values, 2, axis=1), {"units": "1"})

    return xr.Dataset(
        {
            "reflectance": spectrum(table[:, :1]),
            "transmittance": spectrum(0 * table[:, :1]),
            "refractive_index_spectrum": spectrum(table[:, 1:2]),
            "extinction_index_spectrum": spectrum(table[:, 2:3]),
            "refractive_index": column(1),
            "extinction_index": column(2),
            "roughness": column(3),
            "specular_weight": column(4),
            "mottle": ("material", np.zeros(len(table)), {"units": "1"}),
        },
        coords={
            "material": [f"m{i}" for i in range(len(table))],
            "wavelength": ("wavelength", wavelength, {"units": "um"}),
        },
    )


def flat_sky(
    sun_zenith_deg=45.0,
    sun_azimuth_deg=180.0,
    sun=0.0,
    sky_radiance=0.0,
    path=0.0,
    transmittance=1.0,
    stokes=lambda zenith, azimuth: (1.0, 0.0, 0.0),
):
    """Atmosphere tables of a grey sky whose (I, Q, U)/I in `meridian` is ``stokes(zenith, azimuth)``."""
    wavelength = np.linspace(0.4, 1.0, 7)
    zenith = np.linspace(0, math.pi / 2, 46)
    azimuth = np.linspace(0, 2 * math.pi, 90, endpoint=False)
    view = np.linspace(0, math.radians(85), 18)
    altitude = np.array([500.0, 20000.0])
    sky_map = np.array([[[np.array(stokes(z, a)) for a in azimuth] for z in zenith]])
    path_map = np.zeros((1, 2, len(view), len(azimuth), 3))
    path_map[..., 0] = 1
    ones = np.ones(len(wavelength))
    radiance = {"units": "W m-2 sr-1 um-1"}
    irradiance = {"units": "W m-2 um-1"}
    shape = {"units": "1", "stokes_frame": "meridian"}
    return xr.Dataset(
        {
            "sun_irradiance": ("wavelength", sun * ones, irradiance),
            "sky_irradiance": ("wavelength", math.pi * sky_radiance * ones, irradiance),
            "spherical_albedo": ("wavelength", 0 * ones, {"units": "1"}),
            "transmittance": (
                ("wavelength", "altitude", "view_zenith"),
                np.full((7, 2, 18), transmittance),
                {"units": "1"},
            ),
            "sky_spectrum": (("sky_component", "wavelength"), sky_radiance * ones[None], radiance),
            "sky_map": (("sky_component", "zenith", "azimuth", "stokes"), sky_map, shape),
            "path_spectrum": (("path_component", "wavelength"), path * ones[None], radiance),
            "path_gas": (("altitude", "wavelength"), np.ones((2, 7)), {"units": "1"}),
            "path_map": (
                ("path_component", "altitude", "view_zenith", "azimuth", "stokes"),
                path_map,
                shape,
            ),
        },
        coords={
            "wavelength": ("wavelength", wavelength, {"units": "um"}),
            "zenith": ("zenith", zenith, {"units": "rad"}),
            "azimuth": ("azimuth", azimuth, {"units": "rad"}),
            "view_zenith": ("view_zenith", view, {"units": "rad"}),
            "altitude": ("altitude", altitude, {"units": "m"}),
            "stokes": ["I", "Q", "U"],
        },
        attrs={
            "sun_zenith_rad": math.radians(sun_zenith_deg),
            "sun_azimuth_rad": math.radians(sun_azimuth_deg),
        },
    )


def nadir(up_m=1000.0, **angles):
    """A true pose over the origin."""
    return Pose(0.0, 0.0, up_m, **angles)


def small_camera(rows=21, columns=21, fov_m=100.0, range_m=1000.0):
    """A camera whose frame covers about ``fov_m`` at ``range_m``."""
    pitch = 10e-6
    return Camera(pitch * columns * range_m / fov_m, pitch, rows, columns)


ASPHALT_SPEED_M_S = 9.0


@dataclass(frozen=True)
class ThreeCars:
    """Three white boxes on level asphalt, driving east, north and west: what a run asks of a `City`."""

    materials: xr.Dataset
    extent_m: tuple = (-120.0, -90.0, 120.0, 90.0)
    crs: str = "EPSG:32618"
    origin_easting_m: float = 288000.0
    origin_northing_m: float = 4781000.0
    origin_height_m: float = 0.0
    latitude_deg: float = 43.16
    longitude_deg: float = -77.61
    duration_s: float = 3600.0

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
        names = [str(name) for name in self.materials["material"].values]
        place, _ = self.position(t)
        transforms = [
            [[math.sin(h), -math.cos(h), 0, x], [math.cos(h), math.sin(h), 0, y], [0, 0, 1, 0]]
            for h, (x, y) in zip(self.headings, place, strict=True)
        ]
        ground = plane(3000, 0.0, names.index("asphalt"))
        car = box(4.5, 1.8, 1.5, names.index("panel_80"))
        return snapshot(ground, [car], transforms, [0, 0, 0], vehicle_id=[11, 22, 33])

    def truth(self, t):
        place, speed = self.position(t)
        columns = {
            "east_m": (place[:, 0], "m"),
            "north_m": (place[:, 1], "m"),
            "up_m": (np.zeros(3), "m"),
            "east_speed_m_s": (speed[:, 0], "m s-1"),
            "north_speed_m_s": (speed[:, 1], "m s-1"),
            "heading_rad": (self.headings, "rad"),
            "length_m": (np.full(3, 4.5), "m"),
            "width_m": (np.full(3, 1.8), "m"),
            "height_m": (np.full(3, 1.5), "m"),
        }
        return xr.Dataset(
            {name: ("vehicle", values, {"units": units}) for name, (values, units) in columns.items()},
            coords={"vehicle": [11, 22, 33]},
        )


@pytest.fixture
def three_cars(monkeypatch):
    """Put the three cars in place of whatever city a case names."""
    put_three_cars(monkeypatch)


def put_three_cars(monkeypatch):
    """Let every case have the three cars."""
    monkeypatch.setattr(scenario, "build_scene", lambda design: ThreeCars(load_materials()))
