"""A picture of a scene in natural colour: from above, from the side, or from the street."""

import math
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from jaxtyping import Float

from glintrack.atmosphere import AtmosphereDesign, solve_tables
from glintrack.camera import Camera, Pose, look_at
from glintrack.core.arrays import Array
from glintrack.core.colour import colour_channels, natural_colour
from glintrack.render.light.sky import unpack_sky
from glintrack.render.observer import Observer
from glintrack.scene import City

View = Literal["plan", "oblique", "street"]
_PITCH_M = 10e-6
_PLAN_RANGE_M = 8000.0  # far above, so that walls hardly show
_OBLIQUE_DEPRESSION_RAD = math.radians(38)
_EYE_BEHIND_M, _EYE_UP_M = 11.0, 3.2  # street: behind and above a vehicle
_LOWEST_GROUND_M = -2.0  # rays start above ENU zero


@dataclass(frozen=True)
class Preview:
    """A picture of a city, with its camera.

    Parameters
    ----------
    picture
        sRGB, 0 to 1. White-balanced, in the light of the default atmosphere, without path radiance.
    camera, pose
        Camera and pose of the picture.
    sun_direction
        Unit vector toward the sun, ENU.
    """

    picture: Float[Array, "y x 3"]
    camera: Camera
    pose: Pose
    sun_direction: Float[Array, " 3"]


def preview(city: City, view: View = "oblique", columns: int = 1600, time_s: float = 30.0) -> Preview:
    """Render a city in natural colour.

    Parameters
    ----------
    city
        The city.
    view
        ``plan`` from straight above, ``oblique`` from the south-west, ``street`` from behind a vehicle.
    columns
        Width of the picture. [pixel]
    time_s
        Time of the case, at most its traffic's. [s]
    """
    time_s = min(time_s, city.duration_s)
    camera, pose = _camera(city, view, columns, time_s)
    sky = unpack_sky(solve_tables(AtmosphereDesign()), 2000.0)
    no_path, clear = np.zeros_like(sky.path_spectrum), np.ones_like(sky.transmittance)
    sky = replace(sky, path_spectrum=no_path, transmittance=clear)
    now = city.at(time_s)
    observer = Observer(city, sky, camera, now, oversampling=2)
    channels = colour_channels(sky.wavelength_um)
    light = observer.radiance(observer.trace(now, pose))
    picture = natural_colour(light(channels).values[..., 0], observer.white(channels))
    return Preview(picture, camera, pose, sky.sun_direction)


def _camera(city: City, view: View, columns: int, time_s: float) -> tuple[Camera, Pose]:
    west, south, east, north = city.extent_m
    wide, high = east - west, north - south
    middle = np.array([(west + east) / 2, (south + north) / 2, 0.0])
    if view == "plan":
        rows = max(round(columns * high / wide), 16)
        camera = Camera(_PITCH_M * columns * _PLAN_RANGE_M / wide, _PITCH_M, rows, columns)
        return camera, Pose(float(middle[0]), float(middle[1]), _PLAN_RANGE_M)
    camera = Camera(_PITCH_M * columns * 1.1, _PITCH_M, round(columns * 0.5625), columns)
    if view == "oblique":
        away = 0.62 * math.hypot(wide, high) + 150.0
        azimuth = math.radians(200)
        flat, up = away * math.cos(_OBLIQUE_DEPRESSION_RAD), away * math.sin(_OBLIQUE_DEPRESSION_RAD)
        eye = middle + [flat * math.sin(azimuth), flat * math.cos(azimuth), up]
        return camera, look_at(Pose(*eye.tolist()), middle)
    return camera, _behind_a_vehicle(city, middle, time_s)


def _behind_a_vehicle(city: City, middle: Array, time_s: float) -> Pose:
    """Pose behind the moving vehicle nearest to the middle; without one in the middle, toward the north."""
    truth = city.truth(time_s)
    east, north, up, heading = (truth[name].values for name in ("east_m", "north_m", "up_m", "heading_rad"))
    speed = np.hypot(truth["east_speed_m_s"].values, truth["north_speed_m_s"].values)
    seen = up > _LOWEST_GROUND_M
    if not seen.any():
        return look_at(Pose(middle[0], middle[1], _EYE_UP_M), middle + [0.0, 40.0, 1.5])
    order = np.hypot(east - middle[0], north - middle[1]) + 1e4 * (speed < 3) + 1e6 * ~seen
    k = int(np.argmin(order))
    ahead = np.array([math.sin(heading[k]), math.cos(heading[k]), 0.0])
    centre = np.array([east[k], north[k], up[k]])
    eye = centre - _EYE_BEHIND_M * ahead + [0.0, 0.0, _EYE_UP_M]
    return look_at(Pose(*eye.tolist()), centre + 25.0 * ahead + [0.0, 0.0, 1.2])
