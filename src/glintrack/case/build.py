"""A case made real: its city, sun and sky, flight and sensor, and the observer that traces its frames."""

from dataclasses import dataclass
from functools import partial
from typing import Any

import xarray as xr

from glintrack.atmosphere import solve_tables, sun_direction
from glintrack.camera import Pose
from glintrack.case.design import Case
from glintrack.core.records import GroundPlace
from glintrack.flight import Flight, build_flight, check_recorded
from glintrack.ortho import ground_grid, rectify_array
from glintrack.render import Observer, Sky, unpack_sky
from glintrack.render.frame import FrameView, GroundGrid
from glintrack.render.observer import FrameRadiance
from glintrack.scene import City, build_scene
from glintrack.sensor import Sensor, SensorDesign, build_sensor, read_lens

_TIMING = ("frames", "rate_hz")  # of a flight: which times are asked for, not where it is then


@dataclass(frozen=True)
class Scenario:
    """What a case describes, built.

    Parameters
    ----------
    case
        The design.
    city, sky, flight, sensor
        What stands and drives, the light on it, where the aircraft is, what it carries.
    observer
        The sensor's camera over the city; its intersectors are built when first needed.
    """

    case: Case
    city: City
    sky: Sky
    flight: Flight
    sensor: Sensor
    observer: Observer


def decides_hits(case: Case) -> dict[str, Any]:
    """All of a case that decides what its rays meet at a time: cases that share it may share hits."""
    sensor, flight = case.sensor, case.flight
    return {
        "scene": case.scene.model_dump(mode="json"),
        "flight": flight.model_dump(mode="json", exclude=set(_TIMING)),
        "sun": sun_direction(case.atmosphere),
        "camera": [sensor.focal_length_mm, sensor.pitch_um, sensor.rows, sensor.columns],
        "rays": [sensor.oversampling, sensor.sun_samples],
        "distortion": _distortion(sensor),
        "jitter": [case.seed, flight.frames, flight.rate_hz] if flight.jitter_rms_urad else None,
    }


def _distortion(sensor: SensorDesign) -> dict:
    """What decides how the lens distorts: coefficients, or the prescription and what it is traced with."""
    optics = sensor.optics
    if not optics.lens:
        return optics.distortion.model_dump()
    return {"lens": read_lens(optics.lens).model_dump(mode="json"), "band_um": sensor.band_um}


def build_scenario(case: Case, like: Scenario | None = None) -> Scenario:
    """Build the city, atmosphere, flight and sensor of a case.

    Parameters
    ----------
    case
        The design.
    like
        Of another case: if that has the same scene, its city, intersectors and probes serve again.
    """
    if not isinstance(case, Case):
        raise TypeError(f"`case` must be a Case, got {case!r} (Case.from_toml reads one; run takes a name)")
    near = like if like is not None and like.case.scene == case.scene else None
    city = build_scene(case.scene) if near is None else near.city
    check_recorded(case.flight, city.duration_s)
    first = city.at(case.flight.start_s)
    tables = solve_tables(case.atmosphere)
    origin_m = (city.origin_easting_m, city.origin_northing_m)
    flight = build_flight(case.flight, float(tables.attrs["sun_azimuth_rad"]), city.crs, origin_m, case.seed)
    sky = unpack_sky(tables, flight.mean_altitude_m)
    sensor = build_sensor(case.sensor, sky.wavelength_um)
    looks = {
        "sky": sky,
        "camera": sensor.camera,
        "oversampling": case.sensor.oversampling,
        "sun_samples": case.sensor.sun_samples,
    }
    if near is None:
        observer = Observer(city=city, first=first, **looks)
    else:
        observer = near.observer.replace(**looks)
    return Scenario(case, city, sky, flight, sensor, observer)


def trace_frame(case: Case, frame: int = 0, ortho: bool = False, gsd_m: float | None = None) -> FrameView:
    """Build what a case describes and trace one of its frames.

    Parameters
    ----------
    case
        The design.
    frame
        Index of the frame, from 0.
    ortho
        Rectify what is asked of it.
    gsd_m
        Cell of the ground grid, instead of the case's. [m]

    Returns
    -------
    The frame: ``.radiance`` is what a sensor exposes, `render.frame.render_product` makes pictures and bands
    of it.

    Raises
    ------
    ValueError
        If the flight has no such frame, the scene is empty, or the lens lies below its ground.
    """
    if not 0 <= frame < case.flight.frames:
        raise ValueError(f"`--frame` must lie within the flight's 0 to {case.flight.frames - 1}, got {frame}")
    scenario = build_scenario(case)
    city, flight = scenario.city, scenario.flight
    time_s = float(flight.times_s[frame])
    pose, snapshot = flight.pose(time_s), city.at(time_s)
    if len(snapshot.static.faces) == 0 and len(snapshot.vehicle_id) == 0:
        raise ValueError("`scene` must hold at least one triangle, got none")
    _check_above_ground(pose, city.terrain)
    grid = _ground_grid(case, scenario, pose, gsd_m or case.ortho.gsd_m) if ortho else None
    observer = scenario.observer
    light = FrameRadiance(observer.trace(snapshot, pose), observer.sky, city.materials)
    return FrameView(observer, pose, light, frame, time_s, band_um=case.sensor.band_um, grid=grid)


def _check_above_ground(pose: Pose, terrain: xr.Dataset) -> None:
    height = terrain["height"].sel(x=pose.east_m, y=pose.north_m, method="nearest")
    if pose.up_m <= float(height):
        raise ValueError(
            f"`flight.altitude_m` must put the lens above the ground, at {float(height):g} m there, "
            f"got {pose.up_m:g} m"
        )


def _ground_grid(case: Case, scenario: Scenario, pose: Pose, gsd_m: float) -> GroundGrid:
    """The city's ground grid, and the rectification of a frame from a pose onto it."""
    city = scenario.city
    east, north = ground_grid(city.extent_m, gsd_m)
    west_m, _, _, north_m = city.extent_m
    place = GroundPlace(city.crs, west_m + city.origin_easting_m, north_m + city.origin_northing_m, gsd_m)
    rectify = partial(
        rectify_array,
        camera=scenario.sensor.camera,
        reported_pose=pose,
        terrain=city.terrain,
        gsd_m=float(gsd_m),
        area_m=city.extent_m,
        method=case.ortho.method,
        is_stokes=True,
    )
    return GroundGrid(len(north), len(east), place, rectify)
