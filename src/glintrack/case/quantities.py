"""Derived quantities of a case by closed forms: geometry, optics, light, motion, and cost of its simulation.

Geometry is that over level ground at the stare point: the ground sample distance across the line of sight is
pitch × slant range / focal length (Table 1 of the paper), along it that over the off-nadir angle's cosine.
Light on the ground is that of a clear sky by SPCTRAL2, seen through haze by Koschmieder's law.
"""

import math
import os
from typing import NamedTuple

import numpy as np
import pvlib
from jaxtyping import Float
from shapely import Polygon

from glintrack.atmosphere import is_solved, sun_direction
from glintrack.atmosphere.design import RAYLEIGH_EXTINCTION_550_PER_KM, SCALE_HEIGHT_M
from glintrack.camera import Camera, ground_points, project
from glintrack.case.area import MIN_COVERED, fit_window
from glintrack.case.design import Case
from glintrack.core.arrays import Array
from glintrack.core.spectral import quadrature_weights
from glintrack.core.units import format_duration
from glintrack.flight import Flight, FlightDesign
from glintrack.scene import City
from glintrack.sensor import image_motion, with_lens
from glintrack.sensor.exposure import FULL_SHARE
from glintrack.sensor.polarizer import load_polarizer
from glintrack.sensor.response import analyser_response, filtered_response, photon_gain
from glintrack.sensor.wavefront import modulation_transfer

CAR_M = (4.5, 1.8)
CITY_SPEED_M_S = 13.9  # 50 km/h, where the case's traffic is not known yet
MIN_HEADWAY_S = 0.7  # time gap of cars that follow each other closely
# reflectance in the panchromatic band (data/spectra): fresh paint and markings, worn asphalt, a blue car
WHITE, ROAD, CAR = 0.8, 0.22, 0.11
AIRLIGHT = 0.2  # reflectance of a surface as bright as deep haze: path radiance of the shipped atmospheres
ANGSTROM_EXPONENT = 1.14  # of SPCTRAL2's rural aerosol (Bird & Riordan 1986)
OZONE_CM = 0.344  # of the US standard atmosphere
RAYLEIGH_SCALE_HEIGHT_M = 8000.0
# processor time on one core, from flights of quickstart: imports, city and sky; an element of a frame with
# three channels; each of its rays; an element of a frame of the loss budget; a wavelength of an atmosphere
BUILD_S, SECONDS_PER_ELEMENT, SECONDS_PER_RAY, BUDGET_S_PER_ELEMENT = 9.0, 3e-6, 0.7e-6, 18e-6
SOLVE_S_PER_WAVELENGTH = 9.0
_BASE_BYTES, _BYTES_PER_ELEMENT, _BYTES_PER_RAY = 1.5e9, 720.0, 105.0  # peak memory of the same flights
_FWHM_MTF50 = 2 * math.log(2) / math.pi  # of a Gaussian: its full width at half maximum × half-MTF frequency
_BLUR_SAMPLES = 1001  # of the MTF curve, up to one cycle an element


def ground_view(case: Case) -> tuple[tuple[float, float], tuple[float, float]]:
    """Ground sample distance and field of view on flat ground at the stare point, across and along. [m]

    A flight along waypoints counts with the altitude and off-nadir angle of ``[flight]``.
    """
    sensor, off_nadir = case.sensor, math.radians(off_nadir_deg(case))
    slant_m = case.flight.altitude_m / math.cos(off_nadir)
    across_m = sensor.ifov_rad * slant_m
    along_m = across_m / math.cos(off_nadir)
    return (across_m, along_m), (sensor.columns * across_m, sensor.rows * along_m)


def off_nadir_deg(case: Case) -> float:
    """Angle of the line of sight from nadir at the first frame. [°]"""
    flight = case.flight
    return flight.off_nadir_deg if flight.gimbal == "stare" else 90 - flight.gimbal_depression_deg


def views(case: Case) -> dict[str, Case]:
    """Case with the off-nadir angle of its first, middle and last frame, by name.

    The case alone where that angle is one: on circles about the stare point, and for a fixed gimbal. That of
    a path along waypoints is not known without its file.
    """
    flight = case.flight
    if flight.gimbal != "stare" or flight.kind in ("orbit", "waypoints"):
        return {"": case}
    path, found = Flight(flight, sun_direction(case.atmosphere)[1]), {}
    for name, at in (("first", 0), ("middle", len(path.times_s) // 2), ("last", -1)):
        away_m = np.subtract(path.pose(float(path.times_s[at])).position, path.stare_point)
        angle_deg = math.degrees(math.atan2(math.hypot(*away_m[:2]), away_m[2]))
        changes = {"kind": "orbit", "off_nadir_deg": angle_deg}
        found[name] = case.model_copy(update={"flight": flight.model_copy(update=changes)})
    return found


def data_rate_mbit_s(case: Case) -> float:
    """Raw data rate of the detector array. [Mbit s⁻¹]"""
    sensor = case.sensor
    return 1e-6 * sensor.rows * sensor.columns * sensor.bits * case.flight.rate_hz


def view_quantities(case: Case) -> dict[str, float]:
    """Derive the sampling of ground and cars, and the footprint beside window and scored area. [m, 1, °]"""
    (across_m, along_m), (wide_m, high_m) = ground_view(case)
    found = {
        "gsd_across_m": across_m,
        "gsd_along_m": along_m,
        "elements_on_car": math.prod(CAR_M) / (across_m * along_m),
        "field_of_view_deg": max(case.sensor.field_of_view_deg),
        "footprint_across_m": wide_m,
        "footprint_along_m": high_m,
    }
    if case.scene.uses_mesh_window:
        return found
    scene = fit_window(case).scene
    east_m, north_m = scene.size_m
    scored_m2 = Polygon(scene.area).area if isinstance(scene.area, tuple) else east_m * north_m
    share = min(wide_m * high_m / scored_m2, 1.0)
    if scene.area != "footprint" and (scene.area is not None or share >= MIN_COVERED):
        found["footprint_share"] = share
    stare = (case.flight.stare_east_m, east_m), (case.flight.stare_north_m, north_m)
    beyond = [max(abs(place) - side / 2, 0.0) for place, side in stare]
    return found | {"beyond_window": math.hypot(*beyond) / (math.hypot(wide_m, high_m) / 2)}


def optics_quantities(case: Case) -> dict[str, float]:
    """Diffraction, blur and modulation transfer at the middle of the band. [element, element, 1]

    The Airy disc's diameter is 2.44 λN. The blur is the full width at half maximum of the Gaussian whose
    modulation transfer falls to one half at the same frequency as that of lens and element.
    """
    sensor = with_lens(case.sensor)
    wavelength_um = sum(sensor.band_um) / 2
    per_element = np.linspace(0, 1, _BLUR_SAMPLES)  # a fully open element has none at 1
    transfer = modulation_transfer(sensor, wavelength_um, 1e3 * per_element / sensor.pitch_um)
    first = max(int(np.argmax(transfer < 0.5)), 1)
    half = np.interp(-0.5, -transfer[first - 1 : first + 1], per_element[first - 1 : first + 1])
    return {
        "airy_elements": 2.44 * wavelength_um * sensor.f_number / sensor.pitch_um,
        "blur_elements": _FWHM_MTF50 / float(half),
        "mtf_nyquist": float(np.interp(0.5, per_element, transfer)),
    }


def ground_irradiance(case: Case, wavelength_um: Float[Array, "wavelength"]) -> Float[Array, "wavelength"]:
    """Irradiance of level ground under a case's sun and sky. [W m⁻² µm⁻¹]

    Below a cloud it is that of a clear sky times `AtmosphereDesign.cloud_transmittance`.

    References
    ----------
    Bird and Riordan, "Simple solar spectral model for direct and diffuse irradiance", J. Climate Appl.
    Meteor. 25, 87 (1986): SPCTRAL2, as in pvlib.
    """
    air = case.atmosphere
    zenith_deg = math.degrees(sun_direction(air)[0])
    found = pvlib.spectrum.spectrl2(
        apparent_zenith=zenith_deg,
        aoi=zenith_deg,
        surface_tilt=0,
        ground_albedo=0.15,
        surface_pressure=101325,
        relative_airmass=pvlib.atmosphere.get_relative_airmass(zenith_deg),
        precipitable_water=air.water_cm,
        ozone=OZONE_CM,
        aerosol_turbidity_500nm=air.aerosol_optical_depth_550 * (550 / 500) ** ANGSTROM_EXPONENT,
        dayofyear=air.date.timetuple().tm_yday,
    )
    cloud = air.cloud_transmittance(math.cos(math.radians(zenith_deg))) if air.cloud_optical_depth else 1.0
    return cloud * np.interp(wavelength_um, 1e-3 * found["wavelength"], 1e3 * np.ravel(found["poa_global"]))


def haze_transmittance(case: Case) -> float:
    """Transmittance of the air between the stare point and the lens at 0.55 µm, without gases. [1]"""
    height_m = case.flight.altitude_m
    aerosol = case.atmosphere.aerosol_optical_depth_550 * -math.expm1(-height_m / SCALE_HEIGHT_M)
    scale_m = RAYLEIGH_SCALE_HEIGHT_M
    rayleigh = RAYLEIGH_EXTINCTION_550_PER_KM * 1e-3 * scale_m * -math.expm1(-height_m / scale_m)
    return math.exp(-(aerosol + rayleigh) / math.cos(math.radians(off_nadir_deg(case))))


class ElementLight(NamedTuple):
    """Electrons of a white ground and of haze on an element, and well filling by white paint. [e, e, 1]"""

    white_e: float
    haze_e: float
    well_fill: float

    def electrons(self, reflectance: float) -> float:
        """Mean electrons of a ground of a reflectance, seen through the haze. [e]"""
        return self.white_e * reflectance + self.haze_e


def ground_light(case: Case) -> ElementLight:
    """Derive the electrons of the brightest element in the case's sun and haze, at the exposure in use."""
    sensor, um = case.sensor, np.asarray(case.atmosphere.wavelength_um)
    photons, light = quadrature_weights(um) * um, ground_irradiance(case, um)
    kinds = {what for row in sensor.superpixel for what in row if isinstance(what, str)}
    responses = [filtered_response(sensor, what, um) for what in kinds] or [
        analyser_response(sensor, load_polarizer(sensor), um)[0]
    ]
    response = max(responses, key=lambda one: float(photons @ (one * light)))
    weights = photons * response
    if not weights.sum() > 0:
        return ElementLight(0.0, 0.0, 0.0)
    radiance = float(weights @ light / weights.sum()) / math.pi  # of a white ground
    white_e = radiance * photon_gain(sensor, um, response)
    passed = haze_transmittance(case)
    haze_e = white_e * AIRLIGHT * (1 - passed)
    dark_e = 1e-3 * sensor.dark_current_e_per_s * sensor.integration_time_ms
    fill = (white_e * passed * WHITE + haze_e + dark_e) / sensor.saturation_e
    automatic, factor = sensor.auto_exposure, 1.0
    if automatic.quantile:  # the exposure that the light would lead to
        longest = automatic.longest_ms / sensor.integration_time_ms
        factor = min(FULL_SHARE / fill, longest)
    return ElementLight(factor * white_e * passed, factor * haze_e, factor * fill)


def light_quantities(case: Case) -> dict[str, float]:
    """Derive the filling of the well and signal-to-noise ratios in the case's sun and haze. [1]

    ``car_contrast`` is the mean contrast of a blue car to worn asphalt over the noise of that mean, over all
    elements on the car. Haze adds light, and so noise.
    """
    light = ground_light(case)
    if not light.well_fill > 0:
        return dict.fromkeys(("well_fill", "road_snr", "car_contrast"), 0.0)
    noise_e = float(np.sqrt(case.sensor.noise_variance_e2(light.electrons(ROAD))))
    elements = view_quantities(case)["elements_on_car"]
    return {
        "well_fill": light.well_fill,
        "road_snr": light.white_e * ROAD / noise_e,
        "car_contrast": light.white_e * (ROAD - CAR) / noise_e * math.sqrt(max(elements, 1.0)),
    }


def fastest_speed_m_s(city: City, flight: FlightDesign) -> float:
    """98th percentile of the speeds of a city's vehicles during a flight; `CITY_SPEED_M_S` without any."""
    times_s = flight.start_s + np.linspace(0, (flight.frames - 1) / flight.rate_hz, 5)
    rows = [city.truth(time_s) for time_s in times_s]
    speeds = np.concatenate([np.hypot(row["east_speed_m_s"], row["north_speed_m_s"]) for row in rows])
    return float(np.percentile(speeds, 98)) if speeds.size and speeds.max() > 0 else CITY_SPEED_M_S


def motion_quantities(case: Case, fastest_m_s: float = CITY_SPEED_M_S) -> dict[str, float]:
    """Blur by motion, overlap of frames, time in view, and traffic beside the tracker's limits.

    Parameters
    ----------
    case
        The design. Quantities of the platform's motion are left out for a path of waypoints.
    fastest_m_s
        Speed of its fastest vehicles. [m s⁻¹]
    """
    flight, exposure_s = case.flight, 1e-3 * case.sensor.integration_time_ms
    narrow_m, in_view_s = min(min(ground_view(one)[1]) for one in views(case).values()), math.inf
    found = {
        "vehicle_blur_m": fastest_m_s * exposure_s,
        "displacement_share": fastest_m_s / flight.rate_hz / (fastest_m_s * MIN_HEADWAY_S + CAR_M[0]),
        "speed_share": fastest_m_s / case.track.detect.max_speed_m_s,
        "duration_s": (flight.frames - 1) / flight.rate_hz,
    }
    if flight.kind != "waypoints":
        size = case.sensor.rows, case.sensor.columns
        camera = Camera(case.sensor.focal_length_m, case.sensor.pitch_m, *size)
        sun_azimuth = sun_direction(case.atmosphere)[1]
        path = Flight(flight, sun_azimuth, seed=case.seed)
        times_s = np.linspace(path.times_s[0], path.times_s[-1], 5)
        up_m = flight.stare_up_m
        paths = [image_motion(camera, path.pose, t, exposure_s, up_m, samples=9) for t in times_s]
        moved = [np.ptp(one, axis=0) * len(one) / (len(one) - 1) for one in paths]
        steady = Flight(flight.model_copy(update={"jitter_rms_urad": 0.0}), sun_azimuth)
        now, after = (steady.pose(times_s[2] + k / flight.rate_hz) for k in (0, 1))
        on_axis = ground_points(camera, now, camera.principal_point, flight.stare_up_m)
        step = np.abs(project(camera, after, on_axis) - camera.principal_point) / size  # of the array
        found["platform_blur_elements"] = float(np.hypot(*np.transpose(moved)).max())
        found["overlap"] = float(np.prod(np.maximum(1 - step, 0)))
        in_view_s = math.inf if step.max() < 1e-9 else float(1 / step.max() / flight.rate_hz)
        found["ground_dwell_s"] = in_view_s
    crossing_s = min(narrow_m / fastest_m_s, in_view_s)
    return found | {"vehicle_dwell_s": crossing_s, "vehicle_dwell_frames": crossing_s * flight.rate_hz}


def budget_cpu_s(case: Case) -> float:
    """Rough processor time of the loss budget of a whole flight. [s]"""
    every, elements = case.bound.every, case.sensor.rows * case.sensor.columns
    return BUDGET_S_PER_ELEMENT * elements * ((case.flight.frames - 1) // every if every else 0)


def estimate_cpu_s(case: Case) -> float:
    """Rough processor time of a whole flight, as a weight before any case has finished. [s]"""
    sensor = case.sensor
    frame_s = sensor.rows * sensor.columns * (SECONDS_PER_ELEMENT + SECONDS_PER_RAY * sensor.oversampling**2)
    return BUILD_S + frame_s * case.flight.frames + budget_cpu_s(case)


def cost_quantities(case: Case) -> dict[str, float]:
    """Rough wall time and share of this machine's memory, by rates of flights of quickstart. [s, 1]"""
    sensor = case.sensor
    cpu_s = estimate_cpu_s(case)
    if not is_solved(case.atmosphere):
        cpu_s += SOLVE_S_PER_WAVELENGTH * len(case.atmosphere.wavelength_um)
    found = {"run_s": cpu_s / (os.cpu_count() or 1)}
    per_element = _BYTES_PER_ELEMENT + _BYTES_PER_RAY * sensor.oversampling**2
    total = machine_memory_bytes()
    if total:
        found["memory_share"] = (_BASE_BYTES + per_element * sensor.rows * sensor.columns) / total
    return found


def describe_time(case: Case) -> str:
    """Line with the expected time of a run, and the share of it that the loss budget takes."""
    run_s, budget_s = cost_quantities(case)["run_s"], budget_cpu_s(case) / (os.cpu_count() or 1)
    share = f", of which the loss budget takes {100 * budget_s / run_s:.0f} % (`bound.every` = "
    share += f"{case.bound.every}; larger is faster, 0 leaves it out)"
    return f"expected time on this machine: {format_duration(run_s)}{share if budget_s else ''}"


def machine_memory_bytes() -> int | None:
    """Memory of this machine; None if not known. [byte]"""
    try:
        return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    except (AttributeError, ValueError, OSError):
        return None
