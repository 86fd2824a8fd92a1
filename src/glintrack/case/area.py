"""Scored area of a case (`scene.area`), and the window that the footprint needs.

The footprint is the ground in the frame: the convex hull of the frame's border, projected onto the ground.
"""

import math
from dataclasses import dataclass
from importlib.util import find_spec

import numpy as np
import shapely
import xarray as xr
from jaxtyping import Float
from shapely import Geometry, MultiPoint, Polygon, box

from glintrack.atmosphere import sun_direction
from glintrack.camera import Camera, Pose, ground_points
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.records import Extent
from glintrack.flight import Flight
from glintrack.metrics import Area, is_in_area
from glintrack.ortho import intersect_terrain
from glintrack.ortho.rasters import frame_border
from glintrack.scene.design import LARGEST_M2, LARGEST_SIDE_M
from glintrack.scene.objects.layout import area_with_margin

MIN_COVERED = 0.75  # share of the window in the frame, below which the footprint is scored by default
MAX_BEYOND = 0.5  # share of the footprint beyond the city, above which the window grows
_SAMPLES = 5  # frames at which the footprint is compared with the window


@dataclass(frozen=True)
class ScoredArea:
    """Area whose vehicles are scored: ``window``, ``footprint`` or ``polygon``, within the window. [m]"""

    kind: str
    window: Extent
    polygon: Geometry | None = None

    def mark(
        self, truth: xr.Dataset, terrain: xr.Dataset, camera: Camera, pose: Pose
    ) -> tuple[xr.Dataset, Area]:
        """Mark the vehicles of a frame that are ``inside``, and return the frame's area. [m]"""
        area: Area = self.window if self.polygon is None else self.polygon
        if self.kind == "footprint":
            seen = _hull(intersect_terrain(terrain, camera, pose, frame_border(camera)))
            area = seen.intersection(box(*self.window))
        return truth.assign(inside=("vehicle", is_in_area(truth, area), {"units": "1"})), area


def scored_area(case: Case, window: Extent, camera: Camera, flight: Flight) -> ScoredArea:
    """Choose the scored area of a case: by default the footprint, if it covers too little of the window.

    Raises
    ------
    ValueError
        If the polygon has no area in the window.
    """
    kind, whole = case.scene.area, box(*window)
    if isinstance(kind, tuple):
        polygon = Polygon(kind).intersection(whole)
        if not polygon.area:
            west, south, east, north = window
            raise ValueError(
                f"`scene.area` must lie in the window, east {west:g} to {east:g} m and north {south:g} to "
                f"{north:g} m; got corners from {min(kind)} to {max(kind)}."
            )
        return ScoredArea("polygon", window, polygon)
    if kind is None:
        covered_m2 = np.mean([one.intersection(whole).area for one in _footprints(camera, flight)])
        kind = "footprint" if covered_m2 < MIN_COVERED * whole.area else "window"
    return ScoredArea(kind, window)


def fit_window(case: Case) -> Case:
    """Enlarge the window to the footprint, if most of that lies beyond the city.

    Fixed windows stay: given sizes, a traffic file, Braunschweig, a mesh, and flights along waypoints.
    """
    scene = case.scene
    fixed = scene.width_m or scene.height_m or scene.traffic_file or scene.city in ("braunschweig", "mesh")
    if fixed or case.flight.kind == "waypoints":
        return case
    seen = _footprints(*_sight(case))
    city = area_with_margin(scene.extent_m)
    if sum(one.difference(city).area for one in seen) <= MAX_BEYOND * sum(one.area for one in seen):
        return case
    west, south, east, north = shapely.total_bounds(np.array(seen))
    reach_m = max(-west, east), max(-south, north)
    sides = [min(max(2 * r, own), LARGEST_SIDE_M) for r, own in zip(reach_m, scene.size_m, strict=True)]
    scale = min(1.0, math.sqrt(LARGEST_M2 / math.prod(sides)))
    wide, high = (10.0 * math.ceil(scale * side / 10 - 1) for side in sides)
    return case.replace({"scene.width_m": wide, "scene.height_m": high})


def describe_window(case: Case) -> str:
    """Line on the window: whether it grows, which part of it is scored, and whether it needs SUMO."""
    fitted = fit_window(case)
    scene, name = fitted.scene, case.scene.city
    if scene.uses_mesh_window:
        return "window: that of the mesh"
    own, size = (" m × ".join(f"{side:,.0f}" for side in one.size_m) + " m" for one in (case.scene, scene))
    grown = f"to the ground in the frame, {size} (`scene.width_m` and `scene.height_m` fix it)"
    text = f"window: {size} of the city {name}"
    if fitted is not case:
        text = f"window: grows from {own} of the city {name} {grown}"
    if case.flight.kind != "waypoints":
        kind = scored_area(fitted, scene.extent_m, *_sight(case)).kind
        text += f". Vehicles in the {kind} are scored"
    if name != "embedded" or scene.traffic_file:
        return text
    if scene.uses_shipped_traffic:
        return f"{text}. Its traffic is recorded: SUMO is not needed"
    missing = "" if find_spec("sumo") else ", which is not installed: install the extra `traffic`"
    return f"{text}. Its traffic needs SUMO{missing}"


def _sight(case: Case) -> tuple[Camera, Flight]:
    """Camera and flight of a case without a lens or waypoints from files."""
    sensor = case.sensor
    size, distortion = (sensor.rows, sensor.columns), sensor.optics.distortion
    camera = Camera(sensor.focal_length_m, sensor.pitch_m, *size, distortion=distortion)
    return camera, Flight(case.flight, sun_direction(case.atmosphere)[1], seed=case.seed)


def _footprints(camera: Camera, flight: Flight) -> list[Polygon]:
    """Footprints of some frames of a flight on level ground at the stare point. [m]"""
    times_s, border, up_m = flight.times_s, frame_border(camera), float(flight.stare_point[2])
    chosen = times_s[np.unique(np.linspace(0, len(times_s) - 1, _SAMPLES).round().astype(int))]
    return [_hull(ground_points(camera, flight.pose(float(t)), border, up_m)) for t in chosen]


def _hull(places: Float[Array, "point axis"]) -> Polygon:
    """Convex hull of the places that are known; empty for fewer than three. [m]"""
    hull = MultiPoint(places[np.isfinite(places).all(axis=1), :2]).convex_hull
    return hull if isinstance(hull, Polygon) else Polygon()
