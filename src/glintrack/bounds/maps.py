"""Maps of what a detector finds and of what it reports falsely, over what a tracker can observe.

The probability of detection of a moving vehicle, hidden or not (a tracker does not know), is counted over its
place, and over its speed and the angle between its motion and the line of sight; false detections over their
place. Cells with few counts are drawn toward the mean: P = (k + 5 P̄)/(n + 5), as after a beta prior; and the
density of clutter likewise after a gamma prior of one detection. Place and motion are taken to act apart,
P = P(place) P(speed, angle)/P̄: too few vehicles fly by to tell both at once.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import xarray as xr
from jaxtyping import Bool, Float

from glintrack.core.arrays import Array
from glintrack.io.geotiff import write_bands
from glintrack.io.netcdf import write_tree
from glintrack.io.untrusted import check_netcdf

CELL_M = 30.0
SPEED_EDGES_M_S = (1.0, 2.0, 4.0, 6.0, 8.0, 10.0, 12.0, 14.0, 17.0, 25.0)  # faster ones count with the last
ANGLE_EDGES_DEG = (0.0, 30.0, 60.0, 90.0, 120.0, 150.0, 180.0)  # 0: driving away from the camera
_PRIOR_VEHICLES, _PRIOR_FALSE = 5.0, 1.0
_M2_PER_KM2 = 1e6


def write_maps(path: Path, maps: Mapping[str, xr.Dataset]) -> list[Path]:
    """Maps of channels as NetCDF-4, a group each, and those of places as GeoTIFF beside it; the files.

    Parameters
    ----------
    path
        ``.nc``; the pictures are called ``NAME-CHANNEL.tif``.
    maps
        From `calibrate`.

    Raises
    ------
    ValueError
        If the ending is another one.
    """
    if path.suffix.lower() != ".nc":
        raise ValueError(f"`output` must end in .nc, got {path.name!r}")
    write_tree(path, xr.DataTree.from_dict({f"/{channel}": one for channel, one in maps.items()}))
    names, files = ("detection_probability", "vehicles", "clutter"), [path]
    for channel, one in maps.items():
        files.append(path.with_name(f"{path.stem}-{channel}.tif"))
        bands = np.stack([one[name].values for name in names], axis=-1)
        east, north = one.attrs["origin_m"]
        tags = {name: str(one[name].attrs["units"]) for name in names}
        write_bands(
            files[-1], bands, names, one["x"].values + east, one["y"].values + north, one.attrs["crs"], tags
        )
    return files


def read_maps(path: Path, channel: str) -> xr.Dataset:
    """The maps of one channel that `write_maps` wrote.

    Raises
    ------
    ValueError
        If the file cannot be read, or holds no such channel.
    """
    check_netcdf(path, "maps")
    try:
        with xr.open_datatree(path, engine="h5netcdf") as tree:
            loaded = tree.load()
    except Exception as error:  # whatever strange attributes make the decoders say
        raise ValueError(f"`maps` must be a readable NetCDF-4 file, got {path}: {error}") from error
    if channel not in loaded.children or "clutter" not in loaded[channel]:
        held = ", ".join(map(str, loaded.children)) or "none"
        raise ValueError(f"`channel` must be one of the maps' ({held}), got {channel!r}")
    return loaded[channel].to_dataset()


class Chances(NamedTuple):
    """What a detector had to find, and found, in some frames.

    Parameters
    ----------
    place, speed, angle
        Of every moving vehicle of the window and frame: where, how fast, and its motion from the line of
        sight. [m, m s⁻¹, rad]
    found
        Whether a detection lay in reach of it.
    false
        Where detections were false. [m]
    frames
        How many.
    """

    place: Float[Array, "chance 2"]
    speed: Float[Array, "chance"]
    angle: Float[Array, "chance"]
    found: Bool[Array, "chance"]
    false: Float[Array, "false 2"]
    frames: int

    @classmethod
    def joined(cls, parts: "list[Chances]") -> "Chances":
        """All of them."""
        columns = zip(*(p[:5] for p in parts), strict=True)
        place, speed, angle, found, false = (np.concatenate(values) for values in columns)
        return cls(place, speed, angle, found, false, sum(p.frames for p in parts))


def motion_angle(
    place: Float[Array, "n 2"], velocity: Float[Array, "n 2"], lens_m: Float[Array, "2"]
) -> Float[Array, "n"]:
    """Angle between each motion and the line of sight on the map, 0 for away from the camera, to π. [rad]"""
    away = place - lens_m
    cross = away[:, 0] * velocity[:, 1] - away[:, 1] * velocity[:, 0]
    return np.abs(np.arctan2(cross, (away * velocity).sum(axis=1)))


def detection_maps(chances: Chances, area_m: tuple[float, float, float, float]) -> xr.Dataset:
    """Maps of the chances of a detector.

    Parameters
    ----------
    chances
        Of flights of seeds other than those that the maps are used on.
    area_m
        West, south, east, north of the window. [m]

    Returns
    -------
    ``detection_probability(y, x)`` and ``vehicles(y, x)`` that it was counted over;
    ``motion_probability(speed, angle)`` and ``motion_vehicles``; ``clutter(y, x)``, false detections a frame
    and km². Coordinates are the middles of cells and classes, whose edges are attributes. Attributes
    ``detection_probability`` and ``clutter_per_km2`` are the means.

    Raises
    ------
    ValueError
        If no vehicle moved in the window.
    """
    if not len(chances.found):
        raise ValueError("`chances` must hold moving vehicles in the window, got none")
    west, south, east, north = area_m
    columns, rows = (max(round(side / CELL_M), 1) for side in (east - west, north - south))
    x, y = np.linspace(west, east, columns + 1), np.linspace(north, south, rows + 1)
    speed, angle = np.array(SPEED_EDGES_M_S), np.radians(ANGLE_EDGES_DEG)
    mean = float(chances.found.mean())
    at = _cells(chances.place, x, y)
    motion = _classes(chances.speed, speed), _classes(chances.angle, angle)
    by_place, vehicles = _shares(at, chances.found, (rows, columns), mean)
    by_motion, movers = _shares(motion, chances.found, (len(speed) - 1, len(angle) - 1), mean)
    cell_km2 = (x[1] - x[0]) * (y[0] - y[1]) / _M2_PER_KM2
    density = len(chances.false) / (chances.frames * cell_km2 * rows * columns)
    false = _count(_cells(chances.false, x, y), None, (rows, columns))
    seen_km2 = chances.frames * cell_km2
    prior_km2 = _PRIOR_FALSE / density if density else 1.0
    clutter = (false + (_PRIOR_FALSE if density else 0.0)) / (seen_km2 + prior_km2)
    middles = {"y": (y[1:] + y[:-1]) / 2, "x": (x[1:] + x[:-1]) / 2}
    middles |= {"speed": (speed[1:] + speed[:-1]) / 2, "angle": (angle[1:] + angle[:-1]) / 2}
    edges = {"y": y, "x": x, "speed": speed, "angle": angle}
    units = {"y": "m", "x": "m", "speed": "m s-1", "angle": "rad"}
    return xr.Dataset(
        {
            "detection_probability": (("y", "x"), by_place, {"units": "1"}),
            "vehicles": (("y", "x"), vehicles, {"units": "1"}),
            "motion_probability": (("speed", "angle"), by_motion, {"units": "1"}),
            "motion_vehicles": (("speed", "angle"), movers, {"units": "1"}),
            "clutter": (("y", "x"), clutter, {"units": "km-2"}),
        },
        coords={name: (name, v, {"units": units[name], "edges": edges[name]}) for name, v in middles.items()},
        attrs={"detection_probability": mean, "clutter_per_km2": density, "frames": chances.frames},
    )


def probability_at(
    maps: xr.Dataset, place: Float[Array, "n 2"], velocity: Float[Array, "n 2"], lens_m: Float[Array, "2"]
) -> Float[Array, "n"]:
    """Probability that a vehicle there, moving so, is detected; 0 outside the maps. [1]

    Parameters
    ----------
    maps
        From `detection_maps`.
    place, velocity
        Of vehicles. [m, m s⁻¹]
    lens_m
        East and north of the camera. [m]
    """
    place, velocity = np.asarray(place, float), np.asarray(velocity, float)
    at = _cells(place, *(maps[name].attrs["edges"] for name in ("x", "y")))
    speed = _classes(np.hypot(*velocity.T), np.asarray(maps["speed"].attrs["edges"]))
    angle = _classes(
        motion_angle(place, velocity, np.asarray(lens_m)), np.asarray(maps["angle"].attrs["edges"])
    )
    inside = (at[0] >= 0) & (at[1] >= 0)
    mean = max(float(maps.attrs["detection_probability"]), 1e-9)
    both = maps["detection_probability"].values[at] * maps["motion_probability"].values[speed, angle] / mean
    return np.where(inside, np.clip(both, 0.0, 1.0), 0.0)


def clutter_at(maps: xr.Dataset, place: Float[Array, "n 2"]) -> Float[Array, "n"]:
    """False detections a frame and km² at places; 0 outside the maps. [km⁻²]"""
    at = _cells(np.asarray(place, float), *(maps[name].attrs["edges"] for name in ("x", "y")))
    return np.where((at[0] >= 0) & (at[1] >= 0), maps["clutter"].values[at], 0.0)


def _cells(place: Array, x: Array, y: Array) -> tuple[Array, Array]:
    """Row and column of the cell of each place, −1 outside; y falls."""
    x, y = np.asarray(x), np.asarray(y)
    column = np.searchsorted(x, place[:, 0], side="right") - 1
    row = len(y) - 1 - np.searchsorted(y[::-1], place[:, 1], side="left")
    inside = (place[:, 0] >= x[0]) & (place[:, 0] <= x[-1]) & (place[:, 1] >= y[-1]) & (place[:, 1] <= y[0])
    column, row = np.clip(column, 0, len(x) - 2), np.clip(row, 0, len(y) - 2)
    return np.where(inside, row, -1), np.where(inside, column, -1)


def _classes(values: Array, edges: Array) -> Array:
    """Class of each value; those beyond the outer edges count with the outermost classes."""
    return np.clip(np.searchsorted(edges, values, side="right") - 1, 0, len(edges) - 2)


def _shares(
    at: tuple[Array, Array], found: Array, shape: tuple[int, int], mean: float
) -> tuple[Array, Array]:
    total, hits = _count(at, None, shape), _count(at, found.astype(float), shape)
    return (hits + _PRIOR_VEHICLES * mean) / (total + _PRIOR_VEHICLES), total


def _count(at: tuple[Array, Array], weight: Array | None, shape: tuple[int, int]) -> Array:
    kept = (at[0] >= 0) & (at[1] >= 0)
    flat = at[0][kept] * shape[1] + at[1][kept]
    weights = None if weight is None else weight[kept]
    return np.bincount(flat, weights, minlength=shape[0] * shape[1]).astype(float).reshape(shape)
