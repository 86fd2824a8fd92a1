"""A tiny generator of rectified frames with moving cars, independent of scene and renderer."""

import numpy as np
import xarray as xr
from scipy import ndimage

from glintrack.core.schema import RADIANCE, SCHEMAS

STOKES_VARIABLE = next(name for name, variable in SCHEMAS["image"].items() if "stokes" in variable.dims)
EXTENT_M = (-330.0, -210.0, 330.0, 210.0)


def grid(extent_m, gsd_m):
    """Pixel centres: easting rising, northing falling."""
    west, south, east, north = extent_m
    return np.arange(west + gsd_m / 2, east, gsd_m), np.arange(north - gsd_m / 2, south, -gsd_m)


def texture(shape, gsd_m, rng):
    """Reflectance of streets and grass: patches of 20 m, grain of 1.5 m, sharp bright marks."""
    patches = ndimage.gaussian_filter(rng.normal(size=shape), 20 / gsd_m) * 20 / gsd_m
    grain = ndimage.gaussian_filter(rng.normal(size=shape), 1.0) * 3
    ground = 0.15 + 0.05 * np.tanh(3 * patches) + 0.01 * grain
    marks = ndimage.binary_dilation(rng.random(shape) > 0.9985, iterations=1)
    return np.where(marks, 0.35, ground).astype(np.float32)


def paint_cars(ground, extent_m, gsd_m, cars, oversampling=3):
    """Area-averaged image of rectangular cars (east, north, heading, length, width, reflectance)."""
    x, y = grid(extent_m, gsd_m)
    out = ground.copy()
    fine = (np.arange(oversampling) + 0.5) / oversampling - 0.5
    for east, north, heading, length, width, reflectance in cars:
        reach = int(np.ceil(0.5 * length / gsd_m)) + 2
        column, row = int((east - x[0]) / gsd_m + 0.5), int((y[0] - north) / gsd_m + 0.5)
        r0, r1 = max(row - reach, 0), min(row + reach + 1, len(y))
        c0, c1 = max(column - reach, 0), min(column + reach + 1, len(x))
        if r0 >= r1 or c0 >= c1:
            continue
        dx = (x[c0:c1, None] + fine * gsd_m).ravel()[None, :] - east
        dy = (y[r0:r1, None] - fine * gsd_m).ravel()[:, None] - north
        along = dx * np.sin(heading) + dy * np.cos(heading)
        across = dx * np.cos(heading) - dy * np.sin(heading)
        hit = (np.abs(along) <= length / 2) & (np.abs(across) <= width / 2)
        share = hit.reshape(r1 - r0, oversampling, c1 - c0, oversampling).mean(axis=(1, 3))
        out[r0:r1, c0:c1] += share * (reflectance - out[r0:r1, c0:c1])
    return out


def image(pan, extent_m, gsd_m, dolp=None):
    """Dataset of the schema ``image`` around one plain array."""
    x, y = grid(extent_m, gsd_m)
    dolp = np.full(pan.shape, 0.05) if dolp is None else dolp
    stokes = np.stack([pan, pan * dolp, np.zeros_like(pan)], axis=-1)
    return xr.Dataset(
        {
            "pan": (("y", "x"), pan, {"units": RADIANCE}),
            STOKES_VARIABLE: (("y", "x", "stokes"), stokes, {"units": RADIANCE, "stokes_frame": "meridian"}),
            "dolp": (("y", "x"), dolp, {"units": "1"}),
        },
        coords={
            "y": ("y", y, {"units": "m"}),
            "x": ("x", x, {"units": "m"}),
            "stokes": ["I", "Q", "U"],
        },
    )


def truth(ids, east, north, heading, speed, length=4.5):
    """Dataset of the schema ``truth``."""
    n = len(ids)
    columns = {
        "east_m": (east, "m"),
        "north_m": (north, "m"),
        "up_m": (np.zeros(n), "m"),
        "east_speed_m_s": (speed * np.sin(heading), "m s-1"),
        "north_speed_m_s": (speed * np.cos(heading), "m s-1"),
        "heading_rad": (heading, "rad"),
        "length_m": (np.full(n, length), "m"),
        "width_m": (np.full(n, 1.8), "m"),
        "height_m": (np.full(n, 1.5), "m"),
    }
    return xr.Dataset(
        {k: ("vehicle", np.asarray(v, float), {"units": u}) for k, (v, u) in columns.items()},
        coords={"vehicle": np.asarray(ids, np.int64)},
    )


def street_traffic(times_s, count, rng, extent_m=EXTENT_M):
    """Cars on a grid of two-way streets that queue at lights: (ids, east, north, heading, speed) per epoch.

    Each lane is a ring as long as the window; a car that leaves comes back at the other end as a new one.
    Cars follow the one ahead (intelligent driver model) and stop at lights of 40 s, half red.
    """
    west, south, east, north = extent_m
    lanes = []
    for k, n0 in enumerate(np.arange(south + 35, north, 70)):
        lanes += [(True, n0 - 2, np.pi / 2, k), (True, n0 + 2, 3 * np.pi / 2, k)]
    for k, e0 in enumerate(np.arange(west + 55, east, 110)):
        lanes += [(False, e0 + 2, 0.0, k), (False, e0 - 2, np.pi, k)]
    lane = rng.integers(len(lanes), size=count)
    lengths = np.array([east - west if along else north - south for along, *_ in lanes])[lane]
    place = np.empty(count)
    for j in range(len(lanes)):
        mine = np.nonzero(lane == j)[0]
        spread = np.arange(len(mine)) / max(len(mine), 1) + rng.uniform(0, 0.3) / max(len(mine), 1)
        place[mine] = spread * (lengths[mine] if len(mine) else 0)
    speed, wish = rng.uniform(4, 10, count), rng.uniform(9, 14, count)
    ids, following = np.arange(count), count
    out, now, dt = [], times_s[0], 0.1
    for t in times_s:
        while now < t - 1e-9:
            gap, closing = np.full(count, 1e3), np.zeros(count)
            for j in range(len(lanes)):
                mine = np.nonzero(lane == j)[0]
                if len(mine) > 1:
                    order = mine[np.argsort(place[mine])]
                    ahead = np.roll(order, -1)
                    gap[order] = np.mod(place[ahead] - place[order], lengths[order]) - 4.5
                    closing[order] = speed[order] - speed[ahead]
                red = np.mod(now + 20 * lanes[j][0] + 7 * lanes[j][3], 40) < 18
                if red and len(mine):
                    to_light = np.mod(0.6 * lengths[mine] - place[mine], lengths[mine]) - 2.5
                    nearer = (to_light < gap[mine]) & (to_light > 0)
                    gap[mine[nearer]], closing[mine[nearer]] = to_light[nearer], speed[mine[nearer]]
            wanted = 2.0 + np.maximum(0, speed * 1.2 + speed * closing / (2 * np.sqrt(2.0 * 3.0)))
            force = 2.0 * (1 - (speed / wish) ** 4 - (wanted / np.maximum(gap, 0.3)) ** 2)
            speed = np.clip(speed + np.clip(force, -6, 2) * dt, 0, None)
            place = place + speed * dt
            gone = place > lengths
            place[gone] -= lengths[gone]
            ids = ids.copy()
            ids[gone] = following + np.arange(gone.sum())
            following += gone.sum()
            now += dt
        e, n, h = np.empty(count), np.empty(count), np.empty(count)
        for j, (along, offset, heading, _) in enumerate(lanes):
            mine = lane == j
            forward = heading in (np.pi / 2, 0.0)
            s = place[mine] if forward else lengths[mine] - place[mine]
            e[mine], n[mine] = (west + s, offset) if along else (offset, south + s)
            h[mine] = heading
        out.append((ids, e, n, h, speed.copy()))
    return out
