"""A textured plane with a moving box under a passing camera, as a mosaic of raw elements."""

from dataclasses import replace

import numpy as np
from scipy.ndimage import map_coordinates, zoom

from glintrack.camera import Camera, Pose, ground_points, look_at
from glintrack.core.records import Mosaic
from glintrack.track.detect.frame import Frame, Grid

LAYOUT = (("mirror", 0.0), (60.0, 120.0))
CAMERA = Camera(0.1, 0.1 * 0.75 / 3000, 160, 200)
GRID = Grid((60, 60), (-44.25, 44.25), 1.5)
ELECTRONS, DARK_E = 8000.0, 20.0
SPEED_M_S = 8.0


def gains(layout, per_radiance=100.0):
    """Electrons per unit of S0, S1 and S2 of ideal polarizers and a mirror."""
    out = np.zeros((len(layout), len(layout), 3))
    for i, row in enumerate(layout):
        for j, what in enumerate(row):
            angle = 0.0 if isinstance(what, str) else 2 * np.radians(what)
            polarized = 0.0 if isinstance(what, str) else 1.0
            out[i, j] = per_radiance * np.array([1, polarized * np.cos(angle), polarized * np.sin(angle)])
    return out


def texture(seed=3, size=60, fold=5):
    """Smooth reflectances about 1, a pixel a metre."""
    coarse = np.random.default_rng(seed).normal(0.0, 0.08, (size, size))
    return 1.0 + zoom(coarse, fold, order=3)


def frames(
    count,
    channel="pan",
    vehicle=True,
    turn=0.0,
    mirror=False,
    seed=5,
    contrast=0.6,
    noise=True,
    rows=((), ()),
    roof_m=0.0,
    fine=1,
    travel=lambda t: SPEED_M_S * t,
):
    """Frames at 2 Hz of an aircraft that passes at 50 m/s, 50° off nadir.

    ``turn`` turns the whole world about the vertical, counter-clockwise [rad]; ``mirror`` swaps east and
    west; ``rows`` are first easts and norths of more vehicles [m], one at each crossing; what lies north of
    the line of the vehicle is as high as ``roof_m``; an element of `CAMERA` is split into ``fine`` × ``fine``
    with as much light and noise in all; ``travel`` is the way of the vehicles after a time [m].
    """
    camera = replace(
        CAMERA, pitch_m=CAMERA.pitch_m / fine, rows=fine * CAMERA.rows, columns=fine * CAMERA.columns,
        principal_row=None, principal_column=None,
    )  # fmt: skip
    rng = np.random.default_rng(seed)
    ground = texture()
    out = []
    layout = tuple(row[::-1] for row in LAYOUT) if mirror else LAYOUT
    for k in range(count):
        t = 0.5 * k
        pose = look_at(Pose(-60.0 + 50.0 * t, -2298.0, 1928.0), (0.0, 0.0, 0.0))
        pixels = np.moveaxis(np.mgrid[: camera.rows, : camera.columns].astype(float), 0, -1)
        points = ground_points(camera, pose, pixels)
        at = [150.0 - points[..., 1], 150.0 + points[..., 0]]
        light = map_coordinates(ground, at, order=1, mode="nearest")
        if roof_m:
            above = points[..., :2] + roof_m / pose.up_m * (pose.position[:2] - points[..., :2])
            roof = map_coordinates(ground, [150.0 - above[..., 1], 150.0 + above[..., 0]], order=1)
            light = np.where(points[..., 1] > 9.0, roof, light)
        places = [(east, north) for north in rows[1] for east in rows[0]] + [(-25.0, 5.0)] * vehicle
        for east, north in places:
            ahead, aside = np.abs(points[..., 0] - east - travel(t)), np.abs(points[..., 1] - north)
            light = light + contrast * ((ahead < 2.3) & (aside < 1.0))
        expected = ELECTRONS / fine**2 * light
        sigma = np.sqrt(expected + (DARK_E / fine) ** 2)
        electrons = expected + (sigma * rng.standard_normal(sigma.shape) if noise else 0.0)
        if mirror:
            electrons, sigma = electrons[:, ::-1], sigma[:, ::-1]
        mosaic = Mosaic(electrons.astype(np.float32), sigma.astype(np.float32), layout, gains(layout))
        out.append(
            Frame(
                t, None, mosaic, camera, _turned(pose, turn, mirror), grid=GRID, channel=channel,
                interval_s=0.5 if k else 0.0,
            )
        )  # fmt: skip
    return out


def place_of_vehicle(t, turn=0.0, mirror=False):
    """East and north of the vehicle. [m]"""
    east, north = -25.0 + SPEED_M_S * t, 5.0
    if mirror:
        east = -east
    c, s = np.cos(turn), np.sin(turn)
    return np.array([c * east - s * north, s * east + c * north])


def _turned(pose, turn, mirror):
    east = -pose.east_m if mirror else pose.east_m
    c, s = np.cos(turn), np.sin(turn)
    at = Pose(c * east - s * pose.north_m, s * east + c * pose.north_m, pose.up_m, kind="reported")
    return look_at(at, (0.0, 0.0, 0.0))
