"""A city that a user brings as triangles: its window, its ground, and traffic from a file if there is one."""

from pathlib import Path

import numpy as np
import xarray as xr
from scipy.spatial import KDTree

from glintrack.scene.design import LARGEST_M2, SceneDesign
from glintrack.scene.read.fcd import read_fcd
from glintrack.scene.read.mesh import NamedMesh, default_up, ground_under, read_mesh
from glintrack.scene.objects.surfaces import RoadNetwork
from glintrack.scene.traffic import Recording
from glintrack.scene.sources.site import ROCHESTER, VEHICLE_MARGIN_M, Site, given_place
from glintrack.scene.sources.user_network import resolve_file
from glintrack.scene.objects.terrain import level_terrain
from glintrack.scene.traffic import Traffic

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
    traffic = no_traffic(design.traffic_start_s + design.traffic_duration_s)
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
    """Empty streets for a time. [s]."""
    whole, real = np.zeros(0, int), np.zeros(0)
    steps = int(np.ceil(duration_s / _STEP_S)) + 1
    return Traffic(_STEP_S, steps, whole, whole, whole, real, real, real)
