"""Site that a source of cities gives `build_scene`; that of a city which a user brings as triangles."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyproj
import xarray as xr
from pyproj.exceptions import CRSError, ProjError
from scipy.spatial import KDTree

from glintrack.scene.design import LARGEST_M2, SUMO_PREFIX, SceneDesign
from glintrack.scene.objects.layout import Layout
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.objects.terrain import level_terrain
from glintrack.scene.read.fcd import read_fcd
from glintrack.scene.read.mesh import NamedMesh, default_up, ground_under, read_mesh
from glintrack.scene.read.sumo import NetLocation, sumo_home
from glintrack.scene.traffic import Recording, Traffic

VEHICLE_MARGIN_M = 30.0  # vehicles are kept this far beyond: their shadows and mirror images reach in
# What stands nowhere is given the place of the paper's scene, Rochester, New York.


@dataclass(frozen=True)
class SceneOrigin:
    """Projected CRS, and where ENU (0, 0) lies in it; grid north is taken as north. [m]."""

    crs: str
    easting_m: float
    northing_m: float

    def __post_init__(self):
        """Refuse a CRS that PROJ does not know, and a place that is not on the Earth."""
        try:
            longitude, latitude = self.longitude_latitude_deg
        except (CRSError, ProjError) as error:
            raise ValueError(f"`scene.crs` must be a CRS that PROJ knows, got {self.crs!r}") from error
        if not (np.isfinite(longitude) and np.isfinite(latitude)):
            raise ValueError(
                f"`scene.crs` must reach ({self.easting_m:g}, {self.northing_m:g}), got {self.crs!r}"
            )

    @property
    def longitude_latitude_deg(self) -> tuple[float, float]:
        """Of ENU (0, 0). [°]."""
        transformer = pyproj.Transformer.from_crs(self.crs, 4326, always_xy=True)
        longitude, latitude = transformer.transform(self.easting_m, self.northing_m)
        return float(longitude), float(latitude)


ROCHESTER = SceneOrigin("EPSG:32618", 288000.0, 4781000.0)


@dataclass(frozen=True)
class Site:
    """A city before it is built.

    Parameters
    ----------
    recording
        Streets and traffic in ENU.
    place
        Where ENU (0, 0) lies.
    extent_m
        West, south, east, north of the window. [m]
    layout
        Makes the plan of what stands there from a generator; None for a mesh.
    mesh
        What stands there, for a city that comes as triangles.
    traffic_origin_m
        Where ENU (0, 0) lies in the coordinates of a traffic file. [m]
    assumptions
        What was guessed because the data do not say, one sentence each.
    """

    recording: Recording
    place: SceneOrigin
    extent_m: tuple[float, float, float, float]
    layout: Callable[[np.random.Generator], Layout] | None = None
    mesh: NamedMesh | None = None
    traffic_origin_m: tuple[float, float] = (0.0, 0.0)
    assumptions: tuple[str, ...] = ()


def resolve_file(name: str) -> Path:
    """A file as named, or one of the installed SUMO wheel if the name begins with ``sumo:``."""
    if name.startswith(SUMO_PREFIX):
        return sumo_home() / name.removeprefix(SUMO_PREFIX)
    return Path(name)


def given_place(design: SceneDesign) -> SceneOrigin | None:
    """The place a design names, if it names one."""
    if design.crs is None or design.origin_m is None:
        return None
    return SceneOrigin(design.crs, *design.origin_m)


def network_place(
    design: SceneDesign, location: NetLocation, centre_m: tuple[float, float]
) -> tuple[SceneOrigin, tuple[str, ...]]:
    """Where a network's window lies: as the design says, as its projection says, or by assumption."""
    place = given_place(design)
    if place is not None:
        return place, ()
    if location.projection is None:
        return ROCHESTER, ("the network has no projection: the scene is put at Rochester, New York",)
    try:
        crs = pyproj.CRS.from_user_input(location.projection)
    except CRSError as error:
        raise ValueError(
            f"`net_file` must have a projection that PROJ knows, got {location.projection!r}"
        ) from error
    code = crs.to_epsg(min_confidence=20)
    known = f"EPSG:{code}" if code else location.projection
    east, north = (centre_m[i] - location.offset_m[i] for i in range(2))
    return SceneOrigin(known, east, north), ()


_STEP_S = 0.1


def mesh_site(design: SceneDesign) -> Site:
    """Window, ground and traffic of a design with city ``mesh``.

    Raises
    ------
    ValueError
        If the mesh or the traffic cannot be read, or the mesh is larger than a scene may be.
    """
    mesh_path = Path(resolve_file(str(design.mesh_file)))
    mesh = read_mesh(mesh_path, design.mesh_up, design.mesh_unit_m)
    said = mesh.flaws + _taken(design, mesh_path)
    given = design.width_m is not None or design.height_m is not None
    west, south, east, north = extent = design.extent_m if given else mesh.extent_m
    if (east - west) * (north - south) > LARGEST_M2:
        raise ValueError(
            f"`mesh_file` must cover at most {LARGEST_M2 / 1e6:g} km², got {east - west:.0f} m × "
            f"{north - south:.0f} m (give width_m and height_m of a window about its origin)"
        )
    traffic = no_traffic(design.traffic_duration_s)
    if design.traffic_file:
        margin = VEHICLE_MARGIN_M
        reach = (west - margin, south - margin, east + margin, north + margin)
        traffic, odd = read_fcd(resolve_file(design.traffic_file), reach)
        said += odd.sentences()
    else:
        said += ("there is no traffic: a mesh has no lanes (give a traffic_file)",)
    place = given_place(design)
    if place is None:
        place = ROCHESTER
        said += ("the mesh does not say where it lies: the scene is put at Rochester, New York",)
    return Site(Recording(RoadNetwork((), ()), traffic), place, extent, mesh=mesh, assumptions=said)


def _taken(design: SceneDesign, path: Path) -> tuple[str, ...]:
    """What to say of a mesh's axes, unit and ground where the design leaves them open."""
    said = ()
    if design.mesh_up is None:
        said += (f"up is the mesh's {default_up(path)} axis (scene.mesh_up)",)
    if design.mesh_unit_m is None:
        said += ("the mesh is in metres (scene.mesh_unit_m)",)
    if not design.dem_file:
        said += ("the ground is the mesh's lowest surface that faces up",)
    return said


def mesh_terrain(mesh: NamedMesh, bounds_m: tuple[float, float, float, float]) -> xr.Dataset:
    """Ground of a mesh, the lowest surface that faces up; that of the nearest where there is none.

    Parameters
    ----------
    mesh
        In ENU.
    bounds_m
        West, south, east, north. [m]
    """
    terrain = level_terrain(bounds_m)
    height = ground_under(mesh, terrain["x"].values, terrain["y"].values)
    missing = ~np.isfinite(height)
    if missing.all():
        return terrain
    if missing.any():
        y, x = np.nonzero(~missing)
        nearest = KDTree(np.c_[y, x]).query(np.argwhere(missing))[1]
        height[missing] = height[y[nearest], x[nearest]]
    return terrain.assign(height=(("y", "x"), height, {"units": "m"}))


def no_traffic(duration_s: float) -> Traffic:
    """Empty streets for a time. [s]"""
    whole, real = np.zeros(0, int), np.zeros(0)
    return Traffic(
        step_s=_STEP_S,
        steps=int(np.ceil(duration_s / _STEP_S)) + 1,
        first=whole,
        count=whole,
        model=whole,
        bumper_east=real,
        bumper_north=real,
        angle=real,
    )
