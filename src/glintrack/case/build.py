"""Build the scenario of a case: city, sun and sky, flight, sensor, and the observer that traces frames."""

import warnings
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from glintrack.atmosphere import AtmosphereDesign, solve_tables, sun_direction
from glintrack.case.area import ScoredArea, describe_window, fit_window, scored_area
from glintrack.case.design import Case
from glintrack.core.progress import step
from glintrack.core.records import Extent, GroundPlace
from glintrack.flight import Flight, build_flight, check_recorded
from glintrack.ortho import ground_grid, rectify_array
from glintrack.render import Observer, Sky, unpack_sky
from glintrack.render.frame import FrameView, GroundGrid
from glintrack.render.observer import FrameRadiance
from glintrack.scene import City, build_scene
from glintrack.sensor import Sensor, build_sensor, image_motion, read_lens


@dataclass(frozen=True)
class Scenario:
    """City, sky, flight and sensor of a case.

    Parameters
    ----------
    case
        The design, with the window that its footprint needs.
    city, sky, flight, sensor, area
        Built from the tables of the case; ``area`` is the one whose vehicles are scored.
    observer
        The sensor's camera over the city; its intersectors are built when first needed.
    """

    case: Case
    city: City
    sky: Sky
    flight: Flight
    sensor: Sensor
    observer: Observer
    area: ScoredArea


def decides_hits(case: Case) -> dict[str, Any]:
    """Values of a case that determine the hits of a frame at a given time; cases with the same share them."""
    sensor, flight, optics = case.sensor, case.flight, case.sensor.optics
    distortion = optics.distortion.model_dump()
    if optics.lens:
        distortion = {"lens": read_lens(optics.lens).model_dump(mode="json"), "band_um": sensor.band_um}
    return {
        "scene": fit_window(case).scene.model_dump(mode="json", exclude={"area"}),
        "flight": flight.model_dump(mode="json", exclude={"frames", "rate_hz"}),
        "sun": sun_direction(case.atmosphere),
        "camera": [sensor.focal_length_mm, sensor.pitch_um, sensor.rows, sensor.columns],
        "rays": [sensor.oversampling, sensor.sun_samples],
        "distortion": distortion,
        "jitter": [case.seed, flight.frames, flight.rate_hz] if flight.jitter_rms_urad else None,
    }


def build_scenario(case: Case) -> Scenario:
    """Build the city, atmosphere, flight and sensor of a case."""
    if not isinstance(case, Case):
        raise TypeError(f"`case` must be a Case; got {case!r}. Read one with Case.from_toml.")
    fitted = fit_window(case)
    if fitted is not case:
        warnings.warn(describe_window(case), stacklevel=2)
    case = fitted
    with step("building the city"):
        city = build_scene(case.scene)
    check_place(case.atmosphere, city)
    check_recorded(case.flight, city.duration_s)
    tables = solve_tables(case.atmosphere)
    origin_m = (city.origin_easting_m, city.origin_northing_m)
    design = case.flight
    if design.kind == "waypoints" and design.waypoint_datum_m is None:
        design = design.replace({"waypoint_datum_m": city.origin_height_m})
    flight = build_flight(design, float(tables.attrs["sun_azimuth_rad"]), city.crs, origin_m, case.seed)
    sky = unpack_sky(tables, flight.mean_altitude_m)
    sensor = build_sensor(case.sensor, sky.wavelength_um)
    observer = Observer(
        city=city,
        first=city.at(case.flight.start_s),
        sky=sky,
        camera=sensor.camera,
        oversampling=case.sensor.oversampling,
        sun_samples=case.sensor.sun_samples,
    )
    area = scored_area(case, Extent(*city.extent_m), sensor.camera, flight)
    return Scenario(case, city, sky, flight, sensor, observer, area=area)


def check_place(atmosphere: AtmosphereDesign, city: City) -> None:
    """Refuse a place of the sun that is not the city's: left out, or latitude and longitude exchanged."""
    own = np.array([atmosphere.latitude_deg, atmosphere.longitude_deg])
    there = np.array([city.latitude_deg, city.longitude_deg])
    near, exchanged = (np.abs(own - one).max() < 1.0 for one in (there, there[::-1]))  # within a degree
    if exchanged and not near and atmosphere.sun_zenith_deg is None:
        raise ValueError(
            f"`atmosphere.latitude_deg` and longitude_deg must be those of the city, {there[0]:.4g}° and "
            f"{there[1]:.4g}°; got {own[0]:.4g}° and {own[1]:.4g}°. Exchange them."
        )
    given = {"latitude_deg", "longitude_deg", "sun_zenith_deg"} & atmosphere.explicit_values().keys()
    if not near and not given:
        raise ValueError(
            "`atmosphere.latitude_deg` and longitude_deg must be given for a city at another place than the "
            f"packaged one; got none. This city lies at {there[0]:.4f}° and {there[1]:.4f}°. The sun depends "
            "on it."
        )


def trace_frame(case: Case, frame: int = 0, ortho: bool = False, gsd_m: float | None = None) -> FrameView:
    """Build the scenario of a case and trace one of its frames.

    Parameters
    ----------
    case
        The design.
    frame
        Index of the frame, from 0.
    ortho
        Rectify its products onto the ground grid.
    gsd_m
        Cell size of the ground grid, instead of the case's. [m]

    Returns
    -------
    The frame: ``.radiance`` is the light at the sensor; `render.frame.render_product` gives products of it.

    Raises
    ------
    ValueError
        If the flight has no such frame, the scene is empty, or the lens is below the ground.
    """
    if not 0 <= frame < case.flight.frames:
        raise ValueError(f"`--frame` must lie in the flight's 0 to {case.flight.frames - 1}; got {frame}.")
    scenario = build_scenario(case)
    city, flight, observer = scenario.city, scenario.flight, scenario.observer
    time_s = float(flight.times_s[frame])
    pose, snapshot = flight.pose(time_s), city.at(time_s)
    if len(snapshot.static.faces) == 0 and len(snapshot.vehicle_id) == 0:
        raise ValueError("`scene` must hold at least one triangle; got none.")
    ground_m = float(city.terrain["height"].sel(x=pose.east_m, y=pose.north_m, method="nearest"))
    if pose.up_m <= ground_m:
        raise ValueError(
            f"`flight.altitude_m` must put the lens above the ground, at {ground_m:g} m there; "
            f"got {pose.up_m:g} m."
        )
    grid = None
    if ortho:
        gsd_m = float(gsd_m or case.ortho.gsd_m)
        east, north = ground_grid(city.extent_m, gsd_m)
        west_m, _, _, north_m = city.extent_m
        place = GroundPlace(city.crs, west_m + city.origin_easting_m, north_m + city.origin_northing_m, gsd_m)
        rectify = partial(
            rectify_array,
            camera=scenario.sensor.camera,
            reported_pose=pose,
            terrain=city.terrain,
            gsd_m=gsd_m,
            area_m=city.extent_m,
            method=case.ortho.method,
            is_stokes=True,
        )
        grid = GroundGrid(len(north), len(east), place, rectify)
    light = FrameRadiance(observer.trace(snapshot, pose), observer.sky, city.materials)
    exposure_s = 1e-3 * case.sensor.integration_time_ms
    motion = image_motion(scenario.sensor.camera, flight.pose, time_s, exposure_s, flight.stare_point[2])
    return FrameView(
        observer,
        pose,
        radiance=light,
        frame=frame,
        time_s=time_s,
        band_um=case.sensor.band_um,
        motion=motion,
        grid=grid,
    )
