"""Site of a city for `build_scene`, its position on the Earth, and the site of a mesh of a user."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import pyproj
import xarray as xr
from pyproj.exceptions import CRSError, ProjError
from scipy.spatial import KDTree

from glintrack.core.arrays import Array
from glintrack.io.crs import longitude_latitude
from glintrack.scene.design import LARGEST_M2, SUMO_PREFIX, SceneDesign
from glintrack.scene.objects.layout import Layout, expand_extent
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.objects.terrain import flat_terrain
from glintrack.scene.read.fcd import read_fcd
from glintrack.scene.read.mesh import NamedMesh, default_up, ground_under, read_mesh
from glintrack.scene.read.sumo import NetLocation, sumo_home
from glintrack.scene.traffic import Recording, Traffic

VEHICLE_MARGIN_M = 30.0  # of traffic beyond the window, whose shadows and mirror images reach in
_STEP_S = 0.1
_MAX_ABOVE_M = 1.0  # of a mesh above its elevation model


@dataclass(frozen=True)
class SceneOrigin:
    """Position of ENU (0, 0) in a projected CRS; grid north is taken as north. [m]"""

    crs: str
    easting_m: float
    northing_m: float

    def __post_init__(self):
        """Refuse a CRS that PROJ does not know or that does not count metres, and a place off the Earth."""
        try:
            longitude, latitude = self.longitude_latitude_deg
        except (CRSError, ProjError) as error:
            raise ValueError(f"`scene.crs` must be a CRS that PROJ knows; got {self.crs!r}.") from error
        if not (np.isfinite(longitude) and np.isfinite(latitude)):
            raise ValueError(
                f"`scene.crs` must reach ({self.easting_m:g}, {self.northing_m:g}); got {self.crs!r}."
            )
        longitude_latitude(self.crs, np.array([self.easting_m]), np.array([self.northing_m]))

    def project(
        self, longitude_deg: Array, latitude_deg: Array, origin_m: tuple[float, float] = (0.0, 0.0)
    ) -> tuple[Array, Array]:
        """East and north of places, in coordinates where ENU (0, 0) is at ``origin_m``. [m]"""
        transformer = pyproj.Transformer.from_crs(4326, self.crs, always_xy=True)
        easting, northing = transformer.transform(longitude_deg, latitude_deg)
        return easting - self.easting_m + origin_m[0], northing - self.northing_m + origin_m[1]

    @property
    def longitude_latitude_deg(self) -> tuple[float, float]:
        """Longitude and latitude of ENU (0, 0). [deg]"""
        transformer = pyproj.Transformer.from_crs(self.crs, 4326, always_xy=True)
        longitude, latitude = transformer.transform(self.easting_m, self.northing_m)
        return float(longitude), float(latitude)


# position of the paper's scene, Rochester, New York, for a city without one
ROCHESTER = SceneOrigin("EPSG:32618", 288000.0, 4781000.0)


@dataclass(frozen=True)
class Site:
    """A city before it is built.

    Parameters
    ----------
    recording
        Streets and traffic in ENU.
    place
        Position of ENU (0, 0).
    extent_m
        West, south, east, north of the window. [m]
    layout
        Makes the layout from a generator; None for a mesh.
    mesh
        Mesh of the city, if it has no layout.
    traffic_origin_m
        Position of ENU (0, 0) in the coordinates of a traffic file. [m]
    assumptions
        Assumptions made where the data are incomplete, one sentence each.
    """

    recording: Recording
    place: SceneOrigin
    extent_m: tuple[float, float, float, float]
    layout: Callable[[np.random.Generator], Layout] | None = None
    mesh: NamedMesh | None = None
    traffic_origin_m: tuple[float, float] = (0.0, 0.0)
    assumptions: tuple[str, ...] = ()


def resolve_file(name: str) -> Path:
    """Path of a file, in the installed SUMO wheel if the name begins with ``sumo:``."""
    if name.startswith(SUMO_PREFIX):
        return sumo_home() / name.removeprefix(SUMO_PREFIX)
    return Path(name)


def given_place(design: SceneDesign) -> SceneOrigin | None:
    """Position of a city by its keys ``crs`` and ``origin_m``, if it has them."""
    if design.crs is None or design.origin_m is None:
        return None
    return SceneOrigin(design.crs, *design.origin_m)


def place_of(
    design: SceneDesign, location: NetLocation | None, centre_m: tuple[float, float], name: str
) -> tuple[SceneOrigin, tuple[str, ...]]:
    """Position of a city: by the design, by the projection of its network, or by assumption, with a sentence.

    Parameters
    ----------
    design, location
        Table ``[scene]`` of a case, and the position of its network. [m]
    centre_m
        ENU (0, 0) in network coordinates. [m]
    name
        Data that may lack a position, for the sentence.
    """
    if (given := given_place(design)) is not None:
        return given, ()
    if location is None or location.projection is None:
        return ROCHESTER, (f"the {name}: the scene is put at Rochester, New York",)
    try:
        crs = pyproj.CRS.from_user_input(location.projection)
    except CRSError as error:
        raise ValueError(
            f"`net_file` must have a projection that PROJ knows; got {location.projection!r}."
        ) from error
    code = crs.to_epsg()
    known = f"EPSG:{code}" if code else location.projection
    east, north = (centre_m[i] - location.offset_m[i] for i in range(2))
    return SceneOrigin(known, east, north), ()


def read_traffic(
    design: SceneDesign,
    extent_m: tuple[float, float, float, float],
    place: SceneOrigin | None = None,
    origin_m: tuple[float, float] = (0.0, 0.0),
) -> Traffic:
    """Read a design's traffic file in ENU.

    ``extent_m`` is west, south, east, north in ENU, and ``origin_m`` the position of ENU (0, 0) in the file's
    coordinates. [m] Degrees are refused without a place, and so is a file without a vehicle in the extent.
    """
    path = resolve_file(str(design.traffic_file))
    x, y = origin_m
    west, south, east, north = extent_m
    reach = (west + x, south + y, east + x, north + y)
    traffic = read_fcd(path, reach, project=partial(place.project, origin_m=origin_m) if place else None)
    if not traffic.count.size:
        raise ValueError(
            f"`{path.name}` must have a vehicle in the window, {reach[0]:.0f} to {reach[2]:.0f} m east and "
            f"{reach[1]:.0f} to {reach[3]:.0f} m north of the network's coordinates; "
            "got none. Write it without --fcd-output.utm, from the same network."
        )
    return traffic.shift(-x, -y)


def mesh_site(design: SceneDesign) -> Site:
    """Window, ground and traffic of a design with city ``mesh``.

    Raises
    ------
    ValueError
        If the mesh or the traffic cannot be read, or the mesh is larger than a scene may be.
    """
    mesh_path = resolve_file(str(design.mesh_file))
    mesh = read_mesh(mesh_path, design.mesh_up, design.mesh_unit_m)
    said: tuple[str, ...] = ()
    if design.mesh_up is None:
        said += (f"up is the mesh's {default_up(mesh_path)} axis (scene.mesh_up)",)
    if design.mesh_unit_m is None:
        said += ("the mesh is in metres (scene.mesh_unit_m)",)
    if not design.dem_file:
        said += ("the ground is the mesh's lowest surface that faces up",)
    given = design.width_m is not None or design.height_m is not None
    west, south, east, north = extent = design.extent_m if given else mesh.extent_m
    if (east - west) * (north - south) > LARGEST_M2:
        raise ValueError(
            f"`mesh_file` must cover at most {LARGEST_M2 / 1e6:g} km²; got {east - west:.0f} m × "
            f"{north - south:.0f} m. Give width_m and height_m of a window about its origin."
        )
    if design.traffic_file:
        reach = expand_extent(extent, VEHICLE_MARGIN_M)
        traffic = read_traffic(design, reach, given_place(design))
    else:
        steps = int(np.ceil(design.traffic_duration_s / _STEP_S)) + 1
        none = {name: np.zeros(0) for name in ("bumper_east", "bumper_north", "angle")}
        none |= {name: np.zeros(0, int) for name in ("first", "count", "model")}
        traffic = Traffic(step_s=_STEP_S, steps=steps, **none)
        said += ("there is no traffic: a mesh has no lanes (give a traffic_file)",)
    place, more = place_of(design, None, (0.0, 0.0), "mesh has no position")
    recording = Recording(RoadNetwork((), ()), traffic)
    return Site(recording, place, extent, mesh=mesh, assumptions=said + more)


def mesh_datum_m(mesh: NamedMesh, terrain: xr.Dataset, origin_height_m: float) -> float:
    """Height in an elevation model from which a mesh counts: 0, or that of the ground at ENU (0, 0). [m]

    Parameters
    ----------
    mesh
        Mesh in ENU.
    terrain, origin_height_m
        Heights of the elevation model above its ground at ENU (0, 0), and the height of that ground. [m]

    Raises
    ------
    ValueError
        If the mesh's ground fits neither to 1 m in the median.
    """
    above_m = ground_under(mesh, terrain["x"].values, terrain["y"].values) - terrain["height"].values
    if not np.isfinite(above_m).any():
        return origin_height_m
    median_m = float(np.nanmedian(above_m))
    away_m, datum_m = min((abs(median_m), origin_height_m), (abs(median_m - origin_height_m), 0.0))
    if away_m <= _MAX_ABOVE_M:
        return datum_m
    raise ValueError(
        f"`scene.mesh_file` must have its ground at the heights of `scene.dem_file`, or at heights above "
        f"the origin; got {median_m - origin_height_m:+.1f} m and {median_m:+.1f} m from them. Move the "
        "mesh, or leave dem_file out: then the mesh's own ground is taken."
    )


def mesh_terrain(mesh: NamedMesh, bounds_m: tuple[float, float, float, float]) -> xr.Dataset:
    """Ground of a mesh within west, south, east, north [m]: the lowest, or the nearest, upward surface."""
    terrain = flat_terrain(bounds_m)
    height = ground_under(mesh, terrain["x"].values, terrain["y"].values)
    missing = ~np.isfinite(height)
    if missing.all():
        return terrain
    if missing.any():
        y, x = np.nonzero(~missing)
        nearest = KDTree(np.c_[y, x]).query(np.argwhere(missing))[1]
        height[missing] = height[y[nearest], x[nearest]]
    return terrain.assign(height=(("y", "x"), height, {"units": "m"}))
