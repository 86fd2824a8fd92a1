"""Sky and air at one sensor altitude, nodes of facet normals, and patches of the sky.

Angular maps have axes (polar angle, azimuth) in the ``meridian`` frame, which is singular at the zenith and
the nadir. They are resampled once to a stereographic disc, with Q and U rotated to an axis that is smooth
there: north carried along the great circle from the zenith (sky) or the nadir (path) to the ray. A look-up
then needs no trigonometry and has no pole.

A third to two fifths of the skylight on level ground comes from within 30° of the sun. Shading objects hide
just this part. The patches are small there: a cap of 12° and a ring to 30° in four quarters; elsewhere three
bands of height in sectors. A probe stores the open part of each, and `shade` multiplies that with the
patch's irradiance of each component of the sky.
"""

import math
from dataclasses import dataclass
from typing import NamedTuple

import numba as nb
import numpy as np
import xarray as xr
from jaxtyping import Float, Int

from glintrack.atmosphere import interpolate_map
from glintrack.core.arrays import Array

NORMAL_NODES = 33  # along each side of the square: about 6° apart
LEVEL_NODE = NORMAL_NODES**2 // 2  # the node that faces straight up
SUN_RADIUS_RAD = 4.65e-3  # the sun's mean angular radius, 959.6″


@nb.njit(cache=True)
def on_square(nx, ny, nz, nodes):
    """Node coordinates (0 to nodes − 1) of a unit vector on the unfolded octahedron."""
    scale = 1.0 / (abs(nx) + abs(ny) + abs(nz))
    a, b = nx * scale, ny * scale
    if nz < 0:
        folded = (1.0 - abs(b)) * (1.0 if a >= 0 else -1.0)
        b = (1.0 - abs(a)) * (1.0 if b >= 0 else -1.0)
        a = folded
    half = 0.5 * (nodes - 1)
    return (a + 1.0) * half, (b + 1.0) * half


@nb.njit(cache=True)
def square_cell(nx, ny, nz, stride):
    """Corner (i, j) of the cell that holds a unit vector, and its parts along each side; stride in nodes.

    A part within rounding of a node is put on it, so that level ground reads one node.
    """
    coarse = (NORMAL_NODES - 1) // stride
    x, y = on_square(nx, ny, nz, coarse + 1)
    i, j = min(int(x + 1e-4), coarse - 1), min(int(y + 1e-4), coarse - 1)
    fx, fy = x - i, y - j
    return i * stride, j * stride, fx if fx >= 1e-4 else 0.0, fy if fy >= 1e-4 else 0.0


def node_normals() -> Float[Array, "normal 3"]:
    """Return the unit vectors of the nodes, row by row."""
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, NORMAL_NODES)], indexing="ij")
    z = 1 - np.abs(x) - np.abs(y)
    below = z < 0
    folded = [(1 - np.abs(other)) * np.where(own >= 0, 1, -1) for own, other in ((x, y), (y, x))]
    vectors = np.stack([np.where(below, folded[0], x), np.where(below, folded[1], y), z], axis=-1)
    return (vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)).reshape(-1, 3)


_CAP, _RING = math.radians(12.0), math.radians(30.0)
QUARTERS = 4
_BANDS = ((0.0, 0.35, 6), (0.35, 0.7, 6), (0.7, 1.0, 3))  # lowest and highest sine of the elevation, sectors
PATCHES = 1 + QUARTERS + sum(sectors for *_, sectors in _BANDS)
_RAYS = (4, *QUARTERS * (2,), *6 * (2,), *6 * (2,), *3 * (3,))  # of a probe to each patch
SETS = 4  # of directions: neighbouring probes have different ones, and share their light
_DENSE = 8192  # directions that represent the hemisphere
_BELOW = 16  # directions below the horizon
_DEPTH, _AROUND_SUN, _SPREAD_RAD = 0.25, 6.0, 0.2  # of `clear_sky`
_ROUNDS = 12  # of Lloyd's iteration


class PatchRays(NamedTuple):
    """Directions of a probe's rays: above the horizon patch by patch, then below.

    Parameters
    ----------
    direction
        Unit vectors, ENU. [1]
    patch
        Patch of each; −1 below the horizon.
    solid_angle
        Solid angle of each. [sr]
    brightness
        Relative brightness of a clear sky in each direction: larger toward the horizon and the sun. [1]
    """

    direction: Float[Array, "set ray 3"]
    patch: Int[Array, "ray"]
    solid_angle: Float[Array, "ray"]
    brightness: Float[Array, "set ray"]


def patch_of(direction: Float[Array, "direction 3"], sun: Float[Array, "3"]) -> Int[Array, "direction"]:
    """Patch of each unit vector; those below the horizon have that of the horizon above them."""
    direction, sun = np.asarray(direction, float), np.asarray(sun, float)
    up = np.clip(direction[:, 2], 0.0, 1.0 - 1e-12)
    turn = np.mod(np.arctan2(direction[:, 0], direction[:, 1]) / (2 * math.pi), 1.0)
    patch = np.zeros(len(direction), np.int64)
    first = 1 + QUARTERS
    for low, high, sectors in _BANDS:
        inside = (up >= low) & (up < high)
        patch[inside] = first + np.minimum((turn[inside] * sectors).astype(int), sectors - 1)
        first += sectors
    level = np.array([sun[1], -sun[0], 0.0]) if math.hypot(sun[0], sun[1]) > 1e-6 else np.array([1.0, 0, 0])
    level /= np.linalg.norm(level)
    upright = np.cross(level, sun)
    cosine = direction @ sun
    around = np.mod(np.arctan2(direction @ upright, direction @ level) / (2 * math.pi) + 0.125, 1.0)
    ring = cosine > math.cos(_RING)
    patch[ring] = 1 + np.minimum((around[ring] * QUARTERS).astype(int), QUARTERS - 1)
    patch[cosine > math.cos(_CAP)] = 0
    return patch


def hemisphere_directions(count: int) -> Float[Array, "direction 3"]:
    """Spread unit vectors evenly over the upper hemisphere. [1]

    References
    ----------
    The Fibonacci spiral: Marques et al., "Spherical Fibonacci Point Sets for Illumination Integrals",
    Computer Graphics Forum 32 (2013).
    """
    k = np.arange(count)
    up = (k + 0.5) / count
    azimuth = 2 * math.pi * np.mod(k * (math.sqrt(5) - 1) / 2, 1)
    across = np.sqrt(1 - up * up)
    return np.stack([across * np.cos(azimuth), across * np.sin(azimuth), up], axis=1)


def patch_rays(sun: Float[Array, "3"]) -> PatchRays:
    """Spread directions evenly over each patch (centres of Lloyd's cells), and below the horizon."""
    dense = hemisphere_directions(_DENSE)
    patch = patch_of(dense, sun)
    share = 2 * math.pi / _DENSE
    directions, patches, angles = [], [], []
    for b, count in enumerate(_RAYS):
        mine = dense[patch == b]
        if len(mine) < SETS * count:  # below the horizon, or hidden behind the cap
            continue
        centres = mine[np.linspace(0, len(mine) - 1, SETS * count).round().astype(int)]
        for _ in range(_ROUNDS):
            nearest = np.argmax(mine @ centres.T, axis=1)
            sums = np.array([mine[nearest == c].sum(axis=0) for c in range(len(centres))])
            lengths = np.linalg.norm(sums, axis=1, keepdims=True)
            centres = np.where(lengths > 0, sums / np.maximum(lengths, 1e-9), centres)
        directions += [centres[k * SETS : (k + 1) * SETS] for k in range(count)]
        patches += count * [b]
        angles += count * [share * len(mine) / count]
    below = hemisphere_directions(SETS * _BELOW) * np.array([1.0, 1.0, -1.0])
    directions += [below[k * SETS : (k + 1) * SETS] for k in range(_BELOW)]
    every = np.stack(directions, axis=1)
    return PatchRays(
        np.ascontiguousarray(every, np.float32),
        np.concatenate([patches, np.full(_BELOW, -1)]),
        np.concatenate([angles, np.full(_BELOW, 2 * math.pi / _BELOW)]).astype(np.float32),
        clear_sky(every, sun).astype(np.float32),
    )


def clear_sky(direction: Float[Array, "... 3"], sun: Float[Array, "3"]) -> Float[Array, "..."]:
    """Usual brightness of a clear sky: (1 − exp(−0.25/cos θ)) (1 + 6 exp(−angle to the sun/0.2))."""
    up = np.maximum(direction[..., 2], 1e-3)
    angle = np.arccos(np.clip(direction @ np.asarray(sun, float), -1, 1))
    return (1 - np.exp(-_DEPTH / up)) * (1 + _AROUND_SUN * np.exp(-angle / _SPREAD_RAD))


_DISC_CELLS = 128  # 0.9° to 1.8° a cell, finer than the tables' 3° × 5°


@dataclass(frozen=True)
class Sky:
    """Light of sun, sky and air for `shade`, at one sensor altitude.

    Parameters
    ----------
    wavelength_um
        Wavelengths of every spectrum below. [µm]
    sun_direction
        Unit vector toward the sun, ENU. [1]
    sun_irradiance
        Direct irradiance, normal to the beam, at the ground. [W m⁻² µm⁻¹]
    sky_irradiance
        Diffuse irradiance of level ground. [W m⁻² µm⁻¹]
    sky_spectrum, sky_map
        Sky radiance = Σ spectrum × map. [W m⁻² sr⁻¹ µm⁻¹, 1]
    irradiance_map
        Σ spectrum × map is the irradiance of facets in the open from each patch of the sky, over the nodes of
        `node_normals`; the sum over the patches is ``sky_irradiance`` on level ground.
    path_spectrum, path_map
        Path radiance likewise, with the absorption of gases in the spectrum; the disc's centre is the nadir.
    transmittance
        Transmittance from ground to sensor. [1]
    view_zenith_rad
        Angles of the transmittance, from the nadir. [rad]
    """

    wavelength_um: Float[Array, "wavelength"]
    sun_direction: Float[Array, "3"]
    sun_irradiance: Float[Array, "wavelength"]
    sky_irradiance: Float[Array, "wavelength"]
    sky_spectrum: Float[Array, "sky_component wavelength"]
    sky_map: Float[Array, "disc disc sky_component 3"]
    irradiance_map: Float[Array, "normal patch sky_component"]
    path_spectrum: Float[Array, "path_component wavelength"]
    path_map: Float[Array, "disc disc path_component 3"]
    transmittance: Float[Array, "wavelength view_zenith"]
    view_zenith_rad: Float[Array, "view_zenith"]


_AT_GROUND = {"path_gas": 1.0, "path_map": 0.0, "transmittance": 1.0}


def unpack_sky(tables: xr.Dataset, altitude_m: float) -> Sky:
    """Convert a dataset of schema ``atmosphere`` to a sky at the altitude of the sensor.

    Parameters
    ----------
    tables
        From `glintrack.atmosphere.solve_tables`.
    altitude_m
        Altitude of the sensor above the ground, up to the highest of the tables. Below the lowest the air
        is interpolated to none at the ground. [m]
    """
    altitudes = np.r_[0.0, tables["altitude"].values]
    if not 0 <= altitude_m <= altitudes[-1] + 1e-6:
        raise ValueError(
            f"`altitude_m` must lie within the atmosphere's tables, 0 to {altitudes[-1]:g} m; "
            f"got {altitude_m:g}. Set atmosphere.altitudes_m, or cloud_base_m under a cloud, to extend them."
        )
    high = min(max(int(np.searchsorted(altitudes, altitude_m)), 1), len(altitudes) - 1)
    part = float((altitude_m - altitudes[high - 1]) / (altitudes[high] - altitudes[high - 1]))

    def at_altitude(name: str, leading: str = "wavelength") -> Array:
        values = tables[name].transpose(leading, "altitude", ...).values.astype(float)
        low = values[:, high - 2] if high > 1 else _AT_GROUND[name]
        return (1 - part) * low + part * values[:, high - 1]

    zenith, azimuth = float(tables.attrs["sun_zenith_rad"]), float(tables.attrs["sun_azimuth_rad"])
    across = np.sin(zenith)
    view_zenith = tables["view_zenith"].values.astype(float)
    sky_map = _on_disc(tables["sky_map"].values, tables["zenith"].values, tables["azimuth"].values, "up")
    sun = np.array([across * np.sin(azimuth), across * np.cos(azimuth), np.cos(zenith)])
    return Sky(
        wavelength_um=tables["wavelength"].values.astype(float),
        sun_direction=sun,
        sun_irradiance=tables["sun_irradiance"].values.astype(float),
        sky_irradiance=tables["sky_irradiance"].values.astype(float),
        sky_spectrum=tables["sky_spectrum"].values.astype(float),
        sky_map=sky_map,
        irradiance_map=_irradiance_map(sky_map, sun),
        path_spectrum=tables["path_spectrum"].values.astype(float) * at_altitude("path_gas"),
        path_map=_on_disc(
            at_altitude("path_map", "path_component"), view_zenith, tables["azimuth"].values, "down"
        ),
        transmittance=at_altitude("transmittance"),
        view_zenith_rad=view_zenith,
    )


def _on_disc(meridian: Array, polar_rad: Array, azimuth_rad: Array, looking: str) -> Array:
    """Resample (component, polar, azimuth, 3) in `meridian` to the disc (east, north, component, 3)."""
    cells = np.linspace(-1.0, 1.0, _DISC_CELLS)
    x, y = np.meshgrid(cells, cells, indexing="ij")
    polar, azimuth = 2 * np.arctan(np.hypot(x, y)), np.arctan2(x, y)
    return np.ascontiguousarray(interpolate_map(meridian, polar_rad, azimuth_rad, polar, azimuth, looking))


def _irradiance_map(sky_map: Array, sun: Array) -> Array:
    """Integrate I cos θ dω over each patch of the sky, for facets with the normals of `node_normals`."""
    heights, weights = np.polynomial.legendre.leggauss(32)
    heights, weights = 0.5 * (heights + 1), 0.5 * weights
    turns = (np.arange(64) + 0.5) * 2 * np.pi / 64
    z, azimuth = np.meshgrid(heights, turns, indexing="ij")
    across = np.sqrt(1 - z * z)
    directions = np.stack([across * np.sin(azimuth), across * np.cos(azimuth), z], axis=-1).reshape(-1, 3)
    radiance, _ = look_up_all(sky_map, directions)
    light = radiance[..., 0] * np.repeat(weights * 2 * np.pi / 64, 64)[:, None]
    cosine, patch = np.maximum(node_normals() @ directions.T, 0), patch_of(directions, sun)
    return np.stack([cosine[:, patch == b] @ light[patch == b] for b in range(PATCHES)], axis=1)


@nb.njit(cache=True, fastmath={"contract", "reassoc", "arcp", "nsz"}, forceinline=True)
def look_up(disc, rx, ry, rz, out):
    """Interpolate (component, 3) of a disc map in direction r; beyond the horizon the horizon's value."""
    scale = 1.0 / (1.0 + abs(rz))
    last = disc.shape[0] - 1
    x = min(max((rx * scale + 1.0) * 0.5 * last, 0.0), last - 1e-6)
    y = min(max((ry * scale + 1.0) * 0.5 * last, 0.0), last - 1e-6)
    i, j = int(x), int(y)
    fx, fy = np.float32(x - i), np.float32(y - j)
    w11 = fx * fy
    w10, w01 = fx - w11, fy - w11
    w00 = np.float32(1.0) - w10 - w01 - w11
    for k in range(disc.shape[2]):
        for s in range(3):
            out[k, s] = (
                w00 * disc[i, j, k, s]
                + w01 * disc[i, j + 1, k, s]
                + w10 * disc[i + 1, j, k, s]
                + w11 * disc[i + 1, j + 1, k, s]
            )


@nb.njit(cache=True)
def north_axis(rx, ry, rz):
    """North carried along the great circle from the zenith (rz ≥ 0) or the nadir (rz < 0) to direction r."""
    pole = 1.0 if rz >= 0 else -1.0
    g = ry / (1.0 + pole * rz)
    return -g * rx, 1.0 - g * ry, -g * (rz + pole)


@nb.njit(cache=True)
def look_up_all(disc, directions):
    """Interpolate (direction, component, 3) of a disc map, and the axis of each (`north_axis`)."""
    out = np.empty((directions.shape[0], disc.shape[2], 3))
    north = np.empty((directions.shape[0], 3))
    for i in range(directions.shape[0]):
        x, y, z = directions[i, 0], directions[i, 1], directions[i, 2]
        look_up(disc, x, y, z, out[i])
        north[i, 0], north[i, 1], north[i, 2] = north_axis(x, y, z)
    return out, north
