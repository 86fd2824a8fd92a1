"""Site that a source of cities gives `build_scene`: streets and traffic, what stands, and where on Earth."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pyproj
from pyproj.exceptions import CRSError, ProjError

from glintrack.scene.design import SceneDesign
from glintrack.scene.objects.layout import Layout
from glintrack.scene.read.mesh import NamedMesh
from glintrack.scene.read.sumo import NetLocation
from glintrack.scene.traffic import Recording

VEHICLE_MARGIN_M = 30.0  # vehicles are kept this far beyond: their shadows and mirror images reach in
# What stands nowhere is given the place of the paper's scene, Rochester, New York.


@dataclass(frozen=True)
class Place:
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


ROCHESTER = Place("EPSG:32618", 288000.0, 4781000.0)


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
    place: Place
    extent_m: tuple[float, float, float, float]
    layout: Callable[[np.random.Generator], Layout] | None = None
    mesh: NamedMesh | None = None
    traffic_origin_m: tuple[float, float] = (0.0, 0.0)
    assumptions: tuple[str, ...] = ()


def given_place(design: SceneDesign) -> Place | None:
    """The place a design names, if it names one."""
    if design.crs is None or design.origin_easting_m is None or design.origin_northing_m is None:
        return None
    return Place(design.crs, design.origin_easting_m, design.origin_northing_m)


def network_place(
    design: SceneDesign, location: NetLocation, centre_m: tuple[float, float]
) -> tuple[Place, tuple[str, ...]]:
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
    return Place(known, east, north), ()
